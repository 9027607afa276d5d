"""Measurements of a round body in an image: tangents of two angles and the diameter of its disk, or its range.

The disk diameter is that of the cone tangent to the sphere, cut at unit distance from a pinhole. All take any leading
axes. Equations are of Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, as_floats, require
from giantlike.core.values import Value


def tangent_angles(position_camera_km: ArrayLike) -> Float:
    """Tangents (..., 2), ``x / z`` and ``y / z``, of the angles to a body (eqs. 1, 2)."""
    position = as_floats(position_camera_km, (3,), "position_camera_km")
    require(bool((position[..., 2] > 0.0).all()), "position_camera_km needs z > 0: turn the camera to the body")
    return position[..., :2] / position[..., 2:]


def angular_diameter(range_km: ArrayLike, radius_km: float) -> Float:
    """Angle between opposite tangents to a sphere (eq. 4). ``range_km`` (...); returns (...) rad."""
    return np.asarray(2.0 * np.arcsin(radius_km / _outside(range_km, radius_km)))


def disk_diameter(range_km: ArrayLike, radius_km: float) -> Float:
    """Diameter of the disk of a sphere at unit distance, ``2 R / sqrt(range^2 - R^2)`` (eqs. 5-10).

    >>> float(disk_diameter(np.sqrt(2.0), 1.0).round(12))
    2.0
    """
    distance = _outside(range_km, radius_km)
    return np.asarray(2.0 * radius_km / np.sqrt(distance**2 - radius_km**2))


def range_from_disk_diameter(diameter: ArrayLike, radius_km: float) -> Float:
    """Range (...), km, of a sphere from the positive diameter (...) of :func:`disk_diameter` (eqs. 11, 12)."""
    across = as_floats(diameter, (), "diameter")
    require(bool((across > 0.0).all()), "diameter must be positive")
    return np.asarray(radius_km * np.sqrt(1.0 + (2.0 / across) ** 2))


def measure_body(position_camera_km: ArrayLike, radius_km: float) -> Float:
    """Measurement (..., 3) of a body: the tangents ``x / z`` and ``y / z``, and the range in km (eqs. 1-3)."""
    position = as_floats(position_camera_km, (3,), "position_camera_km")
    distance = _outside(np.linalg.norm(position, axis=-1), radius_km)
    return np.concatenate([tangent_angles(position), distance[..., None]], axis=-1)


def position_from_measurement(measurement: ArrayLike) -> Float:
    """Position (..., 3), km, camera axes, from two tangents and the range, the inverse of :func:`measure_body`."""
    values = as_floats(measurement, (3,), "measurement")
    ray = np.concatenate([values[..., :2], np.ones_like(values[..., :1])], axis=-1)
    position: Float = ray * (values[..., 2:] / np.linalg.norm(ray, axis=-1, keepdims=True))
    return position


def measurement_partials(position_camera_km: ArrayLike) -> Float:
    """Derivative of :func:`measure_body` by the position. ``position_camera_km`` (..., 3); returns (..., 3, 3)."""
    position = as_floats(position_camera_km, (3,), "position_camera_km")
    partials = np.zeros((*position.shape, 3))
    depth = position[..., 2]
    partials[..., 0, 0] = partials[..., 1, 1] = 1.0 / depth
    partials[..., 0, 2] = -position[..., 0] / depth**2
    partials[..., 1, 2] = -position[..., 1] / depth**2
    partials[..., 2, :] = position / np.linalg.norm(position, axis=-1, keepdims=True)
    return partials


def range_per_diameter(range_km: ArrayLike, radius_km: float) -> Float:
    """Derivative (...), km, negative, of the range by the disk diameter of :func:`disk_diameter` (eq. 24)."""
    distance = _outside(range_km, radius_km)
    return -(distance**2 - radius_km**2) / (distance * disk_diameter(distance, radius_km))


def range_sigma(range_km: ArrayLike, radius_km: float, diameter_px: ArrayLike, diameter_sigma_px: ArrayLike) -> Float:
    """Sigma (...), km, of a range from that of the diameter in pixels (eqs. 25, 26); radius 0: of a body far away."""
    distance = _outside(range_km, radius_km)
    relative = np.asarray(diameter_sigma_px, dtype=np.float64) / np.asarray(diameter_px, dtype=np.float64)
    return np.asarray((distance**2 - radius_km**2) / distance * relative)


@dataclass(frozen=True, slots=True, eq=False)
class TangentCamera(Value):
    """Pixels of an ideal camera and the tangents of angles."""

    focal_px: Float  # (2,); over pixel pitch along x and y; negative where a coordinate grows against its tangent
    principal_px: Float  # (2,); pixel of the boresight

    def __post_init__(self) -> None:
        focal_px = as_finite(self.focal_px, (2,), "focal_px")
        require(bool((focal_px != 0.0).all()), "focal_px must not be zero")
        self._keep(focal_px=focal_px, principal_px=as_finite(self.principal_px, (2,), "principal_px"))

    def pixels(self, tangents: ArrayLike) -> Float:
        """Pixels (..., 2) of tangents (..., 2) of angles (eqs. 13, 14, where both focal lengths are negative)."""
        return self.principal_px + self.focal_px * as_floats(tangents, (2,), "tangents")

    def tangents(self, pixels: ArrayLike) -> Float:
        """Tangents of angles of pixels. ``pixels`` (..., 2) px; returns (..., 2)."""
        return (as_floats(pixels, (2,), "pixels") - self.principal_px) / self.focal_px

    def tangent_sigmas(self, sigmas_px: ArrayLike) -> Float:
        """Standard deviations of tangents from those of pixels, both (..., 2) (eqs. 15-20)."""
        return as_floats(sigmas_px, (2,), "sigmas_px") / np.abs(self.focal_px)


def _outside(range_km: ArrayLike, radius_km: float) -> Float:
    """Ranges as an array, all of them beyond the radius."""
    distance = as_floats(range_km, (), "range_km")
    require(radius_km >= 0.0, f"radius_km must be >= 0, got {radius_km}")
    nearest = float(np.min(distance, initial=np.inf))
    require(nearest > radius_km, f"range_km must exceed the radius of {radius_km:g} km, got {nearest:g}")
    return distance
