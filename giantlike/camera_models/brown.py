"""The Brown-Conrady camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models.pinhole import (
    PinholeModel,
    _gnomonic,
    _gnomonic_jacobian,
    _homogeneous_unit,
    _unit_jacobian,
)
from giantlike.core.arrays import Float, as_floats

_MAX_NEWTON_STEPS = 30
_PLANE_TOLERANCE = 1e-14  # image-plane units: 1e-10 px for a focal length of 10,000 px


@dataclass(frozen=True, slots=True, kw_only=True)
class BrownModel(PinholeModel):
    """Pinhole with radial (k1-k3) and decentring (p1, p2) distortion of the image-plane point.

    Points beyond the radius where the radial polynomial stops growing give NaN: there the map folds
    over and a pixel no longer has one direction.

    Parameters
    ----------
    k1, k2, k3 : float
        Radial coefficients of r^2, r^4, r^6, image-plane units.
    p1, p2 : float
        Decentring coefficients.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eqs. 5-8.
    """

    type_name: ClassVar[str] = "brown"
    parameter_names: ClassVar[tuple[str, ...]] = (
        "fx_px", "fy_px", "cx_px", "cy_px", "skew_px", "k1", "k2", "k3", "p1", "p2",
    )  # fmt: skip

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def max_radius(self) -> float:
        """Undistorted image-plane radius up to which the radial map grows (infinite if it always does)."""
        return _fold_radius(self.k1, self.k2, self.k3)

    def project(self, points_camera: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in camera axes; NaN behind the camera or beyond the fold."""
        return self._affine(self._distort(self._valid(_gnomonic(as_floats(points_camera, (3,), "points_camera")))))

    def unproject(self, points_px: ArrayLike) -> Float:
        """Unit vectors (..., 3) in camera axes of pixels (..., 2); NaN where no direction maps there."""
        return _homogeneous_unit(self._undistort(self._affine_inverse(as_floats(points_px, (2,), "points_px"))))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 3) of ``project`` with respect to the point."""
        points = as_floats(points_camera, (3,), "points_camera")
        plane = self._valid(_gnomonic(points))
        result: Float = self._matrix() @ self._distort_jacobian(plane) @ _gnomonic_jacobian(points)
        return result

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative (..., 3, 2) of ``unproject`` with respect to the pixel, 1/px."""
        plane = self._undistort(self._affine_inverse(as_floats(points_px, (2,), "points_px")))
        result: Float = _unit_jacobian(plane) @ np.linalg.inv(self._matrix() @ self._distort_jacobian(plane))
        return result

    def parameter_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 10) of ``project`` with respect to the parameters."""
        plane = self._valid(_gnomonic(as_floats(points_camera, (3,), "points_camera")))
        x, y = plane[..., 0], plane[..., 1]
        r2 = x**2 + y**2
        by_distortion = np.stack(
            [
                np.stack([r2 * x, r2**2 * x, r2**3 * x, 2 * x * y, r2 + 2 * x**2], -1),
                np.stack([r2 * y, r2**2 * y, r2**3 * y, r2 + 2 * y**2, 2 * x * y], -1),
            ],
            axis=-2,
        )
        affine = self._affine_parameter_jacobian(self._distort(plane))
        return np.concatenate([affine, self._matrix() @ by_distortion], axis=-1)

    def _valid(self, plane: Float) -> Float:
        inside = np.sum(plane**2, axis=-1, keepdims=True) <= self.max_radius**2
        return np.where(inside, plane, np.nan)

    def _distort(self, plane: Float) -> Float:
        x, y = plane[..., 0], plane[..., 1]
        r2 = x**2 + y**2
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack(
            [
                radial * x + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x**2),
                radial * y + self.p1 * (r2 + 2 * y**2) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def _distort_jacobian(self, plane: Float) -> Float:
        """(..., 2, 2) derivative of :meth:`_distort`."""
        x, y = plane[..., 0], plane[..., 1]
        r2 = x**2 + y**2
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2.0 * (self.k1 + r2 * (2 * self.k2 + 3 * r2 * self.k3))  # d radial / d r2, times 2
        cross = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
        xx = radial + slope * x**2 + 2 * self.p1 * y + 6 * self.p2 * x
        yy = radial + slope * y**2 + 6 * self.p1 * y + 2 * self.p2 * x
        return np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], axis=-2)

    def _undistort(self, distorted: Float) -> Float:
        """Invert :meth:`_distort` by Newton's method; NaN where it does not converge inside the fold."""
        plane = distorted.copy()
        limit = self.max_radius
        for _ in range(_MAX_NEWTON_STEPS):
            radius = np.linalg.norm(plane, axis=-1, keepdims=True)
            with np.errstate(invalid="ignore", divide="ignore"):
                plane = np.where(radius > limit, plane * (0.9 * limit / radius), plane)
            error = self._distort(plane) - distorted
            step = _solve_symmetric(self._distort_jacobian(plane), error)
            plane = plane - step
            if not np.nanmax(np.abs(step), initial=0.0) > _PLANE_TOLERANCE:
                break
        error = np.abs(self._distort(plane) - distorted).max(axis=-1, keepdims=True)
        return np.where(
            error <= 1e-12 + 1e-12 * np.abs(distorted).max(axis=-1, keepdims=True), self._valid(plane), np.nan
        )


def _solve_symmetric(matrices: Float, vectors: Float) -> Float:
    """Solve symmetric 2 by 2 systems (..., 2, 2) for vectors (..., 2), in closed form."""
    a, b, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    u, v = vectors[..., 0], vectors[..., 1]
    determinant = a * d - b * b
    return np.stack([(d * u - b * v) / determinant, (a * v - b * u) / determinant], axis=-1)


@lru_cache(maxsize=64)
def _fold_radius(k1: float, k2: float, k3: float) -> float:
    """Smallest positive root of d/dr (r + k1 r^3 + k2 r^5 + k3 r^7), infinite when there is none."""
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])  # in r^2; np.roots drops leading zeros
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1e-300)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else float("inf")
