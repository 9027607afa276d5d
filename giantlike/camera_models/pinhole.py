"""The pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES
from giantlike.camera_models.plane import PlaneModel, Slopes
from giantlike.core.arrays import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeModel(PlaneModel):
    """Gnomonic projection with unequal focal lengths and shear, no distortion.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``

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
    parameter_names: ClassVar[tuple[str, ...]] = AFFINE_NAMES + TEMPERATURE_NAMES

    def _distort(self, x: Float, y: Float) -> tuple[Float, Float]:
        return x, y

    def _undistort(self, u: Float, v: Float) -> tuple[Float, Float]:
        return u, v

    def _slopes(self, x: Float, y: Float) -> Slopes:
        one, zero = np.ones_like(x), np.zeros_like(x)
        return one, zero, zero, one

    def _by_coefficient(self, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        return [], []

    def _radial_limit(self) -> float:
        return float("inf")

    def _is_radial(self) -> bool:
        return True
