"""Statistics of a photometric fit whose model is not exact: weights and covariances from the residuals themselves.

A template differs from the image by more than noise: facets, sampling, albedo, the reflectance law. The differences
vary with edges and with light, and they hang together over the width of the point spread function and often farther.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value

_REWEIGHTINGS = 3
_FIRST_ERROR = 0.03  # of a pixel, of the light
_VARIANCE_SAMPLES = 8_000
_VARIANCE_STEPS = 25
_SIGNIFICANT = 2.0
_MOST_ABSORBED = 0.75
_INSIDE_PIXEL_PX = 0.3
_FINE_LENGTH_PX = 4.0
_BLOCKS_PER_PARAMETER = 3.0
_MANY_BLOCKS = 150  # with so many, where they start no longer matters
_CONDITION_LIMIT = 1e12
_LEVERAGE_LIMIT = 0.95  # a block that alone fixes a parameter counts as if a little else did too


@dataclass(frozen=True, slots=True, eq=False)
class Prior(Value):
    """What is known of the parameters before the fit.

    Parameters
    ----------
    mean : (k,) float64
    information : (k,) float64
        Inverse variances; 0 where nothing is known.
    """

    mean: Float
    information: Float


@dataclass(frozen=True, slots=True, eq=False)
class RobustFit(Value):
    """Parameters of a linear model, with what the residuals say of its errors.

    Parameters
    ----------
    parameters : (k,) float64
    errors : (m,) float64
        Variances of the kinds of error.
    noise, error : (n,) float64
        Variances: of what is independent from pixel to pixel, and of model errors that the point spread function
        spreads.
    kept : (n,) bool
        False where a residual was clipped.
    """

    parameters: Float
    errors: Float
    noise: Float
    error: Float
    kept: Mask


def robust_fit(
    design: Float,
    values: Float,
    noise: Float,
    shapes: Float,
    prior: Prior,
    *,
    clip_sigma: float,
    start: Float | None = None,
) -> RobustFit | None:
    """Weighted least squares, with weights that allow for errors of the model.

    Parameters
    ----------
    design : (n, k) float64
    values, noise : (n,) float64
        Noise as variance.
    shapes : (m, n) float64
        How the variances of further kinds of error vary over the values; those of the first kind are independent.
    prior : Prior
    clip_sigma : float
        Values with larger residuals are rejected.
    start : (m,) float64, optional
        Variances of the kinds of error from a fit nearby.

    Returns
    -------
    RobustFit or None
        None when the values do not determine the parameters.
    """
    known = np.zeros(len(shapes)) if start is None else start
    parameters = _weighted(design, values, 1.0 / (noise + known @ shapes), prior)
    if parameters is None:
        return None
    errors = _first_errors(values - design @ parameters, noise, len(shapes)) if start is None else start
    for _ in range(_REWEIGHTINGS if start is None else 1):
        residuals = values - design @ parameters
        errors = model_errors(residuals, noise, shapes, errors, clip_sigma=clip_sigma)
        variance = noise + errors @ shapes
        kept = np.abs(residuals) <= clip_sigma * np.sqrt(variance)
        parameters = _weighted(design, values, kept / variance, prior)
        if parameters is None:
            return None
    return RobustFit(parameters, errors, noise + errors[0] * shapes[0], errors[1:] @ shapes[1:], kept)


def model_errors(residuals: Float, noise: Float, shapes: Float, start: Float, *, clip_sigma: float) -> Float:
    """Variances of several kinds of model error under which Gaussian residuals are most likely.

    Parameters
    ----------
    residuals, noise : (n,) float64
        Noise as variance.
    shapes : (m, n) float64
        How the variance of each kind varies over the values.
    start : (m,) float64
        Positive.
    clip_sigma : float
        Residuals beyond so many standard deviations count as if they lay there.

    Returns
    -------
    (m,) float64
        Not negative. Of many values a part is enough.
    """
    thin = slice(None, None, max(residuals.size // _VARIANCE_SAMPLES, 1))
    squares, noise, shapes = residuals[thin] ** 2, noise[thin], shapes[:, thin]
    result = start
    for _ in range(_VARIANCE_STEPS):
        variance = noise + result @ shapes
        clipped = np.minimum(squares, clip_sigma**2 * variance)
        expected = np.maximum(shapes @ (1.0 / variance), 1e-300)
        result = result * (shapes @ (clipped / variance**2)) / expected
    return result


def _weighted(design: Float, values: Float, weights: Float, prior: Prior) -> Float | None:
    """Weighted least-squares parameters (k,) with a prior; None when they are not determined."""
    information = (design * weights[:, None]).T @ design + np.diag(prior.information)
    right = design.T @ (weights * values) + prior.information * prior.mean
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / scale / scale[:, None]
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > _CONDITION_LIMIT:
        return None
    result: Float = np.linalg.solve(scaled, right / scale) / scale
    return result


def _first_errors(residuals: Float, noise: Float, count: int) -> Float:
    """Rough variances (count,) of model errors: some of each kind."""
    excess = robust_sigma(residuals, 0.0) ** 2 - float(np.median(noise))
    return np.array([max(excess, 1e-3 * float(noise.mean())), *[_FIRST_ERROR**2] * (count - 1)])


def noise_covariance(design: Float, weights: Float, noise: Float, prior: Prior) -> Float:
    """Covariance (k, k) that noise of given variance (n,) makes in a fit with given weights (n,) and prior."""
    inverse = np.linalg.inv((design * weights[:, None]).T @ design + np.diag(prior.information))
    scatter = (design * (weights**2 * noise)[:, None]).T @ design + np.diag(prior.information)
    result: Float = inverse @ scatter @ inverse
    return result


def error_covariance(columns: Float, weights: Float, error: Float, prior: Prior, *, length_px: float) -> Float:
    """Covariance (k, k) that an error of the model of known size makes in a fit.

    Parameters
    ----------
    columns : (k, h, w) float64
        Derivatives of the model.
    weights : (h, w) float64
        0 where a pixel is not used.
    error : (h, w) float64
        The image that one standard deviation of the error makes, with its sign.
    prior : Prior
    length_px : float, px
        Errors at a distance d have the correlation ``exp(-d^2 / (2 length_px^2))``.
    """
    design = columns.reshape(len(columns), -1).T
    inverse = np.linalg.inv((design * weights.ravel()[:, None]).T @ design + np.diag(prior.information))
    result: Float = inverse @ _correlated(columns * (weights * error), length_px / math.sqrt(2.0)) @ inverse
    return result


def full_covariance(
    columns: Float,
    weights: Float,
    residuals: Float,
    noise: Float,
    error: Float,
    prior: Prior,
    *,
    blur_px: float,
    block_px: int,
) -> Float:
    """Covariance of a fit from noise and from model errors that hang together.

    Parameters
    ----------
    columns : (k, h, w) float64
        Derivatives of the model.
    weights : (h, w) float64
        0 where a pixel is not used.
    residuals : (h, w) float64
    noise, error : (h, w) float64
        Variances of what is independent from pixel to pixel, and of what the point spread function spreads.
    prior : Prior
    blur_px : float, px
        Standard deviation of the point spread function.
    block_px : int, px

    Returns
    -------
    (k, k) float64

    Notes
    -----
    The sandwich ``H^-1 (N + E + P) H^-1`` has the scores of the noise, of the model error, correlated between pixels
    at distance d like ``exp(-d^2 / (4 b^2))``, and of the prior; b is ``blur_px``, or more where the residuals are
    correlated over longer distances. E is scaled up for the part of the model error that the parameters absorb, their
    number over that of independent patches. Where a jackknife over blocks of pixels finds more, in any direction of
    parameter space, its variance is taken: it sees whatever hangs together over a block.
    """
    design = columns.reshape(len(columns), -1).T
    flat = weights.ravel()
    known = np.diag(prior.information)
    information = (design * flat[:, None]).T @ design + known
    inverse = np.linalg.inv(information)
    length_px = _correlation_length_px(residuals, weights, error, blur_px, block_px)
    independent = (design * (flat**2 * noise.ravel())[:, None]).T @ design
    absorbed = _absorbed(weights * error, length_px, len(columns))
    together = _correlated(columns * (weights * np.sqrt(error)), length_px) / (1.0 - absorbed)
    scatter = independent + together + known
    sandwich = inverse @ scatter @ inverse
    offsets = (0, block_px // 2) if weights.size < _MANY_BLOCKS * block_px**2 else (0,)
    moves = [_jackknife(columns, residuals, weights, information, block_px, offset) for offset in offsets]
    told = [move for move in moves if move is not None]
    return larger(sandwich, np.mean(told, axis=0) + inverse @ known @ inverse) if told else sandwich


def _correlation_length_px(residuals: Float, weights: Float, error: Float, least_px: float, most_px: float) -> float:
    """Length b over which the model error is correlated like ``exp(-d^2 / (4 b^2))``, from its autocorrelation.

    The sum of that kernel over d = 1, 2, ... is ``sqrt(pi) b - 1/2``; it ends where the correlation drowns in noise.
    """
    scaled = residuals * np.sqrt(weights)
    used = weights > 0.0
    share = float(np.mean((weights * error)[used]))
    total = 0.0
    for lag in range(1, math.ceil(3.0 * most_px)):
        count = np.count_nonzero(used[lag:] & used[:-lag]) + np.count_nonzero(used[:, lag:] & used[:, :-lag])
        if count == 0:
            break
        products = np.vdot(scaled[lag:], scaled[:-lag]) + np.vdot(scaled[:, lag:], scaled[:, :-lag])
        correlation = float(products) / count
        if correlation < _SIGNIFICANT / math.sqrt(count):
            break
        total += correlation / max(share, 1e-12)
    return float(np.clip((total + 0.5) / math.sqrt(math.pi), least_px, max(most_px, least_px)))


def _absorbed(share: Float, length_px: float, count: int) -> float:
    """Part of the variance of a correlated error that ``count`` parameters take out of the residuals."""
    square = float(np.vdot(share, share))
    if square <= 0.0:
        return 0.0
    patches = float(share.sum()) ** 2 / square / max(4.0 * math.pi * length_px**2, 1.0)
    return min(count / max(patches, 1e-12), _MOST_ABSORBED)


def _correlated(scores: Float, length_px: float) -> Float:
    """Covariance (k, k) of the sum of scores (k, h, w), correlated as in :func:`full_covariance`.

    Over long distances sums over small blocks do for pixels.
    """
    if length_px < _INSIDE_PIXEL_PX:
        flat = scores.reshape(len(scores), -1)
        return _symmetric(flat @ flat.T)
    factor = max(int(length_px / _FINE_LENGTH_PX), 1)
    images = _blocks(scores, factor, 0) if factor > 1 else scores
    sigma = math.sqrt(2.0) * length_px / factor
    side = 2 * math.ceil(4.0 * sigma) + 1
    blurred = np.stack([cv2.GaussianBlur(one, (side, side), sigma, borderType=cv2.BORDER_CONSTANT) for one in images])
    flat = images.reshape(len(images), -1)
    return _symmetric(2.0 * math.pi * sigma**2 * (flat @ blurred.reshape(len(images), -1).T))


def _symmetric(matrix: Float) -> Float:
    """A matrix (k, k) without the rounding that makes it uneven."""
    return 0.5 * (matrix + matrix.T)


def larger(first: Float, second: Float) -> Float:
    """A covariance that is nowhere below ``first`` or ``second``, both (k, k), and as small as that allows."""
    root = np.linalg.cholesky(first)
    inverse_root = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse_root @ second @ inverse_root.T)
    wide = root @ vectors
    result: Float = (wide * np.maximum(values, 1.0)) @ wide.T
    return result


def _jackknife(
    columns: Float, residuals: Float, weights: Float, information: Float, block: int, offset: int
) -> Float | None:
    """Covariance (k, k) from how the parameters move when a block of pixels is left out, one block at a time.

    None where so few blocks hold the information that their scatter says little.
    """
    count = len(columns)
    scores, own = _block_scores(columns, weights, residuals, block, offset)
    leverage = np.einsum("bij,ji->b", own, np.linalg.inv(information))
    if float(leverage.sum()) ** 2 < _BLOCKS_PER_PARAMETER * count * float(np.vdot(leverage, leverage)):
        return None
    seen = leverage > 0.0
    moved = np.linalg.solve(information - _LEVERAGE_LIMIT * own[seen], scores[seen][..., None])[..., 0]
    moved = moved - moved.mean(axis=0)
    result: Float = moved.T @ moved
    return result


def _block_scores(columns: Float, weights: Float, residuals: Float, block: int, offset: int) -> tuple[Float, Float]:
    """Scores (b, k) and information (b, k, k) of square blocks of pixels, the first starting ``offset`` early."""
    scores, own = [], []
    height, width = weights.shape
    for top in range(-offset, height, block):
        for left in range(-offset, width, block):
            part = (slice(max(top, 0), top + block), slice(max(left, 0), left + block))
            weight = weights[part].ravel()
            design = columns[:, part[0], part[1]].reshape(len(columns), -1)
            weighted = design * weight
            scores.append(weighted @ residuals[part].ravel())
            own.append(weighted @ design.T)
    return np.array(scores), np.array(own)


def _blocks(images: Float, block: int, offset: int) -> Float:
    """Sums (k, rows, columns) of images (k, h, w) over square blocks."""
    count, height, width = images.shape
    padded = np.pad(images, [(0, 0), (offset, -(height + offset) % block), (offset, -(width + offset) % block)])
    shape = (count, padded.shape[1] // block, block, padded.shape[2] // block, block)
    result: Float = padded.reshape(shape).sum(axis=(2, 4))
    return result
