"""Checkerboards: detection of their corners, and a first pose of the board for any camera model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from giantlike.calibration.observations import ImageObservations
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import Image

CORNER_SIGMA_PX = 0.05
"""Standard deviation of a corner per axis, px: the scatter in sharp images of boards with squares of about 20 px. If
the residuals are larger, the covariance of a calibration is scaled with them."""
_DARKEST, _BRIGHTEST = 0.5, 99.5  # percentiles of the pixels mapped to black and white: ignores hot and dead pixels
_WINDOW = 0.3  # half the refinement window / distance of the nearest corners: it contains no other corner
_WINDOWS_PX = (2, 5)  # smallest and largest half window, px: lines are straight over this length in any lens
_STEPS, _LAST_STEP_PX = 60, 1e-3  # of the refinement: a fiftieth of the scatter of a corner


def board_corners(*, across: int, down: int, square: float = 1.0) -> Float:
    """Inner corners (n, 3) of a checkerboard in its own axes, row by row, z = 0, in the unit of ``square``."""
    require(min(across, down) >= 3, f"a board needs at least 3 by 3 inner corners, got {across} by {down}")
    require(square > 0, f"square must be > 0, got {square}")
    x, y = np.meshgrid(np.arange(across), np.arange(down))
    return square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1).astype(np.float64)


def find_board(pixels: NDArray[np.float64], *, across: int, down: int) -> Float | Failure:
    """Find the inner corners (n, 2), px, of a checkerboard by OpenCV, in the order of :func:`board_corners`.

    They may be rotated or reflected if the board looks the same. With a fisheye the detector alone has an error of
    about 0.1 px, with the refinement 0.05 px.
    """
    import cv2

    require(np.ndim(pixels) == 2, f"an image has shape (rows, columns), got {np.shape(pixels)}")
    low, high = np.nanpercentile(pixels, [_DARKEST, _BRIGHTEST])
    stretched = (np.nan_to_num(pixels, nan=low) - low) / max(high - low, 1e-12)
    gray = np.round(255.0 * np.clip(stretched, 0.0, 1.0)).astype(np.uint8)
    found, corners = cv2.findChessboardCornersSB(gray, (across, down))
    if not found:
        return Failure(Reason.NO_PATTERN_MATCH, f"no complete board of {across} by {down} inner corners was found")
    corners = corners.reshape(-1, 2).astype(np.float32)
    nearest = np.asarray(cKDTree(corners).query(corners, k=2)[0])[:, 1]
    window = int(np.clip(_WINDOW * nearest.min(), *_WINDOWS_PX))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, _STEPS, _LAST_STEP_PX)
    refined = cv2.cornerSubPix(gray, corners, (window, window), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def board_pose(corners: Float, points_px: Float, model: CameraModel) -> tuple[Rotation, Float] | Failure:
    """Pose of a board from its corners (n, 3) in one image, at (n, 2): ``camera_from_board`` and the origin (3,).

    The homography from the board to the unit rays of the camera (linear least squares of ``ray x H corner = 0``),
    orthonormalized to a rotation; rays at any angle from the axis are used, also beyond 90 degrees.
    """
    points_px = as_finite(points_px, (len(corners), 2), "points_px")
    rays = model.unproject(points_px)
    seen = np.isfinite(rays).all(axis=1)
    if np.count_nonzero(seen) < 4:
        return Failure(Reason.DEGENERATE_GEOMETRY, "the start model can unproject fewer than four corners of the board")
    middle, size = corners.mean(axis=0), float(np.ptp(corners, axis=0).max())
    flat = np.column_stack([(corners - middle)[seen, :2] / size, np.ones(np.count_nonzero(seen))])
    ray = rays[seen]
    zero = np.zeros(len(ray))
    crosses = np.array([[zero, -ray[:, 2], ray[:, 1]], [ray[:, 2], zero, -ray[:, 0]], [-ray[:, 1], ray[:, 0], zero]])
    design = (crosses[..., None] * flat).transpose(2, 0, 1, 3).reshape(-1, 9)
    homography = np.linalg.svd(design)[2][-1].reshape(3, 3)
    if np.sum((flat @ homography.T) * ray) < 0:  # the board lies where the camera looks
        homography = -homography
    length = (np.linalg.norm(homography[:, 0]) + np.linalg.norm(homography[:, 1])) / 2.0
    first, second, position = (homography / length).T
    left, _, right = np.linalg.svd(np.column_stack([first, second]), full_matrices=False)
    axes = left @ right
    rotation = Rotation.from_matrix(np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])]))
    return rotation, size * position - rotate(rotation, middle)


def board_observations(
    images: Sequence[Image],
    model: CameraModel,
    *,
    across: int,
    down: int,
    square: float = 1.0,
    sigma_px: float = CORNER_SIGMA_PX,
) -> tuple[list[ImageObservations], list[tuple[str, Failure]]]:
    """Observations of a checkerboard for :func:`~giantlike.calibration.calibrate`, with a first pose in every image.

    Source: Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, Table 2 and Fig. 12.
    """
    corners = board_corners(across=across, down=down, square=square)
    found = [_observe_board(image, corners, model, (across, down), sigma_px) for image in images]
    failed = [(image.name, one) for image, one in zip(images, found, strict=True) if isinstance(one, Failure)]
    return [one for one in found if not isinstance(one, Failure)], failed


def _observe_board(
    image: Image, corners: Float, model: CameraModel, shape: tuple[int, int], sigma_px: float
) -> ImageObservations | Failure:
    found = find_board(image.pixels, across=shape[0], down=shape[1])
    if isinstance(found, Failure):
        return found
    pose = board_pose(corners, found, model)
    if isinstance(pose, Failure):
        return pose
    return ImageObservations(
        name=image.name,
        targets=corners,
        points_px=found,
        sigma_px=np.array(sigma_px),
        camera_from_reference=pose[0],
        position_reference=pose[1],
        finite=True,
    )
