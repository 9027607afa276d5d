"""Resampling of images to another camera model, such as one without distortion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.camera_models.base import CameraModel
from giantlike.camera_models.pinhole import PinholeModel
from giantlike.core.arrays import Float, Mask, require


def pinhole_of(model: CameraModel) -> PinholeModel:
    """Return the pinhole with the focal lengths, principal point and shear of a model: the model without distortion."""
    known = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    return PinholeModel(**{name: known[name] for name in PinholeModel.parameter_names})


def resampling_map(model: CameraModel, target: CameraModel, *, columns: int, rows: int) -> Float:
    """Map (rows, columns, 2) of the pixels of a new image to the old one; NaN where it does not show a direction."""
    pixels = np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float)), axis=-1)
    return model.project(target.unproject(pixels))


def resample(
    image: NDArray[np.float64], model: CameraModel, target: CameraModel | None = None, *, fill: float = np.nan
) -> Float:
    """Resample an image to another camera model by bilinear interpolation.

    For measurements use the original: resampling blurs, correlates noise, and rounds positions to about 1e-4 px.
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
