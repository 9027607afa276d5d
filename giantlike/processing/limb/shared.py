"""Parameters that all lines across a limb share: how the reflectance law and the blur differ from those assumed.

A wrong law or blur moves the whole limb in or out and leaves no residuals between lines, but it shows in the profile of
every line. What lines say about it is added up, every shift left free, and taken off the shifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.processing.limb.scan import ProfileMatch

_LINES_TOGETHER = 10
"""Neighboring lines whose errors are taken to have something in common: 15 px of limb with the usual spacing.

Profiles of lines share pixels over 4 px, and albedo is alike over some of that.
"""


_GAIN_STEPS = 4
"""Rounds of shared parameters and gains: each takes off most of what is left of twofold gains."""
_SPREAD_STEPS = 3
"""Rounds of the estimate and of how far lines scatter about it."""
_GAIN_LIMITS = (0.2, 5.0)
"""Least and largest gain over that fitted before, as for good points of a limb."""


_SMOOTHED_LINES = 15
"""Neighboring lines over which shifts are averaged: leaves a quarter of their noise, follows the course of a limb."""
_OWN_SIGMAS, _OWN_PX = 3.0, 0.1
"""Sigmas of its noise, and px besides, by which a line may lie off its neighbors and still be taken for one of them."""

_CONTRADICTED = 3.0
"""Standard deviations above what is known before from which on that is believed less, Huber's limit: there the normal
distribution ends. With optics of 1.2 px told 0.7 to 5 %, on 8 views, squared errors per degree of freedom are 1.0, 1.2
and 1.6 with 2, 3 and 5, and 2.0 with all belief, which leaves a third of the blur to law, wings and size."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharedEstimate(Value):
    """Estimate of the parameters that all lines share.

    Parameters
    ----------
    values : (c,) float64
    covariance : (c, c) float64
    """

    values: Float
    covariance: Float


def estimate_shared(
    match: ProfileMatch, good: Mask, *, prior: Float, expected: Float, open_above: Mask
) -> SharedEstimate:
    """Estimate the parameters that all lines share.

    ``good`` (n,); ``prior``, ``expected``, ``open_above`` (c,).

    Notes
    -----
    What the shared parameters change is multiplied by the gain of a line, and this changes with them: a line that was
    fitted with too little gain overstates them as much. Some rounds of both settle that.

    The covariance comes from how the lines differ in what they say (Newey and West's estimate, which counts that
    neighbors say the same for the same reason), not from the noise that the weights suppose. Where they differ by more
    than that noise (albedo, relief, a point spread function of another form), what is known before counts for more.

    What is known before of a parameter that is open above is the less believed the farther lines say it is off: its
    information falls with the distance from 3 standard deviations on, as that of Huber's outliers.
    """
    information, pull, gain_change = match.information[good], match.pull[good], match.shared_gain[good]
    spread, believed = 1.0, np.ones(len(prior))
    for _ in range(_SPREAD_STEPS):
        values, inverse, gain = _solved(information, pull, gain_change, prior * spread * believed, expected)
        above = np.where(open_above, (values - expected) * np.sqrt(prior), 0.0)
        believed = _CONTRADICTED / np.maximum(above, _CONTRADICTED)
        scores = gain[:, None] * pull - gain[:, None] ** 2 * np.einsum("nij,j->ni", information, values)
        scatter = _scatter(scores)
        told = np.einsum("n,nij->ij", gain**2, information)
        spread = max(float(np.trace(inverse @ scatter) / max(np.trace(inverse @ told), 1e-9)), 1.0)
    covariance = inverse @ (scatter + spread**2 * np.diag(prior)) @ inverse
    return SharedEstimate(values=values, covariance=(covariance + covariance.T) / 2.0)


def _solved(
    information: Float, pull: Float, gain_change: Float, prior: Float, expected: Float
) -> tuple[Float, Float, Float]:
    """Shared parameters (c,), inverse (c, c) of all information on them, and gains (n,) over those fitted before."""
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
    """Places of lines by those of their neighbors, about which the next match is made.

    ``good`` (n,); returns (n,) px, NaN for lines that are not good, or lie farther from their neighbors than noise
    explains: relief.
    """
    count = min(_SMOOTHED_LINES, int(good.sum()))
    shift, sigma = match.shift_px[good], match.sigma_px[good]
    level = convolve1d(shift / sigma**2, np.ones(count), mode="nearest") / convolve1d(
        sigma**-2.0, np.ones(count), mode="nearest"
    )
    near = np.abs(shift - level) < _OWN_SIGMAS * sigma + _OWN_PX
    result = np.full(good.size, np.nan)
    result[good] = np.where(near, level, np.nan)
    return result
