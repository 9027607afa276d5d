"""Named alternatives to a fix, each with its odds: a second image of the body, rows or columns shifted from one on.

An alternative is an image that the fit of a body to cells left out. Its odds are the ratio of two Student-t likelihoods
of the affected cells, with it and without, at an unknown scale of the errors. Residuals of real images are not white
noise: markings, clouds and laws are correlated over a good part of a radius. The likelihood is therefore raised to the
power of the number of such parts divided by the number of cells (a tempered, or power, likelihood). The scale has a
prior of as many parts at the formal errors, so that n parts with squares Q have a likelihood of ``(n + Q)^-n``. The
amplitude of an alternative is integrated over its prior, and its position over all possible positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.image_model.columns import Block, Prior, Solution

_LIGHT_SIGMA = 0.5
"""A priori standard deviation of a second image relative to the first: exposures of similar length, and ghosts."""
_SHIFT_SIGMA = 0.1  # A priori standard deviation of a shift of rows, radii
_WAVES, _OUTLINE_SIGMA = (3, 4, 5, 6), 0.1
"""Wave numbers along the outline of another body, beyond those of a strain, and a priori standard deviation of their
amplitudes, radii: a guess of the difference of two outlines."""
_APART = 0.1  # minimum distance of a second image, radii: nearer ones are a blur or a motion of the first
_CANDIDATES = 6
"""Number of positions of a second image whose odds are computed exactly; the odds of all others are set to zero."""
_REACHED = 0.05  # fraction of its largest change below which an alternative does not affect a cell


@dataclass(frozen=True, slots=True, kw_only=True)
class CellScores:
    """Scores of alternatives in cells."""

    solution: Solution  # the fit of the body to the cells (n, n), around its position
    temper: float  # ratio of independent parts of a body to cells

    @property
    def log_evidence(self) -> float:
        """Logarithm of the likelihood of the cells under the fit, up to a constant."""
        parts = self.temper * float(np.count_nonzero(self.solution.columns.weights))
        return -parts * math.log(1.0 + self.temper * self.solution.penalized_squares / max(parts, 1e-300))

    def joint_log_odds(self, images: Float, sigma: float) -> float:
        """Logarithm of the odds of images (a, n, n) in the data in addition to the fit, all of them together."""
        prior = Prior.of_sigmas([sigma] * len(images))
        score = self.solution.score_omitted(Block(effect="alternative", cause=Cause.NOISE, matrix=images, prior=prior))
        reached = np.any(np.abs(images) > _REACHED * np.abs(images).max(), axis=0)
        reached &= self.solution.columns.weights > 0.0
        parts = max(self.temper * float(np.count_nonzero(reached)), 1e-300)
        squares = (self.solution.columns.weights * self.solution.residuals**2)[
            reached
        ].sum() + self.solution.mode_squares
        before = parts + self.temper * float(squares)
        after = max(before - self.temper * score.chi_square, parts)
        scaled = np.eye(len(images)) + self.temper * sigma**2 * score.information * 2.0 * parts / before
        return parts * math.log(before / after) - 0.5 * float(np.linalg.slogdet(scaled)[1])

    def log_odds(self, images: Float, sigma: float) -> Float:
        """Logarithms (a,) of the odds of images (a, n, n) in the data in addition to the fit, each alone.

        ``sigma`` is the a priori standard deviation of their amplitudes, which may be negative.
        """
        prior = Prior.of_sigmas([sigma] * len(images))
        score = self.solution.score_omitted(Block(effect="alternative", cause=Cause.NOISE, matrix=images, prior=prior))
        weights = self.solution.columns.weights
        information = np.maximum(np.diag(score.information), 0.0)
        explained = score.gradient**2 / (information + sigma**-2.0)
        size = np.abs(images)
        reached = (size > _REACHED * size.max(axis=(1, 2), keepdims=True)) & (weights > 0.0)
        parts = np.maximum(self.temper * np.count_nonzero(reached, axis=(1, 2)), 1e-300)
        squares = weights * self.solution.residuals**2
        left = np.tensordot(reached, squares, 2) + self.solution.mode_squares
        before = parts + self.temper * left
        after = np.maximum(before - self.temper * explained, parts)
        scale = before / (2.0 * parts)
        return np.asarray(parts * np.log(before / after) - 0.5 * np.log1p(self.temper * information * sigma**2 / scale))


def other_outline(scores: CellScores, growth: Float, center: Float) -> float:
    """Logarithm of the odds of the outline of another body, by waves along it beyond a strain.

    ``growth`` (n, n); ``center`` in cells, column and row of its center.
    """
    return scores.joint_log_odds(growth * waves_along(growth.shape, center, _WAVES), _OUTLINE_SIGMA)


def waves_along(shape: tuple[int, ...], center: Float, orders: Iterable[int]) -> Float:
    """Cosines and sines (2 k, n, n) of multiples of the angle about a center, column and row."""
    rows, columns = np.indices(shape)
    angle = np.arctan2(rows - center[1], columns - center[0])
    return np.stack([wave(order * angle) for order in orders for wave in (np.cos, np.sin)])


def second_light(scores: CellScores, light: Float, radius: float, blur: float) -> float:
    """Logarithm of the odds of a second image of the body: another exposure, a ghost or a second body.

    ``light`` (n, n); ``radius``, ``blur`` in cells.
    """
    from scipy.fft import irfft2, rfft2

    solution, size = scores.solution, len(light)
    weights = solution.columns.weights
    shape = (2 * size, 2 * size)
    spectra = np.conj(rfft2(np.stack([light, light**2]), shape))
    score, own = irfft2(rfft2(np.stack([weights * solution.residuals, weights]), shape) * spectra, shape)
    steps = np.fft.fftfreq(2 * size, 1.0 / (2 * size)).round().astype(int)
    rows, columns = np.meshgrid(steps, steps, indexing="ij")
    distance = np.hypot(rows, columns)
    allowed = (distance >= max(_APART * radius, 3.0 * blur, 1.5)) & (np.abs(rows) < size) & (np.abs(columns) < size)
    allowed &= own > 0.1 * float(own[0, 0])
    gain = np.where(allowed & (score > 0.0), score**2 / np.maximum(own, 1e-300), 0.0)
    images = list[Float]()
    for _ in range(_CANDIDATES):
        row, column = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if not gain[row, column] > 0.0:
            break
        at = rows[row, column], columns[row, column]
        images.append(_shift(light, *at))
        gain[np.hypot(rows - at[0], columns - at[1]) < 2.0] = 0.0
    return _average_odds(scores, images, _LIGHT_SIGMA, np.count_nonzero(allowed) / (math.pi * 2.0**2))


def shifted_lines(scores: CellScores, motion: Float, axis: int) -> float:
    """Logarithm of the odds that all rows (axis 0), or columns (1), from one on are shifted along themselves.

    ``motion`` (n, n).
    """
    size = len(motion)
    told = np.flatnonzero(np.abs(motion).sum(axis=1 - axis) > _REACHED * float(np.abs(motion).sum(axis=1 - axis).max()))
    if len(told) < 3:
        return -math.inf
    beyond = np.arange(size) >= np.arange(told[0] + 1, told[-1] + 1)[:, None]
    images = motion * (beyond[:, :, None] if axis == 0 else beyond[:, None])
    return _average_odds(scores, images, _SHIFT_SIGMA, len(images))


def _average_odds(scores: CellScores, images: Sequence[Float] | Float, sigma: float, count: float) -> float:
    """Logarithm of the mean odds over ``count`` images, of which those not given have odds of zero."""
    if not len(images):
        return -math.inf
    odds = scores.log_odds(np.asarray(images), sigma)
    most = float(odds.max())
    return most + math.log(float(np.sum(np.exp(odds - most))) / max(count, len(odds)))


def _shift(light: Float, rows: int, columns: int) -> Float:
    """Light (n, n) moved by whole cells, dark where it comes from outside."""
    moved, size = np.zeros_like(light), len(light)
    to = [slice(max(step, 0), min(size + step, size)) for step in (rows, columns)]
    come = [slice(max(-step, 0), min(size - step, size)) for step in (rows, columns)]
    moved[to[0], to[1]] = light[come[0], come[1]]
    return moved
