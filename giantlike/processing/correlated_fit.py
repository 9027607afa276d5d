"""Linear least squares for residuals with correlated neighbors: robust weights, and a covariance that includes it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.elimination import solve_normal, solve_symmetric
from giantlike.core.statistics import MAD_TO_SIGMA
from giantlike.core.values import Value

_ITERATIONS = 20  # maximum iterations of robust weights; they end earlier when the residuals converge
_START_REST, _REST = 0.5, 0.01
"""Motion of the residuals, over a tenth of their median sigma, below which robust weights need no more iterations: on
the way to a start, and from there."""
_TUKEY_LIMIT = 1.5
"""Residual at which a weight reaches zero, relative to the limit for outliers: kept points have positive weight."""
_RATIOS = np.concatenate([[0.0], np.geomspace(0.1, 1e6, 22)])
"""Variance of the correlated part / mean variance of the noise."""
_LENGTH_STEP = 3.0
"""Ratio of neighboring correlation lengths of the grid: solutions are averaged over it, which needs no finer one."""
_LEAST_SCALE = 1e-12
"""Minimum ratio of the variance to the predicted one, so that residuals of exactly zero have a likelihood too."""
_SINGULAR = 1e-12  # minimum pivot of a normal matrix of trace 1 that determines all parameters, far above rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CorrelatedFit(Value):
    """Parameters of a linear model and their covariance."""

    solution: Float  # (k,)
    covariance: Float  # (k, k)
    noise_scale: float  # scatter of the independent part / given sigmas: 1 when noise explains it
    correlated_sigma: float  # standard deviation of the part correlated between neighbors, unit of the residuals
    correlation_length: float  # distance over which it falls to 1/e, unit of the points; most likely value

    def residual_covariance(self, sigma: Float, points: Float) -> Float:
        """Covariance of residuals. ``sigma`` (n,); ``points`` (n, d); returns (n, n)."""
        distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
        shared = self.correlated_sigma**2 * np.exp(-distances / self.correlation_length)
        result: Float = shared + np.diag((self.noise_scale * sigma) ** 2)
        return result


def robust_solution(residuals: Float, design: Float, sigma: Float, *, outlier_mad: float) -> tuple[Float, Mask]:
    """Solve ``design @ solution = residuals`` and find the outliers among the residuals.

    ``residuals`` (n,); ``design`` (n, k), n > k; ``sigma`` (n,); returns ``solution`` (k,) and ``keep`` (n,).

    Starts from reweighting towards least absolute residuals, which is biased by outliers on one side that are half of
    the data, but not a quarter; continues with Tukey's biweight, whose weights fall to zero smoothly, so that residuals
    near the limit do not make the solution jump.
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


def generalized_solution(
    residuals: Float, design: Float, residual_covariance: Float, *, weights: Float | None = None
) -> tuple[Float, Float]:
    """Solve ``design @ solution = residuals`` for residuals of known covariance.

    ``residuals`` (n,); ``design`` (n, k); ``residual_covariance`` (n, n); ``weights`` (n,); returns ``solution`` (k,)
    and ``covariance`` (k, k).
    """
    gain = solution_gain(design, residual_covariance, weights=weights)
    covariance: Float = gain @ residual_covariance @ gain.T
    return gain @ residuals, covariance


def solution_gain(design: Float, residual_covariance: Float, *, weights: Float | None = None) -> Float:
    """Matrix that takes residuals to the solution of :func:`generalized_solution`.

    It propagates each part of the covariance of the residuals to the solution: ``gain @ part @ gain.T``.

    ``design`` (n, k); ``residual_covariance`` (n, n); ``weights`` (n,); returns (k, n).
    """
    scale = np.linalg.norm(design, axis=0)
    x = design / scale
    weighted = np.linalg.solve(residual_covariance, x) if weights is None else x * weights[:, None]
    gain: Float = np.linalg.solve(weighted.T @ x, weighted.T) / scale[:, None]
    return gain


def correlated_solution(
    residuals: Float,
    design: Float,
    sigma: Float,
    points: Float,
    *,
    min_length: float = 1.0,
    max_length: float | None = None,
) -> CorrelatedFit:
    r"""Generalized least squares with a covariance of the residuals estimated from the residuals themselves.

    ``residuals`` (n,); ``design`` (n, k), n > k + 1; ``sigma`` (n,); ``points`` (n, d); ``min_length``: shortest
    correlation length considered, unit of ``points``.

    The residuals' covariance is modeled as ``s^2 (diag(sigma^2) + q m exp(-distance / length))``, m the mean of
    ``sigma^2`` and the distance along the points: a first-order Markov process, which a Kalman filter whitens in one
    pass. For a grid of ratios q and lengths, s^2 is found by restricted maximum likelihood, which accounts for the long
    waves absorbed by the solution; the solutions are averaged with the likelihoods as weights, their disagreement added
    to the covariance.
    """
    n, k = design.shape
    require(n > k + 1, f"needed more than {k + 1} residuals, got {n}")
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    scale = np.linalg.norm(design / sigma[:, None], axis=0)
    typical = float(np.sqrt(np.mean(sigma**2)))
    longest = max(extent if max_length is None else min(extent, max_length), 2.0 * min_length)
    lengths = np.exp(np.arange(np.log(min_length), np.log(longest), np.log(_LENGTH_STEP)))
    ratios, grid = (part.ravel() for part in np.meshgrid(_RATIOS, lengths))  # one length after the other
    values = np.concatenate([residuals[:, None], design / scale], axis=1) / typical
    white, log_determinant = _whiten(values, (sigma / typical) ** 2, np.exp(-steps[:, None] / grid), ratios)
    likelihood, solutions, covariances, noise = _restricted_likelihoods(white, log_determinant)
    chance = np.exp(likelihood - likelihood.max())
    chance /= chance.sum()
    mean = chance @ solutions
    spread = solutions - mean
    covariance = np.einsum("g,gij->ij", chance, covariances) + np.einsum("g,gi,gj->ij", chance, spread, spread)
    by_length = chance.reshape(lengths.size, -1).sum(axis=1)
    return CorrelatedFit(
        solution=mean / scale,
        covariance=covariance / np.outer(scale, scale),
        noise_scale=float(np.sqrt(chance @ noise)),
        correlated_sigma=typical * float(np.sqrt(chance @ (ratios * noise))),
        correlation_length=float(lengths[np.argmax(by_length)]),
    )


def _whiten(values: Float, noise: Float, memory: Float, ratios: Float) -> tuple[Float, Float]:
    """Whiten columns of values under g covariances: values of variance 1 (g, n, columns), and log determinants (g,).

    Noise of variance ``noise`` (n,) is added to a part of variance ``ratios`` (g,) whose correlation from one value to
    the next is ``memory`` (n - 1, g): returns the normalized innovations of a Kalman filter, (g, n, columns).
    """
    white = np.empty((len(values), ratios.size, values.shape[1]))
    state, variance, log_determinant = np.zeros(white.shape[1:]), ratios.copy(), np.zeros(ratios.size)
    for number, row in enumerate(values):
        total = variance + noise[number]
        surprise = row - state
        white[number] = surprise / np.sqrt(total)[:, None]
        log_determinant += np.log(total)
        if number < len(memory):
            keep = memory[number]
            state = keep[:, None] * (state + (variance / total)[:, None] * surprise)
            variance = ratios + keep**2 * (variance * noise[number] / total - ratios)
    return np.swapaxes(white, 0, 1), log_determinant


def _restricted_likelihoods(white: Float, log_determinant: Float) -> tuple[Float, Float, Float, Float]:
    """For each covariance: log likelihood (g,), solution (g, k), its covariance (g, k, k), variance scale (g,).

    ``white`` (g, n, 1 + k) are residuals and design made independent.
    """
    y, x = white[..., 0], white[..., 1:]
    freedom = y.shape[1] - x.shape[2]
    across = np.swapaxes(x, 1, 2)
    normal = across @ x
    solution = np.linalg.solve(normal, across @ y[..., None])
    left = y - (x @ solution)[..., 0]
    noise: Float = np.maximum(np.einsum("gn,gn->g", left, left) / freedom, _LEAST_SCALE)
    likelihood: Float = -0.5 * (freedom * np.log(noise) + log_determinant + np.linalg.slogdet(normal)[1])
    covariance: Float = np.linalg.inv(normal) * noise[:, None, None]
    parameters: Float = solution[..., 0].astype(np.float64)
    return likelihood, parameters, covariance, noise
