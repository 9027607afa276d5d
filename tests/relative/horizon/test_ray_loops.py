"""Compiled sums over rays near a horizon beside points laid on it by its parametric form."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.relative.horizon.geometry import Figure, PixelRays, horizon_residuals, ray_residuals
from giantlike.relative.horizon.profile import HorizonArc, horizon_arc

PLACE_PX = 1e-4  # 3 px away, where rays are taken to be linear in the pixel
BEND = 1e-3  # relative, of a circle through three points some 2 px apart
RADII_KM = np.array([12.0, 9.0, 7.0])
POSITION_KM = np.array([3.0, -2.0, 400.0])
MODEL = PinholeModel(fx_px=5000.0, fy_px=5000.0, cx_px=512.0, cy_px=512.0)


def _arc() -> tuple[Figure, HorizonArc]:
    figure = Figure(radii_km=RADII_KM, camera_from_axes=Rotation.from_rotvec([0.3, 0.7, -0.4]))
    arc = horizon_arc(MODEL, figure, POSITION_KM)
    assert isinstance(arc, HorizonArc)
    return figure, arc


def test_points_moved_along_normals_are_as_far_from_a_horizon_as_they_were_moved() -> None:
    figure, arc = _arc()
    moved_px = 3.0 * np.sin(np.arange(len(arc.points_px)))
    points_px = arc.points_px + moved_px[:, None] * arc.normals_px
    outward_px, _, normals_px = horizon_residuals(points_px, MODEL, figure, POSITION_KM)
    assert_allclose(outward_px, moved_px, rtol=0, atol=PLACE_PX)
    assert_allclose(normals_px, arc.normals_px, rtol=0, atol=PLACE_PX)


def test_motions_of_a_horizon_with_the_position_are_differences_of_its_distances() -> None:
    figure, arc = _arc()
    rays = PixelRays.through(arc.points_px, MODEL)
    _, by_position, _ = ray_residuals(rays, figure, POSITION_KM)
    for axis, step_km in enumerate(1e-4 * np.eye(3)):
        sides = [ray_residuals(rays, figure, POSITION_KM + sign * step_km)[0] for sign in (1.0, -1.0)]
        assert_allclose(by_position[:, axis], (sides[1] - sides[0]) / 2e-4, rtol=0, atol=1e-5)


def test_the_curvature_of_a_horizon_is_that_of_circles_through_its_points() -> None:
    _, arc = _arc()
    before, here, after = (np.roll(arc.points_px, -step, axis=0) for step in (-2, 0, 2))
    one, other, both = here - before, after - here, after - before
    area = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    lengths = [np.linalg.norm(side, axis=1) for side in (one, other, both)]
    circles = 2.0 * np.abs(area) / (lengths[0] * lengths[1] * lengths[2])
    assert_allclose(arc.curvature, circles, rtol=BEND, atol=0)
