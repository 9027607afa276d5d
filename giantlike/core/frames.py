"""Directions, attitudes and small rotations: exact geometry without physics.

Rotations are scipy's, named ``target_from_source``, so that neighbors cancel in products; a :class:`FrameRotation`
holds names that are known only at run time and checks every product.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, as_floats, require, unit
from giantlike.core.errors import FrameMismatchError
from giantlike.core.values import Value

INERTIAL_FRAME = "J2000"  # name that SPICE gives the axes of the ICRF
INERTIAL_FROM_ECLIPTIC = Rotation.from_euler("x", 84381.448 / 3600.0, degrees=True)
"""To these axes from ECLIPJ2000 of SPICE: the obliquity at J2000, IAU 1976."""


def require_same_frame(have: str, need: str) -> None:
    """Raise unless two frame names agree; an empty name denotes an unknown frame and matches any other."""
    if have and need and have != need:
        raise FrameMismatchError(have, need)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRotation(Value):
    """A rotation ``target_from_source`` between two frames with names that every product checks.

    target, source: names of the frames, such as ``"CASSINI_ISS_NAC"`` and ``"J2000"``; empty where a name is not known.

    >>> bus_from_inertial = FrameRotation(rotation=Rotation.identity(), target="BUS", source="J2000")
    >>> camera_from_bus = FrameRotation(rotation=Rotation.identity(), target="CAMERA", source="BUS")
    >>> (camera_from_bus * bus_from_inertial).target
    'CAMERA'
    """

    rotation: Rotation  # one or n rotations that take vectors in ``source`` axes to ``target`` axes
    target: str
    source: str

    def __mul__(self, other: FrameRotation) -> FrameRotation:
        """``target_from_source * source_from_other``; the inner frames must agree."""
        require_same_frame(other.target, self.source)
        return FrameRotation(rotation=self.rotation * other.rotation, target=self.target, source=other.source)

    def inv(self) -> FrameRotation:
        """Return ``source_from_target``."""
        return FrameRotation(rotation=self.rotation.inv(), target=self.source, source=self.target)

    def between(self, target: str, source: str) -> Rotation:
        """Return the plain rotation for callers that need ``target_from_source``."""
        require_same_frame(self.target, target)
        require_same_frame(self.source, source)
        return self.rotation


def direction_from_radec(ra_deg: ArrayLike, dec_deg: ArrayLike) -> Float:
    """Unit vectors (..., 3), inertial axes, of right ascensions and declinations (...).

    >>> direction_from_radec(90.0, 0.0).round(12).tolist()
    [0.0, 1.0, 0.0]
    """
    ra, dec = np.radians(as_floats(ra_deg, (), "ra_deg")), np.radians(as_floats(dec_deg, (), "dec_deg"))
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec) * np.ones_like(ra)], axis=-1)


def radec_from_direction(direction_inertial: ArrayLike) -> tuple[Float, Float]:
    """Return the right ascensions and declinations, deg, (...), of vectors (..., 3)."""
    x, y, z = np.moveaxis(as_floats(direction_inertial, (3,), "direction_inertial"), -1, 0)
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))


def east_north(ra_deg: ArrayLike, dec_deg: ArrayLike) -> tuple[Float, Float]:
    """Unit vectors (..., 3), inertial axes, to the east and to the north at points (...) of the sky."""
    ra, dec = np.radians(as_floats(ra_deg, (), "ra_deg")), np.radians(as_floats(dec_deg, (), "dec_deg"))
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], axis=-1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=-1)
    return east, north


def position_angle_deg(direction_inertial: ArrayLike, toward_inertial: ArrayLike) -> float:
    """Compute the position angle of a direction at a point of the sky."""
    point = unit(as_finite(direction_inertial, (3,), "direction_inertial"))
    toward = as_finite(toward_inertial, (3,), "toward_inertial")
    east = np.cross([0.0, 0.0, 1.0], point)
    require(float(np.linalg.norm(east)) > 1e-12, "position angle is not defined at a celestial pole")
    east /= np.linalg.norm(east)
    north = np.cross(point, east)
    return float(np.degrees(np.arctan2(toward @ east, toward @ north)) % 360.0)


def pointing_deg(camera_from_inertial: Rotation, line_of_sight_camera: ArrayLike) -> tuple[float, float, float]:
    """RA, Dec and roll in degrees of a line of sight of a camera, usually that of the center of the image."""
    inertial_from_camera = camera_from_inertial.inv()
    los = rotate(inertial_from_camera, as_finite(line_of_sight_camera, (3,), "line_of_sight_camera"))
    ra, dec = radec_from_direction(los)
    up = rotate(inertial_from_camera, [0.0, -1.0, 0.0])
    return float(ra), float(dec), position_angle_deg(los, up)


def camera_from_inertial_of_pointing(ra_deg: float, dec_deg: float, roll_deg: float) -> Rotation:
    """Return the attitude of a pointing: the inverse of :func:`pointing_deg` for the boresight.

    >>> r = camera_from_inertial_of_pointing(10.0, 20.0, 30.0)
    >>> [round(v, 9) for v in pointing_deg(r, [0.0, 0.0, 1.0])]
    [10.0, 20.0, 30.0]
    """
    z = direction_from_radec(ra_deg, dec_deg)
    east, north = east_north(ra_deg, dec_deg)
    roll = np.radians(roll_deg)
    up = np.cos(roll) * north + np.sin(roll) * east
    return Rotation.from_matrix(np.stack([np.cross(-up, z), -up, z]))


def rotate(rotation: Rotation, vectors: ArrayLike) -> Float:
    """Rotate vectors (..., 3): ``rotation.apply`` refuses read-only arrays such as the fields of a value."""
    array = as_floats(vectors, (3,), "vectors")
    matrix = rotation.as_matrix()
    return array @ matrix.T if matrix.ndim == 2 else (matrix @ array[..., None])[..., 0]


def turn_between(first: Float, second: Float) -> Rotation:
    """Smallest rotation from one unit vector (3,) to another in the same axes, less than 90 deg apart."""
    axis = np.cross(first, second)
    sine = float(np.linalg.norm(axis))
    return Rotation.from_rotvec(axis * (math.asin(min(sine, 1.0)) / sine if sine > 0.0 else 0.0))


def rotation_between(estimate: Rotation, truth: Rotation) -> Float:
    """Return the small rotation vector (3,), rad, ``e`` with ``truth = Rotation.from_rotvec(e) * estimate``."""
    return np.asarray((truth * estimate.inv()).as_rotvec(), dtype=np.float64)


def quaternion_xyzw(rotation: Rotation) -> Float:
    """Return the quaternion (4,), scalar last, with non-negative scalar, so that equal attitudes print equal."""
    return np.asarray(rotation.as_quat(canonical=True), dtype=np.float64)


def rotation_from_xyzw(quaternion: ArrayLike, name: str = "quaternion") -> Rotation:
    """Return the rotation of a quaternion from a file or a user. ``quaternion`` (4,), scalar last."""
    q = as_finite(quaternion, (4,), name)
    norm = math.hypot(*q)  # without overflow
    require(abs(norm - 1.0) < 1e-3, f"{name} must have norm 1, got {norm:.6g}; give it scalar last: x, y, z, w")
    return Rotation.from_quat(q)


def turned_about(vectors: Float, jacobian: Float) -> Float:
    """Derivatives (n, k, 3) by a small rotation, from those by vectors (n, 3): ``-jacobian @ skew(vectors)``."""
    x, y, z = vectors.T[:, :, None]
    a, b, c = np.moveaxis(jacobian, -1, 0)
    result = np.empty(jacobian.shape)
    result[..., 0], result[..., 1], result[..., 2] = y * c - z * b, z * a - x * c, x * b - y * a
    return result


def skew(vectors: Float) -> Float:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(a) @ b == cross(a, b)``."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2)
