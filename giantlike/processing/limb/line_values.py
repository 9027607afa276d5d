"""Images sampled along lines by a cubic B-spline, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float


@compiled
def sample_lines(images: Float, points_px: Float, normals_px: Float, offsets_px: Float) -> Float:
    """Weighted means of 4 x 4 pixels, the weights a cubic B-spline about each position.

    ``images`` (k, rows, columns); ``points_px``, ``normals_px`` (n, 2); ``offsets_px`` (m,); returns (k, n, m).
    """
    count, rows, columns = images.shape
    result = np.empty((count, len(points_px), len(offsets_px)))
    across, down = np.empty(4), np.empty(4)
    xs, ys = np.empty(4, np.int64), np.empty(4, np.int64)
    for line in range(len(points_px)):
        for place in range(len(offsets_px)):
            _taps(points_px[line, 0] + offsets_px[place] * normals_px[line, 0], columns, xs, across)
            _taps(points_px[line, 1] + offsets_px[place] * normals_px[line, 1], rows, ys, down)
            for k in range(count):
                total = 0.0
                for j in range(4):
                    part = 0.0
                    for i in range(4):
                        part += across[i] * images[k, ys[j], xs[i]]
                    total += down[j] * part
                result[k, line, place] = total
    return result


@compiled
def _taps(at: float, size: int, pixels: NDArray[np.int64], shares: Float) -> None:
    """Fill in the four pixels about a position along an axis of given size, and their cubic B-spline weights."""
    first = math.floor(at) if math.isfinite(at) else 0
    t = at - first
    s = 1.0 - t
    shares[0] = s * s * s / 6.0
    shares[1] = 2.0 / 3.0 - 0.5 * t * t * (2.0 - t)
    shares[2] = 2.0 / 3.0 - 0.5 * s * s * (2.0 - s)
    shares[3] = t * t * t / 6.0
    for k in range(4):
        pixels[k] = min(max(first - 1 + k, 0), size - 1)
