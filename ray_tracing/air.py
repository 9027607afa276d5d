"""Air over a surface: extinction of the light of the ground, and sunlight scattered by the air.

Near the limb and the terminator rays pass through much air: the ground fades, and air is lit beyond the terminator, up
to where the shadow of the body stands as high as the air does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erfcx

from giantlike.core.arrays import Float, require_number
from giantlike.ray_tracing.reflectance.law import Reflectance, SurfaceLaw

_SENT = 0.5
"""Brightness of infinitely deep air relative to the ground, both at normal incidence: 1/8 by single scattering into all
directions alike, up to 3/16 by Rayleigh's phase function, over ground of the Earth's albedo, 0.3. A mixture
with :class:`Black` ground has any other."""
_REACH = 3.0
"""Largest depression of the Sun in units of ``sqrt(2 H / R)``: brightness is exp(-9) of the value at the terminator."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    r"""Air whose density falls exponentially, over a surface.

    A ray that leaves the ground under the angle of cosine c is at the altitude ``c s + s^2 / (2 R)`` after a length
    s, as long as that is much less than R. The integral of ``exp(-altitude / H) / H`` along it, the depth over the
    vertical one (Chapman's function of a thin layer), is ``sqrt(pi X / 2) erfcx(sqrt(X / 2) c)`` with ``X = R / H``;
    far from the horizon it is 1/c. Its inverse takes the place of the cosine here: positive at the horizon, falling as
    ``exp(-d^2 / (2 H / R))`` at the angle d below.
    """

    scale_height: float  # over the radius of the body
    optical_depth: float  # vertical

    def __post_init__(self) -> None:
        require_number(self.scale_height, "scale_height", above=0.0)
        require_number(self.optical_depth, "optical_depth", above=0.0)

    @property
    def least_cosine(self) -> float:
        """Cosine of incidence from which on air is lit; below zero, beyond the terminator."""
        return -_REACH * math.sqrt(2.0 * self.scale_height)

    def slant_cosine(self, cosine: ArrayLike) -> Float:
        """Inverse of the depth along a ray over the vertical one. ``cosine`` (...); returns (...)."""
        width = math.sqrt(2.0 * self.scale_height)
        steepness = np.maximum(np.asarray(cosine, dtype=np.float64) / width, -_REACH)
        return np.asarray(width / math.sqrt(math.pi) / erfcx(steepness))

    def brightness(
        self, ground: Reflectance, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike
    ) -> Float:
        """Brightness (...) of ground under the air, and of the air, in the unit of the law of the ground."""
        down, up = self.slant_cosine(cos_incidence), self.slant_cosine(cos_emission)
        through = np.exp(-self.optical_depth * (1.0 / down + 1.0 / up))
        sent = 2.0 * _SENT * down / (down + up) * (1.0 - through)
        return np.asarray(ground(cos_incidence, cos_emission, phase_rad) * through + sent)


@dataclass(frozen=True, slots=True)
class Black(SurfaceLaw):
    """A surface that sends no light: under air, only the air is bright."""

    type_name: ClassVar[str] = "black"

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        return np.zeros_like(mu0)
