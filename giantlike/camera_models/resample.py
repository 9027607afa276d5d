"""Images as another camera model would have taken them, first of all without distortion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.camera_models.base import CameraModel
from giantlike.camera_models.pinhole import PinholeModel
from giantlike.core.arrays import Float, Mask, require


def pinhole_of(model: CameraModel) -> PinholeModel:
    """Pinhole with the focal lengths, principal point and shear of a model: its picture without distortion."""
    known = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    return PinholeModel(**{name: known[name] for name in PinholeModel.parameter_names})


def resampling_map(model: CameraModel, target: CameraModel, *, columns: int, rows: int) -> Float:
    """Where each pixel of a new image lies in the old one.

    Parameters
    ----------
    model : CameraModel
        Of the image that exists.
    target : CameraModel
        Of the new image, in the same camera axes.
    columns, rows : int
        Size of the new image.

    Returns
    -------
    (rows, columns, 2) float64, px
        Pixels of the old image; NaN where it shows nothing of the direction.
    """
    pixels = np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float)), axis=-1)
    return model.project(target.unproject(pixels))


def resample(
    image: NDArray[np.float64], model: CameraModel, target: CameraModel | None = None, *, fill: float = np.nan
) -> Float:
    """Image as another camera model would have taken it, bilinear.

    For measurements use the image as it is and the model: resampling blurs and correlates noise.

    Parameters
    ----------
    image : (rows, columns) float64
    model : CameraModel
        Of the image.
    target : CameraModel, optional
        Of the new image; default :func:`pinhole_of` the model, an undistorted image.
    fill : float
        Where the image shows nothing.

    Returns
    -------
    (rows, columns) float64

    Raises
    ------
    InputError
        The image is no two-dimensional array.

    Notes
    -----
    OpenCV's ``remap`` interpolates on places given in float32: to some 1e-4 px over 2,000 px.
    """
    import cv2

    require(np.ndim(image) == 2, f"an image has shape (rows, columns), got {np.shape(image)}")
    rows, columns = image.shape
    places = resampling_map(model, target or pinhole_of(model), columns=columns, rows=rows)
    seen: Mask = np.all((places >= -0.5) & (places <= np.array([columns, rows]) - 0.5), axis=-1)
    at = np.where(seen[..., None], places, 0.0).astype(np.float32)
    result = cv2.remap(
        np.asarray(image, dtype=np.float64), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.where(seen, result, fill)
