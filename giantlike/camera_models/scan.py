"""Scanning imagers on a fixed grid of two scan angles, as full disks of geostationary satellites are resampled to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES, AffineModel
from giantlike.core.arrays import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepXModel(AffineModel):
    """Scan angles of a gimbal that sweeps about the axis of columns: ``sin u = X / |r|`` and ``tan v = Y / Z``.

    The fixed grid of GOES ABI, PROJ's ``+sweep=x``.

    Parameters
    ----------
    fx_px, fy_px : float, px; pixels per radian of the scan angles
    cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``

    References
    ----------
    .. [1] NOAA STAR, GOES Imager Projection (ABI Fixed Grid), star.nesdis.noaa.gov/atmospheric-composition-training.
    """

    type_name: ClassVar[str] = "sweep_x"
    parameter_names: ClassVar[tuple[str, ...]] = AFFINE_NAMES + TEMPERATURE_NAMES

    def _lens(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        u, v = np.arctan2(x, np.hypot(y, z)), np.arctan2(y, z)
        seen = z > 0.0
        return np.where(seen, u, np.nan), np.where(seen, v, np.nan)

    def _lens_inverse(self, u: Float, v: Float) -> tuple[Float, Float, Float]:
        seen = np.maximum(np.abs(u), np.abs(v)) < math.pi / 2.0
        cosine = np.where(seen, np.cos(u), np.nan)
        return np.where(seen, np.sin(u), np.nan), cosine * np.sin(v), cosine * np.cos(v)

    def _lens_jacobian(self, x: Float, y: Float, z: Float) -> Float:
        across2 = y * y + z * z
        across, range2 = np.sqrt(across2), x * x + across2
        u = np.stack([across / range2, -x * y / (across * range2), -x * z / (across * range2)])
        v = np.stack([np.zeros_like(x), z / across2, -y / across2])
        return np.where(z > 0.0, np.stack([u, v]), np.nan)

    def _lens_by_parameter(self, x: Float, y: Float, z: Float) -> Float:
        return np.empty((2, 0, x.size))


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepYModel(SweepXModel):
    """Scan angles of a gimbal that sweeps about the axis of rows: ``tan u = X / Z`` and ``sin v = Y / |r|``.

    The normalized geostationary projection, PROJ's ``+sweep=y``: Himawari AHI, MTSAT, Meteosat. Parameters are those of
    :class:`SweepXModel`.

    References
    ----------
    .. [1] JMA, Himawari-8/9 Himawari Standard Data User's Guide, section 3.
    """

    type_name: ClassVar[str] = "sweep_y"

    def _lens(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        v, u = SweepXModel._lens(self, y, x, z)
        return u, v

    def _lens_inverse(self, u: Float, v: Float) -> tuple[Float, Float, Float]:
        y, x, z = SweepXModel._lens_inverse(self, v, u)
        return x, y, z

    def _lens_jacobian(self, x: Float, y: Float, z: Float) -> Float:
        return SweepXModel._lens_jacobian(self, y, x, z)[::-1][:, [1, 0, 2]]
