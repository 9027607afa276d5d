"""Where in an image landmarks are: normalized correlation, then a fit of the template, with a covariance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.processing.correlate import find_peak, normalized_correlation
from giantlike.relative.landmarks.rendering import Patch
from giantlike.relative.template.rendering import FitBox

_ROUNDS = 3
_DERIVATIVE = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]]) / 12.0
_LEAST_OVERLAP = 0.6
_CONDITION_LIMIT = 1e12
_NEAR_SEARCH_PX = 8
_MAX_SHIFT_PX = 1.5  # beyond a pixel and a half the correlation peak and the fit contradict each other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkMatch(Value):
    """A landmark found in the image.

    Parameters
    ----------
    number : int
        Its place in the catalog.
    offset_px : (2,) float64, px
        Found minus predicted.
    covariance_px2 : (2, 2) float64, px^2
        Of the noise alone.
    score : float
        Correlation of image and template, -1 to 1.
    """

    number: int
    offset_px: Float
    covariance_px2: Float
    score: float


def correlation_surface(pixels_dn: Float, usable: Mask, patch: Patch, search_px: int) -> Float:
    """Correlation (2 s + 1, 2 s + 1) of a patch with the image, for shifts of up to ``search_px``; NaN if undefined.

    A wide search takes the ground around the landmark along where it is rendered: it makes the place more certain.
    """
    core = patch.core
    box = FitBox(
        x=patch.box.x + core[1].start - search_px,
        y=patch.box.y + core[0].start - search_px,
        width=patch.light[core].shape[1] + 2 * search_px,
        height=patch.light[core].shape[0] + 2 * search_px,
    )
    return normalized_correlation(
        box.cut(pixels_dn),
        patch.light[core],
        image_usable=box.cut(usable),
        template_usable=None if patch.whole and search_px > _NEAR_SEARCH_PX else patch.mask[core],
        min_overlap=_LEAST_OVERLAP,
    )


def common_shift(surfaces: Sequence[Float], radii_px: Float) -> NDArray[np.int64]:
    """The shift (2,), px, that most landmarks agree with, each of which may be off it by ``radii_px`` (n,)."""
    total = np.zeros_like(surfaces[0])
    for surface, radius in zip(surfaces, radii_px, strict=True):
        side = 2 * math.ceil(float(radius)) + 1
        known = np.nan_to_num(surface, nan=0.0).astype(np.float32)
        total += cv2.dilate(known, np.ones((side, side), np.uint8)) ** 2
    smooth = cv2.GaussianBlur(total, (0, 0), 1.0 + float(np.median(radii_px)))
    row, column = np.unravel_index(int(np.argmax(smooth)), total.shape)
    half = (total.shape[0] - 1) // 2
    return np.array([column - half, row - half])


def peak_near(surface: Float, shift_px: NDArray[np.int64], radius_px: float) -> tuple[Float, float] | None:
    """The peak (2,), px, of a correlation surface within a radius of a shift, and its height; None if it has none."""
    half = (surface.shape[0] - 1) // 2
    reach = math.ceil(radius_px) + 1
    low = np.maximum(shift_px + half - reach, 0)
    high = np.minimum(shift_px + half + reach + 1, surface.shape[0])
    part = surface[low[1] : high[1], low[0] : high[0]]
    if part.size == 0:
        return None
    peak = find_peak(part)
    if peak is None or peak.at_edge:
        return None
    return peak.offset_px + low - half, peak.score


def fit_patch(
    pixels_dn: Float,
    usable: Mask,
    patch: Patch,
    shift_px: NDArray[np.int64],
    score: float,
    noise_variance_dn2: Callable[[Float], Float],
) -> LandmarkMatch | None:
    """Fit a patch to the image near a whole shift.

    Parameters
    ----------
    pixels_dn : (rows, columns) float64, DN
    usable : (rows, columns) bool
    patch : Patch
    shift_px : (2,) int64, px
        Of the correlation peak, rounded.
    score : float
        Correlation there.
    noise_variance_dn2 : callable
        Variance, DN^2, of the noise on pixels that hold a given signal.

    Returns
    -------
    LandmarkMatch or None
        None where too few pixels are usable, or the fit moves away from the peak.

    Notes
    -----
    The image is modeled as the light of the patch, moved by a fraction of a pixel, times a gain that may slope across
    the landmark, plus the light under another law times a second gain, plus a constant. Slopes are those of the whole
    model, so that three rounds settle.
    """
    box = FitBox(
        x=patch.box.x + int(shift_px[0]),
        y=patch.box.y + int(shift_px[1]),
        width=patch.box.width,
        height=patch.box.height,
    )
    used = patch.mask & box.cut(usable)
    if used.sum() < max(_LEAST_OVERLAP * patch.mask.sum(), 20.0):
        return None
    image = box.cut(pixels_dn)[used]
    lights = _lights(patch, used)
    columns_of = lights[:, used].T
    model, noise = patch.light * (image.std() / max(float(patch.light[used].std()), 1e-12)), np.ones_like(image)
    offset, covariance = np.zeros(2), np.eye(2)
    for _ in range(_ROUNDS):
        slopes = [cv2.filter2D(model, cv2.CV_64F, kernel) for kernel in (_DERIVATIVE, _DERIVATIVE.T)]
        design = np.column_stack([-slopes[0][used], -slopes[1][used], columns_of])
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        weighted = design / scale / np.sqrt(noise)[:, None]
        gram = weighted.T @ weighted
        if not np.linalg.cond(gram) < _CONDITION_LIMIT:
            return None
        inverse = np.linalg.inv(gram)
        solution = inverse @ (weighted.T @ (image / np.sqrt(noise))) / scale
        offset = solution[:2]
        covariance = inverse[:2, :2] / np.outer(scale[:2], scale[:2])
        model = np.tensordot(solution[2:], lights, axes=1)
        noise = noise_variance_dn2(np.maximum(model[used], 0.0))
    if not float(np.abs(offset).max()) <= _MAX_SHIFT_PX:
        return None
    return LandmarkMatch(number=patch.number, offset_px=offset + shift_px, covariance_px2=covariance, score=score)


def _lights(patch: Patch, used: Mask) -> Float:
    """Images (k, h, w) that a landmark is made of: its light, even and with slopes, the other law's, and a constant."""
    rows, columns = np.mgrid[: patch.box.height, : patch.box.width].astype(np.float64)
    across, down = (axis - axis[used].mean() for axis in (columns, rows))
    lights = [patch.light, across * patch.light, down * patch.light, np.ones_like(patch.light)]
    return np.stack(lights if patch.other is None else [*lights, patch.other])
