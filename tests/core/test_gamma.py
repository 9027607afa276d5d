"""Coded values, their light, and its noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.causes import Cause
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.core.gamma import Gamma, GammaCurve
from giantlike.core.outcomes import PositionFix
from giantlike.core.pixel_noise import EightBitValues
from giantlike.image import Image
from giantlike.relative import ESTIMATORS
from giantlike.shapes import Ellipsoid
from giantlike.simulation.detector import convert_charge
from tests.limb_images import CAMERA, NEES_LIMIT, body_image
from tests.sizes import slow

CURVES = pytest.mark.parametrize("gamma", ["srgb", 1.0, 1.8, 2.2])
POLYNOMIAL = 1.5  # of sigma: a polynomial with three terms that are not negative, over all of the range
ROUND = 1e-9


def test_the_curve_of_srgb_is_that_of_its_standard() -> None:
    """IEC 61966-2-1: a value of 0.5 is a light of 0.214041, and both pieces meet at 0.04045."""
    curve = GammaCurve(gamma="srgb", full_scale_dn=1.0)
    assert_allclose(curve.light_dn([0.5, 0.04045]), [0.214041, 0.04045 / 12.92], rtol=0, atol=1e-6)
    assert_allclose(curve.light_dn(0.0404501), curve.light_dn(0.0404499), rtol=0, atol=1e-6)


@CURVES
def test_values_of_light_are_the_values_and_the_slope_is_the_derivative(gamma: Gamma) -> None:
    curve = GammaCurve(gamma=gamma, full_scale_dn=255.0)
    values = np.linspace(-20.0, 255.0, 200)
    assert_allclose(curve.values_dn(curve.light_dn(values)), values, rtol=0, atol=1e-4)
    inside = values[np.abs(np.abs(values) - 0.04045 * 255.0) > 0.1]
    numerical = (curve.light_dn(inside + 1e-4) - curve.light_dn(inside - 1e-4)) / 2e-4
    assert_allclose(curve.slope(inside), numerical, rtol=0, atol=1e-4)


@CURVES
def test_noise_of_light_is_what_noise_of_values_becomes(gamma: Gamma) -> None:
    curve, rng = GammaCurve(gamma=gamma, full_scale_dn=255.0), np.random.default_rng(1)
    values = Detector(gain_e_per_dn=5.0, read_noise_e=10.0, step_dn=1.0)
    light = values.of_light(curve)
    for value in (10.0, 40.0, 100.0, 200.0):
        noisy = value + np.sqrt(values.variance_dn2(np.array(value))) * rng.normal(size=20_000)
        drawn, stated = curve.light_dn(noisy).std(), np.sqrt(light.variance_dn2(curve.light_dn(value)))
        assert drawn / POLYNOMIAL < stated < drawn * POLYNOMIAL
    averaged = light.averaged(4).variance_dn2(curve.light_dn(100.0))
    assert averaged == pytest.approx(float(light.variance_dn2(curve.light_dn(100.0))) / 16.0)


def test_a_gamma_of_one_leaves_values_and_their_noise_alone() -> None:
    known = Detector(gain_e_per_dn=5.0, read_noise_e=10.0, step_dn=1.0)
    light, signal = known.of_light(GammaCurve(gamma=1.0, full_scale_dn=255.0)), np.linspace(0.0, 255.0, 20)
    assert_allclose(light.variance_dn2(signal), known.variance_dn2(signal), rtol=1e-6)


def test_gamma_is_a_key_of_the_detector_in_camera_files() -> None:
    table = {"name": "c", "columns": 20, "rows": 20, "fov_deg": 5.0}
    for gamma in ("srgb", 2.2):
        camera = Camera.from_mapping(table | {"detector": {"gamma": gamma}})
        assert camera.detector.gamma == gamma
        assert camera.detector.estimated
        assert Camera.from_mapping(camera.to_mapping()).detector == camera.detector
    for wrong in ("rec709", 0.45, 9.0, True, [2.2]):
        with pytest.raises(InputError, match="gamma"):
            Camera.from_mapping(table | {"detector": {"gamma": wrong}})


def test_an_image_without_a_declared_gamma_is_its_own_linear_one() -> None:
    image = Image(pixels=np.arange(12.0).reshape(3, 4))
    assert image.linearized(Detector()) is image
    with pytest.raises(InputError, match="saturation_dn"):
        image.linearized(Detector(gamma=2.2))
    linear = image.linearized(Detector(gamma=2.0, saturation_dn=100.0, bias_dn=1.0))
    assert_allclose(linear.pixels[1, 2], 1.0 + (6.0 - 1.0) ** 2 / 99.0, rtol=0, atol=ROUND)
    assert linear.detector is not None
    assert linear.detector.gamma is None
    assert linear.linearized(Detector(gamma=2.0, saturation_dn=100.0)) is linear


@pytest.mark.parametrize("name", [slow("cross_correlation"), slow("limb_matching"), "ellipsoid_cra", slow("auto")])
def test_a_body_on_coded_values_is_found_where_it_is_when_the_gamma_is_declared(name: str) -> None:
    linear = dataclasses.replace(
        CAMERA, detector=Detector(gain_e_per_dn=50.0, read_noise_e=40.0, saturation_dn=255.0, bias_dn=0.0)
    )
    case = body_image(Ellipsoid(radii_km=np.array([1.0, 0.97, 0.9])), 5, phase_deg=60.0, peak_dn=200.0, camera=linear)
    curve = GammaCurve(gamma="srgb", full_scale_dn=255.0)
    coded = np.rint(curve.values_dn(np.maximum(case.image.pixels, 0.0))).astype(np.uint8)
    image = Image(pixels=coded, camera_from_inertial=Rotation.identity(), eight_bit=EightBitValues())
    camera = dataclasses.replace(CAMERA, detector=Detector(gamma="srgb", estimated=True))
    fix = ESTIMATORS[name]().estimate(image, camera, case.scene)
    assert isinstance(fix, PositionFix), fix
    assert case.nees(fix) < NEES_LIMIT
    assert not fix.flags.suspect, fix.flags
    assert "response" not in fix.provenance


def test_a_simulated_detector_codes_what_is_linearized() -> None:
    detector = Detector(gamma="srgb", gain_e_per_dn=10.0, saturation_dn=255.0)
    charge_e = np.linspace(0.0, 2550.0, 50).reshape(5, 10)
    image = Image(pixels=convert_charge(charge_e, detector)).linearized(detector)
    rounding = GammaCurve(gamma="srgb", full_scale_dn=255.0).slope(255.0) * 0.5
    assert_allclose(image.pixels, charge_e / 10.0, rtol=0, atol=float(rounding) + ROUND)


@pytest.mark.parametrize("name", [slow("limb_matching"), slow("ellipsoid_cra"), "sigmoid_limb"])
def test_an_undeclared_coding_of_a_display_file_is_an_error_of_the_fix(name: str) -> None:
    linear = dataclasses.replace(
        CAMERA, detector=Detector(gain_e_per_dn=50.0, read_noise_e=40.0, saturation_dn=255.0, bias_dn=0.0)
    )
    case = body_image(Ellipsoid(radii_km=np.array([1.0, 0.97, 0.9])), 5, phase_deg=60.0, peak_dn=200.0, camera=linear)
    curve = GammaCurve(gamma="srgb", full_scale_dn=255.0)
    coded = np.rint(curve.values_dn(np.maximum(case.image.pixels, 0.0))).astype(np.uint8)
    undeclared = dataclasses.replace(CAMERA, detector=Detector(estimated=True))
    fixes = {}
    for eight_bit in (EightBitValues(), None):
        image = Image(pixels=coded, camera_from_inertial=Rotation.identity(), eight_bit=eight_bit)
        fix = ESTIMATORS[name]().estimate(image, undeclared, case.scene)
        assert isinstance(fix, PositionFix), fix
        fixes[eight_bit is not None] = fix
    display, science = fixes[True], fixes[False]
    assert case.nees(display) < NEES_LIMIT
    assert case.nees(display) < case.nees(science)
    added = display.parts[Cause.REFLECTANCE] - science.parts[Cause.REFLECTANCE]
    assert np.linalg.eigvalsh(added)[-1] > 0.0
    assert_allclose(sum(part[:2, :2] for part in display.parts.values()), display.covariance_px2, rtol=1e-6, atol=1e-12)
