"""Where Bennu and the Sun are, and the flight of the spacecraft, by the independent integrator.

The paper gives no trajectory, only how large Bennu is in the cameras of each phase: the waypoints of ``mission.toml``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, unit
from giantlike.core.frames import direction_from_radec
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.units import AU_KM, RAD_PER_DEG, SECONDS_PER_DAY
from giantlike.core.values import Value
from giantlike.independent.flight import SmallBodyField
from giantlike.independent.orbit import Maneuver
from giantlike.io.spice import CoverageError, load_kernels, spk_state

SUN_GM_KM3_S2 = 1.32712440041e11
"""km^3/s^2, gravitational parameter of the Sun, TDB-compatible: IAU 2009 system of astronomical constants."""
_OBLIQUITY_RAD = math.radians(84381.448 / 3600.0)
"""rad, obliquity of the ecliptic of J2000 in the IAU 1976 system, in which the elements are stated."""
_KERNEL_PATTERNS = ("naif*.tls", "bennu*.tpc", "orx_*ALT*.bsp")
"""Names of the kernels that are read, in loading order: leap seconds, orientation of Bennu, spacecraft."""
_SPACECRAFT, _BENNU = "-64", "2101955"  # NAIF codes of OSIRIS-REx and of Bennu


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """Ecliptic osculating elements of Bennu, and its rotation."""

    epoch_jd_tdb: float  # d; of the elements
    a_au: float  # a_au, e: semi-major axis, au, and eccentricity
    e: float
    i_deg: float
    node_deg: float
    perihelion_deg: float
    mean_anomaly_deg: float
    pole_ra_deg: float  # pole_ra_deg, pole_dec_deg: spin axis
    pole_dec_deg: float
    meridian_deg: float  # angle of the prime meridian at J2000
    spin_deg_day: float  # in deg/day

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, with respect to the Sun at ``et``, ICRF axes."""
        a_km = self.a_au * AU_KM
        rate = math.sqrt(SUN_GM_KM3_S2 / a_km**3)
        since_s = et - (self.epoch_jd_tdb - 2451545.0) * SECONDS_PER_DAY
        mean = math.remainder(self.mean_anomaly_deg * RAD_PER_DEG + rate * since_s, 2.0 * math.pi)
        anomaly = float(brentq(lambda x: x - self.e * math.sin(x) - mean, mean - 1.0, mean + 1.0, xtol=1e-13))
        minor = math.sqrt(1.0 - self.e**2)
        speed = a_km * rate / (1.0 - self.e * math.cos(anomaly))
        plane = np.array([a_km * (math.cos(anomaly) - self.e), a_km * minor * math.sin(anomaly), 0.0])
        motion = np.array([-speed * math.sin(anomaly), speed * minor * math.cos(anomaly), 0.0])
        angles = (self.perihelion_deg, self.i_deg, self.node_deg)
        turn = Rotation.from_euler("x", _OBLIQUITY_RAD) * Rotation.from_euler("zxz", angles, degrees=True)
        return turn.apply(plane), turn.apply(motion)

    @property
    def pole(self) -> Float:
        """Direction (3,) of the spin axis, ICRF axes."""
        return direction_from_radec(self.pole_ra_deg, self.pole_dec_deg)

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation of the body axes at ``et``."""
        pole = self.pole
        node = unit(np.cross([0.0, 0.0, 1.0], pole))
        at_node = Rotation.from_matrix(np.stack([node, np.cross(pole, node), pole], axis=-1))
        angle_deg = math.remainder(self.meridian_deg + self.spin_deg_day * et / SECONDS_PER_DAY, 360.0)
        return at_node * Rotation.from_rotvec([0.0, 0.0, angle_deg * RAD_PER_DEG])


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """Place of the spacecraft at a time."""

    utc: str  # time, ISO 8601
    range_km: float
    phase_deg: float  # angle Sun - Bennu - camera
    turn_deg: float  # direction of the camera about the direction of the Sun, from the north of the ICRF

    def place(self, orbit: Orbit) -> tuple[float, Float, Float]:
        """Time, position (3,) from Bennu, km, and direction (3,) of a polar orbit about the Sun's direction there."""
        et = et_from_time(time_from_utc(self.utc))
        to_sun = unit(-orbit.state(et)[0])
        east = unit(np.cross([0.0, 0.0, 1.0], to_sun))
        north = np.cross(to_sun, east)
        phase, turn = self.phase_deg * RAD_PER_DEG, self.turn_deg * RAD_PER_DEG
        direction = math.cos(phase) * to_sun + math.sin(phase) * (math.cos(turn) * north + math.sin(turn) * east)
        return et, self.range_km * direction, unit(np.cross(to_sun, direction))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flight(Value):
    """A flown phase: true states of the spacecraft from Bennu by time, and the maneuvers as planned and as executed."""

    states: Mapping[float, Float]  # (6,), km and km/s, ICRF axes, by TDB seconds past J2000
    maneuvers: tuple[Maneuver, ...]
    executed_km_s: Float  # (m, 3)


def fly(
    waypoints: Sequence[Waypoint],
    ets: Sequence[float],
    orbit: Orbit,
    setup: SimpleNamespace,
    *,
    trim_mm_s: float | None,
    seed: int,
) -> Flight:
    """Fly from waypoint to waypoint, by maneuvers planned from the true state, executed in error.

    With ``trim_mm_s`` it is a circular orbit at first, and each maneuver is that much along the velocity.
    """
    rng = np.random.default_rng([seed, 30])
    declared = SmallBodyField(
        gm=setup.told_gm_km3_s2,
        sun_gm=SUN_GM_KM3_S2,
        zonals={2: setup.j2_km2},
        pole=orbit.pole,
        sun_km=lambda et: -orbit.state(et)[0],
        sunlight=setup.sunlight_km_s2,
    )
    true = replace(
        declared,
        gm=setup.gm_km3_s2,
        zonals={2: setup.j2_km2, 4: setup.j4_km4},
        sunlight=setup.sunlight_km_s2 * setup.true_sunlight,
    )
    places = [each.place(orbit) for each in waypoints]
    et, place, along = places[0]
    state = np.append(place, math.sqrt(setup.gm_km3_s2 / waypoints[0].range_km) * along)
    if trim_mm_s is None:
        state[3:] += declared.aim(state, et, *places[1][:2])
    states, maneuvers, executed = dict[float, Float](), list[Maneuver](), list[Float]()
    for number, (end, _, _) in enumerate(places[1:], 1):
        for stop in sorted(each for each in ets if et < each <= end):
            state, et = true.coast(state[None], et, stop)[0], stop
            states[stop] = state
        state, et = true.coast(state[None], et, end)[0], end
        if number + 1 < len(places):
            change = (
                declared.aim(state, et, *places[number + 1][:2])
                if trim_mm_s is None
                else 1e-6 * trim_mm_s * unit(state[3:])
            )
            sigma = setup.maneuver_error * float(np.linalg.norm(change)) + 1e-6 * setup.maneuver_error_mm_s
            executed.append(change + sigma * rng.normal(size=3))
            maneuvers.append(Maneuver(et, sigma, tuple(change.tolist())))
            state = state + np.append(np.zeros(3), executed[-1])
    return Flight(states=states, maneuvers=tuple(maneuvers), executed_km_s=np.array(executed).reshape(-1, 3))


def kernel_ranges_km(ets: Sequence[float], kernels: Path | None) -> Float:
    """Distances (n,) of the spacecraft from Bennu by the mission's kernels; NaN where they do not cover it."""
    ranges = np.full(len(ets), np.nan)
    if kernels is not None:
        with load_kernels([f"**/{pattern}" for pattern in _KERNEL_PATTERNS], kernels):
            for number, et in enumerate(ets):
                with suppress(CoverageError):
                    ranges[number] = np.linalg.norm(spk_state(_SPACECRAFT, et, observer=_BENNU)[0])
    return ranges
