"""The Brown-Conrady camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES
from giantlike.camera_models.polynomial import smallest_positive_root
from giantlike.camera_models.rational import RationalModel
from giantlike.core.arrays import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class BrownModel(RationalModel):
    """Pinhole with radial (k1-k3) and decentering (p1, p2) distortion of the image-plane point.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float
        See :class:`~giantlike.camera_models.affine.AffineModel`.
    k1, k2, k3 : float
        Radial coefficients of r^2, r^4, r^6, image-plane units.
    p1, p2 : float
        Decentering coefficients.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eqs. 5-8.
    """

    type_name: ClassVar[str] = "brown"
    parameter_names: ClassVar[tuple[str, ...]] = (*AFFINE_NAMES, "k1", "k2", "k3", "p1", "p2", *TEMPERATURE_NAMES)

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def _twelve(self) -> tuple[float, ...]:
        return (self.k1, self.k2, self.k3, 0.0, 0.0, 0.0, self.p1, self.p2, 0.0, 0.0, 0.0, 0.0)

    def _by_coefficient(self, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        r2 = x * x + y * y
        return (
            [r2 * x, r2**2 * x, r2**3 * x, 2 * x * y, r2 + 2 * x * x],
            [r2 * y, r2**2 * y, r2**3 * y, r2 + 2 * y * y, 2 * x * y],
        )

    def _radial_limit(self) -> float:
        return math.sqrt(smallest_positive_root(3 * self.k1, 5 * self.k2, 7 * self.k3))

    def _is_radial(self) -> bool:
        return self.p1 == 0.0 == self.p2
