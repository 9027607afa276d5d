"""Edges between light and dark: pixels along the direction of sunlight, then measured in windows by ``zernike``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Float, Mask, as_finite, require
from giantlike.core.values import Value, select_rows

Pixels = NDArray[np.int64]

_MIN_RUN = 3  # lit samples in a row that make light: a hot pixel, and its neighbors behind interpolation, are fewer
_STEEPEST_WITHIN_PX = 3.0  # distance from the first light within which the steepest rise counts, px, besides the blur
_SETTLED_PX, _FAR_PX = 0.65, 1.1  # of an edge from the middle: below, the window stays; above, it is left out
_MOVES = 3  # maximum moves of a window: seeds lie within two pixels of their edge
_MOST_ROWS = 1 << 31  # of an image: column and row of a pixel are one number of 64 bits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgePoints(Value):
    """Edges measured to a fraction of a pixel."""

    pixels_px: Pixels  # (n, 2); middle (x, y) of the window that each was measured in
    points_px: Float  # (n, 2); on the edge, nearest to that middle
    normals_px: Float  # (n, 2); unit normals, from light to dark
    sigma_px: Float  # (n,); standard deviation along the normal: noise of the pixels, and the error of the method
    sigma_normal_rad: Float  # (n,); standard deviation of the direction of the normal from noise
    contrast_dn: Float  # (n,); brightness step across the edge, light minus dark

    def __len__(self) -> int:
        return len(self.points_px)

    def shift(self, corner_px: tuple[int, int]) -> EdgePoints:
        """Return the edges of a part of an image in the pixels of the whole; ``corner_px``: its first pixel."""
        return replace(self, pixels_px=self.pixels_px + corner_px, points_px=self.points_px + corner_px)


def scan_edges(
    pixels_dn: Float, usable: Mask, sunlight: ArrayLike, *, threshold_dn: float, blur_sigma_px: float = 0.0
) -> Pixels:
    """Find the pixels (n, 2) in which sunlight, of direction (2,), first meets a body, by scan lines parallel to it.

    Source: Inman et al., Artemis I optical navigation system performance, section III.A.
    """
    require(pixels_dn.shape == usable.shape, f"pixels {pixels_dn.shape} and usable {usable.shape} differ in shape")
    along = as_finite(sunlight, (2,), "sunlight")
    length = float(np.linalg.norm(along))
    require(length > 0.0, "sunlight must have a direction in the image")
    lines = _ParallelLines.across(np.where(usable, pixels_dn, -np.inf), along / length)
    lit = lines.values > threshold_dn
    run = lit.shape[1] - _MIN_RUN + 1
    started = np.logical_and.reduce([lit[:, first : first + run] for first in range(_MIN_RUN)])
    found = np.flatnonzero(started.any(axis=1))
    if found.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    reach = math.ceil(_STEEPEST_WITHIN_PX + 2.0 * blur_sigma_px)
    last = lit.shape[1] - 2
    columns = np.clip(np.argmax(started[found], axis=1)[:, None] + np.arange(-2, reach + 1), 1, last)
    after, before = (lines.values[found[:, None], columns + step] for step in (1, -1))
    after, before = (np.where(np.isfinite(each), each, threshold_dn) for each in (after, before))
    steepest = columns[np.arange(found.size), np.argmax(after - before, axis=1)]
    places = lines.places(found, steepest)
    inside = np.all((places >= 0) & (places < [pixels_dn.shape[1], pixels_dn.shape[0]]), axis=1)
    return _each_once(places[inside])


def _each_once(pixels_px: Pixels) -> Pixels:
    """Pixels (n, 2), each once, by column and row; in a quarter of the time of ``np.unique`` along an axis."""
    columns, rows = np.divmod(np.unique(pixels_px[:, 0] * _MOST_ROWS + pixels_px[:, 1]), _MOST_ROWS)
    return np.stack([columns, rows], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ParallelLines(Value):
    """Nearest pixels of an image on parallel lines one pixel apart."""

    values: Float  # (k, m); of m pixels along each of k lines; -inf outside
    onto: Float  # (2, 3); place (x, y) in the image of (m, k, 1)

    @classmethod
    def across(cls, image: Float, along: Float) -> _ParallelLines:
        """Lay lines in a direction (2,) over an image."""
        rows, columns = image.shape
        reach = math.ceil(0.5 * math.hypot(rows, columns)) + 1
        across = np.array([-along[1], along[0]])
        middle = np.array([columns // 2, rows // 2])  # whole pixels, where lines go along rows or columns
        onto = np.stack([along, across, middle - reach * (along + across)], axis=1)
        size = (2 * reach + 1, 2 * reach + 1)
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        values = cv2.warpAffine(image, onto, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-math.inf)
        return cls(values=np.asarray(values, dtype=np.float64), onto=onto)

    def places(self, lines: Pixels, steps: Pixels) -> Pixels:
        """Pixels (n, 2) that lines have at steps along them."""
        places = np.stack([steps, lines], axis=1) @ self.onto[:, :2].T + self.onto[:, 2]
        return np.floor(places + 0.5).astype(np.int64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowEdges(Value):
    """Edges found in windows, one each, relative to the middle of the window."""

    offsets_px: Float  # (n, 2); from the middle to the nearest point of the edge
    normals_px: Float  # (n, 2); from light to dark
    sigma_px: Float  # (n,)
    sigma_normal_rad: Float  # (n,)
    contrast_dn: Float  # (n,); NaN where there is no edge


def measured_edges(
    pixels_dn: Float, usable: Mask, seeds_px: Pixels, *, half_px: int, measure: Callable[[Float], WindowEdges]
) -> EdgePoints:
    """Measure edges in windows about pixels (n, 2), moved to where the edge goes through their middle pixel.

    Windows have ``2 half_px + 1`` pixels a side; those that reach over the frame or bad pixels are left out.
    """
    require(pixels_dn.shape == usable.shape, f"pixels {pixels_dn.shape} and usable {usable.shape} differ in shape")
    side = 2 * half_px + 1
    clean = cv2.erode(usable.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0) > 0
    middles = np.asarray(seeds_px, dtype=np.int64).reshape(-1, 2)
    for move in range(_MOVES + 1):
        inside = np.all((middles >= half_px) & (middles < np.array(pixels_dn.shape[::-1]) - half_px), axis=1)
        middles = _each_once(middles[inside])
        middles = middles[clean[middles[:, 1], middles[:, 0]]]
        found = measure(_windows(pixels_dn, middles, half_px))
        off = np.abs(found.offsets_px).max(axis=1, initial=0.0)
        if move == _MOVES or not bool(np.any(off > _SETTLED_PX)):
            break
        near = np.isfinite(off) & (off <= half_px)
        middles = middles[near] + np.where(off[near, None] > _SETTLED_PX, np.rint(found.offsets_px[near]), 0).astype(
            np.int64
        )
    good = np.isfinite(off) & (off < _FAR_PX) & np.isfinite(found.sigma_px) & (found.contrast_dn > 0)
    edges = EdgePoints(
        pixels_px=middles,
        points_px=middles + found.offsets_px,
        normals_px=found.normals_px,
        sigma_px=found.sigma_px,
        sigma_normal_rad=found.sigma_normal_rad,
        contrast_dn=found.contrast_dn,
    )
    return select_rows(edges, good)


def _windows(pixels_dn: Float, middles_px: Pixels, half_px: int) -> Float:
    """Squares (n, side, side) of pixels about middles (n, 2) that lie inside."""
    steps = np.arange(-half_px, half_px + 1)
    rows = middles_px[:, 1, None, None] + steps[:, None]
    windows: Float = pixels_dn[rows, middles_px[:, 0, None, None] + steps[None, :]]
    return windows
