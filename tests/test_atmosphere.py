"""Altitudes of limbs in atmospheres."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike import InputError
from giantlike.atmosphere import AIRLESS, ATMOSPHERES, Atmosphere
from giantlike.ephemeris import ApparentGeometry
from giantlike.scene import Target
from giantlike.shapes import Ellipsoid

EARTH_KM = 6371.0
QUADRATURE_KM = 1e-3  # trapezoids of 10 m over 300 km


@pytest.mark.parametrize("depth", [0.01, 0.1, 1.0])
def test_the_altitude_is_that_of_a_sharp_edge_with_as_much_light(depth: float) -> None:
    air = Atmosphere(scale_height_km=8.0, optical_depth=depth, sigma_km=1.0, base_km=2.0)
    heights = np.arange(2.0, 302.0, 0.01)
    light = np.trapezoid(air.brightness(heights, EARTH_KM), heights)
    assert_allclose(air.limb_altitude_km(EARTH_KM), 2.0 + light, rtol=0, atol=QUADRATURE_KM)


def test_the_slant_depth_is_the_integral_of_the_density_along_a_grazing_ray() -> None:
    air = Atmosphere(scale_height_km=8.0, optical_depth=0.1, sigma_km=1.0)
    along = np.arange(-2000.0, 2000.0, 0.1)
    height = np.hypot(along, EARTH_KM) - EARTH_KM
    depth = 0.1 / 8.0 * np.trapezoid(np.exp(-height / 8.0), along)
    assert_allclose(air.slant_depth(EARTH_KM), depth, rtol=0, atol=2e-3 * depth)  # next order: 3 H / 8 R


def test_air_is_seen_higher_in_blue_by_four_scale_heights_of_the_ratio_of_wavelengths() -> None:
    earth = Atmosphere.of("earth")
    rise = earth.seen_at(450.0).limb_altitude_km(EARTH_KM) - earth.seen_at(550.0).limb_altitude_km(EARTH_KM)
    assert_allclose(rise, 4.06 * 7.0 * math.log(550.0 / 450.0), rtol=0, atol=0.02)


def test_the_limb_of_the_earth_is_where_a_camera_on_the_way_to_the_moon_saw_it() -> None:
    """Inman et al., section IV.C.3: 24.25 km in one image, 25 km on the average."""
    earth = Atmosphere.of("EARTH")
    assert abs(earth.limb_altitude_km(EARTH_KM) - 25.0) < 1.1 * earth.sigma_km


def test_an_altitude_alone_is_a_sharp_limb() -> None:
    known = Atmosphere.at(25.0, sigma_km=3.0)
    assert (known.limb_altitude_km(EARTH_KM), known.sigma_km, known.limb_width_km) == (25.0, 3.0, 0.0)
    assert_allclose(known.brightness([24.9, 25.1], EARTH_KM), [1.0, 0.0])


def test_every_known_atmosphere_has_a_limb_above_its_base_and_a_sigma_of_a_scale_height() -> None:
    radii = {"EARTH": 6371.0, "MARS": 3390.0, "VENUS": 6052.0, "TITAN": 2575.0, "JUPITER": 69911.0, "SATURN": 58232.0}
    radii |= {"URANUS": 25362.0, "NEPTUNE": 24622.0, "TRITON": 1353.0, "PLUTO": 1188.0}
    assert set(ATMOSPHERES) == set(radii)
    for name, air in ATMOSPHERES.items():
        assert air.limb_altitude_km(radii[name]) >= air.base_km
        assert 0.0 < air.limb_altitude_km(radii[name]) < 0.2 * radii[name]
        assert air.sigma_km >= 0.9 * air.scale_height_km


def test_numbers_that_make_no_sense_and_bodies_that_are_not_known_are_refused() -> None:
    with pytest.raises(InputError, match="MOON"):
        Atmosphere.of("MOON")
    with pytest.raises(InputError, match="scale_height_km"):
        Atmosphere(scale_height_km=-1.0, optical_depth=1.0, sigma_km=1.0)
    with pytest.raises(InputError, match="wavelength_nm"):
        Atmosphere.of("MARS").seen_at(0.5)


PUBLISHED_KM = {420.0: (307.0, 38.0), 611.0: (238.0, 36.0), 650.0: (248.0, 29.0)}
"""Medians and scatter of 7, 15 and 14 altitudes of Titan's limb in violet, clear and red images of Cassini, by the
circles of rms-spindoctor, util/titan_cohort/final_run_summary.csv."""


@pytest.mark.parametrize("wavelength_nm", PUBLISHED_KM)
def test_the_limb_of_titan_is_where_circles_were_fitted_to_images_of_cassini(wavelength_nm: float) -> None:
    altitude_km, scatter_km = PUBLISHED_KM[wavelength_nm]
    titan = Atmosphere.of("TITAN")
    assert abs(titan.seen_at(wavelength_nm).limb_altitude_km(2574.7) - altitude_km) < scatter_km
    assert titan.sigma_km > scatter_km


def body(name: str, **limb: Any) -> Target:
    """A target of 1,000 km at the distance of 1e5 km."""
    return Target(
        name=name,
        shape=Ellipsoid(radii_km=np.full(3, 1000.0)),
        ephemeris=ApparentGeometry(
            position_inertial_km=np.array([0.0, 0.0, 1e5]), inertial_from_body=Rotation.identity()
        ),
        **limb,
    )


def test_a_target_with_air_has_the_atmosphere_that_is_known_by_its_name() -> None:
    assert body("Neptune", air=True).atmosphere == Atmosphere.of("NEPTUNE")
    measured = Atmosphere.at(70.0, sigma_km=5.0)
    assert body("NEPTUNE", air=True, atmosphere=measured).atmosphere == measured
    assert body("NEPTUNE").atmosphere is None
    assert body("KEPLER-10", air=True).atmosphere is None


def test_airless_is_what_is_declared_so_or_known_by_name_and_nothing_else() -> None:
    assert body("MOON").airless
    assert body("KEPLER-10", air=False).airless
    assert not body("MOON", air=True).airless
    assert not body("KEPLER-10").airless
    assert not body("EARTH").airless
    with pytest.raises(InputError, match="airless"):
        body("EARTH", air=False, atmosphere=Atmosphere.of("EARTH"))


def test_no_body_is_both_airless_and_in_an_atmosphere() -> None:
    assert not AIRLESS & set(ATMOSPHERES)
