"""Place of a body in the image and in space: pixels and range to a position, and back, with covariances."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel, ifov_rad
from giantlike.core.arrays import Float
from giantlike.ray_tracing import FocalPlane, Silhouette


def apparent_radius_px(camera: Camera | FocalPlane, center_px: ArrayLike, radius_km: float, range_km: float) -> float:
    """Apparent radius of a sphere, px."""
    x, y = np.clip(center_px, -0.5, [camera.columns - 0.5, camera.rows - 0.5]).tolist()
    angle = math.asin(min(radius_km / range_km, 1.0))
    return angle / _ifov_rad(camera.model, x, y)


@lru_cache(maxsize=16)
def _ifov_rad(model: CameraModel, x_px: float, y_px: float) -> float:
    """Angle that one pixel subtends: kept, because estimators ask a dozen times for the size of one body."""
    return float(ifov_rad(model, [x_px, y_px]))


def position_of_center(model: CameraModel, center_px: Float, range_km: float, covariance: Float) -> tuple[Float, Float]:
    """Position of a body from its center in the image and its range.

    ``covariance``: of x, y in px and of the natural logarithm of the range.
    """
    line_of_sight = model.unproject(center_px)
    jacobian = range_km * np.concatenate([model.unproject_jacobian(center_px), line_of_sight[:, None]], axis=1)
    return range_km * line_of_sight, jacobian @ covariance @ jacobian.T


def center_of_position(
    model: CameraModel, position_camera_km: Float, covariance_camera_km2: Float
) -> tuple[Float, Float]:
    """Center of a body in the image from its position."""
    jacobian = model.project_jacobian(position_camera_km)
    return model.project(position_camera_km), jacobian @ covariance_camera_km2 @ jacobian.T


def place_covariance(model: CameraModel, position_camera_km: Float, covariance_camera_km2: Float) -> Float:
    """Image covariance of a body, as in the ``parts`` of a fix, from the covariance of its position.

    The inverse of the propagation of a covariance by :func:`position_of_center`.

    Returns (3, 3), of x, y in px and of the natural logarithm of the range.
    """
    variances, axes = np.linalg.eigh(covariance_camera_km2)
    # By its root: where all of a covariance lies along the line of sight, rounding would leave no covariance of pixels.
    moved = place_jacobian(model, position_camera_km) @ (axes * np.sqrt(np.maximum(variances, 0.0)))
    result: Float = moved @ moved.T
    return result


def place_jacobian(model: CameraModel, position_camera_km: Float) -> Float:
    """Derivative of the place of a body by its position.

    Returns (3, 3), of x, y in px and of the natural logarithm of the range, per km.
    """
    along = position_camera_km / float(position_camera_km @ position_camera_km)
    return np.vstack([model.project_jacobian(position_camera_km), along])


def limb_in_frame(outline: Silhouette, plane: FocalPlane) -> tuple[float, float]:
    """Return the part of the lit outline of a body that lies within the frame, and its length.

    Returns ``share`` and ``length_px``.
    """
    if not outline.lit.any():
        return 0.0, 0.0
    inside = plane.contains(outline.points_px)
    seen = inside & outline.lit
    lengths = np.linalg.norm(np.roll(outline.points_px, -1, axis=0) - outline.points_px, axis=1)
    usable = seen & np.roll(inside, -1) & np.isfinite(lengths)
    return float(seen.sum() / outline.lit.sum()), float(lengths[usable].sum())
