"""Camera models against OpenCV, against their own inverse, and against numerical derivatives."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from giantlike.camera import Camera
from giantlike.camera_models import (
    MODELS,
    BrownModel,
    CameraModel,
    EquidistantModel,
    EquisolidModel,
    GridCorrectedModel,
    OpenCVModel,
    OwenModel,
    PinholeModel,
    ScaramuzzaModel,
    SweepXModel,
    SweepYModel,
    ifov_rad,
    model_from_mapping,
    model_to_mapping,
)
from giantlike.camera_models.affine import AffineModel
from giantlike.camera_models.axial import AxialModel
from giantlike.camera_models.convert import Conversion, convert
from giantlike.camera_models.grid import fit_grid
from giantlike.camera_models.part import PartModel
from giantlike.camera_models.resample import resample
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure
from tests.fixed_grid import FixedGrid
from tests.numerical import numerical_jacobian
from tests.tolerances import FIVE_DIGITS, FLOAT64, FLOAT64_CHAIN, FLOAT64_DIGIT, FLOAT64_SUM, ROUND_TRIP_PX, SETTLED

JACOBIAN_RELATIVE = 1e-7  # central differences with a step of the cube root of float64 rounding
COLUMNS, ROWS = 2592, 1944

# NavCam 1 of the OSIRIS-REx paper, Table 1, y axis turned to point along increasing rows
NAVCAM = BrownModel(
    fx_px=3473.3, fy_px=3473.4, cx_px=1268.7, cy_px=949.6, k1=-0.539, k2=0.388, k3=-0.214, p1=-2.55e-4, p2=8.64e-4
)  # fmt: skip
SHEARED = PinholeModel(fx_px=900.0, fy_px=880.0, cx_px=511.0, cy_px=512.0, skew_px=3.0)
RATIONAL = OpenCVModel(
    fx_px=1800.0, fy_px=1790.0, cx_px=1290.0, cy_px=980.0, k1=0.31, k2=-0.11, k3=0.02, k4=0.65, k5=0.07, k6=0.01,
    p1=8e-4, p2=-6e-4, s1=1e-3, s2=-4e-4, s3=-7e-4, s4=2e-4,
)  # fmt: skip
TILTED = OwenModel(
    fx_px=2900.0, fy_px=2890.0, cx_px=1280.0, cy_px=960.0, e1=1e-3, e2=-0.08, e3=-2e-3, e4=0.05, e5=2e-3, e6=-3e-3
)  # fmt: skip
FISHEYE = EquidistantModel(
    fx_px=700.0, fy_px=705.0, cx_px=1300.0, cy_px=970.0, skew_px=1.5, k1=-0.02, k2=3e-3, k3=-5e-4, k4=2e-5
)  # fmt: skip
EQUISOLID = EquisolidModel(fx_px=900.0, fy_px=900.0, cx_px=1295.5, cy_px=971.5, k1=0.01, k2=-2e-3)
ODIN_WAC = ScaramuzzaModel.from_polynomial(  # Table 2 of the ODIN paper
    a0_px=533.039, a2=-7.764e-4, a3=4.340e-7, a4=-8.639e-10, cx_px=1024.0, cy_px=768.0, stretch=1.001
)  # fmt: skip
SCANS = tuple(
    kind(fx_px=4000.0, fy_px=4100.0, cx_px=1300.0, cy_px=970.0, skew_px=2.0) for kind in (SweepXModel, SweepYModel)
)
EVERY = (SHEARED, NAVCAM, RATIONAL, TILTED, FISHEYE, EQUISOLID, ODIN_WAC, *SCANS)
EACH = pytest.mark.parametrize("model", EVERY, ids=lambda m: m.type_name)
BEHIND_ITSELF = pytest.mark.parametrize("model", [FISHEYE, EQUISOLID, ODIN_WAC], ids=lambda m: m.type_name)


def pixels_of(model: CameraModel, count: int = 2000) -> Float:
    """Pixels spread over the part of the frame that the lens fills."""
    pixels = np.random.default_rng(1).uniform([-0.5, -0.5], [COLUMNS - 0.5, ROWS - 0.5], (count, 2))
    seen = pixels[np.isfinite(model.unproject(pixels)).all(axis=1)]
    assert len(seen) > 0.3 * count
    return seen


def inner_pixels(count: int = 50) -> Float:
    """Pixels far from folds and from the rim of the grid, where differences are no derivative."""
    low, high = 0.15, 0.85
    return np.random.default_rng(9).uniform([low * COLUMNS, low * ROWS], [high * COLUMNS, high * ROWS], (count, 2))


def directions_at(angle_rad: Float, azimuth_rad: Float) -> Float:
    across = np.sin(angle_rad)
    return np.stack([across * np.cos(azimuth_rad), across * np.sin(azimuth_rad), np.cos(angle_rad)], axis=-1)


def test_every_model_of_the_registry_is_examined_here() -> None:
    assert {model.type_name for model in EVERY} == set(MODELS)


@EACH
def test_projecting_an_unprojected_pixel_gives_the_pixel_back(model: CameraModel) -> None:
    pixels = pixels_of(model)
    directions = model.unproject(pixels)
    assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=0, atol=FLOAT64_DIGIT)
    assert_allclose(model.project(directions * 123.0), pixels, rtol=0, atol=ROUND_TRIP_PX)


@EACH
def test_many_points_at_once_give_what_each_gives_alone(model: CameraModel) -> None:
    pixels = np.tile(pixels_of(model, 50), (500, 1)).reshape(5, -1, 2)
    directions = model.unproject(pixels)
    few = model.unproject(pixels[0, :10])
    assert_allclose(directions[0, :10], few, rtol=0, atol=FLOAT64_DIGIT)
    assert_allclose(model.project(directions)[0, :10], model.project(few), rtol=0, atol=ROUND_TRIP_PX)


def opencv_pixels(model: BrownModel | OpenCVModel, points: Float) -> Float:
    """What OpenCV projects; its p1, p2 have the meaning of the OSIRIS-REx paper's eq. 7."""
    values = dict(zip(model.parameter_names, model.parameters, strict=True))
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
    matrix = np.array([[model.fx_px, 0, model.cx_px], [0, model.fy_px, model.cy_px], [0, 0, 1]])
    coefficients = np.array([values.get(name, 0.0) for name in order])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    return np.asarray(pixels[:, 0], dtype=np.float64)


@pytest.mark.parametrize("model", [NAVCAM, RATIONAL], ids=lambda m: m.type_name)
def test_the_model_projects_where_opencv_does(model: BrownModel | OpenCVModel) -> None:
    points = model.unproject(pixels_of(model)) * 7.0
    assert_allclose(model.project(points), opencv_pixels(model, points), rtol=0, atol=ROUND_TRIP_PX)


def test_the_equidistant_fisheye_projects_where_opencv_does() -> None:
    points = directions_at(*np.random.default_rng(2).uniform([0, 0], [1.5, 6.2], (1000, 2)).T)
    # OpenCV calls the shear over fx alpha
    matrix = np.array([[FISHEYE.fx_px, 0, FISHEYE.cx_px], [0, FISHEYE.fy_px, FISHEYE.cy_px], [0, 0, 1]])
    coefficients = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, coefficients, alpha=FISHEYE.skew_px / FISHEYE.fx_px
    )  # fmt: skip
    assert_allclose(FISHEYE.project(points), expected[:, 0], rtol=0, atol=ROUND_TRIP_PX)


def test_owen_terms_move_a_point_as_the_printed_formula_says() -> None:
    x, y = 0.2, -0.3
    r = float(np.hypot(x, y))
    stretch = 1 + TILTED.e2 * r**2 + TILTED.e4 * r**4 + TILTED.e5 * y + TILTED.e6 * x
    moved = stretch * np.array([x, y]) + (TILTED.e1 * r + TILTED.e3 * r**3) * np.array([-y, x])
    expected = [TILTED.cx_px, TILTED.cy_px] + [TILTED.fx_px, TILTED.fy_px] * moved
    assert_allclose(TILTED.project([x, y, 1.0]), expected, rtol=0, atol=ROUND_TRIP_PX)


def test_an_ideal_equisolid_lens_gives_equal_areas_to_equal_solid_angles() -> None:
    lens = EquisolidModel(fx_px=100.0, fy_px=100.0, cx_px=0.0, cy_px=0.0)
    angles = np.radians([10.0, 60.0, 120.0, 179.0])
    radii = np.linalg.norm(lens.project(directions_at(angles, np.full(4, 0.7))), axis=1)
    caps = 2 * np.pi * (1 - np.cos(angles))
    assert_allclose(np.pi * radii**2 / caps, 100.0**2, rtol=FLOAT64 / 10, atol=0)


def test_scaramuzza_agrees_with_the_published_polynomial() -> None:
    u, v = 300.0, -200.0  # from the center, px
    rho = np.hypot(u, v)
    ray = np.array([u, v, 533.039 - 7.764e-4 * rho**2 + 4.340e-7 * rho**3 - 8.639e-10 * rho**4])
    square = ScaramuzzaModel.from_polynomial(
        a0_px=533.039, a2=-7.764e-4, a3=4.340e-7, a4=-8.639e-10, cx_px=1024.0, cy_px=768.0
    )
    assert_allclose(square.project(ray), [1024.0 + u, 768.0 + v], rtol=0, atol=ROUND_TRIP_PX)


@BEHIND_ITSELF
def test_a_fisheye_images_what_lies_beside_and_behind_it(model: CameraModel) -> None:
    directions = directions_at(np.radians([0.0, 89.9, 90.0, 90.1, 98.0]), np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
    pixels = model.project(directions)
    assert np.isfinite(pixels).all()
    assert_allclose(model.unproject(pixels), directions, rtol=0, atol=FLOAT64)


@EACH
def test_jacobians_agree_with_numerical_differences(model: CameraModel) -> None:
    pixels = inner_pixels()
    points = model.unproject(pixels)
    scale = model.focal_length_px
    by_point = numerical_jacobian(model.project, points, 1e-5)
    assert_allclose(model.project_jacobian(points), by_point, rtol=0, atol=JACOBIAN_RELATIVE * scale)
    by_pixel = numerical_jacobian(model.unproject, pixels, 1e-2)
    assert_allclose(model.unproject_jacobian(pixels) * scale, by_pixel * scale, rtol=0, atol=JACOBIAN_RELATIVE)


@EACH
def test_jacobians_hold_on_the_optical_axis(model: CameraModel) -> None:
    axis = np.array([0.0, 0.0, 2.0])
    assert_allclose(
        model.project_jacobian(axis), numerical_jacobian(model.project, axis, 1e-5), rtol=0,
        atol=10 * JACOBIAN_RELATIVE * model.focal_length_px,  # Owen's e1 has a kink there
    )  # fmt: skip
    assert np.isfinite(model.parameter_jacobian(axis)).all()


@EACH
@pytest.mark.parametrize("temperature_c", [0.0, 30.0])
def test_parameter_jacobian_agrees_with_numerical_differences(model: AffineModel, temperature_c: float) -> None:
    points = model.unproject(inner_pixels())
    names = model.parameter_names
    values = model.parameters + np.array([1e-4 if name == "a1_per_c" else 0.0 for name in names])
    model = model.with_parameters(values)
    analytic = model.parameter_jacobian(points, temperature_c=temperature_c)
    for k, name in enumerate(names):
        step = np.zeros(len(names))
        step[k] = 1e-7 if "_per_c" in name else 1e-5 * max(1.0, abs(values[k]))
        ahead = model.with_parameters(values + step).at_temperature(temperature_c).project(points)
        behind = model.with_parameters(values - step).at_temperature(temperature_c).project(points)
        assert_allclose(
            analytic[..., k],
            (ahead - behind) / (2 * step[k]),
            rtol=0,
            atol=JACOBIAN_RELATIVE * max(1.0, float(np.abs(analytic[..., k]).max())),
            err_msg=name,
        )


@EACH
def test_a_warm_camera_magnifies_about_the_principal_point(model: AffineModel) -> None:
    terms = dict(zip(model.parameter_names, model.parameters, strict=True))
    terms |= {"a1_per_c": 2e-5, "a2_per_c2": -3e-7, "a3_per_c3": 4e-9}
    cold = model.with_parameters(list(terms.values()))
    points, center = model.unproject(pixels_of(model, 50)), np.array([model.cx_px, model.cy_px])
    magnification = 1.0 - 20.0 * 2e-5 - 400.0 * 3e-7 - 8000.0 * 4e-9
    warm = cold.at_temperature(-20.0)
    expected = center + magnification * (cold.project(points) - center)
    assert_allclose(warm.project(points), expected, rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(warm.at_temperature(50.0).project(points), expected, rtol=0, atol=ROUND_TRIP_PX)


def test_temperature_terms_far_from_where_they_were_fitted_are_refused() -> None:
    model = PinholeModel(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, a1_per_c=-0.01)
    with pytest.raises(InputError, match="valid where it was fitted"):
        model.at_temperature(200.0)


@EACH
def test_binning_and_windowing_map_pixels_exactly(model: AffineModel) -> None:
    pixels = pixels_of(model, 100)
    points = model.unproject(pixels)
    # the first 4 by 4 block has its center at 1.5 px
    assert_allclose(model.binned(4).project(points), (pixels - 1.5) / 4, rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(model.windowed(300, 17).project(points), pixels - [300, 17], rtol=0, atol=ROUND_TRIP_PX)


def test_points_behind_the_camera_or_beyond_the_fold_are_nan() -> None:
    behind, folded = NAVCAM.project([[0.1, 0.0, -1.0], [NAVCAM.max_radius * 1.01, 0.0, 1.0]])
    assert np.isnan(behind).all()
    assert np.isnan(folded).all()
    assert np.isfinite(NAVCAM.project([NAVCAM.max_radius * 0.99, 0.0, 1.0])).all()
    assert np.isnan(NAVCAM.unproject([1e5, 1e5])).all()


@BEHIND_ITSELF
def test_a_fisheye_gives_nan_beyond_its_largest_angle(model: AxialModel) -> None:
    edge = min(model.max_angle_rad, np.pi - 1e-6)
    inside, outside = model.project(directions_at(np.array([edge * 0.999, edge * 1.001 + 1e-5]), np.zeros(2)))
    assert np.isfinite(inside).all()
    if edge < 3.0:
        assert np.isnan(outside).all()
    assert np.isnan(model.project([0.0, 0.0, -1.0])).all()
    assert np.isnan(model.unproject([1e6, 1e6])).all()


def test_the_fold_is_where_the_radial_map_stops_growing() -> None:
    radial = BrownModel(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, k1=-0.539, k2=0.388, k3=-0.214)
    r = np.linspace(0, radial.max_radius, 1000)
    growth = 1 + 3 * radial.k1 * r**2 + 5 * radial.k2 * r**4 + 7 * radial.k3 * r**6
    assert (growth[:-1] > 0).all()
    assert_allclose(growth[-1], 0.0, rtol=0, atol=FLOAT64)
    assert BrownModel(fx_px=1, fy_px=1, cx_px=0, cy_px=0, k1=0.1).max_radius == np.inf


def test_decentering_brings_the_fold_nearer() -> None:
    radial = BrownModel(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, k1=-0.3)
    tilted = BrownModel(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, k1=-0.3, p2=-0.02)
    x = tilted.max_radius  # along x the map is x - 0.3 x^3 - 0.06 x^2
    assert_allclose(1 - 0.9 * x**2 - 0.12 * x, 0.0, rtol=0, atol=FIVE_DIGITS)
    assert x < radial.max_radius


coefficient = st.floats(-0.5, 0.5)
small = st.floats(-0.05, 0.05)


@settings(max_examples=60, deadline=None)
@given(k1=coefficient, k2=coefficient, k3=coefficient, k4=coefficient, p1=small, p2=small, s1=small, s3=small)
def test_inside_the_fold_every_direction_is_recovered_whatever_the_polynomial(**coefficients: float) -> None:
    check_no_folded_solution(OpenCVModel(fx_px=1000.0, fy_px=900.0, cx_px=10.0, cy_px=20.0, **coefficients))


@settings(max_examples=60, deadline=None)
@given(e1=small, e2=coefficient, e3=small, e4=coefficient, e5=small, e6=small)
def test_inside_the_fold_owen_recovers_every_direction(**coefficients: float) -> None:
    check_no_folded_solution(OwenModel(fx_px=1000.0, fy_px=900.0, cx_px=10.0, cy_px=20.0, **coefficients))


def check_no_folded_solution(model: OpenCVModel | OwenModel) -> None:
    """Directions well inside the fold come back; pixels that have a direction come back; beyond is NaN."""
    limit = min(model.max_radius, 3.0)
    generator = np.random.default_rng(5)
    radius, azimuth = 0.98 * limit * np.sqrt(generator.uniform(0, 1, 200)), generator.uniform(0, 2 * np.pi, 200)
    directions = directions_at(np.arctan(radius), azimuth)
    assert_allclose(model.unproject(model.project(directions)), directions, rtol=0, atol=FLOAT64_CHAIN)
    pixels = generator.uniform(-3000, 3000, (200, 2))
    there = model.unproject(pixels)
    seen = np.isfinite(there).all(axis=1)
    error_px = np.abs(model.project(there[seen]) - pixels[seen]).max(axis=1)
    # next to a fold the direction is a double root: half the digits; next to a pole its rounding is magnified
    magnified = np.linalg.norm(model.project_jacobian(there[seen]), axis=(1, 2))
    assert (error_px <= 1e-6 + 1e-14 * magnified).all()
    if np.isfinite(model.max_radius):
        assert np.isnan(model.project(directions_at(np.arctan(1.001 * model.max_radius + 0 * azimuth), azimuth))).all()


@settings(max_examples=60, deadline=None)
@given(k1=coefficient, k2=small, k3=small, k4=small, kind=st.sampled_from([EquidistantModel, EquisolidModel]))
def test_inside_its_largest_angle_a_fisheye_recovers_every_direction(
    kind: type[EquidistantModel], **coefficients: float
) -> None:
    model = kind(fx_px=1000.0, fy_px=900.0, cx_px=10.0, cy_px=20.0, **coefficients)
    generator = np.random.default_rng(6)
    angle = 0.98 * min(model.max_angle_rad, 3.1) * generator.uniform(0, 1, 200)
    directions = directions_at(angle, generator.uniform(0, 2 * np.pi, 200))
    assert_allclose(model.unproject(model.project(directions)), directions, rtol=0, atol=FLOAT64_CHAIN)


@settings(max_examples=60, deadline=None)
@given(b2=coefficient, b3=coefficient, b4=coefficient)
def test_inside_its_largest_angle_scaramuzza_recovers_every_direction(**coefficients: float) -> None:
    model = ScaramuzzaModel(fx_px=500.0, fy_px=510.0, cx_px=10.0, cy_px=20.0, **coefficients)
    generator = np.random.default_rng(7)
    angle = 0.97 * model.max_angle_rad * generator.uniform(0, 1, 200)
    directions = directions_at(angle, generator.uniform(0, 2 * np.pi, 200))
    assert_allclose(model.unproject(model.project(directions)), directions, rtol=0, atol=FLOAT64_SUM)


def waves(amplitude_px: float) -> GridCorrectedModel:
    """NavCam with a smooth correction that no lens formula has."""
    j, i = np.mgrid[0:11, 0:14]
    return GridCorrectedModel(
        base=NAVCAM, corner_px=np.array([-0.5, -0.5]), step_px=250.0,
        dx_px=amplitude_px * np.sin(0.9 * i + 0.3 * j), dy_px=amplitude_px * np.cos(0.4 * i - 0.8 * j),
    )  # fmt: skip


def test_a_grid_correction_is_inverted_and_differentiated_exactly() -> None:
    model = waves(5.0)
    pixels = inner_pixels()
    points = model.unproject(pixels)
    assert_allclose(model.project(points), pixels, rtol=0, atol=ROUND_TRIP_PX)
    tolerance = JACOBIAN_RELATIVE * model.focal_length_px
    by_point = numerical_jacobian(model.project, points, 1e-6)
    assert_allclose(model.project_jacobian(points), by_point, rtol=0, atol=10 * tolerance)
    by_pixel = numerical_jacobian(model.unproject, pixels, 1e-2) * model.focal_length_px
    assert_allclose(model.unproject_jacobian(pixels) * model.focal_length_px, by_pixel, rtol=0, atol=JACOBIAN_RELATIVE)
    step = np.array([1e-3 if name == "fx_px" else 0.0 for name in model.parameter_names])
    moved = [model.with_parameters(model.parameters + sign * step).project(points) for sign in (1, -1)]
    assert_allclose(model.parameter_jacobian(points)[..., 0], (moved[0] - moved[1]) / 2e-3, rtol=0, atol=SETTLED)


def test_a_grid_correction_of_equal_controls_shifts_every_pixel_alike() -> None:
    model = GridCorrectedModel(
        base=NAVCAM, corner_px=np.array([-0.5, -0.5]), step_px=500.0,
        dx_px=np.full((7, 9), 1.25), dy_px=np.full((7, 9), -0.5),
    )  # fmt: skip
    points = NAVCAM.unproject(pixels_of(NAVCAM, 50))
    assert_allclose(
        model.project(points) - NAVCAM.project(points), [[1.25, -0.5]] * 50, rtol=0, atol=FLOAT64_CHAIN / 10
    )


def test_a_grid_correction_survives_binning_windows_temperature_and_its_file() -> None:
    model = waves(2.0)
    pixels = pixels_of(model, 100)
    points = model.unproject(pixels)
    assert_allclose(model.binned(2).project(points), (pixels - 0.5) / 2, rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(model.windowed(9, 5).project(points), pixels - [9, 5], rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(model_from_mapping(model_to_mapping(model)).project(points), pixels, rtol=0, atol=ROUND_TRIP_PX)
    warm = dataclasses.replace(model, base=dataclasses.replace(NAVCAM, a1_per_c=1e-4)).at_temperature(10.0)
    expected = NAVCAM.project(points) * 1.001 - [NAVCAM.cx_px * 1e-3, NAVCAM.cy_px * 1e-3]
    assert_allclose(warm.project(points), expected + model.correction(expected), rtol=0, atol=ROUND_TRIP_PX)


def test_a_correction_that_might_fold_is_refused() -> None:
    with pytest.raises(InputError, match="sure to be invertible"):
        waves(100.0)


def test_a_fitted_grid_recovers_the_correction_from_noise_free_points() -> None:
    truth = waves(2.0)
    pixels = np.random.default_rng(4).uniform([-0.5, -0.5], [COLUMNS - 0.5, ROWS - 0.5], (4000, 2))
    start = GridCorrectedModel.flat(NAVCAM, COLUMNS, ROWS, step_px=250.0)
    fitted = fit_grid(start, truth.unproject(pixels), pixels, smoothing=1e-6)
    assert isinstance(fitted, GridCorrectedModel)
    left = fitted.project(truth.unproject(pixels)) - pixels
    assert np.abs(left).max() < 1e-3  # the smoothing of 1e-6 against some 40 points a cell
    few = fit_grid(start, np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0]]))
    assert isinstance(few, Failure)


def test_converting_to_a_model_that_holds_the_old_one_loses_nothing() -> None:
    conversion = convert(NAVCAM, "opencv", columns=COLUMNS, rows=ROWS)
    assert isinstance(conversion, Conversion)
    assert conversion.coverage == 1.0
    assert conversion.max_px < 1e-6  # where the fit stops


def test_a_conversion_states_what_it_loses() -> None:
    conversion = convert(TILTED, "brown", columns=COLUMNS, rows=ROWS)
    assert isinstance(conversion, Conversion)
    directions = TILTED.unproject(conversion.points_px)
    lost = conversion.model.project(directions) - conversion.points_px
    assert_allclose(conversion.residuals_px, lost, rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(conversion.max_px, np.linalg.norm(lost, axis=-1).max(), rtol=FLOAT64, atol=0)
    # a pinwheel cannot be had from decentering: the field of the two differs by 1e-3 r (-y, x), some px at the corner
    assert 0.1 < conversion.rms_px < conversion.max_px < 10.0
    pinhole = convert(TILTED, "pinhole", columns=COLUMNS, rows=ROWS)
    assert isinstance(pinhole, Conversion)
    assert pinhole.rms_px > conversion.rms_px


def test_a_fisheye_becomes_another_and_only_its_front_a_gnomonic_one() -> None:
    equisolid = convert(ODIN_WAC.windowed(300, 200), "equisolid", columns=1448, rows=1136)
    assert isinstance(equisolid, Conversion)
    assert equisolid.rms_px < 0.1  # four coefficients against three, up to 118 degrees
    scaramuzza = convert(EQUISOLID, "scaramuzza", columns=COLUMNS, rows=ROWS)
    assert isinstance(scaramuzza, Conversion)
    assert scaramuzza.coverage == 1.0
    gnomonic = convert(FISHEYE, "brown", columns=COLUMNS, rows=ROWS)
    assert isinstance(gnomonic, Conversion)
    assert gnomonic.coverage < 1.0
    with pytest.raises(InputError, match="type must be one of"):
        convert(FISHEYE, "eye", columns=COLUMNS, rows=ROWS)


def test_undistorting_agrees_with_opencv() -> None:
    y, x = np.mgrid[0:200, 0:300]
    image = 100.0 + 50.0 * np.sin(x / 17.0) * np.cos(y / 23.0)
    model = BrownModel(fx_px=250.0, fy_px=255.0, cx_px=150.0, cy_px=98.0, k1=-0.25, k2=0.05, p1=1e-3, p2=-2e-3)
    matrix = np.array([[250.0, 0, 150.0], [0, 255.0, 98.0], [0, 0, 1]])
    expected = cv2.undistort(image, matrix, np.array([model.k1, model.k2, model.p1, model.p2]))
    ours = resample(image, model)
    seen = np.isfinite(ours) & (expected > 0)
    assert seen.mean() > 0.9
    # OpenCV's undistort rounds places to 1/32 px; the image changes by less than 3.7 counts per px
    assert_allclose(ours[seen], expected[seen], rtol=0, atol=3.7 * np.sqrt(2) / 32)


def test_resampling_to_the_same_model_changes_nothing_and_marks_what_was_not_seen() -> None:
    image = np.random.default_rng(3).uniform(0, 100, (60, 80))
    model = EquidistantModel(fx_px=40.0, fy_px=40.0, cx_px=39.5, cy_px=29.5)
    assert_allclose(resample(image, model, model), image, rtol=0, atol=1e-3)  # places in float32
    wide = resample(image, model, EquidistantModel(fx_px=10.0, fy_px=10.0, cx_px=39.5, cy_px=29.5))
    assert np.isnan(wide[0, 0])
    assert np.isfinite(wide[30, 40])


def test_ifov_of_an_undistorted_camera_is_the_inverse_focal_length_at_the_center() -> None:
    model = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=10.0, cy_px=20.0)
    assert_allclose(ifov_rad(model, [10.0, 20.0]), 1e-3, rtol=0, atol=FLOAT64_DIGIT)


@EACH
def test_models_survive_their_file_form(model: AffineModel) -> None:
    assert model_from_mapping(model_to_mapping(model)) == model
    warm = model.with_parameters([*model.parameters[:-3], 1e-5, 0.0, 1e-9])
    assert model_from_mapping(model_to_mapping(warm)) == warm


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"type": "fisheyes"}, "type must be 'grid' or one of"),
        ({"type": "brown", "fx_px": 1.0, "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0, "k9": 1.0}, "unknown key 'k9'"),
        ({"type": "brown", "fx_px": 1.0}, "'fy_px' is missing"),
        ({"type": "pinhole", "fx_px": "a", "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0}, "fx_px must be a number"),
        ({"type": "pinhole", "fx_px": -1.0, "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0}, "must be > 0"),
    ],
)
def test_a_wrong_model_table_is_refused_with_its_key(table: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        model_from_mapping(table)


def test_a_camera_knows_its_field_with_a_lens_that_leaves_the_corners_dark() -> None:
    lens = EquisolidModel(fx_px=100.0, fy_px=100.0, cx_px=199.5, cy_px=149.5, k1=-0.02)
    camera = Camera(name="sky", columns=400, rows=300, model=lens)
    angles = np.radians([0.0, 60.0, 85.0, 120.0])
    along_x, along_y = directions_at(angles, np.zeros(4)), directions_at(angles, np.full(4, np.pi / 2))
    assert camera.in_field(along_x).tolist() == [True, True, True, True]
    assert camera.in_field(along_y).tolist() == [True, True, True, False]
    assert camera.in_field(along_y, margin_px=20.0).tolist() == [True, True, False, False]
    assert camera.in_field([0.0, 0.0, -1.0]).tolist() is False
    assert np.isnan(lens.unproject([-0.5, -0.5])).all()
    assert np.radians(120.0) < camera.half_diagonal_rad <= np.pi
    assert_allclose(camera.ifov_rad(), 0.01, rtol=FIVE_DIGITS, atol=0)


def test_a_camera_is_windowed_binned_and_warmed_as_its_model_is() -> None:
    model = dataclasses.replace(NAVCAM, a1_per_c=1e-4)
    camera = Camera(name="nav", columns=COLUMNS, rows=ROWS, model=model, psf=GaussianPsf(sigma_px=1.0))
    window = camera.windowed(100, 50, columns=1000, rows=800)
    assert (window.columns, window.rows, window.model) == (1000, 800, model.windowed(100, 50))
    binned = camera.binned(2, detector=Detector(read_noise_e=5.0))
    assert (binned.columns, binned.rows, binned.model) == (1296, 972, model.binned(2))
    assert binned.psf == GaussianPsf(sigma_px=0.5)
    assert binned.detector.read_noise_e == 5.0
    assert camera.at_temperature(-10.0).model == model.at_temperature(-10.0)
    with pytest.raises(InputError, match="must lie on"):
        camera.windowed(2000, 0, columns=1000, rows=800)


PARTS = (
    PartModel(base=FixedGrid(), x0_px=300.0, y0_px=200.0, size_px=4.0),
    PartModel(base=NAVCAM, x0_px=-1.5, y0_px=2.25, size_px=3.0),
)


@pytest.mark.parametrize("part", PARTS, ids=lambda m: m.base.type_name)
def test_part_of_any_model_has_its_directions_and_derivatives(part: PartModel) -> None:
    assert isinstance(part, CameraModel)
    pixels = np.random.default_rng(3).uniform(20.0, 150.0, (50, 2))
    directions = part.unproject(pixels)
    assert_allclose(part.project(7.0 * directions), pixels, rtol=0, atol=ROUND_TRIP_PX)
    base_px = part.size_px * pixels + [part.x0_px, part.y0_px]
    assert_allclose(directions, part.base.unproject(base_px), rtol=0, atol=FLOAT64_DIGIT)
    for analytic, function, at, step in (
        (part.project_jacobian(directions), part.project, directions, 1e-5),
        (part.unproject_jacobian(pixels), part.unproject, pixels, 1e-2),
    ):
        numerical = numerical_jacobian(function, at, step)
        assert_allclose(analytic, numerical, rtol=0, atol=1e-6 * np.abs(numerical).max())
    steps = 1e-4 * np.maximum(np.abs(part.parameters), 1e-3)
    by_parameter = part.parameter_jacobian(directions)
    for k, step in enumerate(steps):
        moved = step * np.eye(len(steps))[k]
        forth, back = (part.with_parameters(part.parameters + sign * moved).project(directions) for sign in (1, -1))
        difference = (forth - back) / (2 * step)
        assert_allclose(by_parameter[..., k], difference, rtol=0, atol=1e-4 * max(np.abs(difference).max(), 1e-3))


def test_blocks_and_windows_of_any_model_are_those_of_the_lenses_that_know_them_themselves() -> None:
    pixels = np.random.default_rng(4).uniform(0.0, 400.0, (50, 2))
    wrapped = PartModel(base=NAVCAM)
    for by_part, by_lens in (
        (wrapped.binned(3), NAVCAM.binned(3)),
        (wrapped.windowed(100, 50).binned(4), NAVCAM.windowed(100, 50).binned(4)),
        (wrapped.binned(4).windowed(10, 20).binned(2), NAVCAM.binned(4).windowed(10, 20).binned(2)),
    ):
        assert_allclose(by_part.unproject(pixels), by_lens.unproject(pixels), rtol=0, atol=10 * FLOAT64_DIGIT)
        assert by_part.focal_length_px == pytest.approx(by_lens.focal_length_px)


def test_a_camera_with_a_lens_of_the_user_is_binned_and_windowed() -> None:
    camera = Camera(name="abi", columns=1024, rows=1024, model=FixedGrid())
    binned = camera.windowed(100, 60, columns=800, rows=800).binned(4, detector=Detector())
    assert (binned.columns, binned.rows) == (200, 200)
    assert_allclose(binned.model.unproject([0.0, 0.0]), camera.model.unproject([101.5, 61.5]), rtol=0, atol=FLOAT64)


@EACH
def test_no_points_at_all_are_no_mistake(model: CameraModel) -> None:
    assert model.project(np.zeros((0, 3))).shape == (0, 2)
    assert model.unproject(np.zeros((3, 0, 2))).shape == (3, 0, 3)
    assert model.project_jacobian(np.zeros((0, 3))).shape == (0, 2, 3)
    assert model.unproject_jacobian(np.zeros((0, 2))).shape == (0, 3, 2)
    assert model.parameter_jacobian(np.zeros((0, 3))).shape == (0, 2, len(model.parameter_names))


@EACH
def test_a_parameter_of_any_size_is_refused_or_gives_a_model_that_works(model: CameraModel) -> None:
    """Overflow within a model would be a warning, which is an error here, or an exception of linear algebra."""
    refused = 0
    for number in range(len(model.parameter_names)):
        for value in (1e308, -1e308, 1e200, 1e30, -1e30, 1e-308):
            parameters = np.array(model.parameters)
            parameters[number] = value
            try:
                changed = model.with_parameters(parameters)
            except InputError:
                refused += 1
                continue
            seen = changed.unproject(np.array([[3.0, 4.0], [600.0, 400.0]]))
            assert seen.shape == (2, 3)
            for derivative in (changed.project_jacobian, changed.parameter_jacobian):
                derivative(np.array([[0.0, 0.0, 1.0], [0.01, 0.02, 1.0]]))
            changed.unproject_jacobian(np.array([[3.0, 4.0]]))
            changed.project(np.array([[0.0, 0.0, 1.0], [0.01, 0.02, 1.0]]))
    assert refused >= 3 * len(model.parameter_names)
