"""Corrections from the center of the light of a body to the center of its figure."""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.core.frames import rotate
from giantlike.scene import TargetGeometry
from giantlike.shapes.base import PlacedEllipsoid

_LEAST_SINE = 1e-6  # of the angle between Sun and observer, made round: below, the light is that of a full moon
_LEAST_LIGHT = 1e-12  # of the light of a full moon, below which it is rounding
_FULL_MOON = 2.0 / 3.0  # of the radius: the mean of mu weighted with mu
_LEAST_ACROSS = 1e-9  # of the direction to the Sun, perpendicular to the line of sight, below which it is rounding


class Correction(StrEnum):
    """Correction of the centroid of the light to the center of the figure."""

    RENDERED = "rendered"  # of the body rendered at its predicted geometry
    KAASALAINEN_TANGA = "kaasalainen_tanga"  # by Liounis et al. eq. 3, meant for unresolved bodies.
    ELLIPSOID = "ellipsoid"
    """By the center of light of its best-fitting ellipsoid under the law of Lommel and Seeliger, in closed form."""
    NONE = "none"


def require_correction(name: str) -> None:
    """Raise :class:`~giantlike.core.errors.InputError` unless ``name`` is a :class:`Correction`."""
    known = [str(kind) for kind in Correction]
    require(name in known, f"correction must be one of {', '.join(known)}, got {name!r}")


def phase_correction_px(
    kind: Correction, rendered_px: Float, geometry: TargetGeometry, model: CameraModel, *, radius_px: float
) -> Float:
    """Correction from the center of the light to the center of the figure. ``rendered_px`` (2,); returns (2,)."""
    if kind in (Correction.RENDERED, Correction.NONE):
        return rendered_px if kind is Correction.RENDERED else np.zeros(2)
    shape, position_km = geometry.target.shape, geometry.position_camera_km
    by_position = model.project_jacobian(position_km)
    if kind is Correction.KAASALAINEN_TANGA or shape.circumscribing_radius_km == 0.0:
        sunlight = sunlight_px(geometry, model)
        return kaasalainen_tanga(sunlight, radius_px=radius_px, phase_angle_rad=geometry.phase_angle_rad)
    body_from_camera = geometry.camera_from_body.inv()
    light_body_km = ellipsoid_photocenter_km(
        shape.best_fit_ellipsoid,
        sun_direction_body=rotate(body_from_camera, geometry.sun_direction_camera),
        observer_direction_body=-rotate(body_from_camera, unit(position_km)),
    )
    return np.asarray(-by_position @ rotate(geometry.camera_from_body, light_body_km))


def sunlight_px(geometry: TargetGeometry, model: CameraModel) -> Float:
    """Direction of the sunlight in the image at the predicted center. Returns (2,), zero at zero phase."""
    along = model.project_jacobian(geometry.position_camera_km) @ geometry.sun_direction_camera
    length = float(np.linalg.norm(along))
    seen = length > _LEAST_ACROSS * model.focal_length_px / geometry.range_km
    return -along / length if seen else np.zeros(2)


def kaasalainen_tanga(sunlight: Float, *, radius_px: float, phase_angle_rad: float) -> Float:
    """Phase correction to add to a center of brightness.

    ``sunlight`` (2,), image axes, unit vector along which the light travels in the image, away from the Sun; returns
    (2,) px.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eq. 3.

    Examples
    --------
    >>> kaasalainen_tanga(np.array([1.0, 0.0]), radius_px=1.0, phase_angle_rad=np.radians(50.0)).round(9).tolist()
    [0.31, 0.0]
    """
    phase_deg = math.degrees(phase_angle_rad)
    return sunlight * (0.0062 if phase_deg < 80 else 0.0065) * radius_px * phase_deg


def ellipsoid_photocenter_km(
    placed: PlacedEllipsoid, *, sun_direction_body: ArrayLike, observer_direction_body: ArrayLike
) -> Float:
    r"""Center of the light of a homogeneous ellipsoid that scatters by the law of Lommel and Seeliger.

    ``sun_direction_body``, ``observer_direction_body``: unit vectors from the body to the Sun and to the observer, both
    far away; returns (3,), body axes, towards new phase it goes to the end of the crescent's middle.

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
        require(light > _LEAST_LIGHT, "the Sun must not stand right behind the body: none of its light is seen")
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
