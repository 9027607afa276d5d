"""Searching a whole outline at once, coarse steps before fine ones: bright craters do not mislead it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value

_COARSE_BLUR_PX = 1.0
_COARSE_STEP, _MAX_COARSE_STEP_PX = 0.05, 4.0  # of the radius
_FINE_STEP_PX, _LEAST_STEP_PX, _FINER = 2.0, 0.5, 4
_SKY_STEP = 5  # pixels from one to the next that the level of the sky is found from
_COARSE_OFFSET_PX = 1.5
_COARSE_POINTS = 80  # that the first step needs
_COARSE_NOISE_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoarseLimb(Value):
    """Where an outline as a whole fits an image best.

    Parameters
    ----------
    shift_px : (2,) float64, px
        From prediction to image.
    scale : float
        Size in the image over that predicted.
    contrast : float
        Mean of (inside - outside) / (inside + outside) across the outline: 1 for a bright body before a black sky.
    """

    shift_px: Float
    scale: float
    contrast: float


def search_limb(
    pixels_dn: Float,
    usable: Mask,
    points_px: Float,
    normals_px: Float,
    weights: Float,
    center_px: Float,
    *,
    search_px: float,
    search_scale: float,
    noise_dn: float,
) -> CoarseLimb:
    """Find shift and size of a whole outline by the contrast across it.

    Parameters
    ----------
    pixels_dn : (rows, columns) float64
    usable : (rows, columns) bool
    points_px, normals_px : (n, 2) float64
        Predicted lit limb.
    weights : (n,) float64
        How bright each point should be, in any unit.
    center_px : (2,) float64, px
        About which the outline grows.
    search_px : float, px
        Largest shift, in both coordinates.
    search_scale : float
        Largest change of size: 0.03 means 3 %.
    noise_dn : float, DN
        Noise of a dark pixel: contrasts below a few times this count little.

    Returns
    -------
    CoarseLimb
        To about a pixel.
    """
    radius_px = float(np.max(np.linalg.norm(points_px - center_px, axis=1)))
    step = float(np.clip(_COARSE_STEP * radius_px, _FINE_STEP_PX, _MAX_COARSE_STEP_PX))
    coarsest, grown = step, 1.0 + search_scale
    low = np.floor(np.min(center_px + grown * (points_px - center_px), axis=0) - search_px - 8.0)
    high = np.ceil(np.max(center_px + grown * (points_px - center_px), axis=0) + search_px + 8.0)
    rows, columns = pixels_dn.shape
    x0, y0 = np.clip(low, 0, [columns - 1, rows - 1]).astype(int)
    x1, y1 = np.clip(high, 0, [columns - 1, rows - 1]).astype(int) + 1
    corner = np.array([x0, y0])
    crop, good = pixels_dn[y0:y1, x0:x1], usable[y0:y1, x0:x1]
    sky = float(np.percentile(crop[good][::_SKY_STEP], 1.0)) if good.any() else 0.0
    dark_sky = np.where(good, crop - sky, 0.0).astype(np.float32)
    pad = int(np.ceil(search_px)) + 8
    scales = _around(1.0, search_scale, int(np.ceil(search_scale * radius_px / step)))
    best = CoarseLimb(shift_px=np.zeros(2), scale=1.0, contrast=0.0)
    shifts = _around(0.0, search_px, int(np.ceil(search_px / step)))
    scale_step = search_scale / max(scales.size // 2, 1)
    while True:
        blurred = cv2.GaussianBlur(dark_sky, (0, 0), max(0.5 * step, _COARSE_BLUR_PX)).astype(np.float32)
        offset_px = min(max(step, _COARSE_OFFSET_PX), 0.25 * radius_px)
        thin = slice(None, None, max(len(points_px) // _COARSE_POINTS, 1) if step == coarsest else 1)
        arms = points_px[thin] - corner, normals_px[thin], weights[thin], center_px - corner
        search = _ContrastSearch(blurred, good, *arms, offset_px, noise_dn, pad)
        found = search.best(best.shift_px, shifts, scales, steepest=step < coarsest)
        best = found if step == coarsest else replace(found, contrast=best.contrast)
        if step <= _LEAST_STEP_PX:
            return best
        shifts = _around(0.0, step, _FINER)
        scales = np.clip(_around(best.scale, scale_step, _FINER), 1.0 - search_scale, 1.0 + search_scale)
        scales, scale_step, step = np.unique(scales), scale_step / _FINER, step / _FINER


def _around(middle: float, reach: float, steps: int) -> Float:
    """Values from ``middle - reach`` to ``middle + reach`` in so many steps to either side."""
    return middle + np.arange(-steps, steps + 1, dtype=np.float64) * (reach / max(steps, 1))


class _ContrastSearch:
    """Contrast across an outline at many places at once, by nearest pixels of a blurred image."""

    def __init__(
        self,
        image: NDArray[np.float32],
        good: Mask,
        points: Float,
        normals: Float,
        weights: Float,
        center: Float,
        offset_px: float,
        noise_dn: float,
        pad: int,
    ) -> None:
        self._pad = pad
        self._values, self._good = np.pad(image, pad).ravel(), np.pad(good, pad).ravel()
        self._size = np.array(image.shape[::-1]) + 2 * pad
        self._arms, self._normals, self._center = points - center, normals * offset_px, center
        self._weights = (weights / weights.mean()).astype(np.float32)
        self._floor = np.float32(_COARSE_NOISE_SIGMAS * noise_dn + 1e-6)

    def best(self, about_px: Float, shifts_px: Float, scales: Float, *, steepest: bool) -> CoarseLimb:
        """The place of highest contrast among a square of shifts about one, for every scale.

        Or of the largest difference across, which is sharper but rises with every bright edge.
        """
        x, y = np.meshgrid(shifts_px, shifts_px)
        shifts = about_px + np.stack([x.ravel(), y.ravel()], axis=-1)
        found = []
        for scale in scales:
            contrast, difference = self._contrast(shifts, float(scale))
            value = difference if steepest else contrast
            winner = int(np.argmax(value))
            found.append((float(value[winner]), float(scale), winner, float(contrast[winner])))
        _, scale_best, winner, contrast_best = max(found)
        return CoarseLimb(shift_px=shifts[winner], scale=scale_best, contrast=contrast_best)

    def _contrast(self, shifts: Float, scale: float) -> tuple[Float, Float]:
        """Mean contrast (k,) at shifts (k, 2), and mean difference, DN.

        Outlines that lie mostly outside the image count as if half inside.
        """
        middle = self._center + scale * self._arms
        inner, outer = self._index(middle - self._normals, shifts), self._index(middle + self._normals, shifts)
        valid = self._good[inner] & self._good[outer]
        light, dark = self._values[inner], self._values[outer]
        difference = light - dark
        contrast = difference / (np.abs(light) + np.abs(dark) + self._floor)
        weights = valid * self._weights
        weight = weights.sum(axis=1)
        weight = np.maximum(weight, 0.5 * max(float(weight.max()), 1.0))
        return np.einsum("kn,kn->k", contrast, weights) / weight, np.einsum("kn,kn->k", difference, weights) / weight

    def _index(self, points: Float, shifts: Float) -> NDArray[np.intp]:
        """Flat index (k, n) of the pixels nearest to points (n, 2) moved by shifts (k, 2), or as near as the border."""
        columns, rows = (
            np.clip(np.rint(points[:, i] + shifts[:, i, None]).astype(np.intp) + self._pad, 0, self._size[i] - 1)
            for i in range(2)
        )
        index: NDArray[np.intp] = rows * self._size[0] + columns
        return index
