"""The independent renderer against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.independent import (
    EllipsoidBody,
    Motion,
    PinholeView,
    Pose,
    Psf,
    ReliefBody,
    Sampling,
    SphereField,
    apparent_disk,
    bumps,
    render_body,
)
from giantlike.independent.laws import Float

CENTROID_PX = 1e-3  # 30 rays a pixel along a limb of 300 px: 2e-4 px
AREA = 3e-5  # of the disk
FOCAL_PX = 5000.0
TURN = Rotation.from_rotvec([0.4, -0.9, 0.3])


def flat(cos_incidence: Float, cos_emission: Float, cos_phase: Float) -> Float:
    return np.ones_like(cos_incidence)


def centroid(image: Float) -> Float:
    rows, columns = np.indices(image.shape)
    return np.asarray([(image * columns).sum(), (image * rows).sum()], dtype=float) / float(image.sum())


def at(pixel: tuple[float, float], view: PinholeView, distance: float) -> Float:
    return np.asarray(view.directions(pixel) * distance, dtype=float)


def outline_conic(radii: Float, position: Float, turn: Rotation) -> tuple[Float, float]:
    """Center (plane coordinates) and area of the outline of an ellipsoid, by the polar cone of the camera."""
    shape = turn.as_matrix() @ np.diag(1.0 / radii**2) @ turn.as_matrix().T
    side = shape @ position
    cone = np.outer(side, side) - (position @ side - 1.0) * shape
    block, rest = cone[:2, :2], cone[:2, 2]
    center = -np.linalg.solve(block, rest)
    level = cone[2, 2] + rest @ center
    return np.asarray(center, dtype=float), float(np.pi * abs(level) / np.sqrt(np.linalg.det(block)))


def test_a_flat_disk_has_the_area_and_center_of_the_outline_of_the_ellipsoid() -> None:
    view = PinholeView(FOCAL_PX, (160.3, 170.7), 340, 330)
    radii = np.array([3.0, 2.6, 2.1])
    position = at((171.2, 163.9), view, 100.0)
    toward = -position / np.linalg.norm(position)
    image = render_body(EllipsoidBody(radii), view, Pose(position, TURN, toward), law=flat, peak_dn=None)
    center, area = outline_conic(radii, position, TURN)
    # Seen and lit from the same place up to parallax: the ground that is seen but dark is foreshortened to nothing.
    np.testing.assert_allclose(centroid(image), FOCAL_PX * center + view.center_px, rtol=0, atol=CENTROID_PX)
    assert abs(image.sum() / (area * FOCAL_PX**2) - 1.0) < AREA


@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 90.0, 125.0])
def test_the_light_of_a_lambert_sphere_follows_the_phase_integral(phase_deg: float) -> None:
    view = PinholeView(6e7, (80.0, 80.0), 161, 161)  # a million radii away: the closed forms are for parallel rays
    phase = np.radians(phase_deg)
    distance = 1e6
    sun = np.array([np.sin(phase), 0.0, -np.cos(phase)])
    pose = Pose(at((80.0, 80.0), view, distance), TURN, sun)
    image = render_body(EllipsoidBody(1.0), view, pose, law="lambert", peak_dn=None)
    expected = 2.0 / 3.0 / np.pi * (np.sin(phase) + (np.pi - phase) * np.cos(phase)) * np.pi * 60.0**2
    assert abs(image.sum() / expected - 1.0) < 2e-4
    # Center of light of a Lambert sphere: 3 pi / 16 (1 + cos a) sin a ... / (sin a + (pi - a) cos a) radii to the Sun.
    offset = (
        3.0 * np.pi / 16.0 * np.sin(phase) * (1.0 + np.cos(phase)) / (np.sin(phase) + (np.pi - phase) * np.cos(phase))
    )
    np.testing.assert_allclose(centroid(image), [80.0 + 60.0 * offset, 80.0], rtol=0, atol=2e-3)


def test_a_sphere_with_flat_relief_is_the_sphere() -> None:
    view = PinholeView(FOCAL_PX, (50.2, 49.7), 100, 100)
    pose = Pose(at((50.0, 50.0), view, FOCAL_PX / 40.0), TURN, [np.sin(1.0), 0.0, -np.cos(1.0)])
    level = bumps(1, rms=1e-12, count=2, cells=64)
    ball = SphereField(values=level.values + 0.05, gradients=level.gradients)
    expected = render_body(EllipsoidBody(1.05), view, pose)
    image = render_body(ReliefBody(1.0, ball), view, pose)
    assert np.abs(image - expected).max() < 3.0  # DN of 3,000: 0.001 px at the limb
    np.testing.assert_allclose(centroid(image), centroid(expected), rtol=0, atol=CENTROID_PX)


def test_normals_of_relief_are_derivatives_of_its_heights() -> None:
    body = ReliefBody([1.0, 0.9, 0.8], bumps(3, rms=0.02, count=20, cells=512))
    directions = np.random.default_rng(4).normal(size=(200, 3))
    hits = body.intersect(np.array([0.0, 0.0, -50.0]), np.array([0.0, 0.0, 1.0]) + 0.01 * directions * [1, 1, 0])
    step = 1e-3

    def level(points: Float) -> Float:
        scaled = points / [1.0, 0.9, 0.8]
        return np.asarray(np.linalg.norm(scaled, axis=1) - 1.0 - body.relief(scaled), dtype=float)

    assert len(hits.points) > 100
    assert np.abs(level(hits.points)).max() < 1e-6
    slopes = np.stack(
        [level(hits.points + step * axis) - level(hits.points - step * axis) for axis in np.eye(3)], axis=1
    )
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    assert np.median(np.abs(slopes - hits.normals)) < 2e-3


def test_more_rays_and_cells_do_not_move_the_light() -> None:
    view = PinholeView(FOCAL_PX, (60.0, 60.0), 120, 120)
    pose = Pose(at((60.3, 59.6), view, FOCAL_PX / 50.0), TURN, [np.sin(1.2), 0.0, -np.cos(1.2)])
    body = EllipsoidBody([1.0, 0.9, 0.8])
    usual = render_body(body, view, pose, law="lommel_seeliger")
    dense = render_body(body, view, pose, law="lommel_seeliger", sampling=Sampling(cells=5, edge_rays=6))
    np.testing.assert_allclose(centroid(usual), centroid(dense), rtol=0, atol=2e-3)
    assert np.abs(usual - dense).max() < 40.0  # DN of 3,000: below the noise of a pixel, 55 DN


def test_wings_keep_the_light_and_its_center() -> None:
    view = PinholeView(FOCAL_PX, (80.0, 80.0), 160, 160)
    pose = Pose(at((80.3, 79.6), view, FOCAL_PX / 20.0), TURN, [np.sin(1.2), 0.0, -np.cos(1.2)])
    sharp = render_body(EllipsoidBody(1.0), view, pose, peak_dn=None)
    wide = Psf(sigma_px=0.7, wing_share=0.2, wing_sigma_px=5.0, motion_px=(2.0, 1.0))
    soft = render_body(EllipsoidBody(1.0), view, pose, peak_dn=None, psf=wide)
    assert abs(soft.sum() / sharp.sum() - 1.0) < 1e-6
    np.testing.assert_allclose(centroid(soft), centroid(sharp), rtol=0, atol=1e-4)


def test_ray_by_ray_aberration_moves_and_scales_a_disk_as_tangent_photons_do() -> None:
    view = PinholeView(100_000.0, (100.0, 100.0), 201, 201)
    position = np.array([0.0, 0.0, 100_000.0 / 60.0])
    swift = Motion(observer_km_s=(40.0, -20.0, 3000.0), body_km_s=(10.0, 5.0, -2000.0))
    axis, half = apparent_disk(position, 1.0, swift)
    toward = np.array([0.0, 0.0, -1.0])
    image = render_body(EllipsoidBody(1.0), view, Pose(position, TURN, toward, swift), law=flat, peak_dn=None)
    still = render_body(EllipsoidBody(1.0), view, Pose(position, TURN, toward), law=flat, peak_dn=None)
    np.testing.assert_allclose(centroid(image), view.project(axis), rtol=0, atol=2e-3)
    ratio = np.sqrt(image.sum() / still.sum())
    assert abs(ratio / (half / np.arcsin(1.0 / position[2])) - 1.0) < 1e-4
    assert abs(ratio - 1.0) > 5e-3  # the effect is there to be seen


def test_bumps_neither_scale_nor_move_a_sphere() -> None:
    relief = bumps(5, rms=0.05, cells=128)
    step = np.arange(200)
    # Points of a golden spiral cover the sphere evenly.
    height, turn = 1.0 - (2.0 * step + 1.0) / 200.0, step * np.pi * (3.0 - np.sqrt(5.0))
    side = np.sqrt(1.0 - height**2)
    directions = np.stack([side * np.cos(turn), side * np.sin(turn), height], axis=1)
    heights = relief(directions)
    assert abs(heights.std() / 0.05 - 1.0) < 0.1
    np.testing.assert_allclose((heights[:, None] * directions).mean(axis=0), 0.0, rtol=0, atol=2e-3)
    assert abs(heights.mean()) < 2e-3


@pytest.mark.parametrize("phase_deg", [60.0, 120.0, 150.0])
def test_the_center_of_light_of_a_tiny_sphere_is_that_of_its_closed_form(phase_deg: float) -> None:
    view = PinholeView(1e6, (20.0, 20.0), 41, 41)
    phase = np.radians(phase_deg)
    pose = Pose(at((20.3, 20.1), view, 1e6), TURN, [np.sin(phase), 0.0, -np.cos(phase)])
    image = render_body(EllipsoidBody(1.0), view, pose, law="lambert")
    offset = (
        3.0 * np.pi / 16.0 * np.sin(phase) * (1.0 + np.cos(phase)) / (np.sin(phase) + (np.pi - phase) * np.cos(phase))
    )
    np.testing.assert_allclose(centroid(image), [20.3 + offset, 20.1], rtol=0, atol=2e-3)


@pytest.mark.parametrize("off", range(17, 26, 2))  # from where the optics bring light into the frame to where not
def test_a_body_beside_the_frame_leaves_it_dark_but_for_its_wings(off: int) -> None:
    view = PinholeView(FOCAL_PX, (60.0, 60.0), 120, 120)
    turned = [(60.0, -float(off)), (60.0, 119.0 + off), (-float(off), 60.0), (119.0 + off, 60.0)]
    poses = [Pose(at(place, view, 2000.0), TURN, np.array([0.0, 0.0, -1.0])) for place in turned]
    images = [render_body(EllipsoidBody(np.array([4.0, 4.0, 4.0])), view, pose, peak_dn=None) for pose in poses]
    assert max(float(image.max()) for image in images) < 1e-3
