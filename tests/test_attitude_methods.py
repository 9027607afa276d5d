"""Every way from identified stars to an attitude: they agree, and their covariances hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import rotation_between
from giantlike.core.outcomes import Failure
from giantlike.processing.wahba import WahbaMethod, solve_wahba
from giantlike.stars import AttitudeMethod, AttitudeSolution, Scale, fit_attitude

TRIALS = 1000
CAMERA = BrownModel(fx_px=3470.0, fy_px=3470.0, cx_px=1023.5, cy_px=1023.5, k1=-0.5)
"""33 degrees across, with some 50 px of distortion in the corners."""


def _stars(rng: np.random.Generator, n: int, *, elongated: bool) -> tuple[Rotation, Float, Float, Float]:
    """True attitude, catalogue directions (n, 3), measured places (n, 2) px and covariances (n, 2, 2) px^2."""
    attitude = Rotation.random(rng=rng)
    places = rng.uniform(0.0, 2047.0, (n, 2))
    sigma = rng.uniform(0.02, 0.3, n)
    roots = sigma[:, None, None] * np.eye(2)
    if elongated:
        roots = roots @ (np.eye(2) + 0.7 * rng.normal(size=(n, 2, 2)))
    covariance = roots @ np.swapaxes(roots, 1, 2) + 1e-4 * np.eye(2)  # the catalogue's 0.01 px
    noise = (np.linalg.cholesky(covariance) @ rng.normal(size=(n, 2, 1)))[..., 0]
    return attitude, attitude.inv().apply(CAMERA.unproject(places)), places + noise, covariance


def _solved(solution: AttitudeSolution | Failure) -> AttitudeSolution:
    assert isinstance(solution, AttitudeSolution), solution
    return solution


def _band(probability: float, freedom: int, trials: int) -> tuple[float, float]:
    """Central interval of the mean of so many chi-squares."""
    tail, total = (1.0 - probability) / 2.0, freedom * trials
    return float(chi2.ppf(tail, total)) / trials, float(chi2.ppf(1.0 - tail, total)) / trials


@pytest.mark.parametrize(
    ("method", "trials"),
    [("weighted", TRIALS), ("q_method", TRIALS // 4), ("svd", TRIALS // 4), ("esoq2", TRIALS // 4)],
)
def test_attitudes_err_as_their_covariance_says_roll_included(method: str, trials: int) -> None:
    method = AttitudeMethod(method)
    rng = np.random.default_rng(20)
    squares, roll = np.empty(trials), np.empty(trials)
    for k in range(trials):
        truth, directions, points, covariance = _stars(rng, 15, elongated=method is AttitudeMethod.WEIGHTED)
        solution = _solved(fit_attitude(directions, points, covariance, CAMERA, method=method, outlier_sigma=6.0))
        error = rotation_between(solution.camera_from_inertial, truth)
        squares[k] = error @ np.linalg.solve(solution.covariance_rad2, error)
        roll[k] = error[2] ** 2 / solution.covariance_rad2[2, 2]
    low, high = _band(0.95, 3, trials)
    assert low < squares.mean() < high
    low, high = _band(0.95, 1, trials)
    assert low < roll.mean() < high


def test_methods_agree_far_within_the_covariance() -> None:
    rng = np.random.default_rng(21)
    for _ in range(20):
        _, directions, points, covariance = _stars(rng, 15, elongated=False)
        reference = _solved(
            fit_attitude(directions, points, covariance, CAMERA, method=AttitudeMethod.Q_METHOD, outlier_sigma=8.0)
        )
        for method, sigmas in (("svd", 1e-6), ("esoq2", 1e-4), ("weighted", 1.0)):
            # Directions weigh the two axes of a pixel alike, pixels as distortion has it: that is all that differs.
            other = _solved(
                fit_attitude(directions, points, covariance, CAMERA, method=AttitudeMethod(method), outlier_sigma=8.0)
            )
            difference = rotation_between(other.camera_from_inertial, reference.camera_from_inertial)
            assert difference @ np.linalg.solve(reference.covariance_rad2, difference) < sigmas**2


def test_full_covariances_make_the_weighted_attitude_better_than_one_sigma_a_star() -> None:
    rng = np.random.default_rng(22)
    errors = {method: np.empty(100) for method in (AttitudeMethod.WEIGHTED, AttitudeMethod.Q_METHOD)}
    for k in range(100):
        truth, directions, points, covariance = _stars(rng, 15, elongated=True)
        for method, list_ in errors.items():
            solution = _solved(fit_attitude(directions, points, covariance, CAMERA, method=method, outlier_sigma=6.0))
            list_[k] = np.sum(rotation_between(solution.camera_from_inertial, truth)[:2] ** 2)
    assert errors[AttitudeMethod.WEIGHTED].mean() < 0.8 * errors[AttitudeMethod.Q_METHOD].mean()


@pytest.mark.parametrize("half_width", [1.0, 0.3, 0.03])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-9, 1e-4, 1.0, np.pi])
def test_wahba_is_solved_alike_by_every_method_for_any_turn(half_width: float, turn_rad: float) -> None:
    rng = np.random.default_rng(23)
    for axis in (*np.eye(3), unit(rng.normal(size=3))):
        truth = Rotation.from_rotvec(turn_rad * axis)
        camera = unit(np.column_stack([rng.uniform(-half_width, half_width, (8, 2)), np.ones(8)]))
        inertial = truth.inv().apply(camera)
        measured = unit(camera + 1e-5 * rng.normal(size=camera.shape))
        solutions = {method: solve_wahba(inertial, measured, 1e-5, method=method) for method in WahbaMethod}
        reference = solutions[WahbaMethod.Q_METHOD]
        assert not isinstance(reference, Failure)
        for method, digits in ((WahbaMethod.SVD, 1e-5), (WahbaMethod.ESOQ2, 1e-3)):
            solution = solutions[method]
            assert not isinstance(solution, Failure)
            difference = rotation_between(solution[0], reference[0])
            assert difference @ np.linalg.solve(reference[1], difference) < digits**2


def test_a_method_of_directions_cannot_estimate_the_scale() -> None:
    rng = np.random.default_rng(24)
    _, directions, points, covariance = _stars(rng, 15, elongated=False)
    with pytest.raises(InputError, match="'weighted'"):
        fit_attitude(directions, points, covariance, CAMERA, scale=Scale.RADIAL, method=AttitudeMethod.SVD)
