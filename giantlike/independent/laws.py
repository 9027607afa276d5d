"""Reflectance laws as plain functions of the cosines of incidence and emission and of the phase angle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Law = Callable[[Float, Float, Float], Float]
"""Brightness of lit and visible points: (cos incidence, cos emission, cos phase), each (n,), to (n,); any scale."""

SMALLEST_COSINE = 1e-9
"""Cosine of emission below which a power of it is no longer evaluated: such points fill less than 1e-9 of any pixel."""


def lambert(cos_incidence: Float, cos_emission: Float, cos_phase: Float) -> Float:
    """Return ``mu0``: Lambert, Photometria (1760)."""
    return cos_incidence


def lommel_seeliger(cos_incidence: Float, cos_emission: Float, cos_phase: Float) -> Float:
    """Return ``2 mu0 / (mu0 + mu)``: Seeliger (1887), single scattering in a dark medium."""
    return 2.0 * cos_incidence / (cos_incidence + cos_emission)


def mcewen(cos_incidence: Float, cos_emission: Float, cos_phase: Float) -> Float:
    """Return ``A 2 mu0 / (mu0 + mu) + (1 - A) mu0``, ``A = exp(-phase / 60 deg)``: McEwen (1986), Nature 321, 563."""
    weight = np.exp(-np.degrees(np.arccos(np.clip(cos_phase, -1.0, 1.0))) / 60.0)
    return np.asarray(
        weight * 2.0 * cos_incidence / (cos_incidence + cos_emission) + (1.0 - weight) * cos_incidence, dtype=float
    )


def lunar_lambert(cos_incidence: Float, cos_emission: Float, cos_phase: Float) -> Float:
    """Return the lunar-Lambert law with the polynomial weight of McEwen (1996), LPSC 27, 841, for the Moon."""
    phase = np.degrees(np.arccos(np.clip(cos_phase, -1.0, 1.0)))
    weight = np.clip(1.0 - 0.019 * phase + 2.42e-4 * phase**2 - 1.46e-6 * phase**3, 0.0, 1.0)
    return np.asarray(
        weight * 2.0 * cos_incidence / (cos_incidence + cos_emission) + (1.0 - weight) * cos_incidence, dtype=float
    )


def minnaert(cos_incidence: Float, cos_emission: Float, cos_phase: Float, *, k: float = 0.7) -> Float:
    """Return ``mu0^k mu^(k - 1)``: Minnaert (1941), ApJ 93, 403; k = 0.7 lies between a flat disk and Lambert."""
    return np.asarray(cos_incidence**k * np.maximum(cos_emission, SMALLEST_COSINE) ** (k - 1.0), dtype=float)


def hapke(
    cos_incidence: Float,
    cos_emission: Float,
    cos_phase: Float,
    *,
    albedo: float = 0.21,
    surge: float = 1.0,
    surge_width: float = 0.06,
    asymmetry: float = -0.3,
) -> Float:
    """Return Hapke's law without roughness: Hapke (1981), JGR 86, 3039, with the surge of Hapke (1986).

    ``w / 4 mu0 / (mu0 + mu) ((1 + B(g)) P(g) + H(mu0) H(mu) - 1)``, P a Henyey-Greenstein function; the defaults are
    about those of the average S-type asteroid (Helfenstein & Veverka 1989, Asteroids II, 557).
    """
    phase = np.arccos(np.clip(cos_phase, -1.0, 1.0))
    opposition = surge / (1.0 + np.tan(0.5 * np.minimum(phase, np.pi - 1e-9)) / surge_width)
    particle = (1.0 - asymmetry**2) / (1.0 + 2.0 * asymmetry * cos_phase + asymmetry**2) ** 1.5
    root = np.sqrt(1.0 - albedo)
    multiple = (1.0 + 2.0 * cos_incidence) / (1.0 + 2.0 * root * cos_incidence)
    multiple = multiple * (1.0 + 2.0 * cos_emission) / (1.0 + 2.0 * root * cos_emission)
    scattered = (1.0 + opposition) * particle + multiple - 1.0
    return np.asarray(albedo * cos_incidence / (cos_incidence + cos_emission) * scattered, dtype=float)


LAWS: Mapping[str, Law] = MappingProxyType(
    {
        "lambert": lambert,
        "lommel_seeliger": lommel_seeliger,
        "mcewen": mcewen,
        "lunar_lambert": lunar_lambert,
        "minnaert": minnaert,
        "hapke": hapke,
    }
)
"""Laws by name."""
