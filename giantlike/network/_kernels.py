"""Loops over the points of a network and the pairs of images that show each of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float

Index = NDArray[np.int64]


@compiled
def accumulate(
    photo: Index,
    point: Index,
    rows: Float,
    by_point: Float,
    poses: Float,
    points: Float,
    shared: Float,
    coupling: Float,
    shared_coupling: Float,
) -> None:
    """Add products of weighted derivatives, and residuals in the last columns, to normal equations.

    ``rows`` (n, 2, 6 + k + 1), by pose and shared parameters; ``by_point`` (n, 2, 3); ``poses`` (m, 6, 6 + k + 1),
    ``points`` (p, 3, 4), ``shared`` (k, k + 1), ``coupling`` (n, 6, 3) and ``shared_coupling`` (p, k, 3).
    """
    width = rows.shape[2]
    for n in range(len(photo)):
        for axis in range(2):
            row, three = rows[n, axis], by_point[n, axis]
            for i in range(6):
                for j in range(width):
                    poses[photo[n], i, j] += row[i] * row[j]
                for j in range(3):
                    coupling[n, i, j] += row[i] * three[j]
            for i in range(6, width - 1):
                for j in range(6, width):
                    shared[i - 6, j - 6] += row[i] * row[j]
                for j in range(3):
                    shared_coupling[point[n], i - 6, j] += row[i] * three[j]
            for i in range(3):
                for j in range(3):
                    points[point[n], i, j] += three[i] * three[j]
                points[point[n], i, 3] += three[i] * row[width - 1]


@compiled
def eliminate_points(reduced: Float, rows: Index, first: Index, coupling: Float, inverse: Float) -> None:
    """Subtract from the upper triangle of ``reduced`` (r, r) what the points take: ``W V^-1 W^T``.

    ``rows`` (n,): first of the rows in ``reduced`` of each of the n blocks of ``coupling`` (n, 6, 3), ascending within
    a point; ``first`` (p + 1,): its first block; ``inverse`` (p, 3, 3).
    """
    size = coupling.shape[1]
    left = np.empty((size, 3))
    for point in range(len(inverse)):
        for a in range(first[point], first[point + 1]):
            for i in range(size):
                for j in range(3):
                    left[i, j] = (
                        coupling[a, i, 0] * inverse[point, 0, j]
                        + coupling[a, i, 1] * inverse[point, 1, j]
                        + coupling[a, i, 2] * inverse[point, 2, j]
                    )
            for b in range(a, first[point + 1]):
                for i in range(size):
                    row = reduced[rows[a] + i]
                    for j in range(size):
                        row[rows[b] + j] -= (
                            left[i, 0] * coupling[b, j, 0]
                            + left[i, 1] * coupling[b, j, 1]
                            + left[i, 2] * coupling[b, j, 2]
                        )


@compiled
def covariance_through(result: Float, matrix: Float, rows: Index, first: Index, gain: Float) -> None:
    """Add ``sum_ab G_a M_ab G_b^T`` to ``result`` (p, 3, 3), with ``M`` (r, r) symmetric and ``gain`` (n, 3, 6)."""
    size = gain.shape[2]
    carried = np.empty((3, size))
    for point in range(len(result)):
        for b in range(first[point], first[point + 1]):
            carried[:] = 0.0
            for a in range(first[point], first[point + 1]):
                for k in range(size):
                    row = matrix[rows[a] + k]
                    for j in range(size):
                        value = row[rows[b] + j]
                        for i in range(3):
                            carried[i, j] += gain[a, i, k] * value
            for i in range(3):
                for j in range(3):
                    for k in range(size):
                        result[point, i, j] += carried[i, k] * gain[b, j, k]


@compiled
def cross_covariance(result: Float, matrix: Float, rows: Index, first: Index, gain: Float) -> None:
    """Set ``result`` (n, 3, 6) to ``sum_a G_a M_ab``: covariance of each point with the rows of each of its blocks."""
    size = gain.shape[2]
    for point in range(len(first) - 1):
        for b in range(first[point], first[point + 1]):
            result[b] = 0.0
            for a in range(first[point], first[point + 1]):
                for k in range(size):
                    row = matrix[rows[a] + k]
                    for j in range(size):
                        value = row[rows[b] + j]
                        for i in range(3):
                            result[b, i, j] += gain[a, i, k] * value
