"""Matching of landmarks in an image: normalized correlation, then a fit of the template, with a covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.pixel_box import BoxPixels, PixelBox
from giantlike.core.values import Value
from giantlike.processing.correlate import find_peak, normalized_correlation
from giantlike.relative.landmarks.patch_sums import SHARED, compute_light, normal_equations, pixels_of
from giantlike.relative.landmarks.rendering import Patch

_ROUNDS = 3  # linear fits of a fraction of a pixel: each leaves a small part of the last step
_LEAST_OVERLAP = 0.6  # of the ground of a landmark that must be usable: see benchmarks/sensitivity.md
_LEAST_PIXELS = 20  # usable: three times the parameters of the fit
_CONDITION_LIMIT = 1e12  # of the scaled normal matrix: four digits of float64 are left
_NEAR_SEARCH_PX = 8  # px: a wider search takes the ground around a landmark along, which makes it more distinct
_MAX_SHIFT_PX = 4.0
"""Motion of the fit away from the correlation peak, px: slopes of the brightness that the template lacks, by another
law or markings, move the peak of a wide patch by some pixels, and the fit has these slopes."""
_MOVES, _SETTLED_PX = 5, 0.75  # fits at most, and motion of the last one: half a pixel and some for rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkMatch(Value):
    """A landmark found in the image."""

    number: int  # number in the catalog
    offset_px: Float  # found minus predicted
    covariance_px2: Float  # of the noise alone
    score: float  # correlation of image and template, -1 to 1


def correlation_surface(pixels_dn: Float, usable: Mask, patch: Patch, search_px: int) -> Float:
    """Correlation of a patch with the image.

    ``pixels_dn`` (rows, columns); returns (2 s + 1, 2 s + 1), NaN where undefined.
    """
    light = patch.light[patch.core]
    low = np.array([patch.box.x + patch.core[1].start, patch.box.y + patch.core[0].start])
    box = PixelBox.spanning(low, low + light.shape[::-1], search_px)
    return normalized_correlation(
        box.cut(pixels_dn),
        light,
        image_usable=box.cut(usable),
        template_usable=None if patch.whole and search_px > _NEAR_SEARCH_PX else patch.mask[patch.core],
        min_overlap=_LEAST_OVERLAP,
    )


def common_shift(surfaces: Sequence[Float], radii_px: Float) -> NDArray[np.int64]:
    """Shift that most landmarks agree with. ``surfaces`` sequence of (k, k); ``radii_px`` (n,); returns (2,) px."""
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
    """Peak of a correlation surface near a shift. ``surface`` (k, k); returns ``peak_px`` (2,) and ``score``."""
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


def fit_patch(pixels: BoxPixels, patch: Patch, shift_px: NDArray[np.int64], score: float) -> LandmarkMatch | None:
    """Fit a patch to the image, from a whole shift on to the nearest one of the result.

    Returns None where too few pixels are usable, or the fit does not converge near the peak.

    The image is modeled as the light of the patch, moved by a fraction of a pixel, times a gain that may slope across
    the landmark, plus the light under another law times a second gain, plus a constant. Slopes are those of the whole
    model, so that three rounds converge.
    """
    peak_px = shift_px
    for _ in range(_MOVES):
        match = _fit_near(pixels, patch, shift_px, score)
        if match is None or float(np.abs(match.offset_px - peak_px).max()) > _MAX_SHIFT_PX:
            return None
        if float(np.abs(match.offset_px - shift_px).max()) <= _SETTLED_PX:
            return match
        shift_px = np.rint(match.offset_px).astype(np.int64)
    return None


def _fit_near(pixels: BoxPixels, patch: Patch, shift_px: NDArray[np.int64], score: float) -> LandmarkMatch | None:
    """Fit a patch moved by a whole shift and a fraction of a pixel."""
    box = replace(patch.box, x=patch.box.x + int(shift_px[0]), y=patch.box.y + int(shift_px[1]))
    used = patch.mask & box.cut(pixels.usable)
    if used.sum() < max(_LEAST_OVERLAP * patch.mask.sum(), _LEAST_PIXELS):
        return None
    lights = [np.array(each) for each in (patch.light, patch.light if patch.other is None else patch.other)]
    seen = pixels_of(np.array(box.cut(pixels.values_dn)), used, *lights)
    gains = np.zeros(SHARED if patch.other is None else SHARED + 1)
    gains[0] = seen[:, 0].std() / max(float(seen[:, 3].std()), 1e-12)
    noise, offset, covariance = np.ones(len(seen)), np.zeros(2), np.eye(2)
    for _ in range(_ROUNDS):
        matrix, right = normal_equations(seen, gains, noise)
        scale = np.maximum(np.sqrt(np.diag(matrix)), 1e-300)
        widths, axes = np.linalg.eigh(matrix / np.outer(scale, scale))
        if not float(widths[-1]) < _CONDITION_LIMIT * float(widths[0]):
            return None
        inverse = (axes / widths) @ axes.T / np.outer(scale, scale)
        solution, covariance = inverse @ right, inverse[:2, :2]
        offset, gains = solution[:2], solution[2:]
        noise = pixels.noise_variance_dn2(np.maximum(compute_light(seen, gains), 0.0))
    return LandmarkMatch(number=patch.number, offset_px=offset + shift_px, covariance_px2=covariance, score=score)
