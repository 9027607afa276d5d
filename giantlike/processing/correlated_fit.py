"""Linear least squares: robust weights, and gains that propagate correlated residuals to the solution."""

from __future__ import annotations

import math

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.elimination import solve_normal, solve_symmetric
from giantlike.core.statistics import MAD_TO_SIGMA

_ITERATIONS = 20  # maximum iterations of robust weights; they end earlier when the residuals converge
_START_REST, _REST = 0.5, 0.01
"""Motion of the residuals, over a tenth of their median sigma, below which robust weights need no more iterations: on
the way to a start, and from there."""
_TUKEY_LIMIT = 1.5  # residual of weight zero, over the limit for outliers: kept points have positive weight
_SINGULAR = 1e-12  # minimum pivot of a normal matrix of trace 1 that determines all parameters, far above rounding


def robust_solution(residuals: Float, design: Float, sigma: Float, *, outlier_mad: float) -> tuple[Float, Mask]:
    """Solve ``design @ solution = residuals`` and find the outliers among the residuals.

    ``residuals``, ``sigma`` (n,); ``design`` (n, k), n > k; returns ``solution`` (k,) and ``keep`` (n,).

    Starts from reweighting towards least absolute residuals, which is biased by outliers on one side that are half of
    the data, but not a quarter; continues with Tukey's biweight, whose weights fall to zero smoothly.
    """
    require(residuals.size > design.shape[1], f"needed more than {design.shape[1]} residuals, got {residuals.size}")
    values, columns, noise = (np.array(one, dtype=np.float64) for one in (residuals, design, sigma))
    return _robust(values, columns, noise, outlier_mad)


@compiled
def _robust(residuals: Float, design: Float, sigma: Float, outlier_mad: float) -> tuple[Float, Mask]:
    """Iterations of :func:`robust_solution`."""
    n, size = design.shape
    floor = 1e-6 + 0.1 * np.median(sigma)
    x, scale = np.empty((n, size)), np.empty(size)
    for i in range(size):
        scale[i] = math.sqrt(np.sum(design[:, i] ** 2))
        x[:, i] = design[:, i] / scale[i]
    weights, solution, left = np.ones(n), np.zeros(size), residuals.copy()
    for _ in range(_ITERATIONS):
        solution = _solve_weighted(residuals, x, weights)
        if _remains(residuals, x, solution, left) < _START_REST * floor:
            break
        weights = 1.0 / np.maximum(np.abs(left), floor + _scatter(left))
    for _ in range(_ITERATIONS):
        variance = sigma**2 + _scatter(left) ** 2
        biweight = np.maximum(1.0 - left**2 / ((_TUKEY_LIMIT * outlier_mad) ** 2 * variance), 0.0) ** 2
        if np.count_nonzero(biweight) <= size:
            break
        solution = _solve_weighted(residuals, x, biweight / variance)
        if _remains(residuals, x, solution, left) < _REST * floor:
            break
    return solution / scale, np.abs(left) <= outlier_mad * np.sqrt(sigma**2 + _scatter(left) ** 2)


@compiled
def _solve_weighted(residuals: Float, design: Float, weights: Float) -> Float:
    """Weighted least squares (k,); with a ridge where the design (n, k), of unit columns, is singular."""
    n, size = design.shape
    normal, right = np.zeros((size, size)), np.zeros((size, 1))
    for point in range(n):
        for i in range(size):
            weighted = weights[point] * design[point, i]
            right[i, 0] += weighted * residuals[point]
            for j in range(size):
                normal[i, j] += weighted * design[point, j]
    trace = np.trace(normal)
    factor, solution = normal / trace, right / trace
    solve_symmetric(factor, solution)
    if not np.diag(factor).min() > _SINGULAR:
        solution[:] = right
        solve_normal(normal, solution)
    result: Float = solution[:, 0]
    return result


@compiled
def _remains(residuals: Float, design: Float, solution: Float, left: Float) -> float:
    """Replace the residuals (n,) of the previous solution by those of a new one; return the largest difference."""
    most = 0.0
    for point in range(len(residuals)):
        before, left[point] = left[point], residuals[point]
        for i in range(len(solution)):
            left[point] -= design[point, i] * solution[i]
        most = max(most, abs(left[point] - before))
    return most


@compiled
def _scatter(values: Float) -> float:
    """:func:`~giantlike.core.statistics.robust_sigma` of values (n,)."""
    result: float = MAD_TO_SIGMA * np.median(np.abs(values - np.median(values)))
    return result


def solution_gain(design: Float, residual_covariance: Float, *, weights: Float | None = None) -> Float:
    """Matrix (k, n) that takes residuals to the solution of ``design @ solution = residuals``, generalized or weighted.

    ``design`` (n, k); ``residual_covariance`` (n, n); ``weights`` (n,). Each part of the covariance of the residuals
    enters that of the solution as ``gain @ part @ gain.T``.
    """
    scale = np.linalg.norm(design, axis=0)
    x = design / scale
    weighted = np.linalg.solve(residual_covariance, x) if weights is None else x * weights[:, None]
    gain: Float = np.linalg.solve(weighted.T @ x, weighted.T) / scale[:, None]
    return gain
