"""Errors of an attitude that all its stars share: the camera model, the velocity of the observer, the epoch.

Noise averages out over many stars, these do not. Each is a consider term: with the derivative ``G`` of the rotation by
the centroids, ``(H^T W H)^-1 H^T W``, an error that moves the stars by ``d`` px rotates the attitude by ``G d``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from giantlike.camera import Camera
from giantlike.catalogs import StarTable, apparent_directions
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.image import Image
from giantlike.stars.attitude import AttitudeSolution
from giantlike.stars.field import EPOCH_WHEN_UNKNOWN, StarField
from giantlike.stars.options import StarOptions


def response_to_camera(solution: AttitudeSolution, field: StarField) -> Float:
    """Derivative (3, m) of the small rotation to the true attitude by the parameters of its camera model, in order."""
    vectors = rotate(solution.camera_from_inertial, field.directions_inertial)
    return -np.tensordot(solution.by_pixels, solution.model.parameter_jacobian(vectors), axes=2)


def attitude_parts(
    solution: AttitudeSolution, field: StarField, by_camera: Float, camera: Camera, image: Image, options: StarOptions
) -> Mapping[Cause, Float]:
    """Covariance of an attitude by cause; ``by_camera`` (3, m) as of :func:`response_to_camera`."""
    parts = {Cause.NOISE: solution.covariance_rad2}
    known = camera.uncertainty
    if known is not None:
        chosen = by_camera[:, [solution.model.parameter_names.index(name) for name in known.estimated]]
        parts[Cause.CAMERA] = _symmetric(chosen @ known.covariance @ chosen.T)
    if image.observer is None:
        turn = _response_to_directions(solution, field, _aberration(field.directions_inertial))
        beta = options.unknown_speed_km_s / SPEED_OF_LIGHT_KM_S / np.sqrt(3.0)
        parts[Cause.ABERRATION] = _symmetric(beta**2 * turn @ turn.T)
    if image.epoch is None:
        moved = _response_to_directions(solution, field, _motion_per_year(field.stars)[:, :, None])
        parts[Cause.EPOCH] = _symmetric(options.unknown_epoch_years**2 * moved @ moved.T)
    return parts


def _response_to_directions(solution: AttitudeSolution, field: StarField, shifts: Float) -> Float:
    """Rotations (3, j), rad, by shifts (k, 3, j) of the inertial directions of the stars used."""
    matrix = solution.camera_from_inertial.as_matrix()
    by_vector = solution.model.project_jacobian(field.directions_inertial @ matrix.T)
    response: Float = np.einsum("ink,nkc,cd,ndj->ij", solution.by_pixels, by_vector, matrix, shifts, optimize=True)
    return response


def _aberration(directions: Float) -> Float:
    """Shifts (n, 3, 3) of directions (n, 3) by a velocity in units of the speed of light, to first order."""
    return np.eye(3) - directions[:, :, None] * directions[:, None, :]


def _motion_per_year(stars: StarTable) -> Float:
    """Shifts (n, 3) of stars in a year by their proper motion, rad."""
    before, after = (apparent_directions(stars, et_of_julian_year(EPOCH_WHEN_UNKNOWN + year)) for year in (-0.5, 0.5))
    return after - before


def _symmetric(matrix: Float) -> Float:
    return (matrix + matrix.T) / 2.0
