"""Rough ground and haze of the independent renderer, beside closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.independent import EllipsoidBody, Haze, PinholeView, Pose, hazy_sphere, render_body, rough

VIEW = PinholeView(focal_px=2000.0, center_px=(31.5, 31.5), columns=64, rows=64)
POSE = Pose((0.0, 0.0, 100_000.0), Rotation.identity(), (np.sin(0.7), 0.0, -np.cos(0.7)))
RADIUS_KM = 1000.0  # 20 px


@pytest.mark.slow
def test_rough_ground_neither_scales_nor_moves_a_sphere_and_its_power_falls_with_the_degree() -> None:
    field = rough(3, rms=1e-3, degrees=(2.5, 200.0), count=400, cells=256)
    directions = np.random.default_rng(1).normal(size=(60_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    heights = field(directions)
    assert_allclose(heights.std(), 1e-3, rtol=0, atol=3e-5)
    assert abs(heights.mean()) < 1e-5
    assert_allclose(directions.T @ heights / len(heights), 0.0, rtol=0, atol=1e-5)
    # Of a field whose variance per degree falls as n^-2, differences over an angle grow as the root of it.
    axis = np.cross(directions, [0.3, -0.5, 0.8])
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    apart = [np.mean((field(np.cos(a) * directions + np.sin(a) * axis) - heights) ** 2) for a in (0.05, 0.2)]
    assert 2.5 < apart[1] / apart[0] < 6.0


def test_a_sphere_in_haze_that_is_next_to_nothing_is_a_bare_sphere() -> None:
    bare = render_body(EllipsoidBody(radii_km=RADIUS_KM), VIEW, POSE, law="lambert", peak_dn=None)
    clear = hazy_sphere(RADIUS_KM, Haze(scale_height_km=5.0, vertical_depth=1e-9), VIEW, POSE)
    assert_allclose(clear, bare, rtol=0, atol=0.03)  # cells of a third of a pixel at the limb
    columns = np.arange(64)
    shift = (clear.sum(axis=0) @ columns) / clear.sum() - (bare.sum(axis=0) @ columns) / bare.sum()
    assert abs(shift) < 0.01


def test_thick_haze_is_as_bright_as_its_albedo_and_larger_than_the_sphere() -> None:
    """Light that enters haze of depth t under the cosine m0 and leaves it under m: m0 / (m0 + m) of its albedo."""
    thick = hazy_sphere(RADIUS_KM, Haze(scale_height_km=10.0, vertical_depth=30.0, albedo=1.0), VIEW, POSE)
    assert_allclose(thick[31, 31], np.cos(0.7) / (np.cos(0.7) + 1.0), rtol=0, atol=0.02)
    bare = hazy_sphere(RADIUS_KM, Haze(scale_height_km=10.0, vertical_depth=1e-9), VIEW, POSE)
    lit = slice(32, 64)
    assert (thick[31, lit] > 0.2).sum() > (bare[31, lit] > 0.2).sum()
