"""A small rotation of one image's camera against the attitude it came with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera_models.base import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats
from giantlike.core.frames import skew


def misaligned(camera_from_inertial: Rotation, misalignment_rad: ArrayLike) -> Rotation:
    """Attitude of a camera that is turned by a small rotation vector (3,), rad, about its own axes.

    ``camera_from_inertial_true = Rotation.from_rotvec(misalignment_rad) * camera_from_inertial``, the same sense as
    the covariance of an :class:`~giantlike.core.outcomes.AttitudeFix`. A misalignment belongs to one image and is
    kept out of the camera model, which all images share.
    """
    return Rotation.from_rotvec(as_finite(misalignment_rad, (3,), "misalignment_rad")) * camera_from_inertial


def misalignment_jacobian(model: CameraModel, points_camera: ArrayLike) -> Float:
    """Derivative (..., 2, 3), px/rad, of the pixels of points (..., 3) by a misalignment, at zero."""
    points = as_floats(points_camera, (3,), "points_camera")
    result: Float = -model.project_jacobian(points) @ skew(np.asarray(points))
    return result
