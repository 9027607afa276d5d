"""Small symmetric systems of equations, solved inside of compiled loops."""

from __future__ import annotations

import math

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float

RIDGE = 1e-12  # added to normal matrices of unit diagonal: beyond rounding, below all information
_NOTHING = 1e-100  # least diagonal of a normal matrix: of unmeasured unknowns; its square must not underflow


@compiled
def solve_normal(normal: Float, right: Float) -> None:
    """Solve normal equations (m, m) of scaled unknowns for ``right`` (m, r), with a ridge that makes them regular."""
    size, sides = right.shape
    units = np.empty(size)
    for i in range(size):
        units[i] = 1.0 / math.sqrt(max(normal[i, i], _NOTHING))
    for i in range(size):
        for j in range(i, size):
            normal[i, j] *= units[i] * units[j]
        normal[i, i] += RIDGE
        for side in range(sides):
            right[i, side] *= units[i]
    solve_symmetric(normal, right)
    for i in range(size):
        for side in range(sides):
            right[i, side] *= units[i]


@compiled
def solve_symmetric(matrix: Float, right: Float) -> None:
    """Solve equations with a symmetric matrix (m, m), positive but for rounding, and right sides (m, r)."""
    size, sides = right.shape
    for i in range(size):
        for j in range(i + 1, size):
            share = matrix[i, j] / matrix[i, i]
            for k in range(j, size):
                matrix[j, k] -= share * matrix[i, k]
            for side in range(sides):
                right[j, side] -= share * right[i, side]
    for i in range(size - 1, -1, -1):
        for side in range(sides):
            for j in range(i + 1, size):
                right[i, side] -= matrix[i, j] * right[j, side]
            right[i, side] /= matrix[i, i]
