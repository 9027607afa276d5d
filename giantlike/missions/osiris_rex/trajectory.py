"""Where Bennu, the Sun and the spacecraft are: from the mission's kernels where a user has them, else rebuilt.

The paper gives no trajectory, only how large Bennu is in the cameras of each phase. A visit holds the apparent size and
phase angle needed for it; kernels that cover its time take their place, and the visit says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, unit
from giantlike.core.frames import direction_from_radec
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.units import AU_KM, RAD_PER_DEG, SECONDS_PER_DAY
from giantlike.core.values import Value
from giantlike.ephemeris import BARYCENTER
from giantlike.io.spice import CoverageError, load_kernels, orientation, spk_state

_SUN_GM_KM3_S2 = 1.32712440041e11
"""km^3/s^2, gravitational parameter of the Sun, TDB-compatible: IAU 2009 system of astronomical constants."""
_OBLIQUITY_RAD = math.radians(84381.448 / 3600.0)
"""rad, obliquity of the ecliptic of J2000 in the IAU 1976 system, in which the elements are stated."""
_KERNEL_PATTERNS = ("naif*.tls", "bennu*.tpc", "orx_*ALT*.bsp")
"""Names of the kernels that are read, in loading order: leap seconds, orientation of Bennu, spacecraft."""
_SPACECRAFT, _BENNU, _BENNU_FRAME = "-64", "2101955", "IAU_BENNU"
"""NAIF codes of OSIRIS-REx and of Bennu, and the frame of Bennu that SPICE has built in."""
_STEP_S = 60.0
"""Velocities are differences of positions so far before and after: those stored in ``orx_s_181108_181217_ALTP_v01.bsp``
are 65 m/s where the positions move by 5 cm/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """Ecliptic osculating elements of Bennu, and its rotation.

    epoch_jd_tdb: d; of the elements.
    a_au, e: semi-major axis, au, and eccentricity.
    pole_ra_deg, pole_dec_deg: spin axis.
    meridian_deg: angle of the prime meridian at J2000.
    spin_deg_day: in deg/day.
    """

    epoch_jd_tdb: float
    a_au: float
    e: float
    i_deg: float
    node_deg: float
    perihelion_deg: float
    mean_anomaly_deg: float
    pole_ra_deg: float
    pole_dec_deg: float
    meridian_deg: float
    spin_deg_day: float

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, with respect to the Sun at ``et``, ICRF axes."""
        a_km = self.a_au * AU_KM
        rate = math.sqrt(_SUN_GM_KM3_S2 / a_km**3)
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

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation of the body axes at ``et``."""
        pole = direction_from_radec(self.pole_ra_deg, self.pole_dec_deg)
        node = unit(np.cross([0.0, 0.0, 1.0], pole))
        at_node = Rotation.from_matrix(np.stack([node, np.cross(pole, node), pole], axis=-1))
        angle_deg = math.remainder(self.meridian_deg + self.spin_deg_day * et / SECONDS_PER_DAY, 360.0)
        return at_node * Rotation.from_rotvec([0.0, 0.0, angle_deg * RAD_PER_DEG])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BennuVisit(Value):
    """A moment at which Bennu is imaged.

    et: in s; TDB seconds past J2000.
    from_body_km: in ICRF axes; from Bennu to the spacecraft.
    velocity_km_s: in ICRF axes; of the spacecraft with respect to Bennu.
    inertial_from_body: orientation of Bennu at ``et``.
    from_kernels: True where the trajectory comes from the mission's kernels, False where it was rebuilt.
    """

    et: float
    from_body_km: Float
    velocity_km_s: Float
    inertial_from_body: Rotation
    from_kernels: bool

    @property
    def range_km(self) -> float:
        """Distance from the center of Bennu, km."""
        return float(np.linalg.norm(self.from_body_km))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisitedBody(Value):
    """Bennu around the time of a visit, as an ephemeris: its orbit, and its spin from the orientation of the visit."""

    orbit: Orbit
    visit: BennuVisit
    origin: str = field(default=BARYCENTER, init=False)

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, at ``et``; the Sun is treated as the barycenter."""
        return self.orbit.state(et)

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation of the body axes at ``et``."""
        turn_deg = self.orbit.spin_deg_day * (et - self.visit.et) / SECONDS_PER_DAY
        return self.visit.inertial_from_body * Rotation.from_rotvec([0.0, 0.0, turn_deg * RAD_PER_DEG])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedVisit:
    """Apparent size and phase of a visit by the paper, used where no kernel covers it.

    utc: time, ISO 8601.
    phase_deg: angle Sun - Bennu - camera.
    turn_deg: direction of the camera about the direction of the Sun, from the north of the ICRF.
    """

    utc: str
    range_km: float
    phase_deg: float
    turn_deg: float


def visits_of(planned: Sequence[PlannedVisit], orbit: Orbit, kernels: Path | None) -> tuple[BennuVisit, ...]:
    """Place the spacecraft at the times of planned visits."""
    rebuilt = tuple(_rebuilt(each, orbit) for each in planned)
    if kernels is None:
        return rebuilt
    with load_kernels([f"**/{pattern}" for pattern in _KERNEL_PATTERNS], kernels):
        return tuple(_replace_by_kernels(each) for each in rebuilt)


def _replace_by_kernels(visit: BennuVisit) -> BennuVisit:
    """The visit by the loaded kernels, or as it is where they do not cover it."""
    times = visit.et + _STEP_S * np.array([-1.0, 0.0, 1.0])
    try:
        before_km, position_km, after_km = (spk_state(_SPACECRAFT, float(et), observer=_BENNU)[0] for et in times)
    except CoverageError:
        return visit
    return BennuVisit(
        et=visit.et,
        from_body_km=position_km,
        velocity_km_s=(after_km - before_km) / (2.0 * _STEP_S),
        inertial_from_body=orientation(_BENNU_FRAME, visit.et),
        from_kernels=True,
    )


def _rebuilt(planned: PlannedVisit, orbit: Orbit) -> BennuVisit:
    et = et_from_time(time_from_utc(planned.utc))
    to_sun = unit(-orbit.state(et)[0])
    east = unit(np.cross([0.0, 0.0, 1.0], to_sun))
    north = np.cross(to_sun, east)
    phase, turn = planned.phase_deg * RAD_PER_DEG, planned.turn_deg * RAD_PER_DEG
    direction = math.cos(phase) * to_sun + math.sin(phase) * (math.cos(turn) * north + math.sin(turn) * east)
    return BennuVisit(
        et=et,
        from_body_km=planned.range_km * direction,
        velocity_km_s=np.zeros(3),
        inertial_from_body=orbit.inertial_from_body(et),
        from_kernels=False,
    )
