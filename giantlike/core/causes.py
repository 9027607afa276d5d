"""Causes of the errors of a fix, independent of each other, and covariances split by cause: the error budget.

They correlate differently between images (noise is new in each, errors of the camera and of the scale of a shape are
common to all), so a filter needs them separately.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.deprecation import forward_names
from giantlike.core.values import check_covariance, read_only


class Cause(StrEnum):
    """Cause of an error of a fix; the values are those of JSON and tables."""

    NOISE = "noise"
    """Noise of the pixels; in a fix without parts, everything."""
    BACKGROUND = "background"
    """Light that is not of the body: level and slope of the background, stray light."""
    REFLECTANCE = "reflectance"
    """The reflectance law and its parameters."""
    ALBEDO = "albedo"
    """Markings of the surface that the shape model does not hold."""
    RELIEF = "relief"
    """Relief that the shape model does not hold."""
    PSF = "psf"
    """Width and wings of the point spread function."""
    EDGE = "edge"
    """The profile of brightness across the limb that an edge is located with."""
    ALTITUDE = "altitude"
    """Altitude of the visible limb: haze and atmosphere."""
    SHAPE_SCALE = "shape_scale"
    """Size of the shape model, all axes by the same factor."""
    POLE = "pole"
    """Direction of the rotation axis of the body."""
    SPIN = "spin"
    """Rotation of the body about its axis."""
    SUN = "sun"
    """Direction of the Sun."""
    ORIENTATION = "orientation"
    """Orientation of body and Sun in the image, by the error of the attitude."""
    CAMERA = "camera"
    """Parameters of the camera model."""
    ATTITUDE = "attitude"
    """Attitude of the camera."""
    EPHEMERIS = "ephemeris"
    """Ephemeris of the target, across the line of sight and along it."""
    ABERRATION = "aberration"
    """Velocity of the observer, by which stellar aberration is removed."""
    EPOCH = "epoch"
    """Epoch of the image, by which the proper motion of stars is applied."""


OUTSIDE = (Cause.ATTITUDE, Cause.EPHEMERIS, Cause.ABERRATION, Cause.EPOCH)
"""Causes that do not affect the position in camera axes, only its comparison with inertial axes or a prediction.

An attitude error also rotates the predicted body: its effect on the position in the image is ``ORIENTATION``."""
IN_POSITION = tuple(cause for cause in Cause if cause not in OUTSIDE)
"""Causes in ``covariance_camera_km2``: causes in the image, and the camera that converts pixels to directions."""
IN_IMAGE = tuple(cause for cause in IN_POSITION if cause is not Cause.CAMERA)
"""Causes in ``covariance_px2``: noise, and models that move the center measured in the image.

The scale of the shape, its pole, its spin and its orientation are among them: a shape that is too large or rotated is
fitted at another position, for any camera.
"""
SUM_TOLERANCE = 1e-6
"""Tolerance of a covariance against the sum of its parts, divided by the product of the standard deviations.

Both are computed with Jacobians whose scales differ by up to about 1e8 (range in km / angle of a pixel), which leaves
six digits in float64. Parts of lower rank are positive semi-definite to as many.
"""


def sum_parts(parts: Mapping[Cause, Float], causes: Iterable[Cause] = IN_IMAGE) -> Float:
    """Sum (k, k) of the parts, (k, k) each, of a covariance; zero where none of the causes is in ``parts``.

    >>> parts = {Cause.NOISE: np.eye(2), Cause.RELIEF: 2.0 * np.eye(2), Cause.CAMERA: np.eye(2)}
    >>> sum_parts(parts)
    array([[3., 0.],
           [0., 3.]])
    """
    total = np.zeros_like(next(iter(parts.values())), dtype=np.float64)
    for cause in causes:
        if cause in parts:
            total = total + parts[cause]
    return total


def add_parts(first: Mapping[Cause, Float], second: Mapping[Cause, Float]) -> dict[Cause, Float]:
    """Add two covariances, (k, k) each, cause by cause.

    >>> both = add_parts({Cause.NOISE: np.eye(1)}, {Cause.NOISE: np.eye(1), Cause.RELIEF: np.eye(1)})
    >>> both[Cause.NOISE], both[Cause.RELIEF]
    (array([[2.]]), array([[1.]]))
    """
    total = dict(first)
    for cause, part in second.items():
        total[cause] = total[cause] + part if cause in total else part
    return total


def checked_parts(parts: Mapping[Cause, Float], size: int) -> dict[Cause, Float]:
    """Check the parts of a covariance, (size, size) by Cause or its value, and make them read-only."""
    checked = {}
    for key, part in parts.items():
        cause = Cause(key)
        matrix = as_floats(part, (size, size), f"parts: {cause}")
        require(matrix.ndim == 2, f"parts: {cause} must have shape ({size}, {size}), got {matrix.shape}")
        check_covariance(matrix, f"parts: {cause}", tolerance=SUM_TOLERANCE)
        checked[cause] = read_only(matrix)
    return {cause: checked[cause] for cause in Cause if cause in checked}


def checked_partials(partials: Mapping[Cause, Float], size: int) -> dict[Cause, Float]:
    """Check derivatives (size, m) of a position, keyed by Cause or its value, and make them read-only."""
    checked = {}
    for key, partial in partials.items():
        matrix = as_floats(partial, (), f"partials: {key}")
        require(
            matrix.ndim == 2 and len(matrix) == size, f"partials: {key} must be ({size}, m), got shape {matrix.shape}"
        )
        checked[Cause(key)] = read_only(matrix)
    return {cause: checked[cause] for cause in Cause if cause in checked}


def require_sum(parts: Mapping[Cause, Float], causes: Iterable[Cause], covariance: Float, name: str) -> None:
    """Raise unless parts (k, k) sum to a covariance (n, n) of the leading coordinates, if that is finite."""
    count = len(covariance)
    total = sum_parts(parts, causes)[:count, :count]
    if not (np.isfinite(total).all() and np.isfinite(covariance).all()):
        return
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), np.diagonal(total)))
    scale = np.outer(sigma, sigma)
    worst = float(np.max(np.abs(total - covariance) / np.where(scale > 0.0, scale, 1.0), initial=0.0))
    require(worst <= SUM_TOLERANCE, f"parts must sum to {name}, they differ by {worst:.2g} of it")


__getattr__ = forward_names(__name__, {__name__: "summed:sum_parts added:add_parts"}, until="0.4")
