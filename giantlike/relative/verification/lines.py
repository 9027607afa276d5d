"""Rows or columns that were recorded far from their place: a damaged image, put right."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, Scalar
from giantlike.ray_tracing import Template
from giantlike.relative.verification.cells import Cells
from giantlike.relative.verification.light_side import independent_parts

_NEAREST, _FARTHEST = 0.1, 2.0
"""Range of the shift, radii: nearer ones are linear, and farther ones are at another place altogether."""
_INSIDE = 0.9  # of the squares of the light that stay in the region: what leaves it explains dark rows, as in a gap
_REACHED = 0.05  # light of a row relative to the brightest, below which a line there divides nothing


def restore_lines(cells: Cells, own: Template, albedo: float, axis: int) -> tuple[float, float, Cells] | None:
    """Move all rows (axis 0), or columns (1), on one side of a line back to where a body without markings matches best.

    Returns the logarithm of the odds, averaged over lines across the body and shifts, that of their number, and the
    cells with the best of these rows moved back; None where the image matches as well as it is.
    """
    parts = independent_parts(cells, own)
    light, values, good = cells.place(own.brightness, own), cells.crop(cells.values), cells.crop(cells.good)
    if not (parts > 0.0 and light.max() > 0.0 and np.ptp(values[good]) > 0.0):
        return None
    if axis == 1:
        light, values, good = light.T, values.T, good.T
    values = np.where(good, values - values[good].mean(), 0.0)
    nearest, farthest = max(math.ceil(_NEAREST * cells.radius), 1), int(_FARTHEST * cells.radius)
    steps = np.concatenate([np.arange(-farthest, 1 - nearest), np.arange(nearest, farthest + 1)])
    sums, count = _line_sums(light, values, good), int(good.sum())
    here, squares = sums[..., 0], float(sums[2, :, 0].sum())
    before = np.cumsum(sums[..., steps] - here[..., None], axis=1)
    shares = _fit_squares(
        here.sum(axis=1)[:, None, None, None] + np.stack([before, before[:, -1:] - before], 1), count, squares
    )
    own_share, total = float(_fit_squares(here.sum(axis=1), count, squares)), float(np.sum(values**2))
    tries = 2 * int(np.count_nonzero(here[0] > _REACHED * float(here[0].max()))) * len(steps)
    if not tries:
        return None
    left, left_there = (np.maximum(1.0 - share / total, albedo**2) for share in (own_share, shares))
    log_odds = float(np.logaddexp.reduce(0.5 * parts * np.log(left / left_there), axis=None)) - math.log(tries)
    if log_odds <= 0.0:
        return None
    side, line, which = np.unravel_index(int(np.argmax(shares)), shares.shape)
    moved = np.arange(cells.box.width) > cells.room + line
    return log_odds, math.log(tries), _move_back(cells, moved if side else ~moved, int(steps[which]), axis)


def _line_sums(light: Float, values: Float, good: Mask) -> Float:
    """Sums (3, n, 2 n) over each row of light, its products with the values, and its squares, by shift of the light."""
    from scipy.fft import irfft, rfft

    length = 2 * light.shape[1]
    of_light, of_squares = (np.conj(rfft(each, length)) for each in (light, light**2))
    seen, weighed = rfft(good.astype(np.float64), length), rfft(values, length)
    return np.asarray(irfft(np.stack([seen * of_light, weighed * of_light, seen * of_squares]), length))


def _fit_squares(sums: Float, count: int, light: float) -> Float:
    """Squares that light explains beside a level, where its gain is positive and it stays in the region.

    Values have a mean of zero; ``light``: squares of the light where it is.
    """
    total, score, squares = sums
    size = squares - total**2 / count
    found = np.where((score > 0.0) & (squares >= _INSIDE * light), score**2 / np.maximum(size, 1e-300), 0.0)
    return np.asarray(found)


def _shift_lines(image: NDArray[Scalar], step: int) -> NDArray[Scalar]:
    """Image with rows moved along themselves by whole cells, zero where they come from outside."""
    moved = np.roll(image, step, axis=1)
    moved[:, : max(step, 0)] = 0
    moved[:, moved.shape[1] + min(step, 0) :] = 0
    return moved


def _move_back(cells: Cells, moved: Mask, step: int, axis: int) -> Cells:
    """Cells with the rows ``moved`` (n,) shifted by minus a step; what comes from outside is bad."""

    def restore(image: NDArray[Scalar]) -> NDArray[Scalar]:
        lines = (image if axis == 0 else image.T).copy()
        lines[moved] = _shift_lines(lines, -step)[moved]
        return lines if axis == 0 else lines.T

    return replace(
        cells,
        values=restore(cells.values),
        variance=np.where(restore(cells.good), restore(cells.variance), cells.variance),
        good=restore(cells.good),
        fresh=restore(cells.fresh),
    )
