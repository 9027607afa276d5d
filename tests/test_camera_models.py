"""Camera models against OpenCV, against their own inverse, and against numerical derivatives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.camera_models import (
    BrownModel,
    CameraModel,
    PinholeModel,
    ifov_rad,
    model_from_mapping,
    model_to_mapping,
)
from giantlike.core.errors import InputError
from tests.numerical import numerical_jacobian

ROUND_TRIP_PX = 1e-9  # float64 rounding at 3,000 px, with room for Newton's last step
OPENCV_PX = 1e-9  # the same formula in the same precision
JACOBIAN_RELATIVE = 1e-7  # central differences with a step of the cube root of float64 rounding

# NavCam 1 of the OSIRIS-REx paper, Table 1, y axis turned to point along increasing rows
NAVCAM = BrownModel(
    fx_px=3473.3, fy_px=3473.4, cx_px=1268.7, cy_px=949.6, k1=-0.539, k2=0.388, k3=-0.214, p1=-2.55e-4, p2=8.64e-4
)  # fmt: skip
SHEARED = PinholeModel(fx_px=900.0, fy_px=880.0, cx_px=511.0, cy_px=512.0, skew_px=3.0)
MODELS = pytest.mark.parametrize("model", [NAVCAM, SHEARED], ids=lambda m: m.type_name)


def pixels_over_the_frame(count: int = 2000) -> np.ndarray:
    return np.random.default_rng(1).uniform([-0.5, -0.5], [2591.5, 1943.5], (count, 2))


@MODELS
def test_projecting_an_unprojected_pixel_gives_the_pixel_back(model: CameraModel) -> None:
    pixels = pixels_over_the_frame()
    assert_allclose(model.project(model.unproject(pixels)), pixels, rtol=0, atol=ROUND_TRIP_PX)


def test_brown_projects_where_opencv_does() -> None:
    points = NAVCAM.unproject(pixels_over_the_frame()) * 7.0
    # OpenCV's p1, p2 have the same meaning as the paper's eq. 7
    matrix = np.array([[NAVCAM.fx_px, 0, NAVCAM.cx_px], [0, NAVCAM.fy_px, NAVCAM.cy_px], [0, 0, 1]])
    distortion = np.array([NAVCAM.k1, NAVCAM.k2, NAVCAM.p1, NAVCAM.p2, NAVCAM.k3])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    assert_allclose(NAVCAM.project(points), expected[:, 0], rtol=0, atol=OPENCV_PX)


@MODELS
def test_jacobians_agree_with_numerical_differences(model: CameraModel) -> None:
    pixels = pixels_over_the_frame(50)
    points = model.unproject(pixels)
    scale = model.focal_length_px
    by_point = numerical_jacobian(model.project, points, 1e-5)
    assert_allclose(model.project_jacobian(points), by_point, rtol=0, atol=JACOBIAN_RELATIVE * scale)
    by_pixel = numerical_jacobian(model.unproject, pixels, 1e-2)
    assert_allclose(model.unproject_jacobian(pixels) * scale, by_pixel * scale, rtol=0, atol=JACOBIAN_RELATIVE)


@MODELS
def test_parameter_jacobian_agrees_with_numerical_differences(model: CameraModel) -> None:
    points = model.unproject(pixels_over_the_frame(50))
    analytic = model.parameter_jacobian(points)
    for k, value in enumerate(model.parameters):
        step = np.zeros(len(model.parameter_names))
        step[k] = 1e-5 * max(1.0, abs(value))
        ahead = model.with_parameters(model.parameters + step).project(points)
        behind = model.with_parameters(model.parameters - step).project(points)
        assert_allclose(
            analytic[..., k],
            (ahead - behind) / (2 * step[k]),
            rtol=0,
            atol=JACOBIAN_RELATIVE * max(1.0, float(np.abs(analytic[..., k]).max())),
            err_msg=model.parameter_names[k],
        )


@MODELS
def test_a_warm_camera_magnifies_about_the_principal_point(model: CameraModel) -> None:
    terms = dict(zip(model.parameter_names, model.parameters, strict=True))
    terms |= {"a1_per_c": 2e-5, "a2_per_c2": -3e-7, "a3_per_c3": 4e-9}
    cold = model.with_parameters(list(terms.values()))
    points, centre = model.unproject(pixels_over_the_frame(50)), [terms["cx_px"], terms["cy_px"]]
    magnification = 1.0 - 20.0 * 2e-5 - 400.0 * 3e-7 - 8000.0 * 4e-9
    warm = cold.at_temperature(-20.0)
    expected = centre + magnification * (cold.project(points) - centre)
    assert_allclose(warm.project(points), expected, rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(warm.at_temperature(50.0).project(points), expected, rtol=0, atol=ROUND_TRIP_PX)


@MODELS
def test_parameter_jacobian_holds_at_a_temperature_for_every_parameter(model: CameraModel) -> None:
    warm_c = 30.0
    points = model.unproject(pixels_over_the_frame(50))
    values = model.parameters + np.array([name == "a1_per_c" for name in model.parameter_names]) * 1e-4
    model = model.with_parameters(values)
    steps = 1e-5 * np.maximum(1.0, np.abs(values)) / np.where(values == 1e-4, 1e3, 1.0)
    steps = np.array(
        [step / warm_c ** int(name[1]) if name.startswith("a") else step
         for name, step in zip(model.parameter_names, steps, strict=True)]
    )  # fmt: skip
    analytic = model.parameter_jacobian(points, temperature_c=warm_c)
    for k, step in enumerate(np.diag(steps)):
        ahead = model.with_parameters(values + step).at_temperature(warm_c).project(points)
        behind = model.with_parameters(values - step).at_temperature(warm_c).project(points)
        atol = JACOBIAN_RELATIVE * max(1.0, float(np.abs(analytic[..., k]).max()))
        difference = (ahead - behind) / (2 * steps[k])
        assert_allclose(analytic[..., k], difference, rtol=0, atol=atol, err_msg=model.parameter_names[k])


def test_points_behind_the_camera_or_beyond_the_fold_are_nan() -> None:
    behind, folded = NAVCAM.project([[0.1, 0.0, -1.0], [NAVCAM.max_radius * 1.01, 0.0, 1.0]])
    assert np.isnan(behind).all()
    assert np.isnan(folded).all()
    assert np.isfinite(NAVCAM.project([NAVCAM.max_radius * 0.99, 0.0, 1.0])).all()
    assert np.isnan(NAVCAM.unproject([1e5, 1e5])).all()


def test_the_fold_is_where_the_radial_map_stops_growing() -> None:
    r = np.linspace(0, NAVCAM.max_radius, 1000)
    mapped = r * (1 + NAVCAM.k1 * r**2 + NAVCAM.k2 * r**4 + NAVCAM.k3 * r**6)
    assert (np.diff(mapped) > 0).all()
    assert BrownModel(fx_px=1, fy_px=1, cx_px=0, cy_px=0, k1=0.1).max_radius == np.inf


def test_ifov_of_an_undistorted_camera_is_the_inverse_focal_length_at_the_centre() -> None:
    model = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=10.0, cy_px=20.0)
    assert_allclose(ifov_rad(model, [10.0, 20.0]), 1e-3, rtol=0, atol=1e-15)


@MODELS
def test_models_survive_their_file_form(model: CameraModel) -> None:
    assert model_from_mapping(model_to_mapping(model)) == model


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"type": "fisheyes"}, "type must be one of"),
        ({"type": "brown", "fx_px": 1.0, "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0, "k9": 1.0}, "unknown key 'k9'"),
        ({"type": "brown", "fx_px": 1.0}, "fy_px is missing"),
        ({"type": "pinhole", "fx_px": "a", "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0}, "fx_px must be a number"),
        ({"type": "pinhole", "fx_px": -1.0, "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0}, "must be > 0"),
    ],
)
def test_a_wrong_model_table_is_refused_with_its_key(table: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        model_from_mapping(table)
