"""Error models of bodies in images: equations 27 to 38 of the paper on Orion, in its feet and pixels."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.cislunar import BodyErrorModel
from giantlike.core.errors import InputError
from tests.tolerances import FIVE_DIGITS, FLOAT64

FOOT_KM = 3.048e-4
RELIEF_PX_FT = 7291.7 * 6562.0
MOON = BodyErrorModel(
    noise_px=np.array([0.15, 0.06, 0.12]),
    relief_px_km=RELIEF_PX_FT * FOOT_KM * np.array([1.0, 0.5, 1.0]),
    bias_px=np.array([0.383, 0.0, -0.236]),
    bias_px_km=np.array([-3.470e8, 0.0, -1.964e8]) * FOOT_KM,
)


@pytest.mark.parametrize("range_km", [2e4, 1e5, 4e5])
def test_the_moon_has_the_sigmas_of_equations_28_to_30(range_km: float) -> None:
    relief = RELIEF_PX_FT / (range_km / FOOT_KM)
    expected = [np.hypot(0.15, relief), np.hypot(0.06, relief / 2.0), np.hypot(0.12, relief)]
    assert_allclose(MOON.sigmas_px(range_km), expected, rtol=FLOAT64)


def test_the_moon_has_the_biases_of_equations_31_to_33() -> None:
    ranges_ft = np.array([1e8, 1e9])
    expected = [[0.383 - 3.470e8 / each, 0.0, -0.236 - 1.964e8 / each] for each in ranges_ft]
    assert_allclose(MOON.biases_px(ranges_ft * FOOT_KM), expected, rtol=FLOAT64)


def test_errors_turn_with_the_sun_in_the_image() -> None:
    sigmas = MOON.sigmas_px(1e5)
    upright = MOON.covariance_px2(1e5, [0.0, 3.0])
    assert_allclose(np.diag(upright), np.array([sigmas[1], sigmas[0], sigmas[2]]) ** 2, rtol=FLOAT64)
    slanted = MOON.covariance_px2(1e5, [1.0, 1.0])
    assert_allclose(slanted[0, 1], (sigmas[0] ** 2 - sigmas[1] ** 2) / 2.0, rtol=FLOAT64)
    assert_allclose(MOON.bias_in_image_px(1e5, [0.0, 1.0])[1], MOON.biases_px(1e5)[0], rtol=FLOAT64)


def test_sigmas_reach_the_filter_by_equations_19_20_and_25() -> None:
    focal_px, radius_km, range_km = 7312.5, 1737.4, 3e5
    along, across, radius = MOON.sigmas_px(range_km)
    diameter_px = 2.0 * focal_px * radius_km / np.sqrt(range_km**2 - radius_km**2)
    of_range = (range_km**2 - radius_km**2) / range_km * 2.0 * radius / diameter_px
    sigmas = MOON.measurement_sigmas(range_km, radius_km, focal_px)
    assert_allclose(sigmas, [along / focal_px, across / focal_px, of_range], rtol=FLOAT64)


def test_a_radius_too_small_makes_the_range_too_long() -> None:
    biases = MOON.measurement_biases(3e5, 1737.4, 7312.5)
    radius_bias = -0.236 - 1.964e8 * FOOT_KM / 3e5
    assert_allclose(biases[2], -(3e5**2) / 1737.4 * radius_bias / 7312.5, rtol=FIVE_DIGITS)  # (R / range)^2


def test_a_sun_without_direction_in_the_image_is_refused() -> None:
    with pytest.raises(InputError, match="no direction"):
        MOON.covariance_px2(1e5, [0.0, 0.0])
