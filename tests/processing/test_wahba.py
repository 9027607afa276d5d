"""Wahba's problem: exactness, weights, honest covariance, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate, rotation_between
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.geometry.wahba import davenport_quaternions, solve_wahba
from tests.bands import mean_square_band

EXACT_RAD = 1e-13  # float64 rounding over a handful of unit vectors
NARROW_ROLL_RAD = 1e-8  # rounding, 2e-16, over the square of a 5e-4 rad field is 1e-9; ten of it are 2 mas of roll


def _field(rng: np.random.Generator, n: int, half_width: float) -> Float:
    """Unit vectors (n, 3) around +z."""
    return unit(np.column_stack([rng.uniform(-half_width, half_width, (n, 2)), np.ones(n)]))


def _noisy(rng: np.random.Generator, vectors: Float, sigma_rad: Float) -> Float:
    return unit(vectors + sigma_rad[:, None] * rng.normal(size=vectors.shape))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 12))
def test_noise_free_directions_give_the_rotation_exactly(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    truth = Rotation.random(rng=rng)
    inertial = unit(rng.normal(size=(n, 3)))
    solved = solve_wahba(inertial, rotate(truth, inertial), 1e-5)
    if isinstance(solved, Failure):
        assert solved.reason is Reason.DEGENERATE_GEOMETRY
        return
    weakest = np.sqrt(np.linalg.eigvalsh(solved[1])[-1]) / 1e-5  # how far two stars are from one line
    assert np.linalg.norm(rotation_between(solved[0], truth)) < EXACT_RAD * weakest**2


def test_half_turns_are_found_where_the_scalar_part_of_the_quaternion_vanishes() -> None:
    rng = np.random.default_rng(1)
    inertial = unit(rng.normal(size=(5, 3)))
    for axis in np.eye(3):
        truth = Rotation.from_rotvec(np.pi * axis)
        solved = solve_wahba(inertial, rotate(truth, inertial), 1e-5)
        assert not isinstance(solved, Failure)
        assert np.linalg.norm(rotation_between(solved[0], truth)) < EXACT_RAD


def test_the_weighted_solution_is_that_of_scipy() -> None:
    rng = np.random.default_rng(2)
    inertial = unit(rng.normal(size=(9, 3)))
    sigma = rng.uniform(1e-4, 1e-2, 9)
    camera = _noisy(rng, rotate(Rotation.random(rng=rng), inertial), sigma)
    solved = solve_wahba(inertial, camera, sigma)
    assert not isinstance(solved, Failure)
    reference, _ = Rotation.align_vectors(camera, inertial, weights=sigma**-2)
    assert np.linalg.norm(rotation_between(solved[0], reference)) < EXACT_RAD * 100  # weights span four decades


def test_a_narrow_field_keeps_its_roll() -> None:
    rng = np.random.default_rng(3)
    truth = Rotation.random(rng=rng)
    camera = _field(rng, 20, 5e-4)
    solved = solve_wahba(rotate(truth.inv(), camera), camera, 1e-6)
    assert not isinstance(solved, Failure)
    assert np.linalg.norm(rotation_between(solved[0], truth)) < NARROW_ROLL_RAD


@pytest.mark.parametrize("half_width", [0.03, 0.5])
@pytest.mark.monte_carlo(few=60, full=400)
def test_errors_agree_with_the_covariance_about_every_axis(half_width: float, draws: int) -> None:
    rng = np.random.default_rng(4)
    errors, normalized = np.empty((draws, 3)), np.empty((draws, 3))
    for k in range(draws):
        truth = Rotation.random(rng=rng)
        camera = _field(rng, 10, half_width)
        sigma = rng.uniform(2e-5, 2e-4, 10)
        solved = solve_wahba(rotate(truth.inv(), camera), _noisy(rng, camera, sigma), sigma)
        assert not isinstance(solved, Failure)
        error = rotation_between(solved[0], truth)
        errors[k] = np.linalg.solve(np.linalg.cholesky(solved[1]), error)
        normalized[k] = error / np.sqrt(np.diag(solved[1]))
    low, high = mean_square_band(3 * draws, 0.025)
    assert low < np.mean(errors**2) < high
    low, high = mean_square_band(draws, 0.005)  # three axes, each of them
    for axis in range(3):
        assert low < np.mean(normalized[:, axis] ** 2) < high


def test_many_problems_at_once_give_what_each_gives_alone() -> None:
    rng = np.random.default_rng(5)
    inertial = unit(rng.normal(size=(7, 4, 3)))
    camera = unit(
        rotate(Rotation.random(rng=rng), inertial.reshape(-1, 3)).reshape(7, 4, 3) + 0.01 * rng.normal(size=(7, 4, 3))
    )
    weights = rng.uniform(1, 3, (7, 4))
    together = Rotation.from_quat(davenport_quaternions(inertial, camera, weights))
    for k in range(7):
        alone = solve_wahba(inertial[k], camera[k], 1e-4 * weights[k] ** -0.5)
        assert not isinstance(alone, Failure)
        assert np.linalg.norm(rotation_between(together[k], alone[0])) < EXACT_RAD


@pytest.mark.parametrize(
    "vectors",
    [np.zeros((0, 3)), np.eye(3)[:1], np.repeat(np.eye(3)[:1], 5, axis=0), np.array([[0, 0, 1.0], [0, 0, -1.0]])],
    ids=["none", "one", "five times the same", "opposite"],
)
def test_directions_along_one_line_are_refused(vectors: Float) -> None:
    solved = solve_wahba(vectors, vectors, 1e-5)
    assert isinstance(solved, Failure)
    assert solved.reason is Reason.DEGENERATE_GEOMETRY


def test_misuse_is_an_error() -> None:
    vectors = np.eye(3)
    for arguments in (
        (vectors, vectors[:2], 1e-5),
        (2 * vectors, vectors, 1e-5),
        (vectors, vectors, 0.0),
        (vectors, vectors, [1e-5, 1e-5]),
        (vectors, vectors, [1e-5, np.nan, 1e-5]),
    ):
        with pytest.raises(InputError):
            solve_wahba(*arguments)
