"""The independent flight near a small body, against its potential and against the orbit determination's integrator."""

import numpy as np
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.independent.flight import SmallBodyField
from giantlike.independent.orbit import Dynamics, Maneuver

GM, SUN_GM, AU_KM = 4.89e-9, 1.327e11, 149_597_870.7
POLE = np.array([0.1, -0.5, 0.8]) / np.linalg.norm([0.1, -0.5, 0.8])
ORBITS_KM = 1e-6  # two integrators over four revolutions at 1.5 km
AIMED_KM = 1e-6


def sun_km(et: float) -> Float:
    """A circle around the Sun in a year."""
    return AU_KM * np.array([np.cos(2e-7 * et), np.sin(2e-7 * et), 0.05])


def field(zonals: dict[int, float]) -> SmallBodyField:
    return SmallBodyField(GM, SUN_GM, zonals, POLE, sun_km, 5e-11)


def test_zonal_gravity_is_the_gradient_of_its_potential() -> None:
    zonals, place, step = {2: 3e-3, 4: -1e-4}, np.array([0.4, -0.3, 0.7]), 1e-4

    def potential(at: Float) -> float:
        distance, sine = np.linalg.norm(at), at @ POLE / np.linalg.norm(at)
        legendre = {2: 1.5 * sine**2 - 0.5, 4: (35.0 * sine**4 - 30.0 * sine**2 + 3.0) / 8.0}
        return float(GM / distance * (1.0 - sum(zonals[n] / distance**n * legendre[n] for n in zonals)))

    slope = [(potential(place + each) - potential(place - each)) / (2.0 * step) for each in step * np.eye(3)]
    alone = field(zonals).acceleration(0.0, place[None]) - field({}).acceleration(0.0, place[None])
    point_mass = -GM * place / np.linalg.norm(place) ** 3
    assert_allclose(alone[0] + point_mass, slope, rtol=0, atol=1e-6 * float(np.linalg.norm(point_mass)))


def test_an_orbit_with_oblateness_sunlight_and_a_maneuver_is_that_of_the_orbit_determination() -> None:
    speed, kick = np.sqrt(GM / 1.5), np.array([1e-6, -2e-6, 5e-7])
    start, times = np.array([0.0, 1.5, 0.0, 0.0, 0.0, speed]), np.array([0.0, 1e5, 3e5, 6e5])
    dynamics = Dynamics(
        "BENNU",
        {"BENNU": GM, "SUN": SUN_GM},
        lambda name, et: np.zeros(3) if name == "BENNU" else sun_km(et),
        (Maneuver(2e5, 1e-6, (1e-6, -2e-6, 5e-7)),),
        sun="SUN",
        sunlight=5e-11,
        oblateness=(3.3e-3, POLE),
    )
    true = field({2: 3.3e-3})
    after = true.coast(start[None], 0.0, 2e5) + np.append(np.zeros(3), kick)
    ends = [true.coast(start[None], 0.0, 1e5), *(true.coast(after, 2e5, et) for et in (3e5, 6e5))]
    found = dynamics.fly(np.concatenate([start, dynamics.apriori[6:]]), times)
    assert_allclose(found[1:], [end[0, :3] for end in ends], rtol=0, atol=ORBITS_KM)


def test_an_aimed_change_of_velocity_gets_there() -> None:
    true, target = field({2: 3.3e-3}), np.array([-4.0, 7.0, 9.0])
    state = np.array([1.0, 7.0, -9.0, 1e-5, 0.0, 0.0])
    change = true.aim(state, 0.0, 86_400.0, target)
    end = true.coast((state + np.append(np.zeros(3), change))[None], 0.0, 86_400.0)
    assert_allclose(end[0, :3], target, rtol=0, atol=AIMED_KM)
