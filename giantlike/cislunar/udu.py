"""Covariances as U D U^T: unit upper triangular times diagonal, which stay positive where a covariance would not.

Everything takes leading axes: a thousand filters run as one. Sections are of Holt, D'Souza and Saley (2018), Orion
Optical Navigation Progress Toward Exploration Mission 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.values import Value, check_covariance


@dataclass(frozen=True, slots=True, eq=False)
class UduFactors(Value):
    """Factors of covariances."""

    upper: Float  # (..., n, n); upper triangular with ones on the diagonal
    diagonal: Float  # (..., n); not negative

    def composed(self) -> Float:
        """Return the covariance ``U D U^T``. Returns (..., n, n)."""
        return (self.upper * self.diagonal[..., None, :]) @ np.swapaxes(self.upper, -1, -2)

    def sigmas(self) -> Float:
        """Return the standard deviations. Returns (..., n)."""
        return np.asarray(np.sqrt(np.sum(self.upper**2 * self.diagonal[..., None, :], axis=-1)))


def udu_factors(covariance: ArrayLike) -> UduFactors:
    """Factors of a covariance.

    Parameters
    ----------
    covariance : (..., n, n) array_like; symmetric and positive semi-definite; a variance may be zero

    Raises
    ------
    InputError
        The matrix is not a covariance.

    References
    ----------
    .. [1] Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1, I.B.

    Examples
    --------
    >>> udu_factors([[4.0, 2.0], [2.0, 2.0]]).diagonal.tolist()
    [2.0, 2.0]
    """
    rest = np.array(covariance, dtype=np.float64)
    check_covariance(rest, "covariance")
    n = rest.shape[-1]
    upper = np.broadcast_to(np.eye(n), rest.shape).copy()
    diagonal = np.zeros(rest.shape[:-1])
    for j in range(n - 1, -1, -1):
        diagonal[..., j] = np.maximum(rest[..., j, j], 0.0)
        column = rest[..., :j, j] * _inverse(diagonal[..., j])[..., None]
        upper[..., :j, j] = column
        rest[..., :j, :j] -= diagonal[..., j, None, None] * column[..., :, None] * column[..., None, :]
    return UduFactors(upper, diagonal)


def gram_schmidt(rows: Float, weights: Float) -> UduFactors:
    """Factors of ``W diag(w) W^T``, W (..., n, m), by modified weighted Gram-Schmidt without the product (I.B)."""
    left = np.array(rows, dtype=np.float64)
    shape = np.broadcast_shapes(left.shape[:-2], weights.shape[:-1])
    left = np.broadcast_to(left, (*shape, *left.shape[-2:])).copy()
    n = left.shape[-2]
    upper = np.broadcast_to(np.eye(n), (*shape, n, n)).copy()
    diagonal = np.zeros((*shape, n))
    for j in range(n - 1, -1, -1):
        weighted = left[..., j, :] * weights
        diagonal[..., j] = np.sum(left[..., j, :] * weighted, axis=-1)
        products = (left[..., :j, :] @ weighted[..., :, None])[..., 0]
        upper[..., :j, j] = products * _inverse(diagonal[..., j])[..., None]
        left[..., :j, :] -= upper[..., :j, j, None] * left[..., j, None, :]
    return UduFactors(upper, diagonal)


def plus_dyad(factors: UduFactors, weight: ArrayLike, vector: ArrayLike) -> UduFactors:
    """Factors of ``U D U^T + weight * vector vector^T``, weight not negative, by Agee and Turner's update (I.B)."""
    share = np.asarray(weight, dtype=np.float64)
    require(bool((share >= 0.0).all()), "weight must be >= 0")
    upper, diagonal = np.array(factors.upper), np.array(factors.diagonal)
    _add_dyad(upper, diagonal, share, np.array(as_floats(vector, upper.shape[-1:], "vector")))
    return UduFactors(upper, diagonal)


def gauss_markov_step(factors: UduFactors, index: int, decay: ArrayLike, variance: ArrayLike) -> UduFactors:
    """Factors after one state was multiplied by a decay (...) and got independent noise of a variance (...).

    Source: I.B, for parameters: the state's column loses a dyad of the states before it.
    """
    upper, diagonal = np.array(factors.upper), np.array(factors.diagonal)
    factor, noise = np.asarray(decay, dtype=np.float64), np.asarray(variance, dtype=np.float64)
    before = diagonal[..., index].copy()
    after = factor**2 * before + noise
    column = upper[..., :index, index].copy()
    share = before * _inverse(after)
    diagonal[..., index] = after
    upper[..., :index, index] = (factor * share)[..., None] * column
    upper[..., index, index + 1 :] *= factor[..., None]
    lost = np.where(after > 0.0, share * noise, before)
    _add_dyad(upper[..., :index, :index], diagonal[..., :index], lost, column)
    return UduFactors(upper, diagonal)


@dataclass(frozen=True, slots=True, eq=False)
class ScalarUpdate(Value):
    """Effect of one scalar measurement on a covariance."""

    factors: UduFactors  # after the measurement
    gain: Float  # (..., n); change of the states per unit of the innovation
    variance: Float  # (...); of the innovation


def scalar_update(factors: UduFactors, partials: ArrayLike, noise_variance: ArrayLike) -> ScalarUpdate:
    """Update by one measurement, partials (..., n), with independent noise: Carlson's (1973), without roots (I.B)."""
    upper, diagonal = factors.upper, factors.diagonal
    noise = np.asarray(noise_variance, dtype=np.float64)
    require(bool((noise > 0.0).all()), "noise_variance must be positive")
    design = as_floats(partials, upper.shape[-1:], "partials")
    seen = (np.swapaxes(upper, -1, -2) @ design[..., :, None])[..., 0]
    weighted = diagonal * seen
    totals = noise[..., None] + np.cumsum(weighted * seen, axis=-1)
    before = np.concatenate([np.broadcast_to(noise[..., None], totals[..., :1].shape), totals[..., :-1]], axis=-1)
    sums = np.cumsum(upper * weighted[..., None, :], axis=-1)
    shifted = np.concatenate([np.zeros_like(sums[..., :1]), sums[..., :-1]], axis=-1)
    updated = UduFactors(upper - (seen / before)[..., None, :] * shifted, diagonal * before / totals)
    variance = totals[..., -1]
    return ScalarUpdate(updated, sums[..., -1] / variance[..., None], variance)


def considered_update(update: ScalarUpdate, considered: ArrayLike) -> ScalarUpdate:
    """Undo an update of considered states (n,): their errors count, they are not estimated.

    Their gain becomes zero. The covariance loses by that one dyad, that gain times the variance of the innovation.
    """
    kept = np.asarray(considered, dtype=bool)
    if not kept.any():
        return update
    factors = plus_dyad(update.factors, update.variance, np.where(kept, update.gain, 0.0))
    return ScalarUpdate(factors, np.where(kept, 0.0, update.gain), update.variance)


def _add_dyad(upper: Float, diagonal: Float, weight: Float, vector: Float) -> None:
    """Agee and Turner's update in place; all three arrays are overwritten."""
    left = np.array(np.broadcast_to(weight, diagonal.shape[:-1]))
    vector = np.array(np.broadcast_to(vector, diagonal.shape))
    for j in range(diagonal.shape[-1] - 1, -1, -1):
        part = vector[..., j].copy()
        after = diagonal[..., j] + left * part**2
        inverse = _inverse(after)
        slope = (left * part * inverse)[..., None]
        vector[..., :j] -= part[..., None] * upper[..., :j, j]
        upper[..., :j, j] += slope * vector[..., :j]
        left = np.where(after > 0.0, left * diagonal[..., j] * inverse, left)
        diagonal[..., j] = after


def _inverse(values: Float) -> Float:
    """Reciprocals, 0 of 0: a state without variance has no column."""
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0.0)
