"""Small systems of equations by compiled loops beside numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.elimination import solve_normal, solve_symmetric

SOLVED = 1e-9  # over the scale of each unknown: rounding and a ridge of 1e-12


@pytest.mark.parametrize("unknowns", [1, 3, 4, 9])
def test_normal_equations_are_solved_whatever_the_units_of_their_unknowns(unknowns: int) -> None:
    random = np.random.default_rng(11)
    units = np.logspace(0, 6, unknowns)
    columns, data = random.normal(size=(40, unknowns)) * units, random.normal(size=(40, 2))
    normal, right = columns.T @ columns, columns.T @ data
    solve_normal(np.triu(normal), right)
    expected = np.linalg.lstsq(columns, data, rcond=None)[0]
    assert_allclose(right * units[:, None], expected * units[:, None], rtol=0, atol=SOLVED)


def test_an_unknown_that_nothing_depends_on_becomes_nothing() -> None:
    right = np.array([[2.0], [0.0]])
    solve_normal(np.diag([4.0, 0.0]), right)
    assert_allclose(right, [[0.5], [0.0]], rtol=0, atol=SOLVED)


def test_symmetric_equations_are_solved_from_what_stands_above_the_diagonal() -> None:
    random = np.random.default_rng(12)
    root = random.normal(size=(6, 6))
    matrix, right = root @ root.T + np.eye(6), random.normal(size=(6, 3))
    found = right.copy()
    solve_symmetric(np.triu(matrix), found)
    assert_allclose(found, np.linalg.solve(matrix, right), rtol=0, atol=SOLVED)
