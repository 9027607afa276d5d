"""Groups and peaks among the pixels of a frame that are above a threshold: compiled, over these pixels alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Indices
from giantlike.core.compiled import compiled


@compiled
def connected(lit: Indices, columns: int) -> tuple[Indices, int]:
    """Number the groups of pixels that touch, along sides or at corners.

    ``lit`` (n,); returns ``group`` (n,) and ``count``.
    """
    parent = np.arange(len(lit))
    above = 0  # the first pixel that may touch from the row above
    for i in range(len(lit)):
        place = lit[i]
        column = place % columns
        if column > 0 and i > 0 and lit[i - 1] == place - 1:
            _join(parent, i - 1, i)
        first = place - columns - (1 if column > 0 else 0)
        last = place - columns + (1 if column < columns - 1 else 0)
        while lit[above] < first:
            above += 1
        at = above
        while lit[at] <= last:
            _join(parent, at, i)
            at += 1
    group, count = np.empty(len(lit), np.int64), 0
    for i in range(len(lit)):
        root = _root(parent, i)  # the first of its group
        if root == i:
            group[i] = count
            count += 1
        else:
            group[i] = group[root]
    return group, count


@compiled
def peaks_among(response: NDArray[np.float32], lit: Indices) -> Indices:
    """Find pixels above their eight neighbors; of equal ones only the first in reading order.

    ``response`` (rows, columns); ``lit`` (n,); returns (p,).
    """
    rows, columns = response.shape
    found, count = np.empty(len(lit), np.int64), 0
    for i in range(len(lit)):
        y, x = lit[i] // columns, lit[i] % columns
        height, highest = response[y, x], True
        for v in range(max(y - 1, 0), min(y + 2, rows)):
            for u in range(max(x - 1, 0), min(x + 2, columns)):
                earlier = v < y or (v == y and u < x)
                if (v != y or u != x) and not (height > response[v, u] if earlier else height >= response[v, u]):
                    highest = False
        if highest:
            found[count] = i
            count += 1
    return found[:count]


@compiled
def _root(parent: Indices, i: int) -> int:
    """First of the pixels that one is joined with; the way there is shortened."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _join(parent: Indices, i: int, j: int) -> None:
    i, j = _root(parent, i), _root(parent, j)
    parent[max(i, j)] = min(i, j)
