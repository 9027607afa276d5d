"""Paths that no kernel is needed for: a spinning body on a circle about the Sun, a spacecraft near it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import AU_KM
from giantlike.ephemeris import BARYCENTER

_SUN_GM_KM3_S2 = 1.32712440041e11
"""IAU nominal gravity of the Sun to the digits that matter here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CircularOrbit:
    """A body on a circle about the Sun, which rests at the barycenter, spinning evenly about its z axis.

    Parameters
    ----------
    radius_au : float, au
    longitude_rad : float, rad
        Angle along the orbit at ``et = epoch_et``, from the node on the equator of the ICRF.
    inclination_rad : float, rad
        To that equator.
    pole_ra_deg, pole_dec_deg : float, deg
        Spin axis.
    spin_period_s : float, s
    epoch_et : float, s
        TDB seconds past J2000 at which the prime meridian is at the node of the body's equator.
    """

    radius_au: float = 1.1
    longitude_rad: float = 0.0
    inclination_rad: float = 0.41
    pole_ra_deg: float = 86.0
    pole_dec_deg: float = -65.0
    spin_period_s: float = 15466.0
    epoch_et: float = 0.0
    origin: str = field(default=BARYCENTER, init=False)

    def __post_init__(self) -> None:
        require(self.radius_au > 0, f"radius_au must be > 0, got {self.radius_au}")
        require(self.spin_period_s != 0, "spin_period_s must not be 0")

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s."""
        radius = self.radius_au * AU_KM
        rate = math.sqrt(_SUN_GM_KM3_S2 / radius**3)
        angle = self.longitude_rad + rate * (et - self.epoch_et)
        tilt = np.array([0.0, math.cos(self.inclination_rad), math.sin(self.inclination_rad)])
        node = np.array([1.0, 0.0, 0.0])
        position = radius * (math.cos(angle) * node + math.sin(angle) * tilt)
        velocity = radius * rate * (math.cos(angle) * tilt - math.sin(angle) * node)
        return position, velocity

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation of the body axes."""
        pole = direction_from_radec(self.pole_ra_deg, self.pole_dec_deg)
        node = unit(np.cross([0.0, 0.0, 1.0], pole))
        at_epoch = Rotation.from_matrix(np.stack([node, np.cross(pole, node), pole], axis=-1))
        return at_epoch * Rotation.from_rotvec([0.0, 0.0, 2.0 * math.pi * (et - self.epoch_et) / self.spin_period_s])


class Rendezvous:
    """A spacecraft on a smooth path through places relative to a body.

    Parameters
    ----------
    body : CircularOrbit
    et : (n,), s
        TDB seconds past J2000 of the places, increasing; n >= 2.
    relative_km : (n, 3), km, ICRF axes
        From the body to the spacecraft.
    """

    def __init__(self, body: CircularOrbit, et: ArrayLike, relative_km: ArrayLike) -> None:
        times = np.asarray(et, dtype=np.float64)
        require(times.ndim == 1 and times.size >= 2, f"a path needs at least 2 epochs, got shape {times.shape}")
        self.origin = body.origin
        self._body = body
        self._start_et = float(times[0])
        self._path = CubicSpline(times - self._start_et, as_finite(relative_km, (times.size, 3), "relative_km"))
        self._rate = self._path.derivative()

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s."""
        position, velocity = self._body.state(et)
        since = et - self._start_et
        return position + np.asarray(self._path(since)), velocity + np.asarray(self._rate(since))

    def inertial_from_body(self, et: float) -> Rotation:
        """The spacecraft itself has no orientation here: the axes are those of the ICRF."""
        return Rotation.identity()
