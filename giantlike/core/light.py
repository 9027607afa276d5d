"""Stellar aberration of directions, and of bodies of finite size."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, as_floats
from giantlike.core.errors import InputError
from giantlike.core.units import SPEED_OF_LIGHT_KM_S


def aberrate(directions: ArrayLike, velocity_km_s: ArrayLike) -> Float:
    """Compute the apparent directions for a moving observer: stellar aberration by the Lorentz boost, inertial axes.

    With ``b = v / c``, ``n`` the unit direction and ``g = 1 / sqrt(1 - b^2)``, the boosted direction (..., 3) is ``(n /
    g + b + (n.b) b g / (1 + g)) / (1 + n.b)``.

    >>> tilt = aberrate([1.0, 0.0, 0.0], [0.0, 29.79, 0.0])
    >>> round(float(np.degrees(np.arctan2(tilt[1], tilt[0])) * 3600), 3)
    20.496
    """
    vectors = as_floats(directions, (3,), "directions")
    beta, gamma = _beta_gamma(velocity_km_s)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    n = vectors / length
    along = (n @ beta)[..., None]
    result: Float = length * (n / gamma + beta + along * beta * gamma / (1.0 + gamma)) / (1.0 + along)
    return result


def boosted(positions_km: ArrayLike, velocity_km_s: ArrayLike) -> Float:
    """Compute apparent positions of bodies for a moving observer: direction by aberration, distance by apparent size.

    ``positions_km`` (..., 3), inertial axes; returns apparent vectors (..., 3), km: a body of radius R covers the angle
    ``asin(R / length)``.

    Emission of the light and its reception are ``(c t, x) = (-r, r n)`` apart, with ``r`` the distance and ``n`` the
    unit direction. The Lorentz boost to the observer gives a vector of the length ``r g (1 + n.b)``, with ``b = v / c``
    and ``g = 1 / sqrt(1 - b^2)``. That is the distance in the frame of the observer, which determines the apparent
    size: a body that moves along with the observer appears as far as it is. SPICE's ``LT+S`` keeps the length, which is
    in error by 1e-4 of the range at the speed of the Earth.

    >>> round(float(np.linalg.norm(boosted([384400.0, 0.0, 0.0], [29.79, 0.0, 0.0])) - 384400.0), 1)
    38.2
    """
    vectors = as_floats(positions_km, (3,), "positions_km")
    beta, gamma = _beta_gamma(velocity_km_s)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    along = (vectors @ beta)[..., None]
    result: Float = vectors + gamma * beta * (length + along * gamma / (1.0 + gamma))
    return result


def boost_jacobian(position_km: ArrayLike, velocity_km_s: ArrayLike) -> Float:
    """Derivative (3, 3) of :func:`boosted` by the position; vectors in inertial axes."""
    position = as_finite(position_km, (3,), "position_km")
    beta, gamma = _beta_gamma(velocity_km_s)
    along = position / np.linalg.norm(position) + beta * gamma / (1.0 + gamma)
    return np.eye(3) + gamma * np.outer(beta, along)


def _beta_gamma(velocity_km_s: ArrayLike) -> tuple[Float, float]:
    """Velocity (3,) in units of the speed of light, and the Lorentz factor."""
    beta = as_finite(velocity_km_s, (3,), "velocity_km_s") / SPEED_OF_LIGHT_KM_S
    squared = float(beta @ beta)
    if not squared < 1.0:  # its text costs more than the rest
        raise InputError(f"velocity_km_s must be below the speed of light, got {beta * SPEED_OF_LIGHT_KM_S}")
    return beta, float(1.0 / np.sqrt(1.0 - squared))
