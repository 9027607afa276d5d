"""Base of lenses that map the angle from their axis to a radius, and so can image more than a half space."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from giantlike.camera_models.affine import AffineModel
from giantlike.core.arrays import Float

_MAX_NEWTON_STEPS = 30  # a few suffice from a tabulated start; near the limit steps are halved
_LAST_STEP = 1e-7  # relative step at which Newton's method stops; the error left is its square, below float64 rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class AxialModel(AffineModel):
    """A camera whose lens maps the angle from its axis to a radius in the focal plane.

    It images directions up to :attr:`max_angle_rad`, which may exceed 90 degrees; points beyond give NaN, and so do
    pixels outside the radius of this angle. A subclass supplies the radius of an angle and the angle of a radius.
    """

    @property
    @abstractmethod
    def max_angle_rad(self) -> float:
        """Largest angle from the axis that is imaged, rad: where the radius stops growing, at most pi."""

    @abstractmethod
    def _radius(self, angle: Float) -> Float:
        """Focal-plane radius of angles; NaN beyond the largest."""

    @abstractmethod
    def _radius_slope(self, angle: Float, radius: Float) -> Float:
        """Derivative of :meth:`_radius`."""

    @abstractmethod
    def _radius_by_coefficient(self, angle: Float, radius: Float) -> list[Float]:
        """Derivative of :meth:`_radius` with respect to each coefficient."""

    @abstractmethod
    def _angle(self, radius: Float) -> Float:
        """Angle of focal-plane radii; NaN beyond the largest."""

    def _lens(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        cosine, sine, across = _azimuth(x, y)
        radius = self._radius(_angle_from_axis(across, z))
        return radius * cosine, radius * sine

    def _lens_inverse(self, u: Float, v: Float) -> tuple[Float, Float, Float]:
        cosine, sine, radius = _azimuth(u, v)
        angle = self._angle(radius)
        across = np.sin(angle)
        return across * cosine, across * sine, np.cos(angle)

    def _lens_jacobian(self, x: Float, y: Float, z: Float) -> Float:
        cosine, sine, across = _azimuth(x, y)
        angle = _angle_from_axis(across, z)
        radius = self._radius(angle)
        slope = self._radius_slope(angle, radius) / (across * across + z * z)
        around = np.where(across > 0, radius / np.where(across > 0, across, 1.0), 1.0 / z)
        excess = np.where(across > 0, slope * z - around, 0.0)
        cross, along_z = excess * cosine * sine, -slope * across
        return np.array(
            [
                [around + excess * cosine * cosine, cross, along_z * cosine],
                [cross, around + excess * sine * sine, along_z * sine],
            ]
        )

    def _lens_by_parameter(self, x: Float, y: Float, z: Float) -> Float:
        cosine, sine, across = _azimuth(x, y)
        angle = _angle_from_axis(across, z)
        radii = np.array(self._radius_by_coefficient(angle, self._radius(angle)))
        return np.array([radii * cosine, radii * sine])


def _azimuth(x: Float, y: Float) -> tuple[Float, Float, Float]:
    """Cosine and sine of the azimuth (zeros on the axis) and the distance from the axis."""
    across = np.sqrt(x * x + y * y)
    inverse = 1.0 / np.where(across == 0, np.inf, across)
    return x * inverse, y * inverse, across


def _angle_from_axis(across: Float, z: Float) -> Float:
    """Angle from the axis, rad; NaN straight behind, where the azimuth is undefined, and for the zero vector."""
    return np.where((across > 0) | (z > 0), np.arctan2(across, z), np.nan)


def solve_increasing(
    residual_and_slope: Callable[[Float, Float], tuple[Float, Float]], target: Float, start: Float, limit: float
) -> Float:
    """Solve for arguments in [0, limit] by Newton's method from a good start (n,); NaN where they are not inside."""
    result = start.copy()
    todo = np.arange(result.size)
    for _ in range(_MAX_NEWTON_STEPS):
        at = result[todo]
        residual, slope = residual_and_slope(at, target[todo])
        near = at - residual / slope
        outside = (near > limit) | (near < 0)
        near = np.where(near > limit, 0.5 * (at + limit), np.where(near < 0, 0.5 * at, near))
        result[todo] = near
        todo = todo[(np.abs(near - at) > _LAST_STEP * (1.0 + at)) | outside]
        if not todo.size:
            break
    result[todo] = np.nan
    return result
