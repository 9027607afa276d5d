"""Statistics of a photometric fit whose model is not exact: weights and covariances from the residuals themselves.

A template differs from the image by more than noise: facets, sampling, albedo, the reflectance law. The differences
vary with edges and with light, and are correlated over the width of the point spread function and often farther.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask
from giantlike.core.statistics import excess, robust_sigma
from giantlike.core.values import Value
from giantlike.image_model.columns import Columns, Layout, Prior, Solution
from giantlike.image_model.field import MarkingModes

_REWEIGHTINGS = 3
"""Rounds of a first fit in which errors, weights and clipped values are updated; later fits start from their result."""
_FIRST_ERROR = 0.03
"""Model errors that the iteration starts from: pixels at edges, and as a share of the light. Only a start value."""
_VARIANCE_SAMPLES = 4_000
"""Values that sizes of errors are taken from, about: their relative error is then some sqrt(2 / 4000) = 2.2 %."""
_VARIANCE_STEPS = 25
"""Multiplicative updates of the sizes in each round; they settle over the rounds and iterations of the fit."""
_SIGNIFICANT = 2.0  # standard deviations of a sample autocorrelation, 1 / sqrt(n): a smaller one counts as noise
_LEAST_LEFT = 1e-3
"""Share of a correlated error that is left in the residuals, at least, against rounding of its sums over blocks."""
_INSIDE_PIXEL_PX = 0.3
"""Correlation lengths below this are none: exp(-d^2 / (4 b^2)) is then less than 0.07 between neighboring pixels."""
_FINE_LENGTH_PX = 4.0
"""Pixels to a correlation length that remain when scores are summed over blocks: the Gaussian is still well sampled."""
_SMOOTH_LENGTH_PX = 1.5  # as above, for scores that are smooth: of markings
_BLOCKS_PER_PARAMETER = 3.0
"""Effective blocks to a parameter that the jackknife needs; with fewer its own scatter exceeds the covariance."""
_MANY_BLOCKS = 150  # so many average the choice of their first corner; with fewer two grids are averaged
_LEVERAGE_LIMIT = 0.95
"""Share of its information that leaving out a block takes away: one that alone fixes a parameter leaves a little."""


@dataclass(frozen=True, slots=True, eq=False)
class VarianceModel(Value):
    """Variance of values: known noise, and kinds of error of unknown size.

    shapes: (m, n); variance of each kind of error over its unknown size; the first kind is independent from value to
        value.
    """

    noise: Float  # (n,); variance of the noise
    shapes: Float

    def total(self, sizes: Float) -> Float:
        """Variance (n,) for given sizes (m,) of the errors."""
        return np.asarray(self.noise + sizes @ self.shapes)


@dataclass(frozen=True, slots=True, eq=False)
class RobustFit(Value):
    """Parameters of a linear model, and the sizes of its errors by the residuals.

    solution: of the last step. Its data are what it explained, of a limit the value that stands for it, see
        :meth:`Measured.reweight`; no weight where a residual was clipped.
    noise, error: (h, w); variances: of the part that is independent from pixel to pixel, and of model errors that the
        point spread function spreads.
    """

    solution: Solution
    errors: Float  # (m,); sizes of the kinds of error
    noise: Float
    error: Float

    @property
    def parameters(self) -> Float:
        """Parameters (k,)."""
        return self.solution.values

    @property
    def kept(self) -> Mask:
        """Values (h, w) that count; limits far below the model count for nothing."""
        return self.solution.columns.weights > 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Measured(Value):
    """Values to explain, some of which are only a lower limit."""

    values: Float  # (n,)
    offered: Mask  # (n,); True where a value says something
    censored: Mask  # (n,); True where the true value is at least that
    variances: VarianceModel

    def certain(self) -> VarianceModel:
        """Variances of the values that are no limits."""
        known = self.offered & ~self.censored
        return (
            self.variances
            if known.all()
            else VarianceModel(self.variances.noise[known], self.variances.shapes[:, known])
        )

    def reweight(self, model: Float, variance: Float, clip_sigma: float) -> tuple[Float, Float]:
        """Values and weights (n,) of the next least-squares step, from a model (n,) nearby.

        A value is itself, with the weight of its variance, and none where it is clipped. A limit ``c`` below a model
        ``m`` has the logarithmic likelihood ``log Phi(z)``, ``z = (m - c) / sigma``; the step of Newton's method on it
        is that of a value ``m + sigma / (h + z)`` with weight ``h (h + z) / sigma^2``, with ``h = phi(z) / Phi(z)``.
        It is the limit itself where the model lies far below, and has no weight where it lies far above.
        """
        kept = self.offered & (np.abs(self.values - model) <= clip_sigma * np.sqrt(variance))
        weights = np.divide(kept, variance, out=np.zeros(kept.size), where=kept)
        if not self.censored.any():
            return self.values, weights
        values, limits = self.values.copy(), self.censored
        sigma = np.sqrt(variance[limits])
        z = (model[limits] - values[limits]) / sigma
        hazard = _hazard(z)
        values[limits] = model[limits] + sigma / (hazard + z)
        weights[limits] = np.where(z >= -clip_sigma, hazard * (hazard + z) / variance[limits], 0.0)
        return values, weights


def _hazard(z: Float) -> Float:
    """Density of the standard normal distribution over its distribution function (n,)."""
    from scipy.special import log_ndtr

    return np.asarray(np.exp(-0.5 * z**2 - 0.5 * math.log(2.0 * math.pi) - log_ndtr(z)))


def robust_fit(
    layout: Layout,
    matrix: Float,
    measured: Measured,
    prior: Prior,
    *,
    clip_sigma: float,
    start: Float | None = None,
    markings: MarkingModes | None = None,
    approach: bool = False,
) -> RobustFit | None:
    """Weighted least squares, with weights that allow for errors of the model.

    ``matrix`` (k, h, w); ``start`` (m,); returns None when the values do not determine the parameters.
    """
    shape, variances, certain = matrix.shape[1:], measured.variances, measured.offered & ~measured.censored
    noise, shapes = variances.noise, variances.shapes
    known = None if markings is None or not approach else markings.first_variances

    def solve(values: Float, weights: Float, markings: MarkingModes | None) -> Solution | None:
        data = values.reshape(shape), weights.reshape(shape)
        return Columns(layout, matrix, prior, *data, markings, None if markings is None else known).solve()

    first = np.zeros(len(shapes)) if start is None else start
    total = variances.total(first)
    weights = np.divide(certain, total, out=np.zeros(certain.size), where=certain & (total > 0.0))
    solution = solve(measured.values, weights, markings if approach else None)
    if solution is None:
        return None
    sample = measured.certain()
    errors = _first_errors(solution.residuals.ravel()[certain], sample) if start is None else start
    for _ in range(_REWEIGHTINGS if start is None else 1):
        if not approach:
            errors = model_errors(solution.residuals.ravel()[certain], sample, errors, clip_sigma=clip_sigma)
        values, weights = measured.reweight(solution.model.ravel(), variances.total(errors), clip_sigma)
        solution = solve(values, weights, markings)
        if solution is None:
            return None
    noise, error = noise + errors[0] * shapes[0], errors[1:] @ shapes[1:]
    return RobustFit(solution, errors, noise.reshape(shape), error.reshape(shape))


def model_errors(residuals: Float, variances: VarianceModel, start: Float, *, clip_sigma: float) -> Float:
    """Sizes of several kinds of model error under which Gaussian residuals are most likely.

    ``residuals`` (n,); ``start`` (m,), positive; returns (m,), not negative (from a sample where the values are many).
    """
    thin = slice(None, None, max(residuals.size // _VARIANCE_SAMPLES, 1))
    shapes = np.ascontiguousarray(variances.shapes[:, thin])
    return _likeliest(residuals[thin] ** 2, variances.noise[thin].copy(), shapes, np.array(start), clip_sigma**2)


@compiled
def _likeliest(squares: Float, noise: Float, shapes: Float, start: Float, most: float) -> Float:
    """Iterations of :func:`model_errors` by squared residuals (n,)."""
    result, inverse, scores = start, np.empty_like(noise), np.empty_like(noise)
    for _ in range(_VARIANCE_STEPS):
        total = result @ shapes
        for k in range(len(noise)):
            inverse[k] = 1.0 / (noise[k] + total[k])
            ratio = squares[k] * inverse[k]
            scores[k] = (ratio if ratio < most else most) * inverse[k]
        result = result * (shapes @ scores) / np.maximum(shapes @ inverse, 1e-300)
    return result


def _first_errors(residuals: Float, variances: VarianceModel) -> Float:
    """Rough sizes (m,) of the model errors to start from: some of each kind."""
    noise, count = variances.noise, len(variances.shapes)
    excess = robust_sigma(residuals, 0.0) ** 2 - float(np.median(noise))
    return np.array([max(excess, 1e-3 * float(noise.mean())), *[_FIRST_ERROR**2] * (count - 1)])


@dataclass(frozen=True, eq=False)
class LinearFit(Solution):
    """Images fitted to pixels (h, w), with the covariances by noise and errors of the model."""

    def sigmas(self, effect: str) -> Float:
        """Standard deviations (j,) of the parameters of an effect, by the weights of the pixels."""
        return np.sqrt(np.diag(np.linalg.inv(self.columns.information))[self.columns.layout.span(effect)])

    def noise_covariance(self, noise: Float) -> Float:
        """Covariance (k, k) of the parameters from independent noise of variance (h, w), markings and the prior."""
        columns = self.columns
        rows = columns.rows * (columns.weights * np.sqrt(noise)).ravel()
        return columns.propagate(rows @ rows.T + np.diag(columns.prior.information) + columns.field_scatter)

    def error_covariance(self, error: Float, *, length_px: float) -> Float:
        """Covariance of the parameters from an error of the model of known size.

        ``error`` (h, w); ``length_px``: errors at a distance d have the correlation ``exp(-d^2 / (2 length_px^2))``;
        returns (k, k).
        """
        columns = self.columns
        scores = columns.projected * (columns.weights * error)
        return columns.propagate(_compute_covariance(scores, length_px / math.sqrt(2.0)))

    def full_covariance(self, error: Float, *, of_noise: Float, blur_px: float, block_px: int) -> Float:
        """Covariance of the parameters from noise and from correlated errors of the model.

        ``error`` (h, w); ``of_noise`` (k, k); returns (k, k).

        The sandwich ``H^-1 (N + E + P) H^-1`` has the scores of the noise, of the model error, correlated between
        pixels at distance d like ``exp(-d^2 / (4 b^2))``, and of the prior; b is ``blur_px``, or more where the
        residuals are correlated over longer distances. E is scaled up for the part of the model error that parameters
        and field absorb: with the residual operator R it is ``tr W E`` over ``tr W R E``. Where a delete-one jackknife
        over blocks of pixels finds more, in any direction of parameter space, its variance is taken: it includes any
        correlation over the size of a block.
        """
        columns, weights = self.columns, self.columns.weights
        length_px = _correlation_length_px(self.residuals, weights, error, blur_px, block_px)
        correlated, absorbed = self.absorb(error, length_px)
        whole = float(np.vdot(weights, error))
        scale = whole / max(whole - absorbed, _LEAST_LEFT * whole, 1e-300)
        sandwich = of_noise + columns.propagate(scale * correlated)
        found = self.jackknife(block_px)
        if found is None:
            return sandwich
        of_prior = columns.propagate(np.diag(columns.prior.information))
        return sandwich + excess(sandwich, found + of_prior)

    def absorb(self, error: Float, length_px: float) -> tuple[Float, float]:
        """Return the covariance of the scores by a correlated error of the model, and the squares that they absorb.

        ``error`` (h, w): variance; correlated like ``exp(-d^2 / (4 length_px^2))``; returns (k, k) and the mean of the
        weighted products of the error and its image in parameters and field.
        """
        columns, sigma = self.columns, self.columns.weights * np.sqrt(error)
        correlated = _compute_covariance(columns.projected * sigma, length_px)
        absorbed = float(np.vdot(np.linalg.inv(columns.information), correlated))
        if columns.eliminated is not None and columns.markings is not None:
            factor = max(int(length_px / _SMOOTH_LENGTH_PX), 1)
            scores = _block_sums(columns.markings.image(np.eye(columns.markings.count)) * sigma, factor)
            absorbed += columns.eliminated.find_absorbed_squares(_compute_covariance(scores, length_px / factor))
        return correlated, absorbed

    def jackknife(self, block_px: int) -> Float | None:
        """Covariance of the parameters from what changes when one block of pixels at a time is left out.

        Returns (k, k), None where so few blocks hold the information that their scatter says little.
        """
        offsets = (0, block_px // 2) if self.residuals.size < _MANY_BLOCKS * block_px**2 else (0,)
        found = [self._jackknife(block_px, offset) for offset in offsets]
        known = [covariance for covariance in found if covariance is not None]
        return np.asarray(np.mean(known, axis=0)) if known else None

    def _jackknife(self, block: int, offset: int) -> Float | None:
        """The same (k, k) with one grid of blocks."""
        information, count = self.columns.information, len(self.columns.matrix)
        scores, own = self._block_scores(block, offset)
        leverage = np.einsum("bij,ji->b", own, np.linalg.inv(information))
        if float(leverage.sum()) ** 2 < _BLOCKS_PER_PARAMETER * count * float(np.vdot(leverage, leverage)):
            return None
        seen = leverage > 0.0
        moved = np.linalg.solve(information - _LEVERAGE_LIMIT * own[seen], scores[seen][..., None])[..., 0]
        moved = moved - moved.mean(axis=0)
        return np.asarray(moved.T @ moved)

    def _block_scores(self, block: int, offset: int) -> tuple[Float, Float]:
        """Scores (b, k) and information (b, k, k) of square blocks of pixels, the first starting ``offset`` early."""
        scores, own = list[Float](), list[Float]()
        scaled, (count, height, width) = self.residuals * np.sqrt(self.columns.weights), self.columns.matrix.shape
        images = self.columns.projected * np.sqrt(self.columns.weights)
        for top in range(-offset, height, block):
            for left in range(-offset, width, block):
                part = (slice(max(top, 0), top + block), slice(max(left, 0), left + block))
                rows = images[:, part[0], part[1]].reshape(count, -1)
                scores.append(rows @ scaled[part].ravel())
                own.append(rows @ rows.T)  # of an array with itself: half of the products
        return np.array(scores), np.array(own)


def _correlation_length_px(residuals: Float, weights: Float, error: Float, least_px: float, most_px: float) -> float:
    """Length b, px, of the correlation ``exp(-d^2 / (4 b^2))`` of the model error, from the sample autocorrelation.

    The sum of that kernel over d = 1, 2, ... is ``sqrt(pi) b - 1/2``; it is taken up to the first lag whose correlation
    is not significant.
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


def _compute_covariance(scores: Float, length_px: float) -> Float:
    """Covariance (k, k) of the sum of scores (k, h, w), correlated as in :meth:`LinearFit.full_covariance`.

    For long correlation lengths scores are first summed over small blocks.
    """
    if length_px < _INSIDE_PIXEL_PX:
        flat = scores.reshape(len(scores), -1)
        return np.asarray(flat @ flat.T)
    factor = max(int(length_px / _FINE_LENGTH_PX), 1)
    images = _block_sums(scores, factor) if factor > 1 else scores
    sigma = math.sqrt(2.0) * length_px / factor
    side = 2 * math.ceil(4.0 * sigma) + 1
    blurred = np.stack([cv2.GaussianBlur(one, (side, side), sigma, borderType=cv2.BORDER_CONSTANT) for one in images])
    flat = images.reshape(len(images), -1)
    covariance: Float = 2.0 * math.pi * sigma**2 * (flat @ blurred.reshape(len(images), -1).T)
    return 0.5 * (covariance + covariance.T)


def _block_sums(images: Float, block: int) -> Float:
    """Sums (k, rows, columns) of images (k, h, w) over square blocks."""
    count, height, width = images.shape
    padded = np.pad(images, [(0, 0), (0, -height % block), (0, -width % block)])
    shape = (count, padded.shape[1] // block, block, padded.shape[2] // block, block)
    return np.asarray(padded.reshape(shape).sum(axis=(2, 4)))
