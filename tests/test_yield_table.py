"""The score of ``benchmarks/yield.py``: what counts as correct, silent and informative."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
SEARCH_PX, SEARCH_RANGE = 40.0, 0.03


@pytest.fixture(scope="module")
def table() -> Iterator[ModuleType]:
    path = list(sys.path)
    sys.path.insert(0, str(FOLDER))
    spec = importlib.util.spec_from_file_location("yield_table", FOLDER / "yield.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["yield_table"] = module
    spec.loader.exec_module(module)
    yield module
    sys.path[:] = path
    del sys.modules["yield_table"]


def row(**changes: Any) -> dict[str, Any]:
    """A fix of a center 0.3 px off with a sigma of 0.2 px; the truth is good to 0.1 px."""
    return {
        "set": "real",
        "frame": "a",
        "variant": "base",
        "estimator": "auto",
        "status": "ok",
        "suspect": [],
        "present": True,
        "radius_px": 100.0,
        "cpu_s": 0.0,
        "center_px": [50.3, 60.0],
        "covariance": [[0.04, 0.0], [0.0, 0.04]],
        "truth": {"center_px": [50.0, 60.0], "range_km": 1e4, "covariance": np.diag([0.01, 0.01, 1e-6]).tolist()},
        "prediction": {"center_px": [57.0, 55.0], "range_km": 1.01e4, "covariance": None},
        "search": [SEARCH_PX, SEARCH_RANGE],
        "answerable": ["auto"],
        **changes,
    }


def score(table: ModuleType, **changes: Any) -> Any:
    (found,) = table.scored([row(**changes)], {})
    return found


def test_errors_are_compared_with_the_uncertainty_of_fix_and_truth_together(table: ModuleType) -> None:
    assert score(table).center_sigmas == pytest.approx(0.3 / math.sqrt(0.05))
    assert score(table).correct
    assert not score(table, center_px=[50.7, 60.0]).correct


def test_a_range_beyond_three_sigma_makes_a_fix_incorrect(table: ModuleType) -> None:
    covariance = np.diag([0.04, 0.04, 1e-6]).tolist()
    near, far = (score(table, covariance=covariance, range_km=1e4 * (1 + off)) for off in (0.004, 0.005))
    assert near.correct
    assert not far.correct
    assert not far.wrong  # 3.5 sigma


def test_silent_errors_are_beyond_five_sigma_and_large_enough_to_matter(table: ModuleType) -> None:
    tight = [[1e-4, 0.0], [0.0, 1e-4]]
    exact = {"center_px": [50.0, 60.0], "range_km": 1e4, "covariance": np.zeros((3, 3)).tolist()}
    assert not score(table, covariance=tight, truth=exact, center_px=[50.4, 60.0]).wrong
    assert score(table, covariance=tight, truth=exact, center_px=[50.6, 60.0]).wrong


def test_every_fix_of_a_body_that_is_not_there_is_wrong(table: ModuleType) -> None:
    found = score(table, present=False, answerable=[])
    assert found.wrong
    assert table.summary([found])["negatives_ok"] == 1


def test_information_is_that_of_closed_form_densities(table: ModuleType) -> None:
    fix = -0.09 / (2 * 0.05) - math.log(2 * math.pi * 0.05)
    assert score(table).bits == pytest.approx((fix + 2 * math.log(2 * SEARCH_PX)) / math.log(2), abs=1e-9)


def test_a_declared_prediction_replaces_the_search(table: ModuleType) -> None:
    declared = {"center_px": [50.0, 60.0], "range_km": 1e4, "covariance": np.diag([0.04, 0.04, 1.0]).tolist()}
    assert score(table, prediction=declared, center_px=[50.0, 60.0]).bits == pytest.approx(0.0, abs=1e-9)


def test_refused_fixes_inform_of_nothing_and_wrong_ones_cost_at_most_500_bits(table: ModuleType) -> None:
    assert score(table, status="suspect", suspect=["blurred"]).bits == 0.0
    assert score(table, center_px=[90.0, 60.0]).bits == -500.0


def test_failures_and_exceptions_count_in_the_yield(table: ModuleType) -> None:
    rows = [
        row(),
        row(frame="b", status="failed", reason="no_limb"),
        row(frame="c", status="raised", reason="ValueError"),
        row(frame="d", status="suspect", suspect=["blurred"]),
    ]
    found = table.summary(table.scored(rows, {}))
    assert found["yield"] == 0.25
    assert (found["correct_suspect"], found["failed"], found["raised"]) == (1, 1, 1)


def test_the_list_says_what_is_demanded_of_real_frames(table: ModuleType) -> None:
    listed = table.read_list()
    (found,) = table.scored([row(frame="Europa 4600R", estimator="moment", answerable=None)], listed)
    assert not found.answerable
    assert "auto" in listed["real", "Europa 4600R", "base"]


def test_the_lens_of_goes_inverts_and_differentiates(table: ModuleType) -> None:
    lens = table.images.FixedGrid()
    points = np.array([[300.0, -200.0, 42000.0], [-5000.0, 3500.0, 42000.0]])
    pixels = lens.project(points)
    np.testing.assert_allclose(
        lens.unproject(pixels), points / np.linalg.norm(points, axis=1, keepdims=True), rtol=0, atol=1e-12
    )
    for axis in range(3):
        step = np.eye(3)[axis]
        numeric = (lens.project(points + step) - lens.project(points - step)) / 2.0
        np.testing.assert_allclose(lens.project_jacobian(points)[..., axis], numeric, rtol=0, atol=1e-8)
    for axis in range(2):
        step = 0.01 * np.eye(2)[axis]
        numeric = (lens.unproject(pixels + step) - lens.unproject(pixels - step)) / 0.02
        np.testing.assert_allclose(lens.unproject_jacobian(pixels)[..., axis], numeric, rtol=0, atol=1e-10)
    for number, step in enumerate(1e-4 * lens.parameters):
        shift = step * np.eye(3)[number]
        low, high = (lens.with_parameters(lens.parameters + sign * shift).project(points) for sign in (-1.0, 1.0))
        expected = lens.parameter_jacobian(points)[..., number]
        np.testing.assert_allclose((high - low) / (2 * step), expected, rtol=1e-6, atol=1e-8)
