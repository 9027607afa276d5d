"""Every way from identified stars to an attitude: they agree, and their covariances hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.catalogs import apparent_directions, load_catalog
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, rotate, rotation_between
from giantlike.core.outcomes import AttitudeFix, Failure
from giantlike.core.time import time_from_et
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.image import Image, ObserverState
from giantlike.processing import Detections
from giantlike.processing.geometry.wahba import WahbaMethod, solve_wahba
from giantlike.stars import StarNavigation, StarOptions
from giantlike.stars.attitude import AttitudeMethod, AttitudeSolution, Scale, fit_attitude
from giantlike.stars.navigation import sky_of
from tests.sizes import slow

TRIALS = 1000
FEW = 60
CAMERA = BrownModel(fx_px=3470.0, fy_px=3470.0, cx_px=1023.5, cy_px=1023.5, k1=-0.5)
"""33 degrees across, with some 50 px of distortion in the corners."""


def _stars(rng: np.random.Generator, n: int, *, elongated: bool) -> tuple[Rotation, Float, Float, Float]:
    """True attitude, catalog directions (n, 3), measured places (n, 2) px and covariances (n, 2, 2) px^2."""
    attitude = Rotation.random(rng=rng)
    places = rng.uniform(0.0, 2047.0, (n, 2))
    sigma = rng.uniform(0.02, 0.3, n)
    roots = sigma[:, None, None] * np.eye(2)
    if elongated:
        roots = roots @ (np.eye(2) + 0.7 * rng.normal(size=(n, 2, 2)))
    covariance = roots @ np.swapaxes(roots, 1, 2) + 1e-4 * np.eye(2)  # the catalog's 0.01 px
    noise = (np.linalg.cholesky(covariance) @ rng.normal(size=(n, 2, 1)))[..., 0]
    return attitude, rotate(attitude.inv(), CAMERA.unproject(places)), places + noise, covariance


def _solved(solution: AttitudeSolution | Failure) -> AttitudeSolution:
    assert isinstance(solution, AttitudeSolution), solution
    return solution


def _band(probability: float, freedom: int, trials: int) -> tuple[float, float]:
    """Central interval of the mean of so many chi-squares."""
    tail, total = (1.0 - probability) / 2.0, freedom * trials
    return float(chi2.ppf(tail, total)) / trials, float(chi2.ppf(1.0 - tail, total)) / trials


@pytest.mark.parametrize(
    ("method", "trials"),
    [
        ("weighted", FEW),
        *(slow(method, FEW) for method in ("q_method", "svd", "esoq2")),
        slow("weighted", TRIALS),
        *(slow(method, TRIALS // 4) for method in ("q_method", "svd", "esoq2")),
    ],
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
    low, high = _band(0.99999, 3, trials)
    assert low < squares.mean() < high
    low, high = _band(0.99999, 1, trials)
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


@pytest.mark.monte_carlo(few=40, full=100)
def test_full_covariances_make_the_weighted_attitude_better_than_one_sigma_a_star(draws: int) -> None:
    rng = np.random.default_rng(22)
    errors = {method: np.empty(draws) for method in (AttitudeMethod.WEIGHTED, AttitudeMethod.Q_METHOD)}
    for k in range(draws):
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
        inertial = rotate(truth.inv(), camera)
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


CAMERA_10_DEG = Camera(
    name="cam",
    columns=1024,
    rows=1024,
    model=PinholeModel(fx_px=5900.0, fy_px=5900.0, cx_px=511.5, cy_px=511.5),
)


@pytest.fixture(scope="module")
def displaced() -> tuple[Image, Detections, Float]:
    """Real stars with 0.05 px of noise, three of them displaced by 2 px (their places are the last value)."""
    rng = np.random.default_rng(25)
    attitude = camera_from_inertial_of_pointing(83.0, 0.0, 10.0)
    observer = ObserverState(position_km=np.array([1.5e8, 0.0, 0.0]), velocity_km_s=np.zeros(3))
    stars = load_catalog("default").cone(rotate(attitude.inv(), [0.0, 0.0, 1.0]), 0.12, max_magnitude=7.5)
    directions = apparent_directions(stars, 7.6e8, observer_position_km=observer.position_km)
    points = CAMERA_10_DEG.model.project(rotate(attitude, directions))
    inside = CAMERA_10_DEG.contains(points, margin_px=-5)
    points = points[inside] + 0.05 * rng.normal(size=(int(inside.sum()), 2))
    moved = np.array([5, 9, 14])
    points[moved] += [1.4, -1.4]
    n = len(points)
    flux = 10.0 ** (-0.4 * (stars.magnitude[inside] - 14.0))
    detections = Detections(
        points_px=points,
        covariance_px2=np.tile(0.05**2 * np.eye(2), (n, 1, 1)),
        flux_dn=flux,
        snr=flux,
        peak_dn=flux,
        area_px=np.full(n, 9),
        background_dn=np.zeros(n),
        width_px=np.full(n, 0.8),
        flags=np.zeros(n, dtype=np.uint16),
        psf_sigma_px=0.8,
        noise_dn=1.0,
    )
    image = Image(
        pixels=np.zeros((1024, 1024), np.uint16),
        camera_from_inertial=Rotation.from_rotvec([3e-4, 0.0, 0.0]) * attitude,
        epoch=time_from_et(7.6e8),
        observer=observer,
    )
    return image, detections, points[moved]


@pytest.mark.parametrize("method", list(AttitudeMethod))
def test_every_method_serves_navigation_and_throws_out_displaced_stars(
    method: AttitudeMethod, displaced: tuple[Image, Detections, Float]
) -> None:
    image, detections, moved_px = displaced
    navigation = StarNavigation(CAMERA_10_DEG, load_catalog("default"), StarOptions(attitude_method=method))
    fix = navigation.solve_detections(image, detections)
    assert isinstance(fix, AttitudeFix), fix
    error = rotation_between(fix.camera_from_inertial, camera_from_inertial_of_pointing(83.0, 0.0, 10.0))
    assert error @ np.linalg.solve(fix.covariance_rad2, error) < chi2.isf(1e-6, 3)
    assert fix.rejected_px.shape == (fix.n_rejected, 2)
    assert not {tuple(point) for point in moved_px} & {tuple(point) for point in fix.observed_px}


def test_light_is_bent_by_the_sun_where_the_options_ask_for_it(displaced: tuple[Image, Detections, Float]) -> None:
    image, _, _ = displaced
    catalog = load_catalog("default")
    assert image.camera_from_inertial is not None
    straight, bent = (
        sky_of(image, catalog, StarOptions(max_magnitude=6.0, light_deflection=on)).field(
            CAMERA_10_DEG, image.camera_from_inertial
        )
        for on in (False, True)
    )
    shift = np.linalg.norm(straight.directions_inertial - bent.directions_inertial, axis=1) * ARCSEC_PER_RAD
    sun = -np.array([1.0, 0.0, 0.0])
    elongation = np.arccos(straight.directions_inertial @ sun)
    # 4.07 mas at 1 au and 90 degrees, with the cotangent of half the elongation; the Sun is within 0.01 au of the
    # barycenter, and 1.5e8 km are 1.003 au.
    np.testing.assert_allclose(shift, 4.07e-3 / np.tan(elongation / 2), rtol=0.02)


def test_an_unknown_method_or_one_without_scale_is_refused() -> None:
    with pytest.raises(InputError, match="attitude_method must be one of weighted"):
        StarOptions(attitude_method="triad")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="cannot estimate the scale"):
        StarOptions(attitude_method=AttitudeMethod.SVD, estimate_scale=True)
