"""Nearest neighbors in the image plane, within a distance: compiled, by cells of a grid as wide as that distance."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float

_MOST_CELLS = 256  # along each axis: cells of a few pixels, and a table of them that stays in the cache


@compiled
def nearest(among_px: Float, of_px: Float, count: int, reach_px: float) -> tuple[Float, NDArray[np.intp]]:
    """Find the nearest of some points for each of others.

    ``among_px`` (n, 2); ``of_px`` (m, 2); returns ``distance`` (m, count) px, nearest first, infinite where there is
    none within reach; ``index`` (m, count).
    """
    n = len(among_px)
    (low_x, low_y), (high_x, high_y) = among_px[0], among_px[0]
    for x, y in among_px:
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
    side = max((1.0 + 1e-9) * reach_px, max(high_x - low_x, high_y - low_y) / (_MOST_CELLS - 1), 1e-9)
    columns, rows = int((high_x - low_x) / side) + 1, int((high_y - low_y) / side) + 1
    cells = np.empty(n, np.int64)
    first = np.zeros(columns * rows + 1, np.int64)
    for k in range(n):
        cells[k] = int((among_px[k, 1] - low_y) / side) * columns + int((among_px[k, 0] - low_x) / side)
        first[cells[k] + 1] += 1
    for cell in range(columns * rows):
        first[cell + 1] += first[cell]
    filled, members = first[:-1].copy(), np.empty(n, np.int64)
    for k in range(n):
        members[filled[cells[k]]] = k
        filled[cells[k]] += 1
    distance, index = np.full((len(of_px), count), np.inf), np.full((len(of_px), count), n, np.intp)
    for m in range(len(of_px)):
        x, y = of_px[m]
        column, row = math.floor((x - low_x) / side), math.floor((y - low_y) / side)
        for other_row in range(max(row - 1, 0), min(row + 2, rows)):
            for other_column in range(max(column - 1, 0), min(column + 2, columns)):
                cell = other_row * columns + other_column
                for member in range(first[cell], first[cell + 1]):
                    k = members[member]
                    away = math.hypot(among_px[k, 0] - x, among_px[k, 1] - y)
                    if away > reach_px or away > distance[m, count - 1]:
                        continue
                    if away < distance[m, 0] or (away == distance[m, 0] and k < index[m, 0]):
                        for place in range(count - 1, 0, -1):
                            distance[m, place], index[m, place] = distance[m, place - 1], index[m, place - 1]
                        distance[m, 0], index[m, 0] = away, k
                    elif count > 1 and (away < distance[m, 1] or k < index[m, 1]):
                        distance[m, 1], index[m, 1] = away, k
    return distance, index
