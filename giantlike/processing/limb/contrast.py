"""Numba kernels of the contrast across an outline, for :mod:`giantlike.processing.limb.search`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float


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
    """Sum up the contrast across an outline by nearest pixels.

    ``image`` in DN, NaN where a pixel counts nothing; ``arms_px``, ``offsets_px`` (n, 2); ``weights`` (n,);
    ``shifts_px`` (k,); ``scales`` (m,); returns (m, k, k).
    """
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
