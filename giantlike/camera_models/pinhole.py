"""The pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, as_floats, require


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeModel:
    """Gnomonic projection with unequal focal lengths and shear.

    Parameters
    ----------
    fx_px, fy_px : float, px
        Focal lengths over pixel pitch, positive.
    cx_px, cy_px : float, px
        Principal point.
    skew_px : float, px
        Shear: x moves by ``skew_px`` per unit of y/z.

    Raises
    ------
    InputError
        A focal length is not positive or a value is not finite.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eqs. 5 and 8.
    .. [2] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, eqs. 1-3 (shear).
    """

    type_name: ClassVar[str] = "pinhole"
    parameter_names: ClassVar[tuple[str, ...]] = ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px")

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    skew_px: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            require(math.isfinite(value), f"camera model: {field.name} must be finite, got {value}")
        for name in ("fx_px", "fy_px"):
            require(
                getattr(self, name) > 0,
                f"camera model: {name} must be > 0, got {getattr(self, name)}; a mission model with a negative "
                "focal length is converted by turning the camera frame half a turn about the other axis",
            )

    @property
    def parameters(self) -> Float:
        """Parameter values (k,) in the order of ``parameter_names``."""
        return np.array([getattr(self, name) for name in self.parameter_names])

    def with_parameters(self, values: ArrayLike) -> Self:
        """Return the same model with other parameter values (k,)."""
        names = self.parameter_names
        numbers = as_finite(values, (len(names),), "camera model parameters")
        return type(self)(**dict(zip(names, numbers.tolist(), strict=True)))

    @property
    def focal_length_px(self) -> float:
        """Focal length along x, px."""
        return self.fx_px

    def project(self, points_camera: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in camera axes; NaN behind the camera."""
        return self._affine(_gnomonic(as_floats(points_camera, (3,), "points_camera")))

    def unproject(self, points_px: ArrayLike) -> Float:
        """Unit vectors (..., 3) in camera axes of pixels (..., 2)."""
        return _homogeneous_unit(self._affine_inverse(as_floats(points_px, (2,), "points_px")))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 3) of ``project`` with respect to the point."""
        points = as_floats(points_camera, (3,), "points_camera")
        result: Float = self._matrix() @ _gnomonic_jacobian(points)
        return result

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative (..., 3, 2) of ``unproject`` with respect to the pixel, 1/px."""
        plane = self._affine_inverse(as_floats(points_px, (2,), "points_px"))
        result: Float = _unit_jacobian(plane) @ np.linalg.inv(self._matrix())
        return result

    def parameter_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 5) of ``project`` with respect to the parameters."""
        return self._affine_parameter_jacobian(_gnomonic(as_floats(points_camera, (3,), "points_camera")))

    def _matrix(self) -> Float:
        return np.array([[self.fx_px, self.skew_px], [0.0, self.fy_px]])

    def _affine(self, plane: Float) -> Float:
        x, y = plane[..., 0], plane[..., 1]
        return np.stack([self.fx_px * x + self.skew_px * y + self.cx_px, self.fy_px * y + self.cy_px], axis=-1)

    def _affine_inverse(self, pixels: Float) -> Float:
        y = (pixels[..., 1] - self.cy_px) / self.fy_px
        return np.stack([(pixels[..., 0] - self.cx_px - self.skew_px * y) / self.fx_px, y], axis=-1)

    def _affine_parameter_jacobian(self, plane: Float) -> Float:
        """(..., 2, 5): fx, fy, cx, cy, skew, for distorted image-plane points (..., 2)."""
        x, y = plane[..., 0], plane[..., 1]
        zero, one = np.zeros_like(x), np.ones_like(x)
        return np.stack([np.stack([x, zero, one, zero, y], -1), np.stack([zero, y, zero, one, zero], -1)], axis=-2)


def _gnomonic(points: Float) -> Float:
    """Image-plane points (..., 2) of points (..., 3); NaN where z <= 0."""
    z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    result: Float = points[..., :2] / z[..., None]
    return result


def _gnomonic_jacobian(points: Float) -> Float:
    """(..., 2, 3) derivative of :func:`_gnomonic`."""
    x, y = points[..., 0], points[..., 1]
    z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    zero = np.zeros_like(z)
    return np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=-2)


def _homogeneous_unit(plane: Float) -> Float:
    """Unit vectors (..., 3) through image-plane points (..., 2)."""
    vectors = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
    result: Float = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result


def _unit_jacobian(plane: Float) -> Float:
    """(..., 3, 2) derivative of :func:`_homogeneous_unit`."""
    x, y = plane[..., 0], plane[..., 1]
    n = 1.0 + x**2 + y**2
    rows = [np.stack([1 + y**2, -x * y], -1), np.stack([-x * y, 1 + x**2], -1), np.stack([-x, -y], -1)]
    result: Float = np.stack(rows, axis=-2) / n[..., None, None] ** 1.5
    return result
