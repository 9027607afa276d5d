"""Hapke's law: bidirectional reflectance of a regolith with opposition surge and macroscopic roughness."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float, require
from giantlike.ray_tracing.reflectance.law import SurfaceLaw, checked_number

_TINY = 1e-30  # keeps divisors that may be 0 positive; the numerator is then 0 as well
_SMALL = 1e-12  # least divisor of the effective cosines, see _roughened
_STEEP = 1e3  # largest cot(theta_bar) cot(angle): its exponentials are 0 in float64


@dataclass(frozen=True, slots=True, kw_only=True)
class Hapke(SurfaceLaw):
    """Hapke's law of 1981 with the shadow-hiding surge of 1986 and the roughness of 1984.

    ``w/4 m0/(m0 + m) ((1 + B) p - 1 + H(m0) H(m)) S``, over its value at normal incidence and emission and zero phase
    (surge and roughness in). Without roughness m0 and m are the cosines of incidence and emission, and S = 1.

    - p, two Henyey-Greenstein lobes of opposite direction: ``(1 - hg2) q(hg1) + hg2 q(-hg1)``,
      ``q(g) = (1 - g^2) / (1 + 2 g cos(phase) + g^2)^1.5``;
    - ``B = b0 / (1 + tan(phase / 2) / h)``;
    - H by Hapke's approximation of 1981, ``(1 + 2 x) / (1 + 2 x sqrt(1 - w))``: off Chandrasekhar's
      function by at most 0.4 % for w = 0.1, 2 % for 0.5 and 4 % for 0.95.

    Parameters
    ----------
    w : float; single-scattering albedo, in (0, 1]
    b0 : float; height of the opposition surge, >= 0; shadow hiding alone gives at most 1
    h : float; angular half width of the surge, as the tangent of half the phase angle; > 0 where b0 is
    theta_bar_deg : float, deg; mean slope of the relief below the resolution of the shape, in [0, 60]
    hg1 : float; asymmetry of the first lobe, in (-1, 1); negative scatters back to the Sun
    hg2 : float; fraction of the second lobe, in [0, 1]; by Hapke's later b, c ``hg1 = -b, hg2 = (1 - c) / 2``

    Notes
    -----
    Obeys Helmholtz reciprocity, with roughness too. Multiple scattering is isotropic, there is no coherent backscatter
    and no porosity factor. The roughness leaves out light between slopes and is meant for slopes well under 45 degrees;
    its effective cosines are not let fall below 0. Slopes that the shape itself shows must not be counted twice.

    The parameters equal Wh, B0, Hh, Theta, Hg1 and Hg2 of ISIS, whose values can be used; ISIS leaves the
    surge out of its scale.

    References
    ----------
    .. [1] USGS ISIS3, ``Hapke.cpp`` and ``Hapke.h``: the law as implemented here; same numbers.
    .. [2] M. Broz, xitau, ``hapke.f90``: the same roughness, there after Spjuth (2009) eqs. 2.36 to 2.41, with signs
       corrected after Hapke (1984).
    """

    type_name: ClassVar[str] = "hapke"

    w: float
    b0: float = 0.0
    h: float = 0.0
    theta_bar_deg: float = 0.0
    hg1: float = 0.0
    hg2: float = 0.0

    def __post_init__(self) -> None:
        checked_number("hapke", "w", self.w, "(0, 1]")
        checked_number("hapke", "b0", self.b0, "[0, inf)")
        checked_number("hapke", "h", self.h, "[0, inf)")
        checked_number("hapke", "theta_bar_deg", self.theta_bar_deg, "[0, 60]")
        checked_number("hapke", "hg1", self.hg1, "(-1, 1)")
        checked_number("hapke", "hg2", self.hg2, "[0, 1]")
        require(self.b0 == 0.0 or self.h > 0.0, f"reflectance hapke: b0 = {self.b0:g} needs h > 0, got {self.h:g}")

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        normal = np.ones(())
        return self._reflect(mu0, mu, phase_rad) / self._reflect(normal, normal, np.zeros(()))

    def _reflect(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """The law without the common factor w / 4."""
        cos_phase = np.cos(phase_rad)
        single = self._particle(cos_phase)
        if self.b0 > 0.0:
            across, along = np.sin(0.5 * phase_rad), np.cos(0.5 * phase_rad)
            single *= 1.0 + self.b0 * self.h * along / (self.h * along + across)
        if self.theta_bar_deg == 0.0:
            return mu0 / (mu0 + mu) * (single - 1.0 + self._multiple(mu0) * self._multiple(mu))
        slope = math.tan(math.radians(self.theta_bar_deg))
        low, high, shadowed = _roughen(np.minimum(mu0, mu), np.maximum(mu0, mu), cos_phase, slope)
        scattered = single - 1.0 + self._multiple(low) * self._multiple(high)
        return np.asarray(mu0 * shadowed * low * high / np.maximum(low + high, _TINY) * scattered)

    def _particle(self, cos_phase: Float) -> Float:
        """The phase function p of a single particle."""
        first = (1.0 - self.hg2) * _lobe(self.hg1, cos_phase)
        return first if self.hg2 == 0.0 else first + self.hg2 * _lobe(-self.hg1, cos_phase)

    def _multiple(self, cosine: Float) -> Float:
        """Hapke's approximation of 1981 to Chandrasekhar's H function."""
        return np.asarray((1.0 + 2.0 * cosine) / (1.0 + 2.0 * math.sqrt(1.0 - self.w) * cosine))


def _lobe(asymmetry: float, cos_phase: Float) -> Float:
    """Henyey and Greenstein's phase function."""
    base = 1.0 + asymmetry**2 + (2.0 * asymmetry) * cos_phase
    return np.asarray((1.0 - asymmetry**2) / (base * np.sqrt(base)))


def _roughen(low: Float, high: Float, cos_phase: Float, slope: float) -> tuple[Float, Float, Float]:
    """Effective cosines and the unshadowed fraction, Sun and camera sorted by height: symmetric but for mu0."""
    mean_cosine = 1.0 / math.sqrt(1.0 + math.pi * slope**2)
    low_sine, low_once, low_twice, low_alone = _tilt(low, slope)
    high_sine, high_once, high_twice, high_alone = _tilt(high, slope)
    sines = np.maximum(low_sine * high_sine, _TINY)
    cos_azimuth = np.clip((cos_phase - low * high) / sines, -1.0, 1.0)
    versine = 0.5 * (1.0 - cos_azimuth)
    hidden = np.exp(-2.0 * np.sqrt(versine / np.maximum(1.0 - versine, _TINY)))
    # The divisor goes to 0 where Sun and camera both graze from opposite sides, slower than its dividend.
    divisor = np.maximum(2.0 - low_once - np.arccos(cos_azimuth) / math.pi * high_once, _SMALL)
    low_rough = low + low_sine * slope * (low_twice - versine * high_twice) / divisor
    high_rough = high + high_sine * slope * (cos_azimuth * low_twice + versine * high_twice) / divisor
    unshadowed = 1.0 - hidden + hidden * high / high_alone
    factor = 1.0 / (mean_cosine * low_alone * high_alone * unshadowed)
    return mean_cosine * np.maximum(low_rough, 0.0), mean_cosine * np.maximum(high_rough, 0.0), factor


def _tilt(cosine: Float, slope: float) -> tuple[Float, Float, Float, Float]:
    """Sine of an angle, the two exponentials of its cotangent, and its effective cosine at azimuth 0 over the mean."""
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    steepness = np.minimum(cosine / np.maximum(slope * sine, _TINY), _STEEP)  # cot(theta_bar) cot(angle)
    once, twice = np.exp(steepness * (-2.0 / math.pi)), np.exp(steepness**2 * (-1.0 / math.pi))
    return sine, once, twice, cosine + sine * slope * twice / (2.0 - once)
