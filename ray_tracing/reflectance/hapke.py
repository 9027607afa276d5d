"""Hapke's law: bidirectional reflectance of a regolith with opposition surge and macroscopic roughness."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, require
from giantlike.ray_tracing.reflectance.law import SurfaceLaw, checked_number

_TINY = 1e-30
_SMALL = 1e-12


class _Tilt(NamedTuple):
    """What the slopes do to one of the two directions; index: incidence or emission."""

    cosine: Float
    sine: Float
    once: Float  # exp(-2 cot(theta) cot(angle) / pi)
    twice: Float  # exp(-cot(theta)^2 cot(angle)^2 / pi)
    alone: Float  # effective cosine at zero azimuth


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
    w : float
        Single-scattering albedo, in (0, 1].
    b0 : float
        Height of the opposition surge, >= 0; shadow hiding alone gives at most 1.
    h : float
        Angular half width of the surge, as the tangent of half the phase angle; > 0 where b0 is.
    theta_bar_deg : float, deg
        Mean slope of the relief below the resolution of the shape, in [0, 60].
    hg1 : float
        Asymmetry of the first lobe, in (-1, 1); negative scatters back to the Sun.
    hg2 : float
        Share of the second lobe, in [0, 1]. Hapke's later (b, c) are ``hg1 = -b, hg2 = (1 - c) / 2``.

    Notes
    -----
    Obeys Helmholtz reciprocity, with roughness too. Multiple scattering is isotropic, there is no coherent backscatter
    and no porosity factor. The roughness leaves out light between slopes and is meant for slopes well under 45 degrees;
    its effective cosines are not let fall below 0. Slopes that the shape itself shows must not be counted twice.

    The parameters mean what Wh, B0, Hh, Theta, Hg1 and Hg2 mean in ISIS, so that those can be used; ISIS leaves the
    surge out of its scale.

    References
    ----------
    .. [1] USGS ISIS3, ``Hapke.cpp`` and ``Hapke.h``: the law as implemented here, with roughness.
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
        checked_number("hapke", "w", self.w, low=0.0, high=1.0, open_low=True)
        checked_number("hapke", "b0", self.b0, low=0.0)
        checked_number("hapke", "h", self.h, low=0.0)
        checked_number("hapke", "theta_bar_deg", self.theta_bar_deg, low=0.0, high=60.0)
        checked_number("hapke", "hg1", self.hg1, low=-1.0, high=1.0, open_low=True, open_high=True)
        checked_number("hapke", "hg2", self.hg2, low=0.0, high=1.0)
        require(self.b0 == 0.0 or self.h > 0.0, f"reflectance hapke: b0 = {self.b0:g} needs h > 0, got {self.h:g}")

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """Return the law over its value at normal incidence and emission and zero phase."""
        normal = np.ones(())
        return self._reflected(mu0, mu, phase_rad) / self._reflected(normal, normal, np.zeros(()))

    def _reflected(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """The law without the common factor w / 4."""
        cos_phase = np.cos(phase_rad)
        single = self._particle(cos_phase)
        if self.b0 > 0.0:
            across, along = np.sin(0.5 * phase_rad), np.cos(0.5 * phase_rad)
            single *= 1.0 + self.b0 * self.h * along / (self.h * along + across)
        if self.theta_bar_deg == 0.0:
            return mu0 / (mu0 + mu) * (single - 1.0 + self._multiple(mu0) * self._multiple(mu))
        rough0, rough, shadowed = _roughened(mu0, mu, cos_phase, math.tan(math.radians(self.theta_bar_deg)))
        scattered = single - 1.0 + self._multiple(rough0) * self._multiple(rough)
        return rough0 / np.maximum(rough0 + rough, _TINY) * scattered * shadowed

    def _particle(self, cos_phase: Float) -> Float:
        """The phase function p of a single particle."""
        square, twice = self.hg1**2, 2.0 * self.hg1 * cos_phase
        first = (1.0 - self.hg2) * (1.0 - square) / (1.0 + square + twice) ** 1.5
        if self.hg2 == 0.0:
            return first
        result: Float = first + self.hg2 * (1.0 - square) / (1.0 + square - twice) ** 1.5
        return result

    def _multiple(self, cosine: Float) -> Float:
        """Hapke's approximation of 1981 to Chandrasekhar's H function."""
        result: Float = (1.0 + 2.0 * cosine) / (1.0 + 2.0 * math.sqrt(1.0 - self.w) * cosine)
        return result


def _roughened(mu0: Float, mu: Float, cos_phase: Float, tan_slope: float) -> tuple[Float, Float, Float]:
    """Effective cosines of incidence and emission, and the factor S that slopes and their shadows leave."""
    mean_cosine = 1.0 / math.sqrt(1.0 + math.pi * tan_slope**2)
    sun, camera = (_tilted(cosine, tan_slope, mean_cosine) for cosine in (mu0, mu))
    sines = sun.sine * camera.sine
    cos_azimuth = np.where(sines > 0.0, (cos_phase - mu0 * mu) / np.where(sines > 0.0, sines, 1.0), 1.0)
    cos_azimuth = np.clip(cos_azimuth, -1.0, 1.0)
    half_versine = 0.5 * (1.0 - cos_azimuth)
    hidden = np.exp(-2.0 * np.sqrt(half_versine / np.maximum(1.0 - half_versine, _TINY)))
    sun_higher = mu0 >= mu
    low, high = _sorted(sun, camera, sun_higher)
    # The divisor goes to 0 where Sun and camera both graze from opposite sides, slower than what it divides.
    weight = tan_slope / np.maximum(2.0 - low.once - np.arccos(cos_azimuth) / math.pi * high.once, _SMALL)
    low_cosine = low.cosine + low.sine * weight * (low.twice - half_versine * high.twice)
    high_cosine = high.cosine + high.sine * weight * (cos_azimuth * low.twice + half_versine * high.twice)
    low_cosine, high_cosine = (mean_cosine * np.maximum(cosine, 0.0) for cosine in (low_cosine, high_cosine))
    rough0, rough = (np.where(sun_higher, *pair) for pair in ((high_cosine, low_cosine), (low_cosine, high_cosine)))
    unshadowed = 1.0 - hidden + hidden * mean_cosine * high.cosine / high.alone
    return rough0, rough, rough / camera.alone * (mu0 / sun.alone) * mean_cosine / unshadowed


def _tilted(cosine: Float, tan_slope: float, mean_cosine: float) -> _Tilt:
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    steepness = cosine / np.maximum(tan_slope * sine, _TINY)  # cot(theta) cot(angle)
    once, twice = np.exp(steepness * (-2.0 / math.pi)), np.exp(np.minimum(steepness, 1e3) ** 2 * (-1.0 / math.pi))
    alone = mean_cosine * (cosine + sine * tan_slope * twice / (2.0 - once))
    return _Tilt(cosine, sine, once, twice, alone)


def _sorted(sun: _Tilt, camera: _Tilt, sun_higher: NDArray[np.bool_]) -> tuple[_Tilt, _Tilt]:
    """The lower and the higher of Sun and camera."""
    low = _Tilt(*(np.where(sun_higher, c, s) for s, c in zip(sun, camera, strict=True)))
    high = _Tilt(*(np.where(sun_higher, s, c) for s, c in zip(sun, camera, strict=True)))
    return low, high
