"""Sources of the noise of a pixel other than the image around it.

Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, section "Identifying Potential
Stars in an Optical Image", name three: (A) a sample of all pixels, (B) a region that light does not reach, (C) a local
region (:mod:`giantlike.processing.detection.matched_filter`). Here are A, B, and the prediction by the detector.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Mask, require
from giantlike.core.detector import Detector
from giantlike.core.statistics import quartile_sigma

_LEVEL_BOX_PX = 31  # side of the box that smooths the level: larger than the largest stars
_SAMPLE_STEP = 3  # between the pixels sampled: a ninth of an image is enough for its noise
_LEAST_COVERED = 16  # good covered pixels: their standard deviation is then known to 18 %

Region = tuple[int, int, int, int]  # first column, first row, columns, rows; px


class NoiseSource(StrEnum):
    """Source of the noise of a pixel."""

    LOCAL = "local"  # the image around each pixel (way C of the paper)
    IMAGE = "image"  # a sample of all pixels of the image (way A)
    COVERED = "covered"
    """Pixels that no light reaches (way B), and the shot noise of the level that the others have above them."""
    DETECTOR = "detector"  # gain, read noise and bias of the detector, at the level around each pixel


def predicted_noise_dn(
    pixels: NDArray[Any], bad: Mask | None, *, source: NoiseSource, detector: Detector, covered: Region | None = None
) -> NDArray[np.float32]:
    """Background noise (rows, columns) from another source than the image around; ``covered``: x, y, columns, rows."""
    rows, columns = pixels.shape
    level = _level_dn(pixels, bad)
    if source is NoiseSource.IMAGE:
        away = (pixels - level)[::_SAMPLE_STEP, ::_SAMPLE_STEP]
        sigma = quartile_sigma(away.ravel() if bad is None else away[~bad[::_SAMPLE_STEP, ::_SAMPLE_STEP]])
        return np.full(pixels.shape, sigma, dtype=np.float32)
    if source is NoiseSource.DETECTOR:
        return np.sqrt(detector.variance_dn2(level.astype(np.float64) - detector.bias_dn)).astype(np.float32)
    require(covered is not None, "noise from covered pixels needs their region: give x, y, columns, rows")
    assert covered is not None
    x, y, wide, high = covered
    inside = x >= 0 and y >= 0 and 0 < wide <= columns - x and 0 < high <= rows - y
    require(inside, f"the covered region {covered} must lie inside the image of {columns} by {rows} pixels")
    region = pixels[y : y + high, x : x + wide].astype(np.float64)
    dark = region.ravel() if bad is None else region[~bad[y : y + high, x : x + wide]]
    require(dark.size >= _LEAST_COVERED, f"the covered region has {dark.size} good pixels, {_LEAST_COVERED} are needed")
    light = np.maximum(level - np.float32(np.median(dark)), 0.0)
    variance: NDArray[np.float32] = float(np.var(dark, ddof=1)) + light / np.float32(detector.gain_e_per_dn)
    return np.sqrt(variance)


def _level_dn(pixels: NDArray[Any], bad: Mask | None) -> NDArray[np.float32]:
    """Level around each pixel (rows, columns), DN: the box mean of a 5 x 5 median, which removes stars."""
    values = pixels.astype(np.float32)
    if bad is not None:
        values = np.where(bad, np.float32(np.median(values[~bad])), values)
    calm = cv2.medianBlur(values, 5)
    return np.asarray(cv2.blur(calm, (_LEVEL_BOX_PX, _LEVEL_BOX_PX), borderType=cv2.BORDER_REFLECT_101), np.float32)
