"""Laws of two or three cosines: Lambert, Lommel-Seeliger, the mixtures of both, Minnaert and Akimov.

``mu0`` and ``mu`` are the cosines of incidence and emission. Every law is 1 at normal incidence and emission and zero
phase, and obeys Helmholtz reciprocity: ``mu * law(mu0, mu)`` does not change when Sun and camera change places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float
from giantlike.ray_tracing.reflectance.law import SurfaceLaw, checked_number, checked_numbers

_SMALLEST_COSINE = 1e-10  # of the emission angle in Akimov's law: keeps the limb finite
_SMALLEST_PRODUCT = 1e-12  # of both cosines in Minnaert's law: keeps the limb finite
_SMALLEST_ANGLE_RAD = 1e-12  # rad, from the phase of pi, where Akimov's law has no limit
_LUNAR_WEIGHT = (1.0, -0.019, 2.42e-4, -1.46e-6)  # per power of a degree: see LunarLambert [1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lambert(SurfaceLaw):
    """Brightness by the cosine of incidence alone: ``mu0``.

    Notes
    -----
    Fits bright, matt surfaces; a dark regolith has a flatter disk at small phase.
    """

    type_name: ClassVar[str] = "lambert"

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        return mu0


@dataclass(frozen=True, slots=True, kw_only=True)
class LommelSeeliger(SurfaceLaw):
    """Single scattering in a dark half-space, without a phase function: ``2 mu0 / (mu0 + mu)``.

    Notes
    -----
    For dark bodies. At large phase it leaves the limb too bright: the disk brightens towards it.
    """

    type_name: ClassVar[str] = "lommel_seeliger"

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        return np.asarray(2.0 * mu0 / (mu0 + mu))


@dataclass(frozen=True, slots=True, kw_only=True)
class McEwen(SurfaceLaw):
    """Mixture of Lommel-Seeliger (at full phase) and Lambert (at large phase), with an exponential weight.

    ``A 2 mu0 / (mu0 + mu) + (1 - A) mu0`` with ``A = exp(-phase / phase_scale_deg)``.

    Parameters
    ----------
    phase_scale_deg : float, deg; phase angle at which the Lommel-Seeliger share has fallen to 1/e

    Notes
    -----
    The law of bodies unless another is chosen; campaign files promise this form. McEwen's own weight for the Moon is a
    polynomial: :class:`LunarLambert`.
    """

    type_name: ClassVar[str] = "mcewen"

    phase_scale_deg: float = 60.0

    def __post_init__(self) -> None:
        checked_number("mcewen", "phase_scale_deg", self.phase_scale_deg, "(0, inf)")

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        share = np.exp(phase_rad * (-1.0 / math.radians(self.phase_scale_deg)))
        return _mix_laws(mu0, mu, share)


@dataclass(frozen=True, slots=True, kw_only=True)
class LunarLambert(SurfaceLaw):
    """Mixture of Lommel-Seeliger and Lambert with a polynomial weight in the phase angle.

    ``L 2 mu0 / (mu0 + mu) + (1 - L) mu0`` with ``L = w0 + w1 a + w2 a^2 + ...``, ``a`` the phase angle in degrees, and
    ``L`` cut to [0, 1].

    Parameters
    ----------
    weight : tuple of float; ``w0, w1, ...`` per power of a degree; by default McEwen's for the Moon

    Notes
    -----
    The lunar polynomial falls from 1 at zero phase to 0 at 104 degrees; beyond, the cut makes the law Lambert's.

    References
    ----------
    .. [1] USGS ISIS3, ``LunarLambertMcEwen.cpp``: the law and the coefficients of the default.
    """

    type_name: ClassVar[str] = "lunar_lambert"

    weight: tuple[float, ...] = _LUNAR_WEIGHT

    def __post_init__(self) -> None:
        object.__setattr__(self, "weight", checked_numbers("lunar_lambert", "weight", self.weight))

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        share = np.polynomial.polynomial.polyval(np.degrees(phase_rad), self.weight)
        return _mix_laws(mu0, mu, np.clip(share, 0.0, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Minnaert(SurfaceLaw):
    """Power law of both cosines: ``mu0^k mu^(k - 1)``.

    Parameters
    ----------
    k : float; limb darkening at zero phase, in [0, 2]: 1 is Lambert, 0.5 a flat disk at full phase
    k_per_deg : float, 1/deg; growth of k with the phase angle; the sum is cut to [0, 2]

    Notes
    -----
    Empirical. For k < 1 the brightness grows without bound where the surface turns away from the camera, so single
    facets at a limb can outshine the disk; ``mu0 mu`` is not let fall below 1e-12, which keeps it finite.

    References
    ----------
    .. [1] VICAR, help of ``PHO_MINNAERT``: ``(mu0 mu)^k / mu``, and that it breaks down at the limb.
    """

    type_name: ClassVar[str] = "minnaert"

    k: float
    k_per_deg: float = 0.0

    def __post_init__(self) -> None:
        checked_number("minnaert", "k", self.k, "[0, 2]")
        checked_number("minnaert", "k_per_deg", self.k_per_deg)

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        k = np.clip(self.k + self.k_per_deg * np.degrees(phase_rad), 0.0, 2.0)
        return np.asarray(mu0 * np.maximum(mu0 * mu, _SMALLEST_PRODUCT) ** (k - 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Akimov(SurfaceLaw):
    """Akimov's disk function, without or with the parameter of the latitude dependence.

    With photometric latitude b and longitude l (both 0 below the camera, the Sun at b = 0, l = a), phase a and
    ``c = pi / (pi - a)``: ``cos(a / 2) cos(c (l - a / 2)) cos(b)^(eta a / (pi - a)) / cos(l)``.

    Parameters
    ----------
    eta : float; exponent of the darkening towards the photometric poles, >= 0: 1 is the parameter-free form

    Notes
    -----
    Made for the Moon: no limb darkening at full phase, and brightness falls smoothly to 0 at the terminator.
    It is the distribution over the disk only, without a phase function.

    References
    ----------
    .. [1] As implemented in public code for phase curves of disks (there after Shkuratov et al. 1999) and, with eta,
       for lunar photometry; the form is stated above.
    """

    type_name: ClassVar[str] = "akimov"

    eta: float = 1.0

    def __post_init__(self) -> None:
        checked_number("akimov", "eta", self.eta, "[0, inf)")

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        half = 0.5 * phase_rad
        total = mu0 + mu
        from_mirror = np.arctan2((mu0 - mu) * np.cos(half), total * np.sin(half))
        rest = np.maximum(np.pi - phase_rad, _SMALLEST_ANGLE_RAD)
        cos_mirror = np.cos(from_mirror)
        cos_half = np.maximum(np.cos(half), 0.5 * _SMALLEST_ANGLE_RAD)
        cos_latitude = np.minimum(0.5 * total / (cos_mirror * cos_half), 1.0)
        reach = np.minimum(np.abs(from_mirror) * (np.pi / rest), 0.5 * np.pi)
        darkening = cos_latitude ** (self.eta * phase_rad / rest)
        return np.asarray(np.cos(reach) / cos_mirror * (0.5 * total / np.maximum(mu, _SMALLEST_COSINE)) * darkening)


def _mix_laws(mu0: Float, mu: Float, share: Float) -> Float:
    """Lommel-Seeliger by ``share`` and Lambert for the rest; few temporary arrays, since renders call it most."""
    lommel_seeliger = 2.0 / (mu0 + mu)
    lommel_seeliger -= 1.0
    result: Float = share * lommel_seeliger
    result += 1.0
    result *= mu0
    return result
