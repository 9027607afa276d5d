"""Where stars appear: space motion, parallax and aberration."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from giantlike.catalogs.table import StarTable, julian_year
from giantlike.core.arrays import Float, as_finite, unit
from giantlike.core.frames import direction_from_radec
from giantlike.core.light import aberrate
from giantlike.core.units import AU_KM, RAD_PER_MAS, SECONDS_PER_JULIAN_YEAR, SPEED_OF_LIGHT_KM_S

_AU_PER_KM_YEAR = SECONDS_PER_JULIAN_YEAR / AU_KM  # one km/s for one year, in au


def apparent_directions(
    stars: StarTable,
    et: float,
    *,
    observer_position_km: ArrayLike | None = None,
    observer_velocity_km_s: ArrayLike | None = None,
) -> Float:
    """Unit vectors to stars as an observer sees them.

    Stars move in straight lines at constant speed. The observer's distance from the solar system barycentre
    gives parallax and the light time across it (Roemer delay); its velocity gives relativistic aberration.
    Light bending by the Sun and planets is left out: 1.8 arcsec at the Sun's limb, 0.004 at 90 degrees from it.

    Parameters
    ----------
    stars : StarTable
    et : float, s
        TDB seconds past J2000.
    observer_position_km : (3,) float64, km, inertial, optional
        With respect to the solar system barycentre; without it no parallax.
    observer_velocity_km_s : (3,) float64, km/s, inertial, optional
        With respect to the solar system barycentre; without it no aberration.

    Returns
    -------
    (n, 3) float64, unitless, inertial (ICRF)

    Raises
    ------
    InputError
        A vector has a wrong shape or is not finite, or the speed is not below that of light.
    """
    radial = direction_from_radec(stars.ra_deg, stars.dec_deg)
    years = julian_year(et) - stars.epoch_jyear
    parallax = stars.parallax_mas * RAD_PER_MAS
    position_au = np.zeros(3)
    if observer_position_km is not None:
        position_au = as_finite(observer_position_km, (3,), "observer_position_km") / AU_KM
        years = years + (radial @ position_au) * (AU_KM / SPEED_OF_LIGHT_KM_S / SECONDS_PER_JULIAN_YEAR)
    east, north = tangent_axes(stars)
    motion = stars.pm_ra_mas_yr[:, None] * east + stars.pm_dec_mas_yr[:, None] * north
    recession = stars.radial_velocity_km_s * _AU_PER_KM_YEAR * parallax  # per year, in units of the distance
    directions = (
        radial * (1.0 + recession * years)[:, None]
        + motion * (RAD_PER_MAS * years)[:, None]
        - parallax[:, None] * position_au
    )
    directions = unit(directions)
    if observer_velocity_km_s is not None:
        directions = aberrate(directions, observer_velocity_km_s)
    return directions


def tangent_axes(stars: StarTable) -> tuple[Float, Float]:
    """Unit vectors east and north (n, 3) each, inertial, at the catalogue positions."""
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], axis=-1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=-1)
    return east, north
