"""Base of lenses that distort the gnomonic image plane, and the region in which they can be inverted."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from giantlike.camera_models.affine import AffineModel
from giantlike.core.arrays import Float

Slopes = tuple[Float, Float, Float, Float]  # du/dx, du/dy, dv/dx, dv/dy of a map of the plane

MAX_NEWTON_STEPS = 40  # a few suffice inside; near the edge of the invertible region steps are halved
LAST_STEP = 1e-8  # relative step at which Newton's method stops; the error left is its square times a curvature
STEP_PER_ERROR = 1e-2  # least step per distance from the goal to stop: next to a pole, steps are short far from it
_AZIMUTHS = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)  # rad, every 5 degrees
_WIDEST_RAD = np.radians(89.9)  # largest angle from the axis at which folds are searched; at 90 degrees r is infinite


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneModel(AffineModel):
    """A camera whose lens moves the points of the gnomonic plane.

    It images points in front of it and inside :attr:`max_radius`: there the derivative of the distortion is
    positive definite, so that no two directions share a pixel. Beyond, points give NaN, and a pixel that only a
    folded-over branch of the polynomial reaches gives NaN too.

    A subclass supplies the distortion (``_distort``, ``_slopes``, ``_by_coefficient``) and the radius up to which its
    radial part grows (``_radial_limit``).
    """

    @property
    def max_radius(self) -> float:
        """Undistorted image-plane radius up to which the map is one to one (infinite if it always is)."""
        return _fold_radius(type(self), self.lens_coefficients)

    @abstractmethod
    def _distort(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Distorted coordinates of image-plane points."""

    @abstractmethod
    def _slopes(self, x: Float, y: Float) -> Slopes:
        """Derivative of :meth:`_distort`."""

    @abstractmethod
    def _by_coefficient(self, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        """Derivatives of both distorted coordinates with respect to each coefficient."""

    @abstractmethod
    def _radial_limit(self) -> float:
        """Radius up to which the radial part alone grows."""

    @abstractmethod
    def _is_radial(self) -> bool:
        """True if the distortion is the same at every azimuth."""

    def _plane(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        """Gnomonic coordinates; NaN behind the camera and beyond the fold."""
        inverse = 1.0 / np.where(z > 0, z, np.nan)
        x, y = x * inverse, y * inverse
        limit = self.max_radius
        if np.isfinite(limit):
            x = np.where(x * x + y * y <= limit * limit, x, np.nan)
        return x, y

    def _lens(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        u, v = self._distort(*self._plane(x, y, z))
        return u, v

    def _lens_inverse(self, u: Float, v: Float) -> tuple[Float, Float, Float]:
        x, y = self._undistort(u, v)
        z = 1.0 / np.sqrt(1.0 + x * x + y * y)
        return x * z, y * z, z

    def _lens_jacobian(self, x: Float, y: Float, z: Float) -> Float:
        px, py = self._plane(x, y, z)
        ux, uy, vx, vy = self._slopes(px, py)
        jacobian = np.array([[ux, uy, -(ux * px + uy * py)], [vx, vy, -(vx * px + vy * py)]])
        jacobian /= z
        return jacobian

    def _lens_by_parameter(self, x: Float, y: Float, z: Float) -> Float:
        along_x, along_y = self._by_coefficient(*self._plane(x, y, z))
        return np.array([along_x, along_y]).reshape(2, len(along_x), x.size)

    def _undistort(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Invert :meth:`_distort` by Newton's method from the radial profile; NaN where nothing inside maps there."""
        limit = self.max_radius
        start = _radial_start(self, np.hypot(u, v))
        x, y = u * start, v * start
        todo = np.arange(x.size)
        for _ in range(MAX_NEWTON_STEPS):
            at_x, at_y = x[todo], y[todo]
            near_x, near_y, error = self._newton(at_x, at_y, u[todo], v[todo])
            step = np.abs(near_x - at_x) + np.abs(near_y - at_y)
            radius = np.hypot(near_x, near_y)
            outside = radius > limit
            if outside.any():
                back = np.where(outside, 0.5 * (np.minimum(np.hypot(at_x, at_y), limit) + limit) / radius, 1.0)
                near_x, near_y = near_x * back, near_y * back
            x[todo], y[todo] = near_x, near_y
            moving = (np.maximum(step, STEP_PER_ERROR * error) > LAST_STEP * (1.0 + radius)) | outside
            todo = todo[moving]
            if not todo.size:
                break
        x[todo] = np.nan
        y[todo] = np.nan
        return x, y

    def _newton(self, x: Float, y: Float, u: Float, v: Float) -> tuple[Float, Float, Float]:
        """Next point of Newton's method, and the distance of the last one from its goal."""
        at_u, at_v = self._distort(x, y)
        ux, uy, vx, vy = self._slopes(x, y)
        inverse = 1.0 / (ux * vy - uy * vx)
        du, dv = at_u - u, at_v - v
        return x - (vy * du - uy * dv) * inverse, y - (ux * dv - vx * du) * inverse, np.abs(du) + np.abs(dv)


@lru_cache(maxsize=256)
def _fold_radius(kind: type[PlaneModel], coefficients: tuple[float, ...]) -> float:
    model = kind.unit_lens(coefficients)
    limit = model._radial_limit()
    if model._is_radial():
        return limit
    radii = np.tan(np.linspace(0.0, min(np.arctan(limit), _WIDEST_RAD), 150)[1:])
    below = 0.0
    for _ in range(3):  # each pass refines fiftyfold
        folded = ~(_least_slope(model, radii).min(axis=1) > 0)  # a pole of a rational lens is not finite
        if not folded.any():
            return limit if limit < radii[-1] * 1.001 else float("inf")
        first = int(np.argmax(folded))
        below = float(radii[first - 1]) if first else below
        radii = np.linspace(below, float(radii[first]), 50)[1:]
    return below


def _least_slope(model: PlaneModel, radii: Float) -> Float:
    """Smallest eigenvalue of the symmetric part of the derivative, at radii (n,) and all azimuths: (n, azimuths)."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ux, uy, vx, vy = model._slopes(radii[:, None] * np.cos(_AZIMUTHS), radii[:, None] * np.sin(_AZIMUTHS))
        result: Float = (ux + vy) / 2.0 - np.hypot((ux - vy) / 2.0, (uy + vx) / 2.0)
    return result


def _radial_start(model: PlaneModel, distorted: Float) -> Float:
    """Factor on distorted points that removes the mean of the distortion over azimuth."""
    mapped, radii = radial_table(type(model), model.lens_coefficients)
    return np.interp(distorted, mapped, radii) / np.where(distorted > 0, distorted, 1.0)


@lru_cache(maxsize=256)
def radial_table(kind: type[PlaneModel], coefficients: tuple[float, ...]) -> tuple[Float, Float]:
    """Distorted radii (256,) of a lens, averaged over azimuth, and the undistorted radii of them."""
    model = kind.unit_lens(coefficients)
    widest = min(np.arctan(model.max_radius), np.radians(80.0)) * (1.0 - 1e-6)  # short of a pole
    radii = np.tan(np.linspace(0.0, widest, 256))
    cosine, sine = np.cos(_AZIMUTHS[::9]), np.sin(_AZIMUTHS[::9])
    u, v = model._distort(radii[:, None] * cosine, radii[:, None] * sine)
    return np.mean(u * cosine + v * sine, axis=1), radii
