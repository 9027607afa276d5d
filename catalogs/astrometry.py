"""Apparent directions of stars: space motion, parallax, light deflection and aberration."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from giantlike.catalogs.table import StarTable, julian_year
from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.core.frames import direction_from_radec, east_north
from giantlike.core.light import aberrate
from giantlike.core.units import (
    AU_KM,
    J2000_JD,
    RAD_PER_ARCSEC,
    RAD_PER_MAS,
    SECONDS_PER_DAY,
    SECONDS_PER_JULIAN_YEAR,
    SPEED_OF_LIGHT_KM_S,
)

SUN_SCHWARZSCHILD_AU = 1.97412574336e-8
"""2 G M / c^2 of the Sun, in au: the value that ERFA uses (``ERFA_SRS`` in erfam.h)."""
_LIGHT_YEARS_PER_AU = AU_KM / SPEED_OF_LIGHT_KM_S / SECONDS_PER_JULIAN_YEAR
_SMALLEST_PARALLAX_RAD = 5e-7 * RAD_PER_ARCSEC  # used for stars of unknown distance, as ERFA's pmsafe does (PXMIN)
_SLOWEST_PARALLAX = 326.0 * RAD_PER_ARCSEC  # over proper motion per year: more would be 1 % of the speed of light
_ITERATIONS = 20  # the slowest, a radial velocity of a third of light's, gains half a digit in each


def apparent_directions(
    stars: StarTable,
    et: float,
    *,
    observer_position_km: ArrayLike | None = None,
    observer_velocity_km_s: ArrayLike | None = None,
    light_deflection: bool = False,
) -> Float:
    """Unit vectors to stars as an observer sees them.

    Stars move in straight lines at constant speed, radial motion included. Light time is from the star's
    distance at either epoch and across the observer's place (Roemer delay). The observer's distance from the solar
    system barycenter gives parallax; its velocity gives relativistic aberration. Light deflection by the Sun is
    neglected by default: 1.75 arcsec at the limb of the Sun, 0.0041 at 90 degrees from it, from 1 au.

    Parameters
    ----------
    stars : StarTable
    et : float, s; TDB seconds past J2000
    observer_position_km : (3,) float64, km, inertial, optional; barycentric; without it no parallax
    observer_velocity_km_s : (3,) float64, km/s, inertial, optional; barycentric; without it no aberration
    light_deflection : bool; bend light in the field of the Sun

    Returns
    -------
    (n, 3) float64, unitless, inertial (ICRF)

    Raises
    ------
    InputError
        A vector has a wrong shape or is not finite, the speed is not below the speed of light, or light deflection is
        requested without a position.

    Notes
    -----
    Orbits of double stars are not followed: alpha Centauri A and B move as if each were alone.

    A catalog gives motions as they are seen: the time between two events on an approaching star appears shortened.
    They become true velocities as in ERFA's ``starpv``, the star moves between the two times of emission as in
    ``starpm``, and parallaxes that would make a star faster than 1 % of light are treated as in ``pmsafe`` [1]_, so
    that all three agree. A straight line without these terms is in error by 4 mas in a century for Barnard's star.

    References
    ----------
    .. [1] ERFA (liberfa) starpv.c, starpm.c, pmsafe.c, which follow Stumpff (1985), A&A 144, 232.
    """
    place = np.zeros(3) if observer_position_km is None else observer_position_km
    position_au = as_finite(place, (3,), "observer_position_km") / AU_KM
    directions = unit(_positions(stars, julian_year(et) - stars.epoch_jyear, position_au))
    if light_deflection:
        require(observer_position_km is not None, "light deflection needs observer_position_km")
        directions = deflect_light(directions, position_au * AU_KM - sun_position_km(et))
    if observer_velocity_km_s is not None:
        directions = aberrate(directions, observer_velocity_km_s)
    return directions


def deflect_light(directions: Float, from_sun_km: ArrayLike) -> Float:
    """Bend the light of stars, unit vectors (n, 3), in the field of the Sun.

    Source: ERFA (liberfa) ld.c and ldsun.c: formula for a deflector at rest, and the limit behind the Sun.
    """
    position_au = as_finite(from_sun_km, (3,), "from_sun_km") / AU_KM
    distance_au = float(np.linalg.norm(position_au))
    require(distance_au > 0.0, "light deflection has no meaning for an observer in the center of the Sun")
    e = position_au / distance_au
    limit = 1e-6 / max(distance_au**2, 1.0)
    along = directions @ e
    weight = SUN_SCHWARZSCHILD_AU / distance_au / np.maximum(1.0 + along, limit)
    return unit(directions + weight[:, None] * (e - along[:, None] * directions))


def sun_position_km(et: float) -> Float:
    """Position (3,), ICRF, of the Sun from the solar system barycenter, by ERFA's ``epv00``: good to tens of km."""
    import erfa

    heliocentric, barycentric = erfa.epv00(J2000_JD, et / SECONDS_PER_DAY)  # of the Earth
    return np.asarray((barycentric["p"] - heliocentric["p"]) * AU_KM, dtype=np.float64)


def _positions(stars: StarTable, years: Float, position_au: Float) -> Float:
    """Vectors (n, 3) from the observer to the stars, in units of each star's distance at its catalog epoch."""
    radial = direction_from_radec(stars.ra_deg, stars.dec_deg)
    east, north = east_north(stars.ra_deg, stars.dec_deg)
    seen = (stars.pm_ra_mas_yr[:, None] * east + stars.pm_dec_mas_yr[:, None] * north) * RAD_PER_MAS
    pace = np.hypot(stars.pm_ra_mas_yr, stars.pm_dec_mas_yr) * RAD_PER_MAS
    parallax = stars.parallax_mas * RAD_PER_MAS
    near = np.maximum(np.maximum(parallax, pace * _SLOWEST_PARALLAX), _SMALLEST_PARALLAX_RAD)
    light_years = _LIGHT_YEARS_PER_AU / near
    stretch, recession = _true_motion(stars.radial_velocity_km_s / SPEED_OF_LIGHT_KM_S, pace * light_years)
    velocity = (stretch[:, None] * seen) + (recession / light_years)[:, None] * radial  # per year
    offset = parallax[:, None] * position_au
    start = radial - offset + velocity * (years + light_years)[:, None]
    away = np.sum(start * velocity, axis=-1)
    slowness = 1.0 / light_years**2 - np.sum(velocity**2, axis=-1)
    light_time = (np.sqrt(away**2 + slowness * np.sum(start**2, axis=-1)) - away) / slowness
    return np.asarray(start - velocity * light_time[:, None])


def _true_motion(radial_seen: Float, across_seen: Float) -> tuple[Float, Float]:
    """True motion of stars (n,): stretch of the proper motion, and radial velocity in units of light's speed."""
    stretch, radial = np.ones_like(radial_seen), radial_seen
    for _ in range(_ITERATIONS):
        across = stretch * across_seen
        lag = np.sqrt(np.maximum(1.0 - radial**2 - across**2, 0.0)) - 1.0
        before = radial
        radial = stretch * radial_seen + lag
        stretch = 1.0 + radial
        if np.array_equal(before, radial):
            break
    return stretch, radial
