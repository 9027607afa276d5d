"""Effect of an error of the altitude of a limb, by haze or an atmosphere, on its points."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float

_FROM_SUN_TO_TERMINATOR = 2.0  # change of the altitude from a limb below the Sun to the terminator, in its sigmas


def lift_points(lift_px: Float, sights: Float, position_camera_km: Float, sun_direction_camera: Float) -> Float:
    """Motions (n, 2) of the points of a limb with its altitude: uniform, and by the elevation of the Sun at each.

    ``lift_px`` (n,), outward motion, px (of an image, change of the signal, DN) with one standard deviation of the
    altitude, or with 1 km; ``sights`` (n, 3), unit vectors toward the points; ``sun_direction_camera``: from body to
    Sun.
    """
    outward = np.linalg.norm(position_camera_km) * sights - position_camera_km
    height = outward @ sun_direction_camera / np.maximum(np.linalg.norm(outward, axis=1), 1e-300)
    height -= np.average(height, weights=lift_px**2)
    return np.stack([lift_px, lift_px * _FROM_SUN_TO_TERMINATOR * height], axis=1)
