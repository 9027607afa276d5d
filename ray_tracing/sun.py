"""The Sun as a disk: where on it the light of a shadow ray comes from."""

from __future__ import annotations

import math

import numpy as np

from giantlike.core.arrays import Float, unit

_GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))


def disk_directions(sun: Float, radius_rad: float, samples: int, first: Float, turn: Float) -> list[Float]:
    """Directions to points of an evenly bright disk, as many for each of n rays.

    Parameters
    ----------
    sun : (4,) float64, unitless
        Unit vector to the center of the disk, and a zero.
    radius_rad : float, rad
        Angular radius of the disk.
    samples : int
        Rings of equal solid angle; each ray gets one point in each, a golden angle apart.
    first, turn : (n,) float64 in [0, 1)
        Where in its rings, and how far around, the pattern of each ray lies: random numbers.

    Returns
    -------
    list of (n, 4) float64
        Unit vectors and zeros, one array for each ring.

    Notes
    -----
    Averaged over uniform ``first`` and ``turn``, the mean over the points is the mean over the disk.
    """
    smallest = int(np.argmin(np.abs(sun[:3])))
    x_axis = unit(np.cross(sun[:3], np.eye(3)[smallest]))
    across, along = (np.append(axis, 0.0) for axis in (x_axis, np.cross(sun[:3], x_axis)))
    directions = []
    for ring in range(samples):
        cos_theta = 1.0 - (ring + first) / samples * (2.0 * math.sin(0.5 * radius_rad) ** 2)
        sin_theta = np.sqrt((1.0 - cos_theta) * (1.0 + cos_theta))
        angle = 2.0 * math.pi * turn + ring * _GOLDEN_ANGLE_RAD
        x, y = sin_theta * np.cos(angle), sin_theta * np.sin(angle)
        directions.append(x[:, None] * across + y[:, None] * along + cos_theta[:, None] * sun)
    return directions
