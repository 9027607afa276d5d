"""Where stars appear: space motion, parallax, light deflection, aberration, beside astropy and ERFA."""

from __future__ import annotations

from dataclasses import replace

import erfa
import numpy as np
import pytest
from astropy import units
from astropy.coordinates import Distance, SkyCoord
from astropy.time import Time

from giantlike.catalogs import StarTable, apparent_directions
from giantlike.catalogs.astrometry import deflect_light, sun_position_km
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec
from giantlike.core.light import aberrate
from giantlike.core.units import AU_KM, RAD_PER_MAS, SPEED_OF_LIGHT_KM_S
from tests.tolerances import FLOAT64_SUM

PLACE_MAS = 1.0
ERFA_RAD = 1e-12  # rounding; ERFA leaves out terms of that order
SPACE_MOTION_MAS = 0.01  # rounding and the last digits of the astronomical unit over 116 years


def moved_by_astropy(stars: StarTable, year: float) -> Float:
    """Directions (n, 3) that astropy gives; stars of one call may have different epochs."""
    directions = np.empty((len(stars), 3))
    for epoch in np.unique(stars.epoch_jyear):
        some = stars.epoch_jyear == epoch
        part = stars.select(some)
        sky = SkyCoord(
            ra=part.ra_deg * units.deg,
            dec=part.dec_deg * units.deg,
            pm_ra_cosdec=part.pm_ra_mas_yr * units.mas / units.yr,
            pm_dec=part.pm_dec_mas_yr * units.mas / units.yr,
            distance=Distance(parallax=part.parallax_mas * units.mas),
            radial_velocity=part.radial_velocity_km_s * units.km / units.s,
            obstime=Time(epoch, format="jyear", scale="tdb"),
        )
        moved = sky.apply_space_motion(new_obstime=Time(year, format="jyear", scale="tdb"))
        directions[some] = direction_from_radec(moved.ra.deg, moved.dec.deg)
    return directions


def _stars(rng: np.random.Generator, n: int) -> StarTable:
    return StarTable(
        ids=np.arange(n),
        ra_deg=rng.uniform(0, 360, n),
        dec_deg=np.degrees(np.arcsin(rng.uniform(-1, 1, n))),
        pm_ra_mas_yr=rng.normal(0, 3000, n),
        pm_dec_mas_yr=rng.normal(0, 3000, n),
        parallax_mas=rng.uniform(40, 700, n),  # ERFA warns of stars faster than 1 % of light
        radial_velocity_km_s=rng.normal(0, 100, n),
        epoch_jyear=np.full(n, 2016.0),
        magnitude=np.zeros(n),
        color_bv=np.zeros(n),
        sigma_mas=np.full(n, 3.0),
        sigma_pm_mas_yr=np.full(n, 0.4),
    )


@pytest.mark.parametrize("year", [1900.0, 1991.25, 2016.0, 2100.0])
def test_space_motion_agrees_with_astropy(year: float) -> None:
    stars = _stars(np.random.default_rng(1), 40)
    expected = moved_by_astropy(stars, year)
    distance = np.linalg.norm(apparent_directions(stars, et_of_julian_year(year)) - expected, axis=1)
    assert distance.max() < SPACE_MOTION_MAS * RAD_PER_MAS


def test_stars_of_unknown_distance_move_as_in_erfa() -> None:
    stars = replace(_stars(np.random.default_rng(8), 40), parallax_mas=np.zeros(40))
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    with pytest.warns(erfa.ErfaWarning, match="distance overridden"):
        there = erfa.pmsafe(
            ra, dec, stars.pm_ra_mas_yr * RAD_PER_MAS / np.cos(dec), stars.pm_dec_mas_yr * RAD_PER_MAS, 0.0,
            stars.radial_velocity_km_s, 2457388.5 + 0.5, 0.0, 2451545.0, 100.0 * 365.25,
        )  # fmt: skip
    expected = direction_from_radec(np.degrees(there[0]), np.degrees(there[1]))
    distance = np.linalg.norm(apparent_directions(stars, et_of_julian_year(2100.0)) - expected, axis=1)
    assert distance.max() < PLACE_MAS * RAD_PER_MAS


@pytest.mark.parametrize("distance_au", [0.1, 1.0, 5.2])
def test_light_deflection_by_the_sun_agrees_with_erfa(distance_au: float) -> None:
    rng = np.random.default_rng(9)
    directions = unit(rng.normal(size=(200, 3)))
    from_sun = unit(rng.normal(size=3))
    near = unit(-from_sun + unit(rng.normal(size=(50, 3))) * np.geomspace(0.02, 0.5, 50)[:, None])
    directions = np.concatenate([directions, near])
    expected = unit(erfa.ldsun(directions, from_sun, distance_au))
    got = deflect_light(directions, from_sun * distance_au * AU_KM)
    assert np.abs(got - expected).max() < ERFA_RAD


def test_the_sun_bends_light_by_4_mas_at_a_right_angle_and_by_a_second_and_three_quarters_at_its_limb() -> None:
    to_sun = np.array([1.0, 0.0, 0.0])
    limb = 0.00465047  # rad, the Sun's radius from 1 au
    directions = np.array([[0.0, 1.0, 0.0], [np.cos(limb), np.sin(limb), 0.0]])
    bent = deflect_light(directions, -to_sun * AU_KM)
    angle_mas = np.linalg.norm(bent - directions, axis=1) / RAD_PER_MAS
    assert abs(angle_mas[0] - 4.07) < 0.01
    assert abs(angle_mas[1] - 1751.0) < 2.0
    assert bent[0] @ to_sun < 0.0  # away from the Sun


def test_light_deflection_is_an_option_that_needs_the_observers_place() -> None:
    stars = _stars(np.random.default_rng(10), 50)
    et = et_of_julian_year(2030.0)
    position = np.array([0.3, -0.9, 0.1]) * AU_KM
    plain = apparent_directions(stars, et, observer_position_km=position)
    bent = apparent_directions(stars, et, observer_position_km=position, light_deflection=True)
    from_sun = position - sun_position_km(et)
    assert np.abs(bent - deflect_light(plain, from_sun)).max() < ERFA_RAD
    assert 1.0 < np.linalg.norm(bent - plain, axis=1).max() / RAD_PER_MAS < 2000.0
    with pytest.raises(InputError, match="observer_position_km"):
        apparent_directions(stars, et, light_deflection=True)


def test_apparent_places_from_earth_agree_with_erfa_from_catalog_to_observer() -> None:
    """The whole chain, space motion to aberration, beside ERFA's ``atciq`` without precession and nutation."""
    stars = _stars(np.random.default_rng(11), 60)
    et = et_of_julian_year(2030.0)
    heliocentric, barycentric = erfa.epv00(2451545.0, 30.0 * 365.25)
    position, velocity = barycentric["p"], barycentric["v"]
    astrom = erfa.apci(2451545.0, 30.0 * 365.25, barycentric, heliocentric["p"], 0.0, 0.0, 0.0)
    astrom["bpn"] = np.eye(3)
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    there = erfa.pmsafe(
        ra, dec, stars.pm_ra_mas_yr * RAD_PER_MAS / np.cos(dec), stars.pm_dec_mas_yr * RAD_PER_MAS,
        stars.parallax_mas / 1e3, stars.radial_velocity_km_s, 2451545.0, 16.0 * 365.25, 2451545.0, 0.0,
    )  # fmt: skip
    ri, di = erfa.atciq(*there, astrom)
    expected = direction_from_radec(np.degrees(ri), np.degrees(di))
    got = apparent_directions(
        stars,
        et,
        observer_position_km=position * AU_KM,
        observer_velocity_km_s=velocity * AU_KM / 86400.0,
        light_deflection=True,
    )
    assert np.linalg.norm(got - expected, axis=1).max() < PLACE_MAS * RAD_PER_MAS


def test_parallax_and_light_time_agree_with_erfa() -> None:
    stars = _stars(np.random.default_rng(2), 40)
    position_au = np.array([20.0, -41.0, 12.0])
    got = apparent_directions(stars, et_of_julian_year(2030.0), observer_position_km=position_au * AU_KM)
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    expected = erfa.pmpx(
        ra, dec, stars.pm_ra_mas_yr * RAD_PER_MAS / np.cos(dec), stars.pm_dec_mas_yr * RAD_PER_MAS,
        stars.parallax_mas / 1000.0, stars.radial_velocity_km_s, 14.0, position_au,
    )  # fmt: skip
    assert np.abs(got - expected).max() < 1e3 * ERFA_RAD  # the au in light days of ERFA is rounded to 1e-9 days


def test_aberration_agrees_with_erfa_at_any_speed() -> None:
    rng = np.random.default_rng(3)
    directions = unit(rng.normal(size=(40, 3)))
    for speed in (30.0, 3e4, 0.9 * SPEED_OF_LIGHT_KM_S):
        velocity = speed * unit(rng.normal(size=3))
        beta = velocity / SPEED_OF_LIGHT_KM_S
        far_from_sun_au = 1e12
        expected = unit(erfa.ab(directions, beta, far_from_sun_au, np.sqrt(1 - beta @ beta)))
        assert np.abs(aberrate(directions, velocity) - expected).max() < ERFA_RAD


def test_without_observer_there_is_no_parallax_and_no_aberration() -> None:
    stars = _stars(np.random.default_rng(4), 5)
    still = apparent_directions(stars, et_of_julian_year(2016.0))
    assert np.abs(still - direction_from_radec(stars.ra_deg, stars.dec_deg)).max() < ERFA_RAD


def test_an_impossible_observer_is_refused() -> None:
    stars = _stars(np.random.default_rng(5), 2)
    with pytest.raises(InputError, match="speed of light"):
        apparent_directions(stars, 0.0, observer_velocity_km_s=[4e5, 0, 0])
    with pytest.raises(InputError, match="observer_position_km"):
        apparent_directions(stars, 0.0, observer_position_km=[1.0, np.nan, 0])


def test_the_error_of_a_direction_grows_with_time_from_the_catalog_epoch() -> None:
    stars = _stars(np.random.default_rng(6), 2)
    sigma_mas = stars.sigma_rad(et_of_julian_year(2026.0)) / RAD_PER_MAS
    np.testing.assert_allclose(sigma_mas, 5.0, rtol=0, atol=FLOAT64_SUM)  # 3 mas and 10 years of 0.4 mas/yr
