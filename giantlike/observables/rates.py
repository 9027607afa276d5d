"""Rotation rates of a camera from the attitudes of neighboring images."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float

_MAX_GAP_S = 600.0
"""Longest time to a neighbor: a prior."""
_SAME_RATE = 0.1
"""Largest difference of the rates before and after an image relative to the larger one: a prior."""
_SIGMAS = 3.0


def camera_rates(et: Float, attitudes: Rotation, sigmas_rad: Float) -> Float:
    """Rates of a camera that rotates steadily from the image before to the image after.

    ``et`` (n,), strictly increasing; ``attitudes`` n of ``camera_from_inertial``; ``sigmas_rad`` (n,), of their errors
    about any axis, 0 where unknown. Returns (n, 3) rad/s, camera axes; NaN where a neighbor is missing or farther than
    600 s, and where the rates before and after differ by more than 10 % and three sigmas, as by a slew.
    """
    rates = np.full((et.size, 3), np.nan)
    if et.size < 3:
        return rates
    steps_s = np.diff(et)
    between = -(attitudes[1:] * attitudes[:-1].inv()).as_rotvec() / steps_s[:, None]
    sigmas = np.hypot(sigmas_rad[1:], sigmas_rad[:-1]) / steps_s
    differ = np.linalg.norm(between[1:] - between[:-1], axis=1)
    size = np.linalg.norm(between, axis=1)
    allowed = np.maximum(_SAME_RATE * np.maximum(size[1:], size[:-1]), _SIGMAS * np.hypot(sigmas[1:], sigmas[:-1]))
    steady = (differ <= allowed) & (np.maximum(steps_s[1:], steps_s[:-1]) <= _MAX_GAP_S)
    over = -(attitudes[2:] * attitudes[:-2].inv()).as_rotvec() / (et[2:] - et[:-2])[:, None]
    rates[1:-1][steady] = over[steady]
    return rates
