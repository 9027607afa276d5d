"""Ellipse fit: hyperaccurate least squares with covariance, and the geometry of ellipses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value

MIN_POINTS = 6  # fewest points of an ellipse: its five parameters and one degree of freedom
_ROUNDS = 4  # of reweighting
_SECOND_ORDER = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # mean of the monomials of noise of unit variance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConicFit(Value):
    """An ellipse ``A x^2 + 2 B x y + C y^2 + 2 D x + 2 E y + F = 0``."""

    coefficients: Float  # (6,); a to F, of norm one and positive inside
    covariance: Float  # of the coefficients, across their own direction
    residuals: Float  # (n,); distances of the points from the ellipse to first order, positive outside

    @property
    def matrix(self) -> Float:
        """The symmetric matrix (3, 3) with ``(x, y, 1) . matrix . (x, y, 1) = 0`` on the ellipse."""
        return conic_matrix(self.coefficients)

    @property
    def ellipse(self) -> Float:
        """Center x and y, semi-major and semi-minor axis (5th: angle, rad, from +x to the major axis): (5,)."""
        return ellipse_of(self.coefficients)


def fit_ellipse(points: ArrayLike, *, sigma: ArrayLike = 1.0) -> ConicFit | Failure:
    r"""Fit an ellipse to points (n, 2) by hyperaccurate least squares, reweighted.

    With ``xi = (x^2, 2xy, y^2, 2x, 2y, 1)``, points on the conic have ``theta . xi = 0``. Plain least squares makes
    arcs too small, because noise enters the squares. Here ``M theta = lambda N theta`` is solved, with M the mean of
    ``w xi xi^T`` and N chosen such that the bias vanishes to second order in the noise: the mean over the points of ``w
    s^2 (V + 2 S[xi e^T])`` minus ``1/n`` times the mean of ``w^2 s^2 ((xi . P xi) V + 2 S[V P xi xi^T])``, where V is
    the covariance of xi for unit noise, e its mean, S the symmetric part and P the pseudo-inverse of M of rank five.
    Unit weights w are K. Kanatani's HyperLS; weights ``1 / (s^2 theta . V theta)`` of the last solution reach the
    Cramer-Rao bound.

    >>> turn = np.linspace(0.0, 4.0, 9)
    >>> fit = fit_ellipse(np.stack([3.0 + 2.0 * np.cos(turn), 1.0 + np.sin(turn)], axis=-1))
    >>> fit.ellipse[:4].round(6).tolist()
    [3.0, 1.0, 2.0, 1.0]
    """
    given = as_floats(points, (2,), "points")
    require(given.ndim == 2 and bool(np.isfinite(given).all()), f"points must be finite and (n, 2), got {given.shape}")
    if len(given) < MIN_POINTS:
        return Failure(
            Reason.TOO_FEW_DETECTIONS, f"needed at least {MIN_POINTS} points for an ellipse, got {len(given)}"
        )
    middle, scale = given.mean(axis=0), float(np.sqrt(given.var(axis=0).sum()))
    spread = np.linalg.svd(given - middle, compute_uv=False)
    if not spread[1] > 1e-9 * spread[0]:
        return Failure(
            Reason.DEGENERATE_GEOMETRY, f"the {len(given)} points lie on a line: no ellipse goes through them"
        )
    local = (given - middle) / scale
    noise = np.broadcast_to(as_floats(sigma, (), "sigma"), len(given)) / scale
    require(bool(np.all(np.isfinite(noise) & (noise > 0))), "sigma must be > 0 and finite")
    theta = _hyper(local, noise)
    curvature = theta[0] * theta[2] - theta[1] ** 2
    if not curvature > 0.0:
        return Failure(
            Reason.DEGENERATE_GEOMETRY, f"the {len(given)} points lie on no ellipse: too short an arc for its noise"
        )
    if not _value(ellipse_center(theta)[None], theta)[0] > 0.0:
        theta = -theta
    return _undo_scaling(local, noise, theta, middle, scale)


def conic_matrix(coefficients: Float) -> Float:
    """Symmetric matrix (3, 3) of a conic with the coefficients A to F (6,)."""
    a, b, c, d, e, f = coefficients
    return np.array([[a, b, d], [b, c, e], [d, e, f]])


def ellipse_center(coefficients: Float) -> Float:
    """Center (2,) of a conic A to F (6,)."""
    a, b, c, d, e, _ = coefficients
    return -np.linalg.solve(np.array([[a, b], [b, c]]), np.array([d, e]))


def ellipse_of(coefficients: Float) -> Float:
    """Center x, y, semi-major, semi-minor axis and angle of the major axis in rad, (5,), of an ellipse A to F (6,)."""
    a, b, c, _, _, _ = coefficients
    center = ellipse_center(coefficients)
    level = float(_value(center[None], coefficients)[0])
    values, vectors = np.linalg.eigh(np.array([[a, b], [b, c]]) / -level)
    minor, major = 1.0 / np.sqrt(values[::-1])
    axis = vectors[:, 0]
    return np.array([*center, major, minor, math.atan2(axis[1], axis[0]) % math.pi])


def _monomials(points: Float) -> tuple[Float, Float]:
    """``xi`` (n, 6) and its derivatives by x and by y (2, n, 6), of which its covariance for unit noise is made."""
    x, y = points.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    xi = np.stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, one], axis=-1)
    by_x = np.stack([x, y, zero, one, zero, zero], axis=-1)
    by_y = np.stack([zero, x, y, zero, one, zero], axis=-1)
    return xi, 2.0 * np.stack([by_x, by_y])


def _value(points: Float, theta: Float) -> Float:
    return _monomials(points)[0] @ theta


def _sum_covariance(weights: Float, slopes: Float) -> Float:
    """Weighted sum (6, 6) over the points (n,) of the covariance that derivatives (2, n, 6) make for unit noise."""
    return np.asarray(np.sum((slopes * weights[:, None]).mT @ slopes, axis=0))


def _hyper(points: Float, sigma: Float) -> Float:
    """Coefficients (6,) of norm one of the conic through points of order one."""
    xi, slopes = _monomials(points)
    count = len(xi)
    variance = sigma**2 / np.mean(sigma**2)
    weights = 1.0 / variance
    for _ in range(_ROUNDS):
        second = (xi * weights[:, None]).T @ xi / count
        values, vectors = np.linalg.eigh(second)
        inverse = (vectors[:, 1:] / values[1:]) @ vectors[:, 1:].T
        pulled = xi @ inverse
        first = _sum_covariance(weights * variance, slopes)
        mixed = np.outer((weights * variance) @ xi, _SECOND_ORDER)
        shares = weights**2 * variance
        absorbed = _sum_covariance(shares * np.sum(pulled * xi, axis=1), slopes)
        turned = np.sum((slopes * (shares * np.sum(slopes * pulled, axis=2))[:, :, None]).mT @ xi, axis=0)
        metric = (first + mixed + mixed.T) / count - (absorbed + turned + turned.T) / count**2
        ratios, solutions = np.linalg.eig(np.linalg.solve(second + 1e-15 * np.trace(second) * np.eye(6), metric))
        theta = np.real(solutions[:, np.argmax(np.abs(ratios))])
        theta = theta / np.linalg.norm(theta)
        weights = 1.0 / (variance * np.sum((slopes @ theta) ** 2, axis=0))
        weights = weights / weights.mean()
    return theta


def _statistics(points: Float, sigma: Float, theta: Float) -> tuple[Float, Float]:
    """Distances (n,) from the conic, positive outside, and covariance (6, 6) of its coefficients."""
    xi, slopes = _monomials(points)
    slope = np.sqrt(np.sum((slopes @ theta) ** 2, axis=0))
    residuals = -(xi @ theta) / slope
    across = np.linalg.svd(theta[None])[2][1:].T  # (6, 5)
    design = (xi @ across) / slope[:, None]  # the ellipse moves outward
    spread = across @ np.linalg.inv(np.linalg.qr(design / sigma[:, None])[1])
    return residuals, spread @ spread.T


def _undo_scaling(local: Float, noise: Float, theta: Float, middle: Float, scale: float) -> ConicFit:
    """Convert a fit to points about ``middle`` in units of ``scale`` to the unit of the points."""
    residuals, covariance = _statistics(local, noise, theta)
    move = _scaling_matrix(middle, scale)
    coefficients = move @ theta
    size = float(np.linalg.norm(coefficients))
    across = np.eye(6) - np.outer(coefficients, coefficients) / size**2
    change = across @ move / size
    return ConicFit(
        coefficients=coefficients / size, covariance=change @ covariance @ change.T, residuals=scale * residuals
    )


def _scaling_matrix(middle: Float, scale: float) -> Float:
    """Matrix (6, 6) from coefficients in ``(point - middle) / scale`` to those in the point itself."""
    x, y = middle / scale
    to_local = np.array([[1.0 / scale, 0.0, -x], [0.0, 1.0 / scale, -y], [0.0, 0.0, 1.0]])
    matrices: Float = to_local.T @ np.array([conic_matrix(one) for one in np.eye(6)]) @ to_local
    return matrices[:, [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]].T
