"""Magnitudes in other bands, and stars that a camera cannot tell apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from giantlike.catalogs import Band, MemoryCatalog, StarTable, apparent_directions
from giantlike.catalogs.blends import blended
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import unit
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_MAS
from tests.catalogs.test_catalog_store import sky
from tests.tolerances import FLOAT64, FLOAT64_SUM

ET = et_of_julian_year(2025.0)


def _sun_like(count: int = 3) -> StarTable:
    one = np.ones(count)
    return StarTable(
        ids=np.arange(count) + 1, ra_deg=10.0 * np.cumsum(one), dec_deg=0 * one, pm_ra_mas_yr=0 * one,
        pm_dec_mas_yr=0 * one, parallax_mas=0 * one, radial_velocity_km_s=0 * one, epoch_jyear=2016.0 * one,
        magnitude=np.array([5.0, 5.1, 5.2][:count]), color_bv=np.array([0.65, np.nan, np.nan][:count]),
        sigma_mas=one, sigma_pm_mas_yr=one, color_bp_rp=np.array([0.82, 0.82, np.nan][:count]),
    )  # fmt: skip


def _catalog(stars: StarTable, band: str = "Gaia G") -> MemoryCatalog:
    return MemoryCatalog(stars, name="few", band=band, version="1")


def test_the_sun_is_0_15_magnitudes_fainter_in_v_than_in_g() -> None:
    """G = -26.90, V = -26.76 at BP-RP = 0.82."""
    stars = _catalog(_sun_like()).in_band("V").stars
    difference = stars.magnitude[np.argsort(stars.ids)] - np.array([5.0, 5.1, 5.2])
    assert abs(difference[0] - 0.14) < 0.03
    assert difference[1] == difference[0]
    assert 0.1 < difference[2] < 0.35  # of unknown color: a usual one


def test_v_and_back_gives_the_magnitudes_that_there_were() -> None:
    stars = replace(sky(500), color_bp_rp=np.random.default_rng(1).uniform(-0.3, 4.0, 500))
    catalog = _catalog(stars)
    again = catalog.in_band("V").in_band("G")
    assert again.band == "Gaia G"
    np.testing.assert_allclose(again.stars.magnitude, catalog.stars.magnitude, rtol=0, atol=FLOAT64)


def test_a_cameras_band_is_a_polynomial_in_a_color_on_top_of_another_band() -> None:
    camera = Band(name="navcam", base="V", color="color_bv", coefficients=(0.1, -0.5), color_range=(-0.2, 1.5))
    catalog = _catalog(_sun_like()).in_band(camera)
    assert catalog.band == "navcam"
    assert "navcam = V + (0.1, -0.5) in bv" in catalog.version
    v = _catalog(_sun_like()).in_band("V").stars
    got = catalog.stars.magnitude[np.argsort(catalog.stars.ids)] - v.magnitude[np.argsort(v.ids)]
    assert abs(got[0] - (0.1 - 0.5 * 0.65)) < 1e-12
    assert abs(got[1] - (0.1 - 0.5 * 0.65)) < 0.02  # its B-V follows from BP-RP


def test_magnitude_limits_and_order_are_those_of_the_new_band() -> None:
    stars = replace(sky(2000), color_bp_rp=np.random.default_rng(2).uniform(0.0, 4.0, 2000))
    catalog = _catalog(stars).in_band("V")
    cone = catalog.cone([0.0, 0.0, 1.0], 1.5, max_magnitude=8.0)
    assert (cone.magnitude <= 8.0).all()
    assert (np.diff(cone.magnitude) >= 0.0).all()
    everything = catalog.cone([0.0, 0.0, 1.0], 1.5)
    assert cone.ids.tolist() == everything.ids[everything.magnitude <= 8.0].tolist()


def test_hipparcos_magnitudes_reach_v_by_way_of_g() -> None:
    catalog = _catalog(replace(_sun_like(), color_bp_rp=np.full(3, np.nan)), band="Hp").in_band("V")
    star = catalog.stars.select(catalog.stars.ids == 1)
    assert abs(star.magnitude[0] - (5.0 - 0.12)) < 0.04  # Hp - V = 0.12 for stars like the Sun


def test_a_band_without_a_relation_is_refused_with_advice() -> None:
    with pytest.raises(InputError, match="Band\\(base='user'"):
        _catalog(_sun_like(), band="user").in_band("V")
    assert _catalog(_sun_like(), band="V").in_band("V").band == "V"
    for wrong in ({"coefficients": ()}, {"color": "u-g"}, {"coefficients": (np.nan,)}, {"color_range": (1.0, 0.0)}):
        with pytest.raises(InputError, match="band x"):
            Band(**({"name": "x", "base": "V", "coefficients": (0.0,)} | wrong))  # type: ignore[arg-type]


# --- blends ------------------------------------------------------------------------------------------------------


def _pair(separation_arcsec: float, magnitudes: tuple[float, float]) -> StarTable:
    stars = _sun_like(2)
    return replace(
        stars,
        ra_deg=np.array([30.0, 30.0 + separation_arcsec / 3600.0]),
        magnitude=np.array(magnitudes),
        pm_ra_mas_yr=np.array([100.0, -50.0]),
        parallax_mas=np.array([20.0, 5.0]),
    )


def test_two_stars_within_the_radius_become_one_at_their_center_of_light() -> None:
    stars = _pair(4.0, (6.0, 7.0))
    (merged,) = [blended(stars, 5.0 * RAD_PER_ARCSEC, et=ET)]
    flux = 10.0 ** (-0.4 * stars.magnitude)
    assert len(merged) == 1
    assert merged.is_double.all()
    assert merged.ids.tolist() == [1]
    np.testing.assert_allclose(merged.magnitude, -2.5 * np.log10(flux.sum()), rtol=0, atol=FLOAT64)
    center = unit((flux[:, None] * apparent_directions(stars, ET)).sum(axis=0))
    assert np.linalg.norm(apparent_directions(merged, ET)[0] - center) < 1e-3 * RAD_PER_MAS
    np.testing.assert_allclose(
        merged.pm_ra_mas_yr, (flux * [100.0, -50.0]).sum() / flux.sum(), rtol=0, atol=FLOAT64_SUM
    )


def test_the_center_of_light_of_a_blend_moves_as_that_of_its_members() -> None:
    stars = _pair(4.0, (6.0, 6.5))
    merged = blended(stars, 5.0 * RAD_PER_ARCSEC, et=ET)
    flux = 10.0 ** (-0.4 * stars.magnitude)
    later = et_of_julian_year(2035.0)
    position = np.array([2e8, -1e9, 3e8])
    center = unit((flux[:, None] * apparent_directions(stars, later, observer_position_km=position)).sum(axis=0))
    got = apparent_directions(merged, later, observer_position_km=position)[0]
    assert np.linalg.norm(got - center) < 0.1 * RAD_PER_MAS


def test_stars_that_are_farther_apart_stay_as_they_are() -> None:
    stars = _pair(8.0, (6.0, 7.0))  # 6.6 when they are merged
    alone = blended(stars, 5.0 * RAD_PER_ARCSEC, et=ET)
    assert alone.ids.tolist() == [1, 2]
    assert not alone.is_double.any()
    assert alone.epoch_jyear.tolist() == [2016.0, 2016.0]


def test_blends_keep_the_light_of_the_field_and_no_two_leaders_are_within_the_radius() -> None:
    rng = np.random.default_rng(4)
    count, radius = 800, 20.0 * RAD_PER_ARCSEC
    stars = replace(sky(count), ra_deg=30.0 + rng.uniform(0, 0.5, count), dec_deg=rng.uniform(0, 0.5, count))
    stars = replace(stars, pm_ra_mas_yr=np.zeros(count), pm_dec_mas_yr=np.zeros(count), is_double=np.zeros(count, bool))
    merged = blended(stars, radius, et=ET)
    assert 0.6 * count < len(merged) < count
    assert (np.diff(merged.magnitude) >= 0.0).all()
    total = [np.sum(10.0 ** (-0.4 * table.magnitude)) for table in (stars, merged)]
    assert abs(total[1] / total[0] - 1.0) < 1e-12
    leaders = stars.select(np.isin(stars.ids, merged.ids))
    directions = direction_from_radec(leaders.ra_deg, leaders.dec_deg)
    apart = np.linalg.norm(directions[:, None] - directions, axis=-1) + np.eye(len(leaders))
    assert apart.min() > 0.999 * radius
    assert merged.is_double.sum() > 50


def test_blends_of_nothing_and_bad_radii() -> None:
    assert len(blended(_sun_like().select([]), 1e-4, et=ET)) == 0
    with pytest.raises(InputError, match="radius_rad"):
        blended(_sun_like(), 0.0, et=ET)
