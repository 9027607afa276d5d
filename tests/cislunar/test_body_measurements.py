"""Measurement models of bodies: the equations of the paper on Orion with its numbers, and both directions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from giantlike.cislunar.body_measurements import (
    TangentCamera,
    angular_diameter,
    disk_diameter,
    measure_body,
    measurement_partials,
    position_from_measurement,
    range_from_disk_diameter,
    range_per_diameter,
    range_sigma,
)
from giantlike.core.errors import InputError
from tests.numerical import numerical_jacobian
from tests.tolerances import FIVE_DIGITS, FLOAT64, FLOAT64_CHAIN, SETTLED

MOON_KM = 1737.4
FOCAL_MM, PITCH_MM = 35.1, 4.8e-3  # the paper's camera
places = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(2e3, 4e5))


def test_the_focal_length_in_pixels_is_that_of_equation_21() -> None:
    camera = TangentCamera(np.full(2, FOCAL_MM / PITCH_MM), np.zeros(2))
    per_px = camera.tangent_sigmas([1.0, 1.0])
    assert_allclose(per_px, 1.3675e-4, rtol=FIVE_DIGITS)
    assert_allclose(np.degrees(per_px) * 3600.0, 28.2, atol=0.05)  # as the paper rounds it


def test_equations_13_and_14_have_pixels_grow_against_the_tangents() -> None:
    camera = TangentCamera(np.full(2, -FOCAL_MM / PITCH_MM), np.array([1295.5, 971.5]))
    pixels = camera.pixels([0.01, -0.02])
    assert_allclose(pixels, [1295.5 - 73.125, 971.5 + 146.25], atol=FLOAT64_CHAIN)
    assert_allclose(camera.tangents(pixels), [0.01, -0.02], atol=FLOAT64)


def test_the_disk_is_cut_from_the_tangent_cone() -> None:
    """Equations 4 to 10 name one diameter by sine, by tangent and by the range."""
    ranges = np.array([2e3, 5e4, 4e5])
    across = disk_diameter(ranges, MOON_KM)
    angle = angular_diameter(ranges, MOON_KM)
    assert_allclose(np.sin(angle / 2.0), MOON_KM / ranges, rtol=FLOAT64)
    assert_allclose(2.0 * np.tan(angle / 2.0), across, rtol=FLOAT64)
    assert_allclose(np.sin(angle / 2.0), across / np.sqrt(across**2 + 4.0), rtol=FLOAT64)


@given(places)
def test_a_position_comes_back_from_its_measurement(place: tuple[float, float, float]) -> None:
    position = np.array([place[0] * place[2], place[1] * place[2], place[2]])
    measured = measure_body(position, MOON_KM)
    assert_allclose(position_from_measurement(measured), position, rtol=FLOAT64_CHAIN, atol=1e-9)
    across = disk_diameter(measured[2], MOON_KM)
    assert_allclose(range_from_disk_diameter(across, MOON_KM), measured[2], rtol=FLOAT64_CHAIN)


@given(places)
def test_the_partials_are_those_of_the_measurement(place: tuple[float, float, float]) -> None:
    position = np.array([place[0] * place[2], place[1] * place[2], place[2]])
    step = 1e-4 * place[2]
    numeric = numerical_jacobian(lambda at: measure_body(at, 1.0), position, step)
    scale = np.array([place[2], place[2], 1.0])[:, None]
    assert_allclose(scale * measurement_partials(position), scale * numeric, atol=1e-6)  # (1e-4)^2 and rounding


def test_the_range_error_of_equation_24_is_the_derivative_of_equation_11() -> None:
    across = disk_diameter(1e5, MOON_KM)
    step = 1e-5 * across
    nearer, farther = (range_from_disk_diameter(across + sign * step, MOON_KM) for sign in (1.0, -1.0))
    assert_allclose(range_per_diameter(1e5, MOON_KM), (nearer - farther) / (2.0 * step), rtol=SETTLED)


def test_the_range_sigma_becomes_that_of_equation_26_far_away() -> None:
    near, far = (range_sigma(3e3, radius, 600.0, 0.3) for radius in (MOON_KM, 0.0))
    assert near < 0.7 * far
    assert_allclose(range_sigma(4e5, MOON_KM, 63.5, 0.24), 4e5 / 63.5 * 0.24, rtol=2e-5)  # (R / range)^2


@pytest.mark.parametrize("bad", [[0.0, 0.0, -1e5], [0.0, 0.0, 1e3]])
def test_a_body_behind_the_camera_or_around_it_is_refused(bad: list[float]) -> None:
    with pytest.raises(InputError, match=r"turn the camera|exceed the radius"):
        measure_body(bad, MOON_KM)
