"""Light time and aberration ray by ray: photons from points of a moving body that meet a moving observer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.independent.laws import Float

LIGHT_KM_S = 299_792.458  # speed of light, km/s (exact by definition of the meter)


@dataclass(frozen=True, eq=False)
class Motion:
    """Velocities with respect to the frame in which light and clocks are described (the solar system barycenter).

    body_km_s: in camera axes; velocity of the body; constant while its light travels. Its turning in that time (an
        angle of rate times light time) is left to the orientation given, and its own contraction (v^2 / c^2 / 2, 5e-9
        at 30 km/s) is left out.
    """

    observer_km_s: ArrayLike = (0.0, 0.0, 0.0)  # in camera axes; velocity of the camera
    body_km_s: ArrayLike = (0.0, 0.0, 0.0)

    @property
    def speed(self) -> float:
        """Sum of both speeds over that of light."""
        total = np.linalg.norm(np.asarray(self.observer_km_s)) + np.linalg.norm(np.asarray(self.body_km_s))
        return float(total) / LIGHT_KM_S


def _boost(velocity: Float) -> Float:
    """Lorentz matrix (4, 4) that takes (ct, x, y, z) to the frame of an observer with this velocity, in units of c."""
    squared = float(velocity @ velocity)
    matrix = np.eye(4)
    if squared == 0.0:
        return matrix
    gamma = 1.0 / np.sqrt(1.0 - squared)
    matrix[0, 0] = gamma
    matrix[0, 1:] = matrix[1:, 0] = -gamma * velocity
    matrix[1:, 1:] += (gamma - 1.0) * np.outer(velocity, velocity) / squared
    return matrix


def _transform(directions: Float, matrix: Float) -> Float:
    """Unit directions to sources in another frame: the photon's four-vector is (1, -n)."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    photon = np.concatenate([np.ones((*unit.shape[:-1], 1)), -unit], axis=-1) @ matrix.T
    return np.asarray(-photon[..., 1:] / photon[..., :1], dtype=float)


def aberrated(directions: ArrayLike, velocity_km_s: ArrayLike) -> Float:
    """Return unit directions (..., 3) as a moving observer sees them, of directions (..., 3) at rest."""
    return _transform(np.asarray(directions, dtype=float), _boost(np.asarray(velocity_km_s, dtype=float) / LIGHT_KM_S))


def unaberrated(rays: Float, motion: Motion) -> Float:
    """Turn rays of a moving camera into straight paths relative to a moving body.

    A photon that arrives from n (frame at rest) was, s km of path earlier, at ``observer + n s``, when the body stood
    back by ``v s / c``: relative to the body as it stands at reception, it came along ``n + v / c``.

    ``rays`` (n, 3), camera axes, of the moving observer; returns (n, 3).
    """
    backward = _boost(-np.asarray(motion.observer_km_s, dtype=float) / LIGHT_KM_S)
    return np.asarray(_transform(rays, backward) + np.asarray(motion.body_km_s, dtype=float) / LIGHT_KM_S, dtype=float)


def apparent_geometry(
    point_at: Callable[[float], ArrayLike], observer_km: ArrayLike, observer_velocity_km_s: ArrayLike, seconds: float
) -> tuple[Float, float]:
    """Find where a moving observer sees a moving point, by the event at which its light left. Returns (3,)."""
    place = np.asarray(observer_km, dtype=float)
    left = seconds
    for _ in range(50):
        earlier = seconds - float(np.linalg.norm(np.asarray(point_at(left), dtype=float) - place)) / LIGHT_KM_S
        if abs(earlier - left) < 1e-12 * max(abs(seconds - earlier), 1.0):
            break
        left = earlier
    return aberrated(np.asarray(point_at(left), dtype=float) - place, observer_velocity_km_s), left


def apparent_disk(position_km: ArrayLike, radius_km: float, motion: Motion, points: int = 72) -> tuple[Float, float]:
    """Find the cone under which a moving camera sees a moving sphere, from tangent rays.

    Returns (3,), axis of the cone, a unit vector, and its half angle, rad.
    """
    position = np.asarray(position_km, dtype=float)
    velocity = np.asarray(motion.body_km_s, dtype=float) / LIGHT_KM_S
    distance = float(np.linalg.norm(position))
    axis = position / distance
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    angles = 2.0 * np.pi * np.arange(points) / points
    half = np.arcsin(radius_km / distance)
    around = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up
    paths = np.cos(half) * axis + np.sin(half) * around  # tangent to the sphere as it stands at reception
    # a path relative to the body is n + v of a unit vector n: n = s path - v with |n| = 1 gives s.
    along = paths @ velocity
    lengths = along + np.sqrt(along**2 + 1.0 - velocity @ velocity)
    seen = aberrated(lengths[:, None] * paths - velocity, motion.observer_km_s)
    # a circle of directions lies in a plane: seen . axis = cos(half angle).
    normal = np.linalg.lstsq(seen, np.ones(points), rcond=None)[0]
    size = float(np.linalg.norm(normal))
    center = normal / size
    spread = np.linalg.norm(np.cross(seen, center), axis=1)
    return np.asarray(center, dtype=float), float(np.arctan2(spread.mean(), (seen @ center).mean()))
