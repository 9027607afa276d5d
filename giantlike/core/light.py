"""Stellar aberration."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, as_floats, require
from giantlike.core.units import SPEED_OF_LIGHT_KM_S


def aberrate(directions: ArrayLike, velocity_km_s: ArrayLike) -> Float:
    """Compute the apparent directions for a moving observer: stellar aberration by the Lorentz boost.

    Parameters
    ----------
    directions : (..., 3), inertial
        Vectors from observer to source, as an observer at rest would see them; the length is kept.
    velocity_km_s : (3,), km/s, inertial
        Velocity of the observer with respect to the frame at rest (the solar system barycenter).

    Returns
    -------
    (..., 3) float64
        Apparent vectors, inertial axes.

    Raises
    ------
    InputError
        Wrong shapes, or a speed that is not below that of light.

    Notes
    -----
    With ``b = v / c``, ``n`` the unit direction and ``g = 1 / sqrt(1 - b^2)``, the boosted direction is
    ``(n / g + b + (n.b) b g / (1 + g)) / (1 + n.b)``.

    >>> tilt = aberrate([1.0, 0.0, 0.0], [0.0, 29.79, 0.0])
    >>> round(float(np.degrees(np.arctan2(tilt[1], tilt[0])) * 3600), 3)
    20.496
    """
    vectors = as_floats(directions, (3,), "directions")
    beta = as_finite(velocity_km_s, (3,), "velocity_km_s") / SPEED_OF_LIGHT_KM_S
    require(
        float(beta @ beta) < 1.0, f"velocity_km_s must be below the speed of light, got {beta * SPEED_OF_LIGHT_KM_S}"
    )
    gamma = 1.0 / np.sqrt(1.0 - beta @ beta)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    n = vectors / length
    along = (n @ beta)[..., None]
    result: Float = length * (n / gamma + beta + along * beta * gamma / (1.0 + gamma)) / (1.0 + along)
    return result
