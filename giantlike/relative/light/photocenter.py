"""Where the light of an ellipsoid lies, in closed form."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.core.frames import rotate
from giantlike.shapes.base import PlacedEllipsoid

_LEAST_SINE = 1e-6  # of the angle between Sun and observer, made round: below, the light is that of a full moon
_LEAST_LIGHT = 1e-12
_FULL_MOON = 2.0 / 3.0  # of the radius: the mean of mu weighted with mu


def ellipsoid_photocenter_km(
    placed: PlacedEllipsoid, *, sun_direction_body: ArrayLike, observer_direction_body: ArrayLike
) -> Float:
    r"""Center of the light of a homogeneous ellipsoid that scatters by the law of Lommel and Seeliger.

    Parameters
    ----------
    placed : PlacedEllipsoid
    sun_direction_body, observer_direction_body : (3,), unitless, body
        Unit vectors from the body to the Sun and to the observer, both far away.

    Returns
    -------
    (3,) float64, km, body
        From the origin of the shape to the mean place of what is seen and lit, weighted by how bright it appears; its
        projection is the photocenter. Towards new phase it goes to the end of the crescent's middle.

    Raises
    ------
    InputError
        A direction is not a unit vector, or no light is seen (Sun behind the body).

    Notes
    -----
    Derived here. With ``x = E u``, E the matrix of the semi-axes and u on the unit sphere, ``mu dA`` is proportional to
    ``p (u . e')`` and ``mu0 dA`` to ``q (u . s')``, where ``p e' = E^-1 e`` and ``q s' = E^-1 s`` for observer e and
    Sun s. The light of a piece of surface, ``mu mu0 / (mu + mu0) dA``, becomes

    .. math:: p q (u \cdot s') (u \cdot e') / (q\, u \cdot s' + p\, u \cdot e') \, d\Omega .

    In longitude and latitude about the plane of s' and e' the denominator is ``R cos(latitude) cos(t)``, with t counted
    from the direction of ``q s' + p e'``. Latitude integrates to pi/2 for the light and 4/3 for its moment, and
    longitude, between the terminator and the limb, to elementary functions of t.
    """
    sun = as_finite(sun_direction_body, (3,), "sun_direction_body")
    observer = as_finite(observer_direction_body, (3,), "observer_direction_body")
    for name, vector in (("sun_direction_body", sun), ("observer_direction_body", observer)):
        require(abs(float(vector @ vector) - 1.0) < 1e-6, f"{name} must be a unit vector, got {vector}")
    to_axes = placed.body_from_axes.inv()
    radii = np.asarray(placed.ellipsoid.radii_km)
    rounded_sun, rounded_observer = rotate(to_axes, sun) / radii, rotate(to_axes, observer) / radii
    middle = unit(rounded_sun + rounded_observer) if float(sun @ observer) > -1.0 + 1e-12 else np.zeros(3)
    side = rounded_sun - float(rounded_sun @ middle) * middle
    length = float(np.linalg.norm(side))
    if length < _LEAST_SINE * float(np.linalg.norm(rounded_sun)):
        mean = _FULL_MOON * middle
    else:
        axis = side / length
        light, along, across = _lune(_angle(rounded_sun, middle, axis), _angle(rounded_observer, middle, axis))
        require(light > _LEAST_LIGHT, "the Sun stands behind the body: none of its light is seen")
        mean = (along * middle + across * axis) / light
    return placed.center_body_km + rotate(placed.body_from_axes, radii * mean)


def _angle(vector: Float, middle: Float, axis: Float) -> float:
    """Longitude of a vector (3,) from ``middle`` towards ``axis``, rad."""
    return math.atan2(float(vector @ axis), float(vector @ middle))


def _lune(sun: float, observer: float) -> tuple[float, float, float]:
    """Light of the lune between terminator and limb, and its moments along and across the zero of longitude."""
    low, high = max(sun, observer) - 0.5 * math.pi, min(sun, observer) + 0.5 * math.pi
    total, product = sun + observer, math.sin(sun) * math.sin(observer)

    def antiderivatives(t: float) -> Float:
        light = math.sin(t - total) + product * math.asinh(math.tan(t))
        along = 0.5 * t * math.cos(sun - observer) + 0.25 * math.sin(2.0 * t - total)
        across = 0.5 * math.cos(total) * math.sin(t) ** 2 + math.sin(total) * (0.5 * t - 0.25 * math.sin(2.0 * t))
        across -= product * math.log(math.cos(t))
        return np.array([0.5 * math.pi * light, 4.0 / 3.0 * along, 4.0 / 3.0 * across])

    light, along, across = antiderivatives(high) - antiderivatives(low)
    return float(light), float(along), float(across)
