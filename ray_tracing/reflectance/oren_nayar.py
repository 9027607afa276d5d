"""The Oren-Nayar law of rough matt surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float
from giantlike.ray_tracing.reflectance.law import SurfaceLaw, checked_number


@dataclass(frozen=True, slots=True, kw_only=True)
class OrenNayar(SurfaceLaw):
    """Lambert facets in V-grooves with Gaussian slopes: the original qualitative model of Oren and Nayar.

    ``mu0 (A + B max(0, cos f) sin u tan v)`` over A, with f the azimuth between Sun and camera, u the larger and v the
    smaller of the angles of incidence and emission, ``A = 1 - 0.5 s^2 / (s^2 + 0.33)`` and
    ``B = 0.45 s^2 / (s^2 + 0.09)``.

    Parameters
    ----------
    sigma_deg : float, deg; standard deviation s of the slopes, in [0, 90]; 0 is Lambert

    Notes
    -----
    No azimuth is computed: ``cos f sin u tan v = (cos(phase) - mu0 mu) / max(mu0, mu)``, which is exact and has no
    singular point. The qualitative model leaves out light between the facets, has a kink where ``cos f`` changes sign
    and one at equal angles (dark rings on a sphere), and is meant for slopes to about 30 degrees. No phase function.

    Obeys Helmholtz reciprocity.

    References
    ----------
    .. [1] Wikipedia, "Oren-Nayar diffuse model": A, B and the law, there after Oren and Nayar (1994).
    .. [2] Y. Fujii, "A tiny improvement of Oren-Nayar reflectance model": the azimuth from dot products, and the limits
       of the qualitative form. His improvement is not used.
    """

    type_name: ClassVar[str] = "oren_nayar"

    sigma_deg: float

    def __post_init__(self) -> None:
        checked_number("oren_nayar", "sigma_deg", self.sigma_deg, "[0, 90]")

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        variance = math.radians(self.sigma_deg) ** 2
        level = 1.0 - 0.5 * variance / (variance + 0.33)
        groove = 0.45 * variance / (variance + 0.09) / level
        toward_sun = np.maximum(np.cos(phase_rad) - mu0 * mu, 0.0)
        return np.asarray(mu0 + groove * toward_sun * (mu0 / np.maximum(mu0, mu)))
