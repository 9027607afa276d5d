"""Compiled sums over the cells around a body beside closed forms and least squares of numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.relative.verification.cell_loops import design_of, least_unexplained

ROUNDING = 1e-9
STEPS = 0.03  # of the largest: derivatives by steps of a cell, of a bell seven cells wide
SIZE, WIDTH = 61, 7.0
X, Y = 31.3, 28.8


def _bell() -> tuple[Float, Float, Float]:
    """A bell (n, n) off the middle, and the places of the cells from its top, in its widths."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    x, y = (columns - X) / WIDTH, (rows - Y) / WIDTH
    return np.exp(-0.5 * (x**2 + y**2)), x, y


def test_columns_of_a_design_are_the_derivatives_of_a_bell() -> None:
    light, x, y = _bell()
    radius = 2.0 * WIDTH
    *blocks, slope = design_of(light, np.stack([light**2]), 0.1 * light, X, Y, radius)
    columns = np.concatenate(blocks)
    moved = [2.0 * x * light, 2.0 * y * light]
    strained = [moved[0] * x + moved[1] * y, moved[0] * y, moved[1] * x, moved[0] * x - moved[1] * y]
    strained = [0.5 * one for one in strained]
    blurred = [0.5 * (x**2 - 1.0) * light, x * y * light, 0.5 * (y**2 - 1.0) * light]
    stray = [light.mean(axis=0) + np.zeros_like(light), light.mean(axis=1)[:, None] + np.zeros_like(light), 0.1 * light]
    expected = [
        light**2 * light.sum() / (light**2).sum() - light,
        *(np.ones_like(light), 0.5 * x, 0.5 * y),
        *stray,
        *moved,
        *strained,
        *(one / WIDTH**2 for one in blurred),
    ]
    assert len(columns) == len(expected)
    for found, right in zip(columns, expected, strict=True):
        assert_allclose(found, right, rtol=0, atol=STEPS * np.abs(right).max())
    assert_allclose(slope, np.hypot(x, y) * light / WIDTH, rtol=0, atol=STEPS / WIDTH)


def _left(values: Float, good: np.ndarray, light: Float, least: float = 1.0) -> float:
    """Least share of the variance that a light leaves at any shift, by least squares of each."""
    shifts = len(values) - len(light) + 1
    for down in range(shifts):
        for across in range(shifts):
            window = slice(down, down + len(light)), slice(across, across + len(light))
            seen = good[window]
            terms, data = np.stack([light[seen], np.ones(seen.sum())], axis=-1), values[window][seen]
            solution, *_ = np.linalg.lstsq(terms, data)
            if solution[0] > 0.0:
                least = min(least, float(np.var(data - terms @ solution) / np.var(data)))
    return least


@pytest.mark.parametrize("masked", [0, 40])
def test_what_bodies_leave_at_their_best_shift_is_what_least_squares_leave(masked: int) -> None:
    random = np.random.default_rng(5)
    rows, columns = np.mgrid[:15, :15] - 7.0
    disk = np.maximum(1.0 - (rows**2 + columns**2) / 25.0, 0.0)
    lights = np.stack([disk * (7.0 + columns), disk * (7.0 - columns), disk * (7.0 + rows)])
    values = random.normal(size=(23, 23)) + 100.0
    values[2:17, 6:21] += lights[0]
    good = np.ones(values.shape, bool)
    good.ravel()[random.choice(good.size, masked, replace=False)] = False
    expected = [_left(values, good, light) for light in lights]
    assert expected[0] < 0.9 * min(expected[1:])
    assert_allclose(least_unexplained(values, good, lights), expected, rtol=0, atol=ROUNDING)
