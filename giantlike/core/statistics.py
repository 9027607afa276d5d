"""Robust statistics used by several packages."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float

MAD_TO_SIGMA = 1.482602218505602
"""Standard deviation / median absolute deviation of a normal distribution: 1 / (inverse normal CDF at 3/4)."""

IQR_PER_SIGMA = 1.3489795003921634
"""Interquartile range of a normal distribution of unit standard deviation: twice the inverse normal CDF at 3/4."""
_COST = 2.0  # of a parameter in -2 ln likelihood, by the criterion of Akaike
_FACTORS = 24  # tried between 1 and the one without a floor: steps of 5 % where that is 3
MEDIAN_CHI2 = 2.0 * math.log(2.0)
"""Median of chi-square with two degrees of freedom: of the squared length of a normalized residual in the image."""


def quartile_sigma(values: ArrayLike) -> float:
    """Standard deviation of values by their interquartile range."""
    low, high = np.quantile(np.asarray(values), (0.25, 0.75))
    return float(high - low) / IQR_PER_SIGMA


def whiten(values: Float, covariance: Float) -> Float:
    """Values (n, 2, ...) in units of their errors: solutions of ``L x = value``, ``L L^T`` the covariance (n, 2, 2)."""
    shape = (-1,) + (1,) * (values.ndim - 2)
    a, b, d = covariance[:, 0, 0], covariance[:, 1, 0], covariance[:, 1, 1]
    first, slope = 1.0 / np.sqrt(a), b / a
    second = 1.0 / np.sqrt(d - slope * b)
    result = np.empty_like(values)
    result[:, 0] = values[:, 0] * first.reshape(shape)
    result[:, 1] = (values[:, 1] - slope.reshape(shape) * values[:, 0]) * second.reshape(shape)
    return result


def squared_residuals(residuals: Float, covariance: Float) -> Float:
    """Squared Mahalanobis distances (n,) of residuals (n, k) by covariances (n, k, k); infinite where not finite."""
    if residuals.shape[1] == 2:
        with np.errstate(invalid="ignore"):
            squares: Float = np.sum(whiten(residuals, covariance) ** 2, axis=1)
    else:
        squares = np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(covariance), residuals)
    return np.where(np.isfinite(squares), squares, np.inf)


def error_floor(residuals: Float, covariance: Float, *, freedom: int | None = None) -> float:
    """Standard deviation per axis that explains residuals (n, 2) larger than their covariances (n, 2, 2); else 0."""
    variances, axes = _principal(covariance)
    return _floor_along(_rotate(residuals, axes) ** 2, variances, freedom)


def _floor_along(squares: Float, variances: Float, freedom: int | None) -> float:
    """Floor of squared residuals along the principal axes (n, 2) of covariances with the eigenvalues (n, 2)."""
    from scipy.optimize import brentq  # slow to import

    def typical(squares: Float) -> float:
        return _median(np.sum(squares, axis=1)) / MEDIAN_CHI2 if freedom is None else float(squares.sum()) / freedom

    def excess(floor: float) -> float:
        return typical(squares / (variances + floor**2)) - 1.0

    if excess(0.0) <= 0.0:
        return 0.0
    top = math.sqrt(typical(squares))  # which would explain the residuals alone
    return float(brentq(excess, 0.0, top, xtol=1e-9)) if excess(top) < 0.0 else top


def _principal(covariance: Float) -> tuple[Float, Float]:
    """Eigenvalues (n, 2), ascending, and unit eigenvectors (n, 2, 2), in columns, of symmetric matrices (n, 2, 2)."""
    a, b, d = covariance[:, 0, 0], covariance[:, 1, 0], covariance[:, 1, 1]
    middle, spread = (a + d) / 2.0, np.hypot((a - d) / 2.0, b)
    turn = 0.5 * np.arctan2(2.0 * b, a - d)
    c, s = np.cos(turn), np.sin(turn)
    least = (a * d - b * b) / (middle + spread)  # not the difference, which loses digits
    return np.stack([least, middle + spread], axis=1), np.stack([-s, c, c, s], axis=1).reshape(-1, 2, 2)


def _rotate(values: Float, axes: Float) -> Float:
    """Values (n, 2, ...) along axes (n, 2, 2) in columns."""
    result: Float = np.swapaxes(axes, 1, 2) @ values.reshape(len(values), 2, -1)
    return result.reshape(values.shape)


def nearest_covariance(matrix: Float) -> Float:
    """Return the positive semi-definite matrix nearest to a symmetric one (n, n), such as tabulated correlations."""
    try:
        np.linalg.cholesky(matrix)  # a covariance already, which takes a twentieth of the time to see
    except np.linalg.LinAlgError:
        pass
    else:
        return matrix
    variances, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(variances, 0.0)) @ axes.T)


def excess(first: Float, second: Float) -> Float:
    """Smallest covariance to add to the first (k, k) so that the sum exceeds the second in every direction.

    A direction in which the first has nothing to rounding counts as if it had that.
    """
    scale = np.sqrt(np.maximum(np.maximum(np.diag(first), np.diag(second)), 1e-300))
    squares, axes = np.linalg.eigh(first / np.outer(scale, scale))
    lengths = np.sqrt(np.maximum(squares, np.finfo(float).eps))
    root, inverse_root = scale[:, None] * axes * lengths, (axes / lengths).T / scale
    values, vectors = np.linalg.eigh(inverse_root @ second @ inverse_root.T)
    wide = root @ (vectors * np.sqrt(np.maximum(values - 1.0, 0.0)))
    return np.asarray(wide @ wide.T)


def error_terms(residuals: Float, covariance: Float, *, freedom: int) -> tuple[float, float]:
    """Factor (at least 1) on the standard deviations, and an error floor, that together explain residuals (n, 2).

    Errors of equal size for all observations (unmodeled distortion, turbulence) are a floor; errors that increase with
    the noise (correlated by compression or color filters, an unknown gain) are a factor. Of all pairs that bring the
    sum of squared residuals to the degrees of freedom the most likely one is taken, for normal errors; a floor alone
    where the factor does not pay for a parameter by Akaike's criterion.
    """
    variances, axes = _principal(covariance)
    along = _rotate(residuals, axes) ** 2
    most = math.sqrt(max(float(np.sum(along / variances)) / freedom, 1.0))

    def fit_floor(factor: float) -> tuple[float, float, float]:
        floor = _floor_along(along, factor**2 * variances, freedom)
        total = factor**2 * variances + floor**2
        return float(np.sum(np.log(total) + along / total)), factor, floor

    alone = fit_floor(1.0)
    best = min(fit_floor(factor) for factor in np.geomspace(1.0, most, _FACTORS).tolist())
    _, factor, floor = best if best[0] < alone[0] - _COST else alone
    return factor, floor


def robust_sigma(values: ArrayLike, center: float | None = None) -> float:
    """Standard deviation of values by their median absolute deviation.

    >>> round(robust_sigma([1.0, 2.0, 3.0, 4.0, 1000.0]), 4)
    1.4826
    """
    array = np.asarray(values, dtype=np.float64)
    middle = _median(array) if center is None else center
    return MAD_TO_SIGMA * _median(np.abs(array - middle))


def _median(values: Float) -> float:
    """Median of values of any shape, NaN where one of them is; for few values several times as fast as numpy's."""
    count = values.size
    if count == 0:
        return math.nan
    lower, upper = (count - 1) // 2, count // 2
    parted = np.partition(values, (lower, upper, count - 1), axis=None)
    middle = 0.5 * (float(parted[lower]) + float(parted[upper]))
    return math.nan if math.isnan(parted[-1]) else middle
