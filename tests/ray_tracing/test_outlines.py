"""Outlines in the image: exact at every range, the same however the axes lie, and moving as their derivatives say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.frames import rotate
from giantlike.ray_tracing import Body, Silhouette, trace_silhouette
from giantlike.ray_tracing.silhouette import lit_outline, outline_points_px
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh, irregular_body, mesh_from_ellipsoid
from tests.numerical import numerical_jacobian
from tests.tolerances import FLOAT64_SUM

OUTLINE_PX = 2e-6  # float64 at 1e6 radii from a camera of 1e9 px focal length; the requirement is 1e-4 px
HIT = 1e-12  # of the range: float64; the requirement is 1e-9
MOTION_PX = 1e-4  # px/km, of derivatives of some 150 px/km by differences over 1e-4 km, where rounding is 1e-12 px

ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.6]))
POLYHEDRON = mesh_from_ellipsoid(ELLIPSOID, facets=500)
TILTED = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
SUN = np.array([0.8, 0.1, -0.6]) / np.linalg.norm([0.8, 0.1, -0.6])
BROWN = BrownModel(
    fx_px=1500.0, fy_px=1510.0, cx_px=640.0, cy_px=500.0, skew_px=1.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4
)
CIRCLE = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False) + 0.01
RANGES_KM = [2.0, 10.0, 1e3, 1e6]  # of a body with radius 1 km
DIAMETER_PX = 2000.0


def _view(shape: Shape, range_km: float) -> tuple[Body, PinholeModel]:
    """A view that shows the long axis of the body some ``DIAMETER_PX`` long."""
    focal_px = 0.5 * DIAMETER_PX * range_km
    body = Body(shape=shape, camera_from_body=TILTED, position_camera_km=range_km * np.array([1e-3, 2e-3, 1.0]))
    return body, PinholeModel(fx_px=focal_px, fy_px=1.01 * focal_px, cx_px=1000.0, cy_px=900.0)


def _outline(body: Body, model: CameraModel, **options: object) -> Silhouette:
    return trace_silhouette(body, model, CIRCLE, sun_direction_camera=SUN, **options)  # type: ignore[arg-type]


def _conic_distance_px(body: Body, model: PinholeModel, points_px: np.ndarray) -> np.ndarray:
    """First-order distance of pixels from the image of the limb: zero of the discriminant of ray and ellipsoid.

    The discriminant is (x.A.s)^2 - (x.A.x) (s.A.s - 1); its first two terms do not change when a multiple of the
    position s is taken from the ray x, which saves the digits that a long range would cost.
    """
    turn = body.camera_from_body.as_matrix()
    matrix = turn @ np.diag(ELLIPSOID.radii_km**-2) @ turn.T
    position = body.position_camera_km

    def discriminant(pixels: np.ndarray) -> np.ndarray:
        offsets = np.zeros((len(pixels), 3))
        offsets[:, :2] = (pixels - model.project(position)) / [model.fx_px, model.fy_px]
        rays = position / position[2] + offsets
        pull, strength = matrix @ position, position @ matrix @ position
        crosswise = (offsets @ pull) ** 2 - np.einsum("ki,ij,kj->k", offsets, matrix, offsets) * strength
        return np.asarray(crosswise + np.einsum("ki,ij,kj->k", rays, matrix, rays))

    step = 1e-2
    gradient = [(discriminant(points_px + e) - discriminant(points_px - e)) / (2 * step) for e in np.eye(2) * step]
    return np.asarray(discriminant(points_px) / np.linalg.norm(gradient, axis=0))


@pytest.mark.parametrize("range_km", RANGES_KM)
def test_the_outline_of_an_ellipsoid_lies_on_its_conic_at_every_range(range_km: float) -> None:
    body, model = _view(ELLIPSOID, range_km)
    found = _outline(body, model)
    assert found.valid.all()
    assert np.abs(_conic_distance_px(body, model, found.points_px)).max() < OUTLINE_PX
    on_surface = body.to_body(found.points_camera_km - body.position_camera_km) / ELLIPSOID.radii_km
    assert_allclose(np.sum(on_surface**2, axis=1), 1.0, rtol=0, atol=HIT * range_km)


@pytest.mark.parametrize("range_km", RANGES_KM)
def test_the_outline_of_a_convex_mesh_is_the_hull_of_its_projected_corners_at_every_range(range_km: float) -> None:
    body, model = _view(POLYHEDRON, range_km)
    found = _outline(body, model)
    corners = model.project(body.to_camera(POLYHEDRON.vertices_km) + body.position_camera_km)
    hull = ConvexHull(corners).equations
    assert found.valid.all()
    assert np.abs((found.points_px @ hull[:, :2].T + hull[:, 2]).max(axis=1)).max() < OUTLINE_PX
    offsets = found.points_px - found.center_px
    across = offsets[:, 0] * np.sin(CIRCLE) - offsets[:, 1] * np.cos(CIRCLE)
    assert_allclose(across, 0.0, rtol=0, atol=OUTLINE_PX)


@pytest.mark.parametrize("range_km", RANGES_KM)
def test_an_ellipsoid_and_its_fine_mesh_have_the_same_outline_at_every_range(range_km: float) -> None:
    outlines = [
        _outline(*_view(shape, range_km)) for shape in (ELLIPSOID, mesh_from_ellipsoid(ELLIPSOID, facets=50_000))
    ]
    edge = 2.0 * np.sqrt(4 * np.pi / 50_000)  # of the longest facets, km
    sagitta_px = edge**2 / 8 / 0.36 * 0.5 * DIAMETER_PX  # curvature of at most 1 / 0.36 per km
    smooth, faceted = (np.linalg.norm(outline.points_px - outline.center_px, axis=1) for outline in outlines)
    assert (smooth - faceted).min() > -OUTLINE_PX
    assert (smooth - faceted).max() < 2.0 * sagitta_px  # seen from 2 radii, the limb is nearer than the center


def test_the_outline_of_an_asteroid_separates_rays_that_meet_it_from_those_that_do_not() -> None:
    mesh = irregular_body(4, radii_km=(1.0, 0.7, 0.6), facets=20_000)
    body, model = _view(mesh, 10.0)
    found = _outline(body, model)
    steps = np.stack([np.cos(CIRCLE), np.sin(CIRCLE)], axis=-1)
    for side, expected in ((-1e-3, True), (1e-3, False)):
        rays = body.to_body(model.unproject(found.points_px + side * steps))
        assert np.all(body.tracer.is_occluded(body.camera_body_km, rays) == expected)
    farther = [body.to_body(model.unproject(found.points_px + out * steps)) for out in (3.0, 30.0, 300.0)]
    assert not any(body.tracer.is_occluded(body.camera_body_km, rays).any() for rays in farther)


@settings(max_examples=10, deadline=None)
@given(turn=st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_an_outline_does_not_depend_on_the_axes_that_the_body_is_given_in(turn: tuple[float, ...]) -> None:
    axes = Rotation.from_rotvec(turn)
    other = TriangleMesh(rotate(axes, POLYHEDRON.vertices_km.copy()), POLYHEDRON.faces)
    position = np.array([1.0, -0.5, 9.0])
    here = _outline(Body(shape=POLYHEDRON, camera_from_body=TILTED, position_camera_km=position), BROWN)
    there = _outline(Body(shape=other, camera_from_body=TILTED * axes.inv(), position_camera_km=position), BROWN)
    assert_allclose(there.points_px, here.points_px, rtol=0, atol=OUTLINE_PX)
    assert_allclose(there.normals_px, here.normals_px, rtol=0, atol=OUTLINE_PX)


@pytest.mark.parametrize("shape", [ELLIPSOID, POLYHEDRON], ids=["ellipsoid", "polyhedron"])
def test_outline_points_move_with_the_body_as_their_derivatives_say(shape: Shape) -> None:
    body = Body(shape=shape, camera_from_body=TILTED, position_camera_km=np.array([2.0, -1.5, 9.0]))
    found = _outline(body, BROWN)

    def moved(position_km: np.ndarray) -> np.ndarray:
        return _outline(body.at(position_km), BROWN, center_px=found.center_px).points_px

    step_km = 1e-6 if shape is POLYHEDRON else 1e-4
    numerical = numerical_jacobian(moved, body.position_camera_km, step_km)
    error = np.abs(numerical - found.points_by_position).max(axis=(1, 2))
    assert np.abs(found.points_by_position).max() > 100.0
    assert np.sort(error)[-3] < MOTION_PX  # a corner of the polyhedron may lie within a step of a line or two


def test_an_outline_that_the_camera_images_in_part_is_that_of_a_camera_without_its_limit() -> None:
    folding = BrownModel(fx_px=1000.0, fy_px=1000.0, cx_px=500.0, cy_px=500.0, k1=-0.4)
    straight = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=500.0, cy_px=500.0)  # the same lines through (500, 500)
    mesh = irregular_body(4, radii_km=(1.0, 0.7, 0.6), facets=2000)
    body = Body(shape=mesh, camera_from_body=TILTED, position_camera_km=np.array([0.4, 0.2, 1.6]))
    part, whole = (_outline(body, model, center_px=[500.0, 500.0]) for model in (folding, straight))
    assert 20 < part.valid.sum() < 175
    assert whole.valid.all()
    assert_allclose(part.points_camera_km[part.valid], whole.points_camera_km[part.valid], rtol=0, atol=FLOAT64_SUM)
    beyond = np.linalg.norm(whole.points_px[~part.valid] - 500.0, axis=1) / 1000.0
    folds_at = np.sqrt(1.0 / 1.2)
    longest = 2.0 * np.sqrt(4 * np.pi / 2000)  # edges, over a range of some 1 km: what is imaged in part is left out
    assert beyond.min() > folds_at - longest


@pytest.mark.parametrize("range_km", RANGES_KM)
def test_hit_points_lie_on_their_rays_and_on_the_surface_at_every_range(range_km: float) -> None:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=50_000)
    camera = range_km * np.array([0.48, -0.6, 0.64])
    rays = np.random.default_rng(1).uniform(-0.6, 0.6, size=(20_000, 3)) - camera
    smooth, faceted = (tracer_for(shape).intersect(camera, rays) for shape in (ELLIPSOID, mesh))
    both = smooth.hit & faceted.hit
    assert np.mean(smooth.hit != faceted.hit) < 3e-3  # between the outlines of the ellipsoid and of its mesh
    assert both.sum() > 10_000
    on_surface = np.sum((smooth.points_km[both] / ELLIPSOID.radii_km) ** 2, axis=1)
    assert_allclose(on_surface, 1.0, rtol=0, atol=HIT * range_km)
    corners, normals = mesh.vertices_km[mesh.faces[faceted.facets[both], 0]], faceted.normals[both]
    heights = np.einsum("ij,ij->i", faceted.points_km[both] - corners, normals)
    assert_allclose(heights, 0.0, rtol=0, atol=HIT * range_km)  # rays met by the smooth body meet the facets in float64
    for hits in (smooth, faceted):
        offsets = hits.points_km[both] - camera
        aside = np.linalg.norm(np.cross(offsets, rays[both]), axis=1) / np.linalg.norm(rays[both], axis=1)
        assert aside.max() < HIT * range_km
    weights = mesh.barycentric(faceted.points_km[both], faceted.facets[both])
    assert weights.min() > -1e-8
    steep = np.einsum("ij,ij->i", smooth.normals[both], -rays[both]) > 0.3 * np.linalg.norm(rays[both], axis=1)
    apart = np.linalg.norm(smooth.points_km - faceted.points_km, axis=1)[both][steep]
    longest = 2.0 * np.sqrt(4 * np.pi / 50_000)
    assert apart.max() < longest**2 / 8 / 0.36 / 0.3


@pytest.mark.parametrize("shape", [POLYHEDRON, ELLIPSOID])
def test_outline_points_alone_are_those_of_a_silhouette(shape: Shape) -> None:
    body = Body(shape=shape, camera_from_body=TILTED, position_camera_km=np.array([0.1, -0.2, 10.0]))
    assert_array_equal(outline_points_px(body, BROWN, CIRCLE), _outline(body, BROWN).points_px)


@pytest.mark.parametrize("shape", [POLYHEDRON, ELLIPSOID])
def test_a_lit_outline_is_lit_on_the_side_of_the_sun(shape: Shape) -> None:
    body = Body(shape=shape, camera_from_body=TILTED, position_camera_km=np.array([0.1, -0.2, 10.0]))
    points_px, lit = lit_outline(body, BROWN, CIRCLE, sun_direction_camera=SUN)
    assert_array_equal(points_px, outline_points_px(body, BROWN, CIRCLE))
    toward_px = (points_px - points_px.mean(axis=0)) @ SUN[:2]
    assert lit[toward_px > 0.5 * toward_px.max()].all()
    assert not lit[toward_px < -0.5 * toward_px.max()].any()
