"""Air over a surface, against sums along rays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from giantlike import InputError
from giantlike.ray_tracing import Lambert
from giantlike.ray_tracing.air import Air, Black


def slant_depth(cosine: float, scale_height: float) -> float:
    """Depth along a ray from the surface of a sphere of radius 1, over the vertical one."""

    def density(way: float) -> float:
        return math.exp(-(math.sqrt(1.0 + 2.0 * way * cosine + way**2) - 1.0) / scale_height) / scale_height

    turning = max(-cosine, 0.0)
    reach = 60.0 * math.sqrt(scale_height)
    return sum(quad(density, *ends, limit=200)[0] for ends in ((0.0, turning), (turning, turning + reach)))


@pytest.mark.parametrize("scale_height", [0.0003, 0.0011, 0.005])
@pytest.mark.parametrize("depression", [-8.0, -2.0, -0.5, 0.0, 0.5, 1.0, 1.5])
def test_the_slant_cosine_is_the_inverse_of_the_depth_along_a_ray(depression: float, scale_height: float) -> None:
    cosine = -depression * math.sqrt(2.0 * scale_height)
    found = float(Air(scale_height=scale_height, optical_depth=1.0).slant_cosine(cosine))
    assert found * slant_depth(cosine, scale_height) == pytest.approx(1.0, abs=8.0 * scale_height)


def test_ground_is_seen_through_thin_air_and_none_through_thick_air() -> None:
    angles = np.array([0.9, 0.5, 0.2]), np.array([0.8, 0.7, 0.9]), np.full(3, 0.5)
    thin, thick = (Air(scale_height=0.001, optical_depth=depth) for depth in (1e-9, 1e3))
    assert np.allclose(thin.brightness(Lambert(), *angles), Lambert()(*angles), rtol=1e-7)
    assert np.allclose(thick.brightness(Lambert(), *angles), thick.brightness(Black(), *angles))


def test_air_is_lit_beyond_the_terminator_up_to_where_the_shadow_stands_above_it() -> None:
    air = Air(scale_height=0.001, optical_depth=0.1)
    depressions = np.array([0.0, 0.5, 1.0, 2.0, 3.0]) * math.sqrt(2.0 * air.scale_height)
    light = air.brightness(Lambert(), -np.sin(depressions), np.full(5, 0.05), np.full(5, 0.1))
    assert np.all(np.diff(light) < 0.0)
    assert light[1] > 0.3 * light[0] > 0.0
    assert light[-1] < 1e-3 * light[0]
    assert air.least_cosine == pytest.approx(-math.sin(depressions[-1]), rel=0.01)


def test_air_needs_a_scale_height_and_a_depth() -> None:
    with pytest.raises(InputError, match="scale_height"):
        Air(scale_height=0.0, optical_depth=0.1)
    with pytest.raises(InputError, match="optical_depth"):
        Air(scale_height=0.1, optical_depth=0.0)
