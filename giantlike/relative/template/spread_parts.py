"""Light of cells, or of parts of them, on lines of pixels: compiled."""

from __future__ import annotations

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Indices


@compiled
def spread(
    light: Float, columns: Indices, rows: Indices, shares: Float, first_px: Indices, row_count: int, width: int
) -> Float:
    """Sum the light of parts over rows of parts and columns of pixels.

    ``light`` (n, k); ``columns``, ``rows`` (n,); ``shares`` (m, c, w); ``first_px`` (c,); returns
    (m, row_count, width, k).
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
def spread_along_axis(shares: Float, first: Indices, light: Float) -> Float:
    """Sum the light of cells along one axis over pixels.

    ``shares`` (m, p, w); ``first`` (p,); ``light`` (n, k); returns (m, p, k).
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
