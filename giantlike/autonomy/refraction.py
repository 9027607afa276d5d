"""Refraction by the atmosphere, for cameras that look at the sky from the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number, unit
from giantlike.core.deprecation import forward_names

__getattr__ = forward_names(
    __name__, {__name__: "refracted:apply_refraction unrefracted:remove_refraction"}, until="0.4"
)

LOWEST_ELEVATION_RAD = math.radians(10.0)
"""Lowest elevation: ERFA's two constants are good to 0.1 arcsec above 15 degrees, some arcsec at 10 (refco.c)."""
_STEPS = 6  # of the inverse: each gains a factor of the refraction's slope, below 0.01 above the lowest elevation


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteAtmosphere:
    """Air at the camera."""

    pressure_hpa: float = 1013.25  # hPa; at the site, not reduced to sea level; 0: no atmosphere
    temperature_c: float = 15.0
    humidity: float = 0.5  # relative, 0 to 1
    wavelength_um: float = 0.55  # effective wavelength of camera and source

    def __post_init__(self) -> None:
        require_number(self.pressure_hpa, "pressure_hpa", least=0.0, most=1200.0)
        require_number(self.temperature_c, "temperature_c", least=-100.0, most=60.0)
        require_number(self.humidity, "humidity", least=0.0, most=1.0)
        require_number(self.wavelength_um, "wavelength_um", above=0.1, most=100.0)

    def constants_rad(self) -> tuple[float, float]:
        """Constants A and B of ``A tan z + B tan^3 z`` with the observed zenith distance z, rad."""
        import erfa  # slow to import

        a, b = erfa.refco(self.pressure_hpa, self.temperature_c, self.humidity, self.wavelength_um)
        return float(a), float(b)


def apply_refraction(directions: ArrayLike, zenith: ArrayLike, atmosphere: SiteAtmosphere) -> Float:
    """Raise directions (..., 3) toward the zenith (3,), in the same axes, as the atmosphere does.

    Source: ERFA (liberfa) refco.c: constants of the refraction, and their limits.
    """
    vectors, up, length, true = _zenith_distances(directions, zenith)
    a, b = atmosphere.constants_rad()
    seen = true
    for _ in range(_STEPS):
        tangent = np.tan(seen)
        seen = true - tangent * (a + b * tangent**2)
    return _set_zenith_distance(vectors, up, length, seen)


def remove_refraction(directions: ArrayLike, zenith: ArrayLike, atmosphere: SiteAtmosphere) -> Float:
    """Take refraction out of directions (..., 3) measured on the ground; zenith (3,) in the same axes."""
    vectors, up, length, seen = _zenith_distances(directions, zenith)
    a, b = atmosphere.constants_rad()
    tangent = np.tan(seen)
    return _set_zenith_distance(vectors, up, length, seen + tangent * (a + b * tangent**2))


def _zenith_distances(directions: ArrayLike, zenith: ArrayLike) -> tuple[Float, Float, Float, Float]:
    """Unit vectors, unit zenith, lengths and zenith distances."""
    vectors = as_floats(directions, (3,), "directions")
    up = unit(as_finite(zenith, (3,), "zenith"))
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    towards = vectors / length
    distance = np.arctan2(np.linalg.norm(np.cross(towards, up), axis=-1), towards @ up)
    lowest = float(np.pi / 2 - np.max(distance, initial=0.0))
    require(
        lowest >= LOWEST_ELEVATION_RAD,
        f"refraction needs elevations of {math.degrees(LOWEST_ELEVATION_RAD):.0f} degrees and more, got"
        f" {math.degrees(lowest):.2f}",
    )
    return towards, up, length, distance


def _set_zenith_distance(towards: Float, up: Float, length: Float, distance: Float) -> Float:
    """Vectors in the vertical planes of unit vectors, at other zenith distances."""
    across = towards - (towards @ up)[..., None] * up
    size = np.linalg.norm(across, axis=-1, keepdims=True)
    flat = across / np.where(size > 0.0, size, 1.0)
    return length * (np.cos(distance)[..., None] * up + np.sin(distance)[..., None] * flat)
