"""A lens that users might write: the fixed grid of geostationary imagers, on the documented protocol alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float


@dataclass(frozen=True)
class FixedGrid:
    """``x = cx + asin(X / |r|) / step``, ``y = cy + atan(Y / Z) / step``: angles are even, and no focal plane is."""

    type_name: ClassVar[str] = "fixed_grid"
    parameter_names: ClassVar[tuple[str, ...]] = ("step_rad", "cx_px", "cy_px")

    step_rad: float = 56e-6 * 5424 / 1024
    cx_px: float = 511.5
    cy_px: float = 511.5

    @property
    def parameters(self) -> Float:
        return np.array([self.step_rad, self.cx_px, self.cy_px])

    def with_parameters(self, values: ArrayLike) -> Self:
        step_rad, cx_px, cy_px = np.asarray(values, dtype=float).tolist()
        return replace(self, step_rad=step_rad, cx_px=cx_px, cy_px=cy_px)

    @property
    def focal_length_px(self) -> float:
        return 1.0 / self.step_rad

    def at_temperature(self, temperature_c: float) -> Self:
        return self

    def project(self, points_camera: ArrayLike) -> Float:
        return np.array([self.cx_px, self.cy_px]) + self._angles(points_camera) / self.step_rad

    def unproject(self, points_px: ArrayLike) -> Float:
        u, v = np.moveaxis((np.asarray(points_px, dtype=float) - [self.cx_px, self.cy_px]) * self.step_rad, -1, 0)
        return np.stack([np.sin(u), np.cos(u) * np.sin(v), np.cos(u) * np.cos(v)], axis=-1)

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        x, y, z = np.moveaxis(np.asarray(points_camera, dtype=float), -1, 0)
        flat2, zero = y**2 + z**2, np.zeros_like(x)
        length2, flat = x**2 + flat2, np.sqrt(flat2)
        by_x = np.stack([flat / length2, -x * y / (length2 * flat), -x * z / (length2 * flat)], axis=-1)
        by_y = np.stack([zero, z / flat2, -y / flat2], axis=-1)
        return np.stack([by_x, by_y], axis=-2) / self.step_rad

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        u, v = np.moveaxis((np.asarray(points_px, dtype=float) - [self.cx_px, self.cy_px]) * self.step_rad, -1, 0)
        by_u = np.stack([np.cos(u), -np.sin(u) * np.sin(v), -np.sin(u) * np.cos(v)], axis=-1)
        by_v = np.stack([np.zeros_like(u), np.cos(u) * np.cos(v), -np.cos(u) * np.sin(v)], axis=-1)
        return np.stack([by_u, by_v], axis=-1) * self.step_rad

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        by_step = -self._angles(points_camera) / self.step_rad**2
        one, zero = np.ones(by_step.shape[:-1]), np.zeros(by_step.shape[:-1])
        return np.stack([by_step, np.stack([one, zero], axis=-1), np.stack([zero, one], axis=-1)], axis=-1)

    def _angles(self, points_camera: ArrayLike) -> Float:
        """Angles (..., 2), rad; NaN behind the camera."""
        x, y, z = np.moveaxis(np.asarray(points_camera, dtype=float), -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            angles = np.stack([np.arcsin(x / np.sqrt(x**2 + y**2 + z**2)), np.arctan(y / z)], axis=-1)
        return np.where((z > 0.0)[..., None], angles, np.nan)
