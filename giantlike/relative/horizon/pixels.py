"""Pixels along a horizon, by cells of it: gathered in compiled loops."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.relative.horizon.blur import LEAST_RADIUS
from giantlike.relative.horizon.profile import HorizonArc, Indices

_ACROSS_STEP_PX, _ALONG_STEP_PX = 0.6, 0.7
"""Steps in which pixels are gathered, px: less than 1 / sqrt(2), so that none is left out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbPixels(Value):
    """Pixels near a horizon, one cell of it after the other."""

    columns: Indices  # (n,)
    rows: Indices  # (n,)
    along_px: Float  # (n,); length of the horizon from its start to the point nearest to each
    outward_px: Float  # (n,); distance from the horizon
    along: Float  # (n,); place in the cell, over its length, from about -1/2 to 1/2
    first: Indices  # (c + 1,); the first pixel of each of c cells, and n
    middles: Indices  # (c,); the point of the horizon in the middle of each cell
    filled: Float  # (c,); share of the cell's area whose pixels are in the frame and usable


def limb_pixels(
    arc: HorizonArc, usable: Mask, *, window_px: float, cell_px: float, displaced_px: Float
) -> LimbPixels | None:
    """Gather the pixels near a horizon in cells. ``displaced_px`` (k,); returns None where there is no usable pixel."""
    pieces = max(round(arc.spacing_px / _ALONG_STEP_PX), 1)
    nearest, corner = _nearest_points(
        arc.points_px,
        arc.normals_px,
        displaced_px,
        usable,
        np.arange(-window_px, window_px + _ACROSS_STEP_PX, _ACROSS_STEP_PX),
        ((np.arange(pieces) + 0.5) / pieces - 0.5) * arc.spacing_px,
    )
    ahead = np.einsum("ni,ni->n", arc.tangents_px[:-1], np.diff(arc.points_px, axis=0))
    pixels, places, nodes = _places(
        nearest,
        corner,
        arc.points_px,
        arc.normals_px,
        arc.curvature,
        arc.along_px,
        math.copysign(1.0, float(np.median(ahead))) if ahead.size else 1.0,
        displaced_px,
        window_px,
    )
    if len(pixels) == 0:
        return None
    number = (arc.along_px / cell_px).astype(np.int64)  # of the cell of each point
    cell = number[nodes]
    order = np.argsort(cell, kind="stable")
    pixels, places = pixels[order], places[order]
    present, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    first = np.searchsorted(number, present, side="left")
    last = np.searchsorted(number, present, side="right") - 1
    middles = (first + last) // 2
    offset = pixels - np.repeat(arc.points_px[middles], count, axis=0)
    return LimbPixels(
        columns=pixels[:, 0],
        rows=pixels[:, 1],
        along_px=places[:, 0],
        outward_px=places[:, 1],
        along=np.einsum("ni,ni->n", offset, np.repeat(arc.tangents_px[middles], count, axis=0)) / cell_px,
        first=np.append(start, len(pixels)),
        middles=middles,
        filled=count / (2.0 * window_px * cell_px),
    )


@compiled
def _nearest_points(
    points_px: Float, normals_px: Float, displaced_px: Float, usable: Mask, across_px: Float, along_px: Float
) -> tuple[NDArray[np.int32], Indices]:
    """Pixels of a grid about points of a horizon.

    ``points_px``, ``normals_px`` (k, 2); ``displaced_px`` (k,), outward, from where pixels are looked for;
    ``across_px`` (a,), ``along_px`` (b,); returns ``nearest`` (h, w), -1 for all others and where pixels are not
    usable; ``corner`` in px, column and row of its first.
    """
    reach = np.abs(across_px).max() + np.abs(displaced_px).max() + np.abs(along_px).max() + 1.0
    low, high = np.empty(2, np.int64), np.empty(2, np.int64)
    for axis in range(2):
        low[axis] = max(math.floor(points_px[:, axis].min() - reach), 0)
        high[axis] = min(math.ceil(points_px[:, axis].max() + reach), usable.shape[1 - axis] - 1)
    nearest = np.full((max(high[1] - low[1] + 1, 0), max(high[0] - low[0] + 1, 0)), -1, np.int32)
    for node in range(len(points_px)):
        (x, y), (a, b) = points_px[node], normals_px[node]
        for height in across_px:
            up = height + displaced_px[node]
            for aside in along_px:
                column, row = int(np.rint(x + up * a - aside * b)), int(np.rint(y + up * b + aside * a))
                if low[0] <= column <= high[0] and low[1] <= row <= high[1] and usable[row, column]:
                    nearest[row - low[1], column - low[0]] = node
    return nearest, low


@compiled
def _places(
    nearest: NDArray[np.int32],
    corner: Indices,
    points_px: Float,
    normals_px: Float,
    curvature: Float,
    along_px: Float,
    sense: float,
    displaced_px: Float,
    window_px: float,
) -> tuple[Indices, Float, Indices]:
    """Places of pixels on a horizon, for which a piece of a circle through a point near each stands.

    ``nearest`` (h, w), a point of the horizon near each pixel, or -1; ``corner`` in px; ``points_px``, ``normals_px``
    (k, 2); ``curvature`` (k,) 1/px; ``along_px`` (k,); ``sense``: else -1; ``displaced_px`` (k,); returns ``pixels``
    (n, 2) px, ``places`` (n, 2) px and ``nodes`` (n,).
    """
    most = nearest.size
    pixels, places, nodes = np.empty((most, 2), np.int64), np.empty((most, 2)), np.empty(most, np.int64)
    between = 0.5 * (along_px[1:] + along_px[:-1])
    n = 0
    for row in range(nearest.shape[0]):
        for column in range(nearest.shape[1]):
            node = nearest[row, column]
            if node < 0:
                continue
            x, y = column + corner[0] - points_px[node, 0], row + corner[1] - points_px[node, 1]
            a, b, bend = normals_px[node, 0], normals_px[node, 1], curvature[node]
            high = x * a + y * b
            aside = (y * a - x * b) / max(1.0 + bend * high, LEAST_RADIUS)
            drop = 0.5 * bend * aside**2  # of the horizon below its tangent
            outward = high + drop * (1.0 + bend * high) - displaced_px[node]
            if abs(outward) <= window_px:
                pixels[n, 0], pixels[n, 1] = column + corner[0], row + corner[1]
                places[n, 0], places[n, 1] = along_px[node] + sense * aside, outward
                nodes[n] = np.searchsorted(between, places[n, 0])
                n += 1
    return pixels[:n], places[:n], nodes[:n]
