"""Least squares and motions of many short lines at once, each against the same of one line by numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.processing.limb.batched import moved, solution_operators, solved
from tests.tolerances import FLOAT64_SUM

LINES, PLACES = 7, 12


def problem(unknowns: int) -> tuple[Float, Float, Float]:
    """Columns, data and weights; some places of some lines count nothing."""
    random = np.random.default_rng(11)
    columns = random.normal(size=(LINES, PLACES, unknowns)) * np.logspace(0, 4, unknowns)
    weights = random.uniform(0.1, 3.0, (LINES, PLACES)) * (random.uniform(size=(LINES, PLACES)) > 0.2)
    return columns, random.normal(size=(LINES, PLACES)), weights


def of_one(columns: Float, data: Float, weights: Float) -> Float:
    root = np.sqrt(weights)
    return np.asarray(np.linalg.lstsq(columns * root[:, None], data * root, rcond=None)[0], dtype=np.float64)


@pytest.mark.parametrize("unknowns", [1, 3, 4])
def test_each_line_gets_the_weighted_least_squares_solution_of_its_own(unknowns: int) -> None:
    columns, data, weights = problem(unknowns)
    expected = np.array([of_one(*line) for line in zip(columns, data, weights, strict=True)])
    scale = np.abs(columns).max(axis=(0, 1))
    assert_allclose(solved(columns, data, weights) * scale, expected * scale, rtol=0, atol=1e-9)  # a ridge of 1e-12
    by_operators = (solution_operators(columns, weights) @ data[..., None])[..., 0]
    assert_allclose(by_operators * scale, expected * scale, rtol=0, atol=1e-9)


def test_stiffness_is_a_measurement_of_the_last_unknown_at_nothing() -> None:
    columns, data, weights = problem(4)
    stiffness = np.logspace(3, 9, LINES)
    found = (solution_operators(columns, weights, stiffness) @ data[..., None])[..., 0]
    scale = np.abs(columns).max(axis=(0, 1))
    for line in range(LINES):
        held = np.vstack([columns[line], np.eye(4)[3]])
        expected = of_one(held, np.append(data[line], 0.0), np.append(weights[line], stiffness[line]))
        assert_allclose(found[line] * scale, expected * scale, rtol=0, atol=1e-9)


@pytest.mark.parametrize("trailing", [(), (1,), (5,)])
def test_cubics_are_moved_exactly_and_ends_go_on(trailing: tuple[int, ...]) -> None:
    random = np.random.default_rng(12)
    powers, steps = random.normal(size=(LINES, 4, *trailing)), np.linspace(-1.9, 1.9, LINES)
    places: Float = np.arange(PLACES, dtype=np.float64) - 0.5 * PLACES

    def cubic(line: int, at: Float) -> Float:
        return np.tensordot(at[:, None] ** np.arange(4), powers[line], axes=1)

    values = np.array([cubic(line, places) for line in range(LINES)])
    inner = slice(3, PLACES - 3)
    expected = np.array([cubic(line, places[inner] - step) for line, step in enumerate(steps)])
    assert_allclose(moved(values, steps, inner), expected, rtol=0, atol=1e3 * FLOAT64_SUM)
    assert_allclose(moved(values, steps)[:, inner], expected, rtol=0, atol=1e3 * FLOAT64_SUM)
    by_much = moved(values, np.full(LINES, 2.0 * PLACES))
    assert_allclose(by_much, np.broadcast_to(values[:, :1], by_much.shape), rtol=0, atol=0)


def test_lines_of_nothing_can_be_moved() -> None:
    assert moved(np.zeros((LINES, PLACES, 0)), np.zeros(LINES), slice(2, 5)).shape == (LINES, 3, 0)
