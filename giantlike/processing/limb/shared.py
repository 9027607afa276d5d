"""Parameters common to all lines across a limb: deviations of the reflectance law and the blur from the assumed ones.

They move the whole limb in or out and leave no residuals between lines, but show in the profile of every line, whose
information is summed, with every shift left free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.processing.limb.scan import ProfileMatch

_LINES_TOGETHER = 10  # number of neighboring lines with correlated errors: 15 px of limb with the usual spacing


_GAIN_STEPS = 4  # iterations of shared parameters and gains: each removes most of the error, even for a factor of 2
_SPREAD_STEPS = 3  # iterations of the estimate and of the scatter of lines about it
_GAIN_LIMITS = (0.2, 5.0)  # minimum and maximum ratio of the gain to the previous one, as for good points of a limb


_SMOOTHED_LINES = 15  # over which shifts are averaged: a quarter of their noise, along the course of a limb
_OWN_SIGMAS, _OWN_PX = 3.0, 0.1  # maximum distance of a line from its neighbors: sigmas of its noise, plus px

_CONTRADICTED = 3.0  # distance from the prior, sigmas, beyond which it has less weight (Huber's limit)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharedEstimate(Value):
    """Estimate of the parameters common to all lines."""

    values: Float  # (c,)
    covariance: Float  # (c, c)


def estimate_shared(
    match: ProfileMatch, good: Mask, *, prior: Float, expected: Float, open_above: Mask
) -> SharedEstimate:
    """Estimate the c parameters common to all lines.

    Their effect is multiplied by the gain of a line, which depends on them; both are iterated. The covariance follows
    from the scatter of the lines' estimates (Newey and West, which allows for correlated neighbors), and the prior has
    more weight where that exceeds the noise assumed in the weights (albedo, relief, another form of the point spread
    function). The prior of a parameter without an upper bound loses information beyond 3 standard deviations, as for
    Huber's outliers.
    """
    information, pull, gain_change = match.information[good], match.pull[good], match.shared_gain[good]
    spread, believed = 1.0, np.ones(len(prior))
    for _ in range(_SPREAD_STEPS):
        values, inverse, gain = _solve(information, pull, gain_change, prior * spread * believed, expected)
        above = np.where(open_above, (values - expected) * np.sqrt(prior), 0.0)
        believed = _CONTRADICTED / np.maximum(above, _CONTRADICTED)
        scores = gain[:, None] * pull - gain[:, None] ** 2 * np.einsum("nij,j->ni", information, values)
        scatter = _scatter(scores)
        formal = np.einsum("n,nij->ij", gain**2, information)
        spread = max(float(np.trace(inverse @ scatter) / max(np.trace(inverse @ formal), 1e-9)), 1.0)
    covariance = inverse @ (scatter + spread**2 * np.diag(prior)) @ inverse
    return SharedEstimate(values=values, covariance=(covariance + covariance.T) / 2.0)


def _solve(
    information: Float, pull: Float, gain_change: Float, prior: Float, expected: Float
) -> tuple[Float, Float, Float]:
    """Shared parameters (c,), inverse (c, c) of their information, and gains (n,) relative to the previous ones."""
    gain = np.ones(len(pull))
    for _ in range(_GAIN_STEPS):
        total = np.einsum("n,nij->ij", gain**2, information) + np.diag(prior)
        scale = np.sqrt(np.diagonal(total))
        inverse = np.linalg.inv(total / np.outer(scale, scale)) / np.outer(scale, scale)
        used = gain
        values = inverse @ (gain @ pull + prior * expected)
        gain = np.clip(1.0 - gain * (gain_change @ values), *_GAIN_LIMITS)
    return values, inverse, used


def _scatter(scores: Float) -> Float:
    """Covariance (c, c) of the sum of scores (n, c) whose neighbors have something in common."""
    count, parameters = scores.shape
    scatter = scores.T @ scores
    for lag in range(1, min(_LINES_TOGETHER, count - 1) + 1):
        shared = scores[lag:].T @ scores[:-lag]
        scatter += (1.0 - lag / (_LINES_TOGETHER + 1.0)) * (shared + shared.T)
    result: Float = scatter * (count / max(count - parameters, 1))
    return result


def smooth_places(match: ProfileMatch, good: Mask) -> Float:
    """Positions (n,) px of lines as their neighbors predict them; NaN of lines that are not good, or far from that."""
    count = min(_SMOOTHED_LINES, int(good.sum()))
    shift, sigma = match.shift_px[good], match.sigma_px[good]
    level = convolve1d(shift / sigma**2, np.ones(count), mode="nearest") / convolve1d(
        sigma**-2.0, np.ones(count), mode="nearest"
    )
    near = np.abs(shift - level) < _OWN_SIGMAS * sigma + _OWN_PX
    result = np.full(good.size, np.nan)
    result[good] = np.where(near, level, np.nan)
    return result
