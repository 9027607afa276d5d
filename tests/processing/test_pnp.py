"""Perspective-n-point: against OpenCV, against closed geometry, and its covariance against Monte Carlo."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.geometry.pnp import PnpFix, PnpOptions, poses_of_three_points, solve_pnp
from tests.sizes import slow
from tests.tolerances import FLOAT64_SUM, RARE, SETTLED

DISTANT_ROUNDING = 1e-6  # seen from 10,000 radii
NOISE_PX = 0.1


def rocks(count: int, seed: int) -> Float:
    """Points on a lumpy body of about 1 km radius, on the side that faces down its -z axis."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points[:, 2] = -np.abs(points[:, 2]) - 0.1
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points * random.uniform(0.8, 1.2, (count, 1))


def camera(range_km: float) -> BrownModel:
    """A body of 1 km radius is 150 px in radius."""
    focal = 150.0 * range_km
    return BrownModel(fx_px=focal, fy_px=focal, cx_px=250.0, cy_px=250.0, k1=-0.1)


def turned(seed: int, angle_rad: float = 0.5) -> Rotation:
    """A random turn that keeps the side with the points towards the camera."""
    return Rotation.from_rotvec(angle_rad * np.random.default_rng(seed).uniform(-1, 1, 3))


@pytest.mark.parametrize("range_km", [3.0, 100.0, 1e4])
def test_one_of_the_poses_of_three_exact_points_is_the_true_one_at_any_distance(range_km: float) -> None:
    random = np.random.default_rng(1)
    points = random.normal(size=(300, 3, 3))
    rotation, position = Rotation.random(random_state=2), np.array([0.02, -0.03, 1.0]) * range_km
    seen = points @ rotation.as_matrix().T + position
    rays = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    rotations, positions = poses_of_three_points(points, rays)
    error = np.abs(rotations - rotation.as_matrix()).max(axis=(1, 2))
    good = error < (FLOAT64_SUM if range_km < 1e3 else DISTANT_ROUNDING)
    assert np.count_nonzero(good) >= 295  # a triple that lies nearly along a line loses digits
    assert_allclose(np.median(positions[good], axis=0), position, rtol=0, atol=SETTLED * range_km)
    assert_allclose(np.linalg.det(rotations), 1.0, rtol=0, atol=FLOAT64_SUM)


def test_every_pose_of_three_points_projects_them_where_they_were_seen_as_opencv_has_it() -> None:
    random = np.random.default_rng(5)
    matched = total = 0
    for _ in range(100):
        points = random.normal(size=(1, 3, 3))
        seen = points[0] @ Rotation.random(random_state=random).as_matrix().T + [0.0, 0.0, 6.0]
        rays = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
        rotations, positions = poses_of_three_points(points, rays[None])
        again = points[0] @ np.swapaxes(rotations, -1, -2) + positions[:, None]
        assert_allclose(again[..., :2] / again[..., 2:], np.broadcast_to(
            rays[:, :2] / rays[:, 2:], (len(again), 3, 2)), rtol=0, atol=SETTLED)  # fmt: skip
        _, turns, moves = cv2.solveP3P(points[0], rays[:, :2] / rays[:, 2:], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
        for turn, move in zip(turns, moves, strict=True):
            oracle = np.column_stack([cv2.Rodrigues(turn)[0], move])
            ours = np.concatenate([rotations, positions[..., None]], axis=-1)
            total += 1
            matched += bool(len(ours)) and bool(np.abs(ours - oracle).max(axis=(1, 2)).min() < 1e-4)
    assert matched >= 0.97 * total  # pairs of roots that meet are one or two by rounding


def test_without_noise_the_pose_is_exact_through_a_lens_with_distortion() -> None:
    points, model = rocks(12, 3), camera(30.0)
    rotation, position = turned(4), np.array([0.5, -0.8, 30.0])
    pixels = model.project(rotate(rotation, points) + position)
    fix = solve_pnp(points, pixels, np.tile(1e-4 * np.eye(2), (12, 1, 1)), model, Rotation.identity())
    assert isinstance(fix, PnpFix)
    assert fix.inliers.all()
    assert_allclose(fix.position_camera_km, position, rtol=0, atol=SETTLED)
    assert (rotation * fix.camera_from_body.inv()).magnitude() < 1e-7


def test_the_noisy_pose_is_that_of_opencvs_iteration() -> None:
    points, range_km = rocks(20, 7), 8.0
    model = PinholeModel(fx_px=1200.0, fy_px=1200.0, cx_px=250.0, cy_px=250.0)
    rotation, position = turned(8), np.array([0.3, 0.2, range_km])
    pixels = model.project(rotate(rotation, points) + position) + np.random.default_rng(9).normal(0, NOISE_PX, (20, 2))
    fix = solve_pnp(points, pixels, np.tile(NOISE_PX**2 * np.eye(2), (20, 1, 1)), model, Rotation.identity())
    assert isinstance(fix, PnpFix)
    matrix = np.array([[1200.0, 0.0, 250.0], [0.0, 1200.0, 250.0], [0.0, 0.0, 1.0]])
    used = fix.inliers
    found, turn, move = cv2.solvePnP(points[used], pixels[used], matrix, None, flags=cv2.SOLVEPNP_ITERATIVE)
    assert found
    sigma = np.sqrt(np.diag(fix.covariance))
    assert np.all(np.abs(fix.position_camera_km - np.ravel(move)) < 0.02 * sigma[:3])
    change = (Rotation.from_rotvec(np.ravel(turn)) * fix.camera_from_body.inv()).as_rotvec()
    assert np.all(np.abs(change) < 0.02 * sigma[3:])


@pytest.mark.parametrize("attitude_sigma_rad", [0.0, slow(2e-3), math.inf])
def test_the_covariance_holds_with_a_third_of_the_points_wrong(attitude_sigma_rad: float) -> None:
    points, model = rocks(24, 11), camera(30.0)
    rotation, position = turned(12), np.array([0.5, -0.8, 30.0])
    size, draws, squares = (3 if attitude_sigma_rad == 0.0 else 6), 40, []
    for seed in range(draws):
        random = np.random.default_rng(seed)
        pixels = model.project(rotate(rotation, points) + position) + random.normal(0, NOISE_PX, (24, 2))
        wrong = random.choice(24, 8, replace=False)
        pixels[wrong] += random.uniform(5.0, 40.0, (8, 2)) * random.choice([-1, 1], (8, 2))
        error = random.normal(0.0, attitude_sigma_rad, 3) if size == 6 and attitude_sigma_rad < 1.0 else np.zeros(3)
        fix = solve_pnp(
            points,
            pixels,
            np.tile(NOISE_PX**2 * np.eye(2), (24, 1, 1)),
            model,
            Rotation.from_rotvec(error) * rotation,
            options=PnpOptions(attitude_sigma_rad=attitude_sigma_rad, inlier_px=1.0),
        )
        assert isinstance(fix, PnpFix)
        assert not fix.inliers[wrong].any()
        turn = (rotation * fix.camera_from_body.inv()).as_rotvec()
        e = np.concatenate([position - fix.position_camera_km, turn])[:size]
        scale = np.sqrt(np.diag(fix.covariance))[:size]
        squares.append((e / scale) @ np.linalg.solve(fix.covariance[:size, :size] / np.outer(scale, scale), e / scale))
    low, high = (float(chi2.ppf(chance, size * draws)) / draws for chance in (RARE, 1.0 - RARE))
    assert 0.75 * low < np.mean(squares) < high  # the floor is never negative: a little on the careful side


def test_what_errs_beyond_the_covariances_is_found_from_the_residuals() -> None:
    points, model = rocks(60, 13), camera(30.0)
    rotation, position = turned(14), np.array([0.5, -0.8, 30.0])
    random = np.random.default_rng(15)
    pixels = model.project(rotate(rotation, points) + position) + random.normal(0, 0.3, (60, 2))
    fix = solve_pnp(points, pixels, np.tile(1e-4 * np.eye(2), (60, 1, 1)), model, rotation)
    assert isinstance(fix, PnpFix)
    assert 0.2 < fix.floor_px < 0.4  # 114 degrees of freedom: good to 7 percent


def test_too_few_points_or_points_along_a_line_are_failures() -> None:
    model = camera(30.0)
    line = np.linspace(-1.0, 1.0, 10)[:, None] * np.array([0.3, 0.5, 0.1])
    pixels = model.project(line + np.array([0.0, 0.0, 30.0]))
    spread = np.tile(1e-2 * np.eye(2), (10, 1, 1))
    few = solve_pnp(line[:3], pixels[:3], spread[:3], model, Rotation.identity())
    assert isinstance(few, Failure)
    assert few.reason is Reason.TOO_FEW_MATCHES
    free = solve_pnp(line, pixels, spread, model, Rotation.identity())
    assert isinstance(free, Failure)
    assert free.reason in {Reason.DEGENERATE_GEOMETRY, Reason.NOT_CONVERGED, Reason.TOO_FEW_MATCHES}
    random = np.random.default_rng(16).uniform(0.0, 500.0, (10, 2))
    chance = solve_pnp(rocks(10, 17), random, spread, model, Rotation.identity(), options=PnpOptions(min_inliers=6))
    assert isinstance(chance, Failure)
    assert chance.reason is Reason.TOO_FEW_MATCHES


def test_misuse_is_said_in_words() -> None:
    points, model = rocks(8, 1), camera(30.0)
    pixels = model.project(points + np.array([0.0, 0.0, 30.0]))
    good = np.tile(np.eye(2), (8, 1, 1))
    for changed, needle in (((points, pixels[:4], good), "observed_px"), ((points, pixels, -good), "positive")):
        with pytest.raises(InputError, match=needle):
            solve_pnp(*changed, model, Rotation.identity())
    for options, needle in (
        ({"inlier_px": 0.0}, "inlier_px"),
        ({"min_inliers": 2}, "min_inliers"),
        ({"attitude_sigma_rad": -1.0}, "attitude_sigma_rad"),
    ):
        with pytest.raises(InputError, match=needle):
            PnpOptions(**options)
