"""The Christian-Robinson algorithm on simulated horizons, and the estimator on rendered ellipsoids and on relief."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.ray_tracing import Body, trace_silhouette
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.relative.horizon.ellipsoid_cra import EllipsoidCRA, EllipsoidCRAOptions, relief_sigma_km
from giantlike.relative.horizon.geometry import (
    CraMethod,
    Figure,
    christian_robinson,
    cone_weights,
    horizon_residuals,
)
from giantlike.relative.horizon.options import HorizonScan
from giantlike.relative.limb.fix import EdgeModel
from giantlike.shapes import Ellipsoid, TriangleMesh, irregular_body, load_shape, mesh_from_ellipsoid
from tests.bands import mean_square_band
from tests.limb_images import BodyImage, assert_sound, body_image, horizon_covariance, mean_nees_band
from tests.numerical import numerical_jacobian
from tests.sizes import slow
from tests.tolerances import FLOAT64, FLOAT64_ROOT, FLOAT64_SUM, SETTLED

RELATIVE = 1e-9  # of the range, noise-free: float64 rounding, magnified by range over radius
FOOT_PX = 2e-3  # for points 3 px off the horizon: rays are taken as linear about them
SIGMA_PX, SIGMA_RANGE = 0.1, 1e-3  # three times what is usual at a radius of 80 px and up to 100 degrees of phase
CRESCENT_PX, CRESCENT_RANGE = 0.2, 2.5e-3  # the same at 120 degrees
STEP_PX, STEP_RANGE = 1.0, 0.01  # three times what a blurred step leaves there: a crescent fades inward

MOON_KM, FAR_KM, ORION_FOCAL_PX = 1737.4, 252_400.0, 7291.7
ORION = PinholeModel(fx_px=ORION_FOCAL_PX, fy_px=ORION_FOCAL_PX, cx_px=1295.5, cy_px=971.5)
DISTORTED = BrownModel(fx_px=2400.0, fy_px=2450.0, cx_px=500.0, cy_px=480.0, skew_px=3.0, k1=-0.2, p1=1e-3, p2=-5e-4)
TRIAXIAL = Figure(radii_km=np.array([0.31, 0.25, 0.19]), camera_from_axes=Rotation.from_rotvec([0.4, -0.9, 1.7]))
POSITION_KM = np.array([0.35, -0.28, 7.1])


def horizon_px(model: CameraModel, figure: Figure, position_km: Float, angles_rad: Float) -> Float:
    """Points of the horizon by geometry: where the surface of the ellipsoid is seen edge-on."""
    center = figure.to_sphere @ position_km  # in the space where the body is a unit sphere
    distance = np.linalg.norm(center)
    axis = center / distance
    first = np.cross(axis, [0.3, -0.5, 0.8])
    first /= np.linalg.norm(first)
    around = np.cos(angles_rad)[:, None] * first + np.sin(angles_rad)[:, None] * np.cross(axis, first)
    tangent = center - axis / distance + np.sqrt(1.0 - distance**-2) * around
    return model.project(tangent @ np.linalg.inv(figure.to_sphere).T)


def noisy(points_px: Float, normals_px: Float, sigma_px: Float | float, rng: np.random.Generator) -> Float:
    return points_px + (sigma_px * rng.normal(size=len(points_px)))[:, None] * normals_px


# --- the algebra ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", list(CraMethod))
@pytest.mark.parametrize("model", [ORION, DISTORTED], ids=["pinhole", "distorted"])
def test_the_position_is_exact_for_exact_points(method: CraMethod, model: CameraModel) -> None:
    points = horizon_px(model, TRIAXIAL, POSITION_KM, np.linspace(0.2, 3.0, 40))
    position = christian_robinson(points, model, TRIAXIAL, method=method)
    assert not isinstance(position, Failure)
    assert_allclose(position, POSITION_KM, rtol=0, atol=RELATIVE * 7.1 * 1e2)


def test_the_horizon_of_a_sphere_on_the_boresight_is_a_circle_of_known_radius() -> None:
    figure = Figure(radii_km=np.full(3, MOON_KM), camera_from_axes=Rotation.identity())
    position = np.array([0.0, 0.0, 10_000.0])
    radius = ORION_FOCAL_PX * np.tan(np.arcsin(MOON_KM / 10_000.0))
    angles = np.linspace(0.0, 6.0, 25)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for off in (-2.5, 0.0, 3.0):
        points = np.array([ORION.cx_px, ORION.cy_px]) + (radius + off) * normals
        residuals, _, outward = horizon_residuals(points, ORION, figure, position)
        assert_allclose(residuals, off, rtol=0, atol=FOOT_PX)
        assert_allclose(outward, normals, rtol=0, atol=FOOT_PX)


@pytest.mark.parametrize("model", [ORION, DISTORTED], ids=["pinhole", "distorted"])
def test_the_jacobian_of_the_horizon_is_that_of_its_residuals(model: CameraModel) -> None:
    points = horizon_px(model, TRIAXIAL, POSITION_KM, np.linspace(0.0, 6.0, 30))
    _, jacobian, _ = horizon_residuals(points, model, TRIAXIAL, POSITION_KM)
    step_km = 1e-5
    numerical = numerical_jacobian(
        lambda position: -horizon_residuals(points, model, TRIAXIAL, position)[0], POSITION_KM, step_km
    )
    assert_allclose(jacobian * step_km, numerical * step_km, rtol=0, atol=FLOAT64_ROOT)


def test_the_covariance_is_that_of_the_paper_for_a_pinhole_camera() -> None:
    points = horizon_px(ORION, TRIAXIAL, POSITION_KM, np.linspace(0.0, 2.5, 50))
    sigma = np.linspace(0.05, 0.2, 50)
    a, s = TRIAXIAL.shape_matrix, POSITION_KM
    information = np.zeros((3, 3))
    m = a @ np.outer(s, s) @ a - (s @ a @ s - 1.0) * a  # Thrasher et al., eq. 15
    for u, sigma_u in zip(points, sigma, strict=True):
        x = np.array([(u[0] - ORION.cx_px) / ORION_FOCAL_PX, (u[1] - ORION.cy_px) / ORION_FOCAL_PX, 1.0])
        r = (sigma_u / ORION_FOCAL_PX) ** 2 * np.diag([1.0, 1.0, 0.0])  # eq. 16
        variance = 4.0 * x @ m @ r @ m @ x  # eq. 17
        h = 2.0 * s @ ((x @ a @ x) * a - a @ np.outer(x, x) @ a)  # eq. 18
        information += np.outer(h, h) / variance  # eq. 20
    stated = horizon_covariance(points, ORION, TRIAXIAL, POSITION_KM, sigma_px=sigma)
    assert_allclose(stated @ information, np.eye(3), rtol=0, atol=SETTLED)


@pytest.mark.parametrize("method", list(CraMethod))
@pytest.mark.parametrize("model", [ORION, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.monte_carlo(few=60, full=1500)
def test_the_covariance_agrees_with_monte_carlo(method: CraMethod, model: CameraModel, draws: int) -> None:
    points = horizon_px(model, TRIAXIAL, POSITION_KM, np.linspace(0.0, 2.8, 40))
    sigma = np.linspace(0.05, 0.25, 40)
    _, _, normals = horizon_residuals(points, model, TRIAXIAL, POSITION_KM)
    rng = np.random.default_rng(11)
    found = []
    for _ in range(draws):
        points_found = noisy(points, normals, sigma, rng)
        position = christian_robinson(points_found, model, TRIAXIAL, method=method, sigma_px=sigma)
        assert not isinstance(position, Failure)
        found.append(position - POSITION_KM)
    stated = horizon_covariance(points, model, TRIAXIAL, POSITION_KM, sigma_px=sigma, method=method)
    errors = np.array(found) @ np.linalg.inv(np.linalg.cholesky(stated)).T  # white where the covariance holds
    low, high = mean_square_band(3 * draws)
    assert low < np.mean(errors**2) < high
    low, high = mean_square_band(draws)
    for along_axis in np.mean(errors**2, axis=0):
        assert low < along_axis < high


def test_maximum_likelihood_has_the_smallest_covariance() -> None:
    points = horizon_px(DISTORTED, TRIAXIAL, POSITION_KM, np.linspace(0.0, 2.8, 40))
    sigma = np.linspace(0.05, 0.25, 40)
    best, plain = (
        horizon_covariance(points, DISTORTED, TRIAXIAL, POSITION_KM, sigma_px=sigma, method=method)
        for method in (CraMethod.MAXIMUM_LIKELIHOOD, CraMethod.LEAST_SQUARES)
    )
    assert np.linalg.eigvalsh(plain - best).min() > 0.0


def range_bias_km(method: CraMethod, *, pairs: int = 150) -> tuple[float, float]:
    """Mean range error and its standard error, km: the Moon from 252,400 km, 160 deg of limb, 0.1 px of noise.

    Noise comes in pairs of opposite sign, so that only what is of second order in it is left.
    """
    figure = Figure(radii_km=np.full(3, MOON_KM), camera_from_axes=Rotation.identity())
    truth = np.array([0.0, 0.0, FAR_KM])
    points = horizon_px(ORION, figure, truth, np.linspace(-1.4, 1.4, 1000))
    _, _, normals = horizon_residuals(points, ORION, figure, truth)
    rng = np.random.default_rng(12)
    bias = []
    for _ in range(pairs):
        error = noisy(np.zeros_like(points), normals, 0.1, rng)
        pair = [christian_robinson(points + e, ORION, figure, method=method, sigma_px=0.1) for e in (error, -error)]
        assert not any(isinstance(position, Failure) for position in pair)
        bias.append(np.mean([np.linalg.norm(np.asarray(position)) for position in pair]) - FAR_KM)
    return float(np.mean(bias)), float(np.std(bias) / np.sqrt(pairs))


def test_least_squares_puts_the_moon_seven_kilometers_too_far() -> None:
    bias, error = range_bias_km(CraMethod.LEAST_SQUARES)
    assert error < 0.5
    assert 5.0 < bias < 10.0


@pytest.mark.parametrize("method", [CraMethod.TOTAL_LEAST_SQUARES, CraMethod.MAXIMUM_LIKELIHOOD])
@pytest.mark.monte_carlo(few=60, full=150)
def test_the_bias_is_gone_with_the_other_methods(method: CraMethod, draws: int) -> None:
    bias, error = range_bias_km(method, pairs=draws)
    assert error < 0.5
    assert abs(bias) < 1.5  # 46 km is the sigma of one image; least squares has 7 km


def test_few_points_and_points_of_no_limb_are_failures() -> None:
    points = horizon_px(ORION, TRIAXIAL, POSITION_KM, np.linspace(0.0, 3.0, 3))
    few = christian_robinson(points, ORION, TRIAXIAL)
    assert isinstance(few, Failure)
    assert few.reason is Reason.TOO_FEW_DETECTIONS
    line = np.stack([np.linspace(0.0, 900.0, 40), np.linspace(100.0, 700.0, 40)], axis=-1)
    straight = christian_robinson(line, ORION, TRIAXIAL, method=CraMethod.LEAST_SQUARES)
    same = christian_robinson(np.full((10, 2), 300.0), ORION, TRIAXIAL, method=CraMethod.TOTAL_LEAST_SQUARES)
    for result in (straight, same):
        assert isinstance(result, Failure)
        assert result.reason is Reason.DEGENERATE_GEOMETRY


def test_misuse_of_the_algebra_is_an_input_error() -> None:
    with pytest.raises(InputError, match="radii_km"):
        Figure(radii_km=np.array([1.0, -1.0, 1.0]), camera_from_axes=Rotation.identity())
    with pytest.raises(InputError, match=r"shape \(n, 2\)"):
        christian_robinson(np.zeros(2), ORION, TRIAXIAL)
    with pytest.raises(InputError, match="outside the ellipsoid"):
        horizon_residuals(np.zeros((5, 2)), ORION, TRIAXIAL, [0.0, 0.0, 0.1])


def test_points_of_a_far_sphere_count_alike_in_the_equations_of_the_cone() -> None:
    figure = Figure(radii_km=np.full(3, MOON_KM), camera_from_axes=Rotation.identity())
    truth = np.array([0.0, 0.0, FAR_KM])
    weights = cone_weights(horizon_px(ORION, figure, truth, np.linspace(0.0, 6.0, 20)), ORION, figure, truth)
    assert_allclose(weights / weights.mean(), 1.0, rtol=0, atol=1e-3)  # the half angle of the cone is 0.4 deg


# --- the estimator ----------------------------------------------------------------------------------------------

SHAPES = (Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22])), Ellipsoid(radii_km=np.array([0.26, 0.26, 0.24])))


def fixed(case: BodyImage, options: EllipsoidCRAOptions | None = None) -> PositionFix:
    result = EllipsoidCRA(options).estimate(case.image, case.camera, case.scene)
    assert isinstance(result, PositionFix), result
    return result


@cache
def cases() -> tuple[BodyImage, ...]:
    """An ellipsoid at each phase angle, predicted 10 px and 1.5 % of range off."""
    return tuple(
        body_image(SHAPES[i % 2], 60 + i, phase_deg=phase).believed(off_px=(-7.0, 7.0), range_error=0.015 * (-1) ** i)
        for i, phase in enumerate((20.0, 45.0, 70.0, 95.0, 120.0, 60.0))
    )


@pytest.mark.parametrize(
    "method",
    [CraMethod.MAXIMUM_LIKELIHOOD, slow(CraMethod.TOTAL_LEAST_SQUARES), slow(CraMethod.LEAST_SQUARES)],
)
def test_an_ellipsoid_is_found_at_all_phase_angles(method: CraMethod) -> None:
    fixes = [fixed(case, EllipsoidCRAOptions(method=method)) for case in cases()]
    for case, fix in zip(cases(), fixes, strict=True):
        assert_sound(case, fix, sigma_px=CRESCENT_PX, sigma_range=CRESCENT_RANGE)
        assert fix.flags is Quality.APRIORI_ATTITUDE
    nees = [case.nees(fix) for case, fix in zip(cases(), fixes, strict=True)]
    low, high = mean_nees_band(len(nees))
    assert low < np.mean(nees) < high, nees
    assert np.median([np.linalg.eigvalsh(fix.covariance_px2)[-1] for fix in fixes]) < SIGMA_PX**2


def test_a_fix_is_complete_and_its_parts_agree() -> None:
    case = cases()[1]
    fix = fixed(case)
    model = case.camera.model
    assert fix.estimator == "ellipsoid_cra"
    assert_allclose(fix.center_px, model.project(fix.position_camera_km), rtol=0, atol=FLOAT64_SUM)
    jacobian = model.project_jacobian(fix.position_camera_km)
    assert_allclose(fix.covariance_px2, jacobian @ fix.covariance_camera_km2 @ jacobian.T, rtol=0, atol=FLOAT64)
    assert fix.residuals.shape == (fix.n_used,)
    assert fix.limb_px.shape == (fix.n_used, 2)
    assert "total_least_squares" not in fix.provenance["options"]


def test_an_ellipsoid_is_found_at_opposition() -> None:
    case = body_image(SHAPES[0], 68, phase_deg=0.0, radius_px=50.0).believed(off_px=(-7.0, 7.0), range_error=0.015)
    assert_sound(case, fixed(case), sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)


def test_without_a_photometric_model_the_error_is_larger_and_the_covariance_says_so() -> None:
    options = EllipsoidCRAOptions(horizon=HorizonScan(edges=EdgeModel.STEP))
    fixes = [fixed(case, options) for case in cases()]
    nees = [case.nees(fix) for case, fix in zip(cases(), fixes, strict=True)]
    assert np.mean(nees) < mean_nees_band(len(nees))[1]
    for case, fix in zip(cases(), fixes, strict=True):
        assert_sound(case, fix, sigma_px=STEP_PX, sigma_range=STEP_RANGE)
    stated, smallest = (np.mean([fix.sigma_range_km**2 for fix in some]) for some in (fixes, map(fixed, cases())))
    assert stated > smallest


def test_a_mesh_of_an_ellipsoid_gives_nearly_the_fix_of_the_ellipsoid_and_is_flagged() -> None:
    case = cases()[2]
    shape = case.target.shape
    assert isinstance(shape, Ellipsoid)
    mesh = mesh_from_ellipsoid(shape, facets=20_000).translated([0.02, -0.01, 0.03])
    moved = replace(case, target=replace(case.target, shape=mesh))
    fix, smooth = fixed(moved), fixed(case)
    assert Quality.SHAPE_APPROXIMATED in fix.flags
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, Failure)
    offset_km = rotate(geometry.camera_from_body, [0.02, -0.01, 0.03])
    center_px = case.camera.model.project(fix.position_camera_km + offset_km)
    assert_allclose(center_px, smooth.center_px, rtol=0, atol=SIGMA_PX)


@pytest.mark.monte_carlo(few=2, full=8)
def test_relief_is_in_the_covariance(draws: int) -> None:
    """Errors of the ellipsoids of made-up bodies against what their relief makes of the covariance."""
    nees, errors = [], []
    wide = EllipsoidCRAOptions(search_range=0.1)
    for seed in range(draws):
        shape = irregular_body(seed, facets=10_000, relief=0.025, roughness=0.002)
        case = body_image(shape, 70 + seed, phase_deg=25.0 + 10.0 * seed).believed(off_px=(4.0, 3.0))
        result = EllipsoidCRA(wide).estimate(case.image, case.camera, case.scene)
        assert isinstance(result, PositionFix), result
        assert Quality.SHAPE_APPROXIMATED in result.flags
        nees.append(case.nees(result))
        errors.append(np.abs(case.error_px(result)).max())
    assert np.mean(errors) > 0.2  # else there would be nothing to test
    low, high = mean_nees_band(len(nees))
    assert low < np.mean(nees) < 1.3 * high, nees  # the correlation length is that of asteroids on average


def test_an_ellipsoid_that_leaves_more_of_the_range_open_than_is_searched_is_the_wrong_shape() -> None:
    shape = irregular_body(1, facets=10_000, relief=0.04, roughness=0.002)
    case = body_image(shape, 71, phase_deg=35.0).believed(off_px=(4.0, 3.0))
    wide = EllipsoidCRA(EllipsoidCRAOptions(search_range=0.2)).estimate(case.image, case.camera, case.scene)
    assert isinstance(wide, PositionFix), wide
    # Three sigma of its own are compared, without the factor for tension, up to 3 for this one.
    found = EllipsoidCRA(EllipsoidCRAOptions(search_range=1.5 * wide.sigma_range_km / wide.range_km)).estimate(
        case.image, case.camera, case.scene
    )
    assert isinstance(found, Failure)
    assert found.reason is Reason.WRONG_SHAPE
    assert "raise search_range" in found.detail


def test_relief_is_the_distance_from_the_ellipsoid_along_its_normals() -> None:
    shape = Ellipsoid(radii_km=np.array([0.3, 0.25, 0.2]))
    mesh = mesh_from_ellipsoid(shape, facets=20_000)
    assert relief_sigma_km(mesh, shape.best_fit_ellipsoid) < 1e-4
    normals = mesh.vertices_km / shape.radii_km**2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    thick = TriangleMesh(mesh.vertices_km + 0.004 * normals, mesh.faces)
    assert_allclose(relief_sigma_km(thick, shape.best_fit_ellipsoid), 0.004, rtol=0, atol=2e-4)


def test_a_body_that_is_no_ellipsoid_is_refused() -> None:
    case = body_image(irregular_body(0, facets=10_000, relief=0.2), 80, phase_deg=40.0)
    result = EllipsoidCRA().estimate(case.image, case.camera, case.scene)
    assert isinstance(result, Failure)
    assert result.reason is Reason.WRONG_SHAPE
    assert "limb_matching" in result.detail


def test_an_empty_sky_has_no_horizon() -> None:
    case = cases()[0]
    noise = np.random.default_rng(0).normal(100.0, 5.0, case.image.pixels.shape)
    image = replace(case.image, pixels=np.rint(noise).astype(np.uint16))
    result = EllipsoidCRA().estimate(image, case.camera, case.scene)
    assert isinstance(result, Failure)
    assert result.reason is Reason.NO_LIMB


@pytest.mark.parametrize(
    ("options", "message"),
    [({"method": "guess"}, "method"), ({"max_relief": 0.0}, "max_relief"), ({"search_px": -1.0}, "search_px")],
)
def test_options_out_of_range_are_refused(options: dict[str, str | float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        EllipsoidCRAOptions(**options)  # type: ignore[arg-type]


def test_the_estimator_is_registered_under_its_name() -> None:
    estimator = ESTIMATORS["ellipsoid_cra"]()
    assert isinstance(estimator, EllipsoidCRA)
    assert isinstance(estimator, Estimator)


@pytest.mark.slow
@pytest.mark.real_data
def test_silhouettes_of_real_shapes_depart_from_their_ellipsoids_as_the_covariance_says(data_dir: Path) -> None:
    """Half outlines of Phobos, Ryugu, Bennu and Steins in random attitudes, without images or noise."""
    nees = []
    for name in ("phobos_lores.bds", "ryugu_test.obj", "BennuUntextured.obj", "steins.obj"):
        shape = load_shape(data_dir / "shapes" / name)
        placed = shape.best_fit_ellipsoid
        radius_px = 150.0
        position = np.array([0.0, 0.0, shape.mean_radius_km * ORION_FOCAL_PX / radius_px])
        relief_px = relief_sigma_km(shape, placed) / shape.mean_radius_km * radius_px
        for seed in range(15):
            rng = np.random.default_rng(seed)
            turn = Rotation.from_quat(rng.normal(size=4))
            body = Body(shape=shape, camera_from_body=turn, position_camera_km=position)
            angles = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, np.pi, 150)
            limb = trace_silhouette(body, ORION, angles, sun_direction_camera=[0.0, 0.0, -1.0])
            points = limb.points_px[limb.valid]
            figure = Figure(radii_km=placed.ellipsoid.radii_km, camera_from_axes=turn * placed.body_from_axes)
            center = christian_robinson(points, ORION, figure)
            assert not isinstance(center, Failure)
            _, design, _ = horizon_residuals(points, ORION, figure, center)
            apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
            scatter = relief_px**2 * np.exp(-apart / (0.3 * radius_px))
            gain = np.linalg.pinv(design)
            error = center - position - rotate(turn, placed.center_body_km.copy())
            nees.append(error @ np.linalg.solve(gain @ scatter @ gain.T, error))
    assert 1.5 < np.mean(nees) < 5.0, np.mean(nees)  # 3 on average; shapes differ by a factor of 1.5 either way
