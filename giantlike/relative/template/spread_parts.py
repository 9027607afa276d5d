"""Light of cells, or of parts of them, on lines of pixels: compiled."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.compiled import compiled
from giantlike.ray_tracing.tracer import Indices


@compiled
def spread(
    light: Float, columns: Indices, rows: Indices, shares: Float, first_px: Indices, row_count: int, width: int
) -> Float:
    """Sum the light of parts over rows of parts and columns of pixels.

    Parameters
    ----------
    light : (n, k) float64
        Of each part, in k kinds.
    columns, rows : (n,) int64
        Of each part.
    shares : (m, c, w) float64
        Of the light of a part in each of c columns that falls on each of w pixels, m kinds of them.
    first_px : (c,) int64
        First of these pixels; those outside of the image count for nothing.
    row_count, width : int
        Rows of parts, pixels along a row of the image.

    Returns
    -------
    (m, row_count, width, k) float64
    """
    kinds, _, reach = shares.shape
    result = np.zeros((kinds, row_count, width, light.shape[1]))
    for part in range(len(columns)):
        column, row = columns[part], rows[part]
        first = first_px[column]
        for step in range(max(0, -first), min(reach, width - first)):
            for kind in range(kinds):
                share = shares[kind, column, step]
                for law in range(light.shape[1]):
                    result[kind, row, first + step, law] += share * light[part, law]
    return result


@compiled
def banded(shares: Float, first: Indices, light: Float) -> Float:
    """Sum the light of cells along one axis over pixels.

    Parameters
    ----------
    shares : (m, p, w) float64
        Of the light of w cells side by side that falls on each of p pixels, m kinds of them.
    first : (p,) int64
        Number of the first of these cells; those outside of the grid hold none.
    light : (n, k) float64
        Of n cells, in k kinds.

    Returns
    -------
    (m, p, k) float64
    """
    kinds, pixels, reach = shares.shape
    result = np.zeros((kinds, pixels, light.shape[1]))
    for kind in range(kinds):
        for pixel in range(pixels):
            here = result[kind, pixel]
            for step in range(max(0, -first[pixel]), min(reach, len(light) - first[pixel])):
                share, there = shares[kind, pixel, step], light[first[pixel] + step]
                for k in range(len(here)):
                    here[k] += share * there[k]
    return result
