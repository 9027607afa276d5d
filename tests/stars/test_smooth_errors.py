"""Errors that stars share, and those of the best star, are in the covariance: truth without a line of the estimator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.independent import PinholeView
from giantlike.stars.attitude import AttitudeSolution, fit_attitude
from tests.sizes import slow

SIZE, FOCAL_PX = 1024, 2000.0
DRAWS = 40
SMOOTH_PX, LENGTH_PX = 0.3, 300.0
NEES = (0.5, 2.0)
VIEW = PinholeView(FOCAL_PX, (511.5, 511.5), SIZE, SIZE)
MODEL = PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=511.5, cy_px=511.5)


def _of_places(
    rng: np.random.Generator, points: Float, sigma_px: Float, offsets: Float, uncertain: tuple[str, ...] = ()
) -> tuple[AttitudeSolution, Float]:
    """Solution of stars at these places, seen with these offsets, and the error of its attitude."""
    attitude = Rotation.random(rng=rng)
    rays = np.column_stack([(points - VIEW.center_px) / VIEW.focal_px, np.ones(len(points))])
    directions = attitude.inv().apply(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    covariance = sigma_px[:, None, None] ** 2 * np.eye(2)
    solution = fit_attitude(directions, points + offsets, covariance, MODEL, uncertain=uncertain)
    assert isinstance(solution, AttitudeSolution)
    return solution, (attitude * solution.camera_from_inertial.inv()).as_rotvec()


def _smooth(rng: np.random.Generator, points: Float, size_px: float, length_px: float = LENGTH_PX) -> Float:
    squares = np.sum((points[:, None] - points[None]) ** 2, axis=-1)
    root = np.linalg.cholesky(np.exp(-squares / (2.0 * length_px**2)) + 1e-9 * np.eye(len(points)))
    return size_px * root @ rng.normal(size=(len(points), 2))


def _squared(solution: AttitudeSolution, error: Float) -> float:
    return float(error @ np.linalg.solve(solution.covariance_rad2, error)) / 3.0


@pytest.mark.parametrize(
    ("n", "length_px"),
    [
        (12, 300.0),
        slow(20, 300.0),
        slow(50, 300.0),
        slow(80, 300.0),
        slow(50, 600.0),
        slow(80, 600.0),
        slow(200, 600.0),
        (200, 100.0),
    ],
)
def test_errors_that_neighbors_share_are_in_the_covariance(n: int, length_px: float) -> None:
    rng, squares = np.random.default_rng(n), []
    for _ in range(DRAWS):
        points = rng.uniform(0.0, SIZE - 1.0, (n, 2))
        sigma = np.exp(rng.uniform(np.log(0.01), np.log(0.2), n))
        offsets = _smooth(rng, points, SMOOTH_PX, length_px) + sigma[:, None] * rng.normal(size=(n, 2))
        squares.append(_squared(*_of_places(rng, points, sigma, offsets)))
    assert (
        NEES[0] < np.mean(squares) < NEES[1]
    )  # 40 and more without the shared part; at 600 px 2.3 to 3.5 without smooth fields


@pytest.mark.parametrize("floor_px", [0.0, slow(0.15)])
def test_errors_without_a_pattern_keep_their_covariance(floor_px: float) -> None:
    rng, squares, shared = np.random.default_rng(3), [], []
    for _ in range(DRAWS):
        sigma = np.exp(rng.uniform(np.log(0.01), np.log(0.2), 50))
        offsets = np.hypot(sigma, floor_px)[:, None] * rng.normal(size=(50, 2))
        solution, error = _of_places(rng, rng.uniform(0.0, SIZE - 1.0, (50, 2)), sigma, offsets)
        squares.append(_squared(solution, error))
        shared.append(solution.shared_error_px)
    assert NEES[0] < np.mean(squares) < NEES[1]
    assert np.quantile(shared, 0.75) < 0.01  # px, times the root of their probability


@pytest.mark.slow
def test_few_stars_with_errors_as_long_as_the_field_are_seldom_far_beyond_their_covariance() -> None:
    rng, squares = np.random.default_rng(13), []
    for n in (10, 12):
        for _ in range(3 * DRAWS):
            points = rng.uniform(0.0, SIZE - 1.0, (n, 2))
            sigma = np.clip(0.1 * 10.0 ** -rng.exponential(0.3, n), 0.003, 0.1)
            offsets = _smooth(rng, points, SMOOTH_PX, 600.0) + sigma[:, None] * rng.normal(size=(n, 2))
            squares.append(_squared(*_of_places(rng, points, sigma, offsets)))
    assert np.mean(np.array(squares) > 10.0) < 0.04  # 0.07 where one kind of error alone counts
    assert np.median(squares) < 1.0


def test_noise_larger_than_told_is_in_the_covariance_of_few_stars() -> None:
    rng, squares = np.random.default_rng(13), []
    for _ in range(3 * DRAWS):
        points, sigma = rng.uniform(0.0, SIZE - 1.0, (12, 2)), np.exp(rng.uniform(np.log(0.02), np.log(0.2), 12))
        squares.append(_squared(*_of_places(rng, points, sigma, 2.0 * sigma[:, None] * rng.normal(size=(12, 2)))))
    assert NEES[0] < np.mean(squares) < NEES[1]


@pytest.mark.slow
def test_a_focal_length_that_is_wrong_is_no_error_that_neighbors_share() -> None:
    rng, squares = np.random.default_rng(4), []
    for _ in range(DRAWS):
        points = rng.uniform(0.0, SIZE - 1.0, (40, 2))
        sigma = np.exp(rng.uniform(np.log(0.01), np.log(0.2), 40))
        offsets = 0.5 * rng.normal() * (points - VIEW.center_px) / 512.0 + sigma[:, None] * rng.normal(size=(40, 2))
        squares.append(_squared(*_of_places(rng, points, sigma, offsets)))
    assert NEES[0] < np.mean(squares) < NEES[1]  # 0.03 as an error that neighbors share


@pytest.mark.slow
def test_the_error_of_a_star_that_dominates_is_in_the_covariance() -> None:
    rng, squares, exact = np.random.default_rng(5), [], []
    for _ in range(DRAWS):
        points, sigma = rng.uniform(0.0, SIZE - 1.0, (50, 2)), np.full(50, 0.1)
        sigma[0] = 0.005
        noise = sigma[:, None] * rng.normal(size=(50, 2))
        squares.append(_squared(*_of_places(rng, points, sigma, noise + _smooth(rng, points, 0.05))))
        exact.append(_squared(*_of_places(rng, points, sigma, noise)))
    assert np.mean(squares) < NEES[1]  # 36 without, 4 to 8 where that star alone decides
    assert NEES[0] < np.mean(exact) < NEES[1]


def test_a_focal_length_whose_error_is_declared_counts_once() -> None:
    ratios = []
    for seed in range(10):
        rng = np.random.default_rng([seed, 8])
        points, sigma = rng.uniform(0.0, SIZE - 1.0, (40, 2)), np.full(40, 0.1)
        sigma[0] = 0.01  # which decides, far from the center as it may be
        noise = sigma[:, None] * rng.normal(size=(40, 2))
        solutions = [_of_places(rng, points, sigma, noise, each)[0] for each in ((), ("fx_px", "fy_px"))]
        plain, declared = (np.trace(each.covariance_rad2[:2, :2]) for each in solutions)
        ratios.append(declared / plain)
    assert np.mean(ratios) < 3.0  # 10 if the scale counts too, which no residual shows then


def test_rows_that_slipped_leave_errors_that_neighbors_share() -> None:
    rng = np.random.default_rng(6)
    points, sigma = rng.uniform(0.0, SIZE - 1.0, (50, 2)), np.full(50, 0.05)
    slipped = np.where(points[:, 1:] > 500.0, np.array([3.0, 0.0]), 0.0)
    solution, error = _of_places(rng, points, sigma, slipped + 0.05 * rng.normal(size=(50, 2)))
    assert solution.shared_error_px > 0.5
    assert _squared(solution, error) < 4.0
