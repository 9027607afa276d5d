"""Flights and sightings of many spacecraft at once, by fixed steps of the classic Runge-Kutta method.

The truth of a Monte Carlo of navigation filters. A spacecraft has 21 numbers: position and velocity from the Earth,
km and km/s; rotation vector from the assumed to the true camera axes, rad; unmodeled acceleration, km/s^2; bias,
km/s^2, and scale factor of the accelerometer; bias of the tangents of two angles and of the disk diameter. The last
fifteen are Ornstein-Uhlenbeck processes, drawn anew at every step with their exact transition. Beside them the flight
near a small body, with zonal gravity and sunlight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEP_S = 60.0  # longest step: processes of hours are sampled a hundred times, and Runge-Kutta errs by meters in days
STEP_OF_PERIOD = 0.01  # longest step near the Earth, of the time in which a circular orbit there turns by one radian
LONGEST_STEP_S = 21_600.0  # longest step far from a small body, where the tide of the Sun changes in days


@dataclass(frozen=True)
class PullingBodies:
    """The bodies that pull."""

    earth_gm: float  # earth_gm, moon_gm, sun_gm: in km^3/s^2
    moon_gm: float
    sun_gm: float
    moon_km: Callable[[float], Array]  # moon_km, sun_km: places (3,) from the Earth, km, at a time in seconds
    sun_km: Callable[[float], Array]

    def gravity(self, time: float, places: Array) -> Array:
        """Acceleration (runs, 3) relative to the Earth, km/s^2, at places (runs, 3), km."""
        total: Array = -self.earth_gm * places / np.sum(places * places, axis=1)[:, None] ** 1.5
        for gm, where in ((self.moon_gm, self.moon_km(time)), (self.sun_gm, self.sun_km(time))):
            toward = where - places
            total = total + gm * (
                toward / np.sum(toward * toward, axis=1)[:, None] ** 1.5 - where / (where @ where) ** 1.5
            )
        return total


@dataclass(frozen=True)
class Processes:
    """Steady standard deviations (15,) and correlation times (15,), s, of all but position and velocity."""

    sigmas: Array
    times_s: Array

    def evolve(self, values: Array, seconds: float, rng: np.random.Generator) -> Array:
        """Values (runs, 15) some seconds later."""
        keep = np.exp(-seconds / self.times_s)
        fresh: Array = rng.standard_normal(values.shape) * self.sigmas * np.sqrt(1.0 - keep**2)
        return keep * values + fresh


def fly_spacecraft(
    craft: Array, start: float, end: float, sky: PullingBodies, processes: Processes, rng: np.random.Generator
) -> Array:
    """Numbers (runs, 21) of spacecraft at a later time."""
    craft, time = craft.copy(), start
    while time < end:
        nearest = float(np.min(np.linalg.norm(craft[:, :3], axis=1)))
        step = min(STEP_S, STEP_OF_PERIOD * float(np.sqrt(nearest**3 / sky.earth_gm)), end - time)
        later = processes.evolve(craft[:, 6:], step, rng)
        pushes = [craft[:, 9:12], (craft[:, 9:12] + later[:, 3:6]) / 2.0, later[:, 3:6]]
        motion = craft[:, :6]
        slopes: list[Array] = []
        for share, push in ((0.0, pushes[0]), (0.5, pushes[1]), (0.5, pushes[1]), (1.0, pushes[2])):
            at = motion + share * step * slopes[-1] if slopes else motion
            slopes.append(np.hstack([at[:, 3:], sky.gravity(time + share * step, at[:, :3]) + push]))
        motion = motion + step / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3])
        craft = np.hstack([motion, later])
        time = end if end - time - step < 1e-6 else time + step
    return craft


def observe_body(craft: Array, camera_from_inertial: Array, body_km: Array, radius_km: float, errors: Array) -> Array:
    """Tangents of the two angles to a body and its range (runs, 3), as a camera with biases and noise has them.

    ``camera_from_inertial`` (3, 3) takes inertial to the assumed camera axes, ``errors`` (runs, 3) are those of the two
    tangents and of the diameter of the disk at unit distance in this image.
    """
    toward = (body_km - craft[:, :3]) @ camera_from_inertial.T
    seen = _rotate(craft[:, 6:9], toward)
    distance = np.sqrt(np.sum(seen * seen, axis=1))
    horizontal, vertical = np.arctan2(seen[:, 0], seen[:, 2]), np.arctan2(seen[:, 1], seen[:, 2])
    diameter = 2.0 * np.tan(np.arcsin(radius_km / distance)) + craft[:, 20] + errors[:, 2]
    return np.column_stack(
        [
            np.tan(horizontal) + craft[:, 18] + errors[:, 0],
            np.tan(vertical) + craft[:, 19] + errors[:, 1],
            radius_km / np.sin(np.arctan(diameter / 2.0)),
        ]
    )


def apply_burn(craft: Array, change: Array, body_from_inertial: Array, seconds: float) -> tuple[Array, Array]:
    """Spacecraft after a burn that changes velocities by ``change`` (runs, 3), and what accelerometers sense (runs, 3).

    ``body_from_inertial`` takes inertial to body axes; those of the accelerometers are off by the attitude error.
    """
    after = craft.copy()
    after[:, 3:6] += change
    felt = _rotate(craft[:, 6:9], change @ body_from_inertial.T)
    return after, felt + craft[:, 12:15] * seconds + craft[:, 15:18] * felt


def _rotate(rotations: Array, vectors: Array) -> Array:
    """Vectors (runs, 3) turned by rotation vectors (runs, 3): Rodrigues' formula."""
    angle = np.linalg.norm(rotations, axis=1, keepdims=True)
    axis = np.divide(rotations, angle, out=np.zeros_like(rotations), where=angle > 0.0)
    along = np.sum(axis * vectors, axis=1, keepdims=True)
    turned: Array = (
        vectors * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle) + axis * along * (1.0 - np.cos(angle))
    )
    return turned


@dataclass(frozen=True)
class SmallBodyField:
    """What moves a spacecraft near a small body: its gravity, the tide of the Sun, and sunlight on the spacecraft."""

    gm: float  # gm, sun_gm: in km^3/s^2
    sun_gm: float
    zonals: Mapping[int, float]  # by degree, the zonal coefficient J times that power of its radius, km
    pole: Array  # unit vector (3,) of the spin axis
    sun_km: Callable[[float], Array]  # place (3,) of the Sun from the body, km, at a time in seconds
    sunlight: float  # acceleration away from the Sun at 1 au, km/s^2

    def acceleration(self, time: float, places: Array) -> Array:
        """Acceleration (runs, 3), km/s^2, at places (runs, 3) from the body, km; zonals by Legendre polynomials."""
        distance = np.linalg.norm(places, axis=1, keepdims=True)
        upward, sine = places / distance, places @ self.pole[:, None] / distance
        radial, polar = np.ones_like(distance), np.zeros_like(distance)
        for degree, strength in self.zonals.items():
            legendre = np.polynomial.Legendre.basis(degree)
            radial = radial - (degree + 1) * strength / distance**degree * legendre(sine)
            polar = polar + strength / distance**degree * legendre.deriv()(sine)
        total = -self.gm / distance**2 * (radial * upward + polar * (self.pole - sine * upward))
        sun = self.sun_km(time)
        toward, au = sun - places, 149_597_870.7
        gap = np.linalg.norm(toward, axis=1, keepdims=True)
        pressed = -self.sunlight * au**2 * toward / gap**3
        tide = self.sun_gm * (toward / gap**3 - sun / np.linalg.norm(sun) ** 3)
        return np.asarray(total + tide + pressed)

    def coast(self, states: Array, start: float, end: float) -> Array:
        """States (runs, 6), km and km/s, at a later time, by the classic Runge-Kutta method."""
        time = start
        while time < end:
            nearest = float(np.min(np.linalg.norm(states[:, :3], axis=1)))
            step = min(2.0 * STEP_OF_PERIOD * float(np.sqrt(nearest**3 / self.gm)), LONGEST_STEP_S, end - time)
            slopes = list[Array]()
            for share in (0.0, 0.5, 0.5, 1.0):
                at = states + share * step * slopes[-1] if slopes else states
                slopes.append(np.hstack([at[:, 3:], self.acceleration(time + share * step, at[:, :3])]))
            states = states + step / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3])
            time = end if end - time - step < 1e-6 else time + step
        return states

    def aim(self, state: Array, start: float, end: float, target_km: Array) -> Array:
        """Change of velocity (3,), km/s, with which a state (6,) gets to a place (3,) at the end."""
        nudge, change = 1e-7, (target_km - state[:3]) / (end - start) - state[3:]
        for _ in range(4):
            tried = state + np.vstack([np.zeros(6), nudge * np.eye(6)[3:]]) + np.append(np.zeros(3), change)
            ends = self.coast(tried, start, end)[:, :3]
            change = change + np.linalg.solve((ends[1:] - ends[0]).T / nudge, target_km - ends[0])
        return np.asarray(change)
