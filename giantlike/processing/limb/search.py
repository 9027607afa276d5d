"""Searching a whole outline at once, coarse steps before fine ones: bright craters do not mislead it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.limb.measurement import SATURATED_SHARE
from giantlike.processing.limb.view import LimbView, PredictedLimb

_COARSE_BLUR_PX = 1.0  # least blur of the searched image, half of the step: no limb falls between steps
_COARSE_STEP, _MAX_COARSE_STEP_PX = 0.05, 4.0  # first step / radius, and its maximum, px
_FINE_STEP_PX, _LEAST_STEP_PX, _FINER = 2.0, 0.5, 4  # least first step, last step; ratio to the next
_SKY_BLOCK = 5  # pixels along a block whose mean the level of the sky is found from: its noise is a fifth of theirs
_WHOLE = 1.0 - 1e-5  # fraction of good pixels from which all of a block are good, but for rounding
_COARSE_OFFSET_PX = 1.5  # minimum distance of the compared pixels from the outline: beyond the blur of a sharp limb
_COARSE_POINTS = 80  # that the first step needs
_COARSE_NOISE_SIGMAS = 4.0  # brightness, in noise of the dark, that is added below contrasts: noise alone has none
_MARGIN_PX = 8  # about the outline, for the blur
_WIDER, _WIDEST_RANGE, _AT_BORDER = 2.75, 0.3, 0.95
"""Factor on the declared search where nothing is found or only at its edge; its limit, relative to the range; and the
start of that edge. Results of the wider search are suspect; a best fit at its edge too is not the limb."""
_NO_RANGE = 1e-6  # search of size below which there is none
_LIGHT_SIGMAS = 5.0  # of the noise of the sky, above which a pixel is bright


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoarseLimb(Value):
    """Shift and size of the best fit of a whole outline to an image."""

    shift_px: Float  # from prediction to image
    scale: float  # size in the image / predicted size
    contrast: float  # mean (inside - outside) / (inside + outside): 1 for a bright body before black sky


def search_limb(
    view: LimbView, limb: PredictedLimb, center_px: Float, *, search_px: float, search_range: float
) -> CoarseLimb:
    """Find the shift, at most ``search_px`` on an axis, and the size of an outline by the contrast across it."""
    points_px = limb.points_px
    radius_px = float(np.max(np.linalg.norm(points_px - center_px, axis=1)))
    step = float(np.clip(_COARSE_STEP * radius_px, _FINE_STEP_PX, _MAX_COARSE_STEP_PX))
    coarsest = step
    corner, crop, good = _around_outline(view, center_px + (1.0 + search_range) * (points_px - center_px), search_px)
    without_sky, bad = (crop - _sky_dn(crop, good)).astype(np.float32), np.flatnonzero(~good)
    without_sky.ravel()[bad] = 0.0
    scales = _around(1.0, search_range, int(np.ceil(search_range * radius_px / step)))
    best = CoarseLimb(shift_px=np.zeros(2), scale=1.0, contrast=0.0)
    shifts = _around(0.0, search_px, int(np.ceil(search_px / step)))
    scale_step = search_range / max(scales.size // 2, 1)
    sigma_px = 0.0
    while True:
        if sigma_px != max(0.5 * step, _COARSE_BLUR_PX):
            sigma_px = max(0.5 * step, _COARSE_BLUR_PX)
            blurred = cv2.GaussianBlur(without_sky, (0, 0), sigma_px).astype(np.float32, copy=False)
            blurred.ravel()[bad] = np.nan
        offset_px = min(max(step, _COARSE_OFFSET_PX), 0.25 * radius_px)
        thin = slice(None, None, max(len(points_px) // _COARSE_POINTS, 1) if step == coarsest else 1)
        values = contrasts(
            blurred,
            center_px - corner + best.shift_px,
            points_px[thin] - center_px,
            offset_px * limb.normals_px[thin],
            limb.brightness[thin] / limb.brightness[thin].mean(),
            shifts,
            scales,
            _COARSE_NOISE_SIGMAS * view.sky_noise_dn + 1e-6,
            step < coarsest,
        )
        winners = values.reshape(scales.size, -1).argmax(axis=1)
        value, scale, winner = max(zip(values.reshape(scales.size, -1).max(axis=1), scales, winners, strict=True))
        down, across = divmod(int(winner), shifts.size)
        best = CoarseLimb(
            shift_px=best.shift_px + shifts[[across, down]],
            scale=float(scale),
            contrast=float(value) if step == coarsest else best.contrast,
        )
        if step <= _LEAST_STEP_PX:
            return best
        shifts = _around(0.0, step, _FINER)
        scales = np.clip(_around(best.scale, scale_step, _FINER), 1.0 - search_range, 1.0 + search_range)
        scales, scale_step, step = np.unique(scales), scale_step / _FINER, step / _FINER


def find_limb(
    view: LimbView,
    limb: PredictedLimb,
    position_camera_km: Float,
    *,
    search_px: float,
    search_range: float,
    min_contrast: float,
) -> tuple[Float, CoarseLimb] | Failure:
    """Find a whole outline and the position of its body, as of :func:`search_limb`, or return a failure."""
    center_px = view.model.project(position_camera_km)
    found = search_limb(view, limb, center_px, search_px=search_px, search_range=search_range)
    if found.contrast < min_contrast or float(np.max(np.abs(found.shift_px))) > _AT_BORDER * search_px:
        farther_px, farther_range = _WIDER * search_px, min(_WIDER * search_range, _WIDEST_RANGE)
        wider = search_limb(view, limb, center_px, search_px=farther_px, search_range=farther_range)
        if wider.contrast > found.contrast:
            found, search_px = wider, farther_px
            if found.contrast >= min_contrast and _at_border(found, farther_px, farther_range):
                return Failure(
                    Reason.NO_LIMB,
                    f"no limb within {farther_px:g} px and {farther_range:.1%} of size of the predicted one: contrast "
                    f"across the outline is best at the border of that, at {np.max(np.abs(found.shift_px)):.0f} px and "
                    f"{found.scale - 1.0:+.1%}, as where it moves towards a terminator",
                )
    if found.contrast < min_contrast:
        return _no_contrast(view, limb, found, search_px=search_px, min_contrast=min_contrast)
    range_km = float(np.linalg.norm(position_camera_km)) / found.scale
    position_km: Float = range_km * view.model.unproject(center_px + found.shift_px)
    if not np.isfinite(position_km).all():
        return Failure(Reason.OUT_OF_FRAME, "the limb was found outside the field of the camera model")
    return position_km, found


def _at_border(found: CoarseLimb, search_px: float, search_range: float) -> bool:
    """True if an outline fits best at the edge of the search, in position or in size."""
    moved = max(
        float(np.max(np.abs(found.shift_px))) / search_px, abs(found.scale - 1.0) / max(search_range, _NO_RANGE)
    )
    return moved > _AT_BORDER


def _no_contrast(
    view: LimbView, limb: PredictedLimb, found: CoarseLimb, *, search_px: float, min_contrast: float
) -> Failure:
    """Say that no outline has contrast enough, and whether that is because the disk is clipped."""
    light = view.clipped_pixels | (view.usable & (view.pixels_dn > _LIGHT_SIGMAS * view.sky_noise_dn))
    clipped = float(view.clipped_pixels.sum()) / max(float(light.sum()), 1.0)
    brightest_dn = float(view.pixels_dn[view.usable].max()) if view.usable.any() else 0.0
    return Failure(
        Reason.SATURATED if clipped > SATURATED_SHARE else Reason.NO_LIMB,
        f"no limb within {search_px:g} px of the predicted one: the best contrast across {len(limb.points_px)} lit "
        f"limb points is {min(found.contrast, min_contrast - 0.001):.3f}, needed {min_contrast:.3f}; the brightest "
        f"good pixel holds {brightest_dn:.4g} DN over bias, noise in the dark is {view.sky_noise_dn:.3g} DN, "
        f"{clipped:.0%} of the light is clipped",
    )


def _around_outline(view: LimbView, outline_px: Float, search_px: float) -> tuple[Float, Float, Mask]:
    """Corner (2,) of the part of an image within reach of an outline (n, 2), its pixels and the usable ones."""
    low = np.floor(np.min(outline_px, axis=0) - search_px - _MARGIN_PX)
    high = np.ceil(np.max(outline_px, axis=0) + search_px + _MARGIN_PX)
    last = np.array(view.usable.shape[::-1]) - 1
    x0, y0 = np.clip(low, 0, last).astype(int)
    x1, y1 = np.clip(high, 0, last).astype(int) + 1
    return np.array([x0, y0], dtype=np.float64), view.pixels_dn[y0:y1, x0:x1], view.with_clipped[y0:y1, x0:x1]


def _sky_dn(crop: Float, good: Mask) -> float:
    """Level of the sky, DN: the darkest percent of blocks of pixels, which have less noise than single pixels."""
    if min(crop.shape) >= _SKY_BLOCK:
        size = (crop.shape[1] // _SKY_BLOCK, crop.shape[0] // _SKY_BLOCK)
        means = cv2.resize(crop.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        if not good.all():
            means = means[cv2.resize(good.astype(np.float32), size, interpolation=cv2.INTER_AREA) > _WHOLE]
        if means.size:
            return float(np.percentile(means, 1.0))
    return float(np.percentile(crop[good], 1.0)) if good.any() else 0.0


def _around(middle: float, reach: float, steps: int) -> Float:
    """Values from ``middle - reach`` to ``middle + reach`` in so many steps to either side."""
    return middle + np.arange(-steps, steps + 1, dtype=np.float64) * (reach / max(steps, 1))


@compiled
def contrasts(
    image: NDArray[np.float32],
    middle_px: Float,
    arms_px: Float,
    offsets_px: Float,
    weights: Float,
    shifts_px: Float,
    scales: Float,
    floor_dn: float,
    steepest: bool,
) -> Float:
    """Sum up the contrast (m, k, k) across an outline by nearest pixels, for m scales and k shifts on each axis."""
    rows, columns = image.shape
    n, k = len(arms_px), len(shifts_px)
    sums, counted = np.zeros((len(scales), k, k)), np.zeros((len(scales), k, k))
    inner, outer = np.empty((k, 2), np.int64), np.empty((k, 2), np.int64)
    for m in range(len(scales)):
        for point in range(n):
            weight = weights[point]
            for axis in range(2):
                at = middle_px[axis] + scales[m] * arms_px[point, axis]
                for j in range(k):
                    inner[j, axis] = int(np.rint(at - offsets_px[point, axis] + shifts_px[j]))
                    outer[j, axis] = int(np.rint(at + offsets_px[point, axis] + shifts_px[j]))
            for j in range(k):
                y, far_y = inner[j, 1], outer[j, 1]
                if y < 0 or y >= rows or far_y < 0 or far_y >= rows:
                    continue
                for i in range(k):
                    x, far_x = inner[i, 0], outer[i, 0]
                    if x < 0 or x >= columns or far_x < 0 or far_x >= columns:
                        continue
                    light, dark = image[y, x], image[far_y, far_x]
                    value = light - dark
                    if value != value:
                        continue
                    if not steepest:
                        value /= abs(light) + abs(dark) + floor_dn
                    sums[m, j, i] += weight * value
                    counted[m, j, i] += weight
        most = 1.0
        for j in range(k):
            for i in range(k):
                most = max(most, counted[m, j, i])
        for j in range(k):
            for i in range(k):
                sums[m, j, i] /= max(counted[m, j, i], 0.5 * most)
    return sums
