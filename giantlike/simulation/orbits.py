"""Ephemerides without kernels: a spinning body on a circular orbit about the Sun, and a spacecraft near it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, require, require_number, unit
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import AU_KM
from giantlike.ephemeris import BARYCENTER

_SUN_GM_KM3_S2 = 1.32712440041e11  # of the Sun, TDB-compatible: IAU 2009 system of astronomical constants


@dataclass(frozen=True, slots=True, kw_only=True)
class CircularOrbit:
    """A body on a circular orbit about the Sun at the solar system barycenter, spinning about its z axis."""

    radius_au: float = 1.1  # au; radius of the orbit
    longitude_rad: float = 0.0  # angle along the orbit at ``et = epoch_et``, from the node on the equator of the ICRF
    inclination_rad: float = 0.41  # of the orbit to that equator; 0.41 rad puts it near the ecliptic
    pole_ra_deg: float = 86.0  # pole_ra_deg, pole_dec_deg: with 1.1 au and the period, close to Bennu's
    pole_dec_deg: float = -65.0
    spin_period_s: float = 15466.0  # sidereal rotation period
    epoch_et: float = 0.0  # TDB s past J2000 at which the prime meridian is at the node of the body's equator
    origin: str = field(default=BARYCENTER, init=False)

    def __post_init__(self) -> None:
        require_number(self.radius_au, "radius_au", above=0.0)
        require(self.spin_period_s != 0, "spin_period_s must not be 0")

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, at ``et``, ICRF axes."""
        radius = self.radius_au * AU_KM
        rate = math.sqrt(_SUN_GM_KM3_S2 / radius**3)
        angle = self.longitude_rad + rate * (et - self.epoch_et)
        tilt = np.array([0.0, math.cos(self.inclination_rad), math.sin(self.inclination_rad)])
        node = np.array([1.0, 0.0, 0.0])
        position = radius * (math.cos(angle) * node + math.sin(angle) * tilt)
        velocity = radius * rate * (math.cos(angle) * tilt - math.sin(angle) * node)
        return position, velocity

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation of the body axes at ``et``."""
        pole = direction_from_radec(self.pole_ra_deg, self.pole_dec_deg)
        node = unit(np.cross([0.0, 0.0, 1.0], pole))
        at_epoch = Rotation.from_matrix(np.stack([node, np.cross(pole, node), pole], axis=-1))
        return at_epoch * Rotation.from_rotvec([0.0, 0.0, 2.0 * math.pi * (et - self.epoch_et) / self.spin_period_s])


class Rendezvous:
    """A spacecraft on a cubic spline through positions (n, 3), ICRF axes, relative to a body, at times (n,) s."""

    def __init__(self, body: CircularOrbit, et: ArrayLike, relative_km: ArrayLike) -> None:
        times = np.asarray(et, dtype=np.float64)
        require(times.ndim == 1 and times.size >= 2, f"a path needs at least 2 epochs, got shape {times.shape}")
        self.origin = body.origin
        self._body = body
        self._start_et = float(times[0])
        self._path = CubicSpline(times - self._start_et, as_finite(relative_km, (times.size, 3), "relative_km"))
        self._rate = self._path.derivative()

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, at ``et``, ICRF axes."""
        position, velocity = self._body.state(et)
        since = et - self._start_et
        return position + np.asarray(self._path(since)), velocity + np.asarray(self._rate(since))

    def inertial_from_body(self, et: float) -> Rotation:
        """Identity: the axes of the spacecraft are not modeled."""
        return Rotation.identity()
