"""Robust statistics that several packages share."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float

MAD_TO_SIGMA = 1.482602218505602
"""Standard deviation over the median absolute deviation of a normal distribution: 1 / (inverse normal CDF at 3/4)."""

IQR_PER_SIGMA = 1.3489795003921634
"""Interquartile range of a normal distribution of unit standard deviation: twice the inverse normal CDF at 3/4."""
_COST = 2.0  # of a parameter in -2 ln likelihood, by the criterion of Akaike
_LEAST_FLOOR, _MOST_FLOOR, _FLOORS = 0.03, 3.0, 14  # floors tried, over the median sigma: steps of 1.4
_FACTORS = 24  # tried between 1 and the one without a floor: steps of 5 % where that is 3
MEDIAN_CHI2 = 2.0 * math.log(2.0)
"""Median of chi-square with two degrees of freedom: of the squared length of a normalized residual in the image."""


def quartile_sigma(values: ArrayLike) -> float:
    """Standard deviation of values by their interquartile range.

    Parameters
    ----------
    values : array_like
        Any shape.

    Returns
    -------
    float
    """
    low, high = np.quantile(np.asarray(values), (0.25, 0.75))
    return float(high - low) / IQR_PER_SIGMA


def squared_residuals(residuals: Float, covariance: Float) -> Float:
    """Squared residuals in units of their covariance (squared Mahalanobis distances).

    Parameters
    ----------
    residuals : (n, k) float64
    covariance : (n, k, k) float64
        Of each residual, positive definite.

    Returns
    -------
    (n,) float64, unitless
        Infinite for residuals that are not finite.
    """
    squares = np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(covariance), residuals)
    return np.where(np.isfinite(squares), squares, np.inf)


def error_floor(residuals: Float, covariance: Float, *, freedom: int | None = None) -> float:
    """Standard deviation per axis that explains residuals larger than their covariances do.

    Parameters
    ----------
    residuals : (n, 2) float64
    covariance : (n, 2, 2) float64
        Of each residual, positive definite.
    freedom : int, optional
        Degrees of freedom that the sum of squared residuals is brought to; default: their median is brought to that of
        chi-square, whatever some outliers are.

    Returns
    -------
    float
        Unit of the residuals: the isotropic error that, added in quadrature to every covariance, makes the squared
        residuals as large as expected; 0 if they are no larger without.
    """
    from scipy.optimize import brentq  # slow to import

    variances, axes = np.linalg.eigh(covariance)
    along = np.einsum("nji,nj->ni", axes, residuals) ** 2

    def excess(floor: float) -> float:
        squares = np.sum(along / (variances + floor**2), axis=1)
        return float(np.median(squares) / MEDIAN_CHI2 if freedom is None else squares.sum() / freedom) - 1.0

    if excess(0.0) <= 0.0:
        return 0.0
    top = float(np.sqrt(np.max(np.sum(residuals**2, axis=1)))) * np.sqrt(float(len(residuals)))
    return float(brentq(excess, 0.0, top, xtol=1e-9))


def error_terms(residuals: Float, covariance: Float, *, freedom: int) -> tuple[float, float]:
    """Factor on the standard deviations, and an error floor, that together explain residuals.

    Errors that all observations have alike (distortion that is not modeled, turbulence) are a floor; errors that grow
    with the noise (pixels whose noise is correlated by compression or color filters, an unknown gain) are a factor. Of
    all pairs that bring the sum of squared residuals to the degrees of freedom the most likely one is taken, for normal
    errors; a floor alone where the factor makes that no more likely than a parameter costs by the criterion of Akaike.

    Parameters
    ----------
    residuals : (n, 2) float64
    covariance : (n, 2, 2) float64
        Of each residual, positive definite.
    freedom : int
        Degrees of freedom of all residuals.

    Returns
    -------
    factor : float
        At least 1.
    floor : float
        Unit of the residuals, per axis; at least 0.
    """
    variances, axes = np.linalg.eigh(covariance)
    along = np.einsum("nji,nj->ni", axes, residuals) ** 2
    most = math.sqrt(max(float(np.sum(along / variances)) / freedom, 1.0))

    def of(factor: float) -> tuple[float, float, float]:
        floor = error_floor(residuals, factor**2 * covariance, freedom=freedom)
        total = factor**2 * variances + floor**2
        return float(np.sum(np.log(total) + along / total)), factor, floor

    alone = of(1.0)
    best = min(of(factor) for factor in np.geomspace(1.0, most, _FACTORS).tolist())
    _, factor, floor = best if best[0] < alone[0] - _COST else alone
    return factor, floor


def hidden_floor(residuals: Float, covariance: Float, jacobian: Float) -> float:
    """Most likely error floor of observations whose residuals their noise explains.

    An observation that is far better than all others is fitted exactly, so that its own error moves the fit off the
    others and hides in it: the sum of squares does not show it. The restricted likelihood (REML) looks at what the fit
    leaves of each.

    Parameters
    ----------
    residuals : (n, 2) float64
        Of the fit with these covariances.
    covariance : (n, 2, 2) float64
        Of each residual, positive definite.
    jacobian : (n, 2, k) float64
        Derivative of the observations by the parameters of the fit.

    Returns
    -------
    float
        Unit of the residuals, per axis; 0 where it makes them no more likely than a parameter costs.
    """
    variances, axes = np.linalg.eigh(covariance)
    along = np.einsum("nji,nj->ni", axes, residuals).ravel()
    design = np.einsum("nji,njk->nik", axes, jacobian).reshape(along.size, -1)
    design /= np.linalg.norm(design, axis=0)
    own = variances.ravel()

    def cost(floor: float) -> float:
        root = np.sqrt(own + floor**2)
        basis, triangle = np.linalg.qr(design / root[:, None])
        left = along / root
        left = left - basis @ (basis.T @ left)
        return float(2.0 * np.log(root).sum() + 2.0 * np.log(np.abs(np.diag(triangle))).sum() + left @ left)

    floors = np.sqrt(np.median(own)) * np.geomspace(_LEAST_FLOOR, _MOST_FLOOR, _FLOORS)
    costs = [cost(floor) for floor in floors.tolist()]
    best = int(np.argmin(costs))
    return float(floors[best]) if costs[best] < cost(0.0) - _COST else 0.0


def robust_sigma(values: ArrayLike, center: float | None = None) -> float:
    """Standard deviation of values by their median absolute deviation.

    Parameters
    ----------
    values : array_like
        Any shape.
    center : float, optional
        Deviations are from this; default the median of the values.

    Examples
    --------
    >>> round(robust_sigma([1.0, 2.0, 3.0, 4.0, 1000.0]), 4)
    1.4826
    """
    array = np.asarray(values, dtype=np.float64)
    middle = np.median(array) if center is None else center
    return MAD_TO_SIGMA * float(np.median(np.abs(array - middle)))
