"""Limbs of shapes: tangency, clock planes, derivatives, and meshes against the ellipsoids that they approach."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.shapes import Ellipsoid, Limb, Point, TriangleMesh, irregular_body, limb, mesh_from_ellipsoid, sphere
from giantlike.shapes.limbs import crossings, silhouette_edges
from tests.numerical import numerical_jacobian
from tests.tolerances import FLOAT64, FLOAT64_CHAIN

EQUATION = 1e-12  # float64 on numbers near 1
ANGLE = 1e-14  # rad, of ray and normal: rounding of unit vectors
DERIVATIVE = 3e-7  # of derivatives near 1: truncation of central differences with steps of 1e-5 of the range
EDGE_DERIVATIVE = 3e-8  # the same on straight edges, with steps of 1e-7

RADII = np.array([1.0, 0.7, 0.6])
ELLIPSOID = Ellipsoid(radii_km=RADII)
RANGES = [1.2, 2.0, 30.0, 1e6]
VIEW = np.array([0.48, -0.6, 0.64])


def _directions(count: int, seed: int = 1) -> np.ndarray:
    return np.asarray(np.random.default_rng(seed).normal(size=(count, 3)))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _off_axis_rad(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Angle (k,) at the camera between points and the origin."""
    across = np.linalg.norm(np.cross(points, camera), axis=1)
    return np.asarray(np.arctan2(across, (camera - points) @ camera))


@pytest.mark.parametrize("distance_km", RANGES)
def test_limb_points_of_an_ellipsoid_satisfy_its_equation_tangency_and_clock_plane(distance_km: float) -> None:
    camera, directions = distance_km * VIEW, _directions(100)
    found = limb(ELLIPSOID, camera, directions)
    assert found.valid.all()
    assert_allclose(np.sum((found.points_body_km / RADII) ** 2, axis=1), 1.0, rtol=0, atol=EQUATION)
    rays = _unit(found.points_body_km - camera)
    assert_allclose(np.einsum("ki,ki->k", rays, found.normals), 0.0, rtol=0, atol=ANGLE)
    assert_allclose(np.cross(found.normals, found.points_body_km / RADII**2), 0.0, rtol=0, atol=EQUATION)
    planes = _unit(np.cross(VIEW, directions))
    assert_allclose(np.einsum("ki,ki->k", planes, found.points_body_km), 0.0, rtol=0, atol=EQUATION)
    sideways = directions - (directions @ VIEW)[:, None] * VIEW
    assert np.all(np.einsum("ki,ki->k", sideways, found.points_body_km) > 0)


def test_the_limb_of_a_sphere_is_the_circle_of_the_textbook() -> None:
    found = limb(sphere(2.0), [0.0, 0.0, 5.0], _directions(50))
    assert_allclose(found.points_body_km[:, 2], 4.0 / 5.0, rtol=0, atol=EQUATION)
    assert_allclose(np.linalg.norm(found.points_body_km[:, :2], axis=1), np.sqrt(4.0 - 0.64), rtol=0, atol=EQUATION)


@pytest.mark.parametrize("distance_km", RANGES)
@pytest.mark.parametrize("quantity", ["points_body_km", "normals"])
@pytest.mark.parametrize(
    ("shape", "step", "tolerance"),
    [
        (ELLIPSOID, 1e-5, DERIVATIVE),
        (mesh_from_ellipsoid(ELLIPSOID, facets=180), 1e-7, EDGE_DERIVATIVE),
        (irregular_body(4, radii_km=(1.0, 0.7, 0.6), facets=2000), 1e-7, EDGE_DERIVATIVE),
    ],
    ids=["ellipsoid", "polyhedron", "asteroid"],
)
def test_limbs_move_with_the_camera_as_their_derivatives_say(
    shape: Ellipsoid | TriangleMesh, step: float, tolerance: float, quantity: str, distance_km: float
) -> None:
    camera, directions = distance_km * VIEW, _directions(60)
    found = limb(shape, camera, directions)
    name = {"points_body_km": "points_by_camera", "normals": "normals_by_camera"}[quantity]
    derivative = getattr(found, name)

    def moved(position: np.ndarray) -> np.ndarray:
        return np.asarray(getattr(limb(shape, position, directions), quantity))

    numerical = numerical_jacobian(moved, camera, step * distance_km)
    size = np.abs(derivative).max(axis=(1, 2))
    error = np.abs(numerical - derivative).max(axis=(1, 2)) / np.maximum(size, 1.0 / distance_km)
    same_edge = np.ones(60, dtype=bool)
    if isinstance(shape, TriangleMesh):  # a limb that passes a vertex within the step has no derivative
        shifts = [
            limb(shape, camera + sign * step * distance_km * e, directions) for e in np.eye(3) for sign in (-1, 1)
        ]
        depth = np.max([np.abs(shift.points_body_km - found.points_body_km).max(axis=1) for shift in shifts], axis=0)
        same_edge = depth < 10.0 * size * step * distance_km + 1e-9
    assert same_edge.sum() >= 57
    assert error[same_edge].max() < tolerance


@pytest.mark.parametrize("distance_km", RANGES)
def test_the_limb_of_a_mesh_approaches_that_of_its_ellipsoid(distance_km: float) -> None:
    camera, directions = distance_km * VIEW, _directions(40)
    smooth = limb(ELLIPSOID, camera, directions)
    for facets in (500, 8000):
        mesh = mesh_from_ellipsoid(ELLIPSOID, facets=facets)
        found = limb(mesh, camera, directions)
        edge = 1.0 * np.sqrt(4 * np.pi / facets) * 1.5  # of the longest facets, on the longest axis
        steepness = 1.0 / np.sin(_off_axis_rad(smooth.points_body_km, camera)).min() if distance_km < 2.0 else 1.0
        inward = (_off_axis_rad(smooth.points_body_km, camera) - _off_axis_rad(found.points_body_km, camera)) * (
            np.linalg.norm(camera - smooth.points_body_km, axis=1)
        )
        sagitta = edge**2 / 8 / 0.36  # curvature of at most 1 / 0.36 per km: the long axis over the short one squared
        assert inward.min() > -EQUATION * distance_km  # the mesh lies within
        assert inward.max() < 2.0 * sagitta * steepness
        assert_allclose(found.normals, smooth.normals, rtol=0, atol=2.0 * edge / 0.36)


def test_the_limb_of_a_mesh_is_the_vertex_outline_that_all_vertices_stay_within() -> None:
    mesh = irregular_body(7, radii_km=(1.0, 0.7, 0.6), facets=3000)
    camera = 3.0 * VIEW
    found = limb(mesh, camera, _directions(200))
    # planes through the camera and an outline edge: whatever of the body is in the same half-plane lies inside
    around = np.arctan2(*np.moveaxis(mesh.vertices_km @ _plane(camera).T, -1, 0)[::-1])
    clock = np.arctan2(*np.moveaxis(found.points_body_km @ _plane(camera).T, -1, 0)[::-1])
    order = np.argsort(clock)
    highest = np.interp(around, clock[order], _off_axis_rad(found.points_body_km, camera)[order], period=2 * np.pi)
    beyond = _off_axis_rad(mesh.vertices_km, camera) - highest
    assert np.quantile(beyond, 0.999) < 0.01  # between neighboring directions, 2 deg apart, the outline bulges a little
    assert found.valid.all()


def _plane(camera: np.ndarray) -> np.ndarray:
    axis = -_unit(camera)
    right = _unit(np.cross(axis, [0.0, 0.0, 1.0]))
    return np.stack([right, np.cross(axis, right)])


@settings(max_examples=15, deadline=None)
@given(turn=st.tuples(*[st.floats(-2.0, 2.0)] * 3), scale=st.floats(1e-3, 1e3), distance=st.floats(1.5, 1e4))
def test_limbs_do_not_depend_on_the_axes_or_the_unit_they_are_computed_in(
    turn: tuple[float, ...], scale: float, distance: float
) -> None:
    rotation = Rotation.from_rotvec(turn)
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=320)
    turned = TriangleMesh(scale * rotate(rotation, mesh.vertices_km.copy()), mesh.faces)
    camera, directions = distance * VIEW, _directions(30)
    here = limb(mesh, camera, directions)
    there = limb(turned, scale * rotate(rotation, camera), rotate(rotation, directions))
    assert_allclose(_off_axis_rad(rotate(rotation.inv(), there.points_body_km.copy()) / scale, camera),
                    _off_axis_rad(here.points_body_km, camera), rtol=0, atol=FLOAT64)  # fmt: skip
    smooth = limb(ELLIPSOID, camera, directions)
    grown = limb(Ellipsoid(radii_km=scale * RADII), scale * camera, directions)
    assert_allclose(grown.points_body_km, scale * smooth.points_body_km, rtol=0, atol=EQUATION * scale)
    assert_allclose(grown.points_by_camera, smooth.points_by_camera, rtol=0, atol=FLOAT64_CHAIN / 10)


def test_the_limb_of_an_open_sheet_is_its_border() -> None:
    vertices = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.1]])
    sheet = TriangleMesh(vertices, np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]))
    assert sheet.border_vertices.tolist() == [0, 1, 2, 3]
    assert mesh_from_ellipsoid(ELLIPSOID, facets=80).border_vertices.size == 0
    found = limb(sheet, [0.0, 0.0, 5.0], [[1.0, 0.2, 0.0], [-0.3, 1.0, 0.0]])
    assert_allclose(found.points_body_km, [[1.0, 0.2, 0.0], [-0.3, 1.0, 0.0]], rtol=0, atol=EQUATION)
    assert_allclose(found.normals[0], _unit(np.array([5.0, 0.0, 1.0])), rtol=0, atol=EQUATION)


def test_a_direction_that_misses_the_body_has_no_limb() -> None:
    aside = mesh_from_ellipsoid(sphere(1.0), facets=80).translated([0.0, 4.0, 0.0])
    found = limb(aside, [0.0, 0.0, 20.0], [[0.1, 1.0, 0.0], [0.1, -1.0, 0.0]])
    assert found.valid.tolist() == [True, False]
    assert np.isnan(found.points_body_km[1]).all()
    assert found.points_body_km[0, 1] > 4.8


def test_directions_along_edges_and_through_vertices_have_limbs_too() -> None:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    cube = TriangleMesh(corners, np.array([f for q in quads for f in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])]))
    camera = np.array([0.0, 0.0, 10.0])
    found = limb(cube, camera, [[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 1.0, 5.0]])
    expected = [[1.0, 1.0, 1.0], [1.0, 0.0, 1.0], [0.0, -1.0, 1.0], [-1.0, 1.0, 1.0]]
    assert_allclose(found.points_body_km, expected, rtol=0, atol=EQUATION)
    assert np.isfinite(found.points_by_camera).all()
    assert len(silhouette_edges(cube, camera)[0]) == 4
    edges, facets = silhouette_edges(cube, np.array([5.0, 5.0, 10.0]))
    assert len(edges) == 6
    assert np.all(cube.normals[facets] @ [5.0, 5.0, 10.0] > 1.0)


def test_segments_cross_the_half_lines_between_their_ends_also_where_angles_wrap() -> None:
    starts = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 0.5], [-3.0, -0.1]])
    stops = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -0.5], [3.0, -0.2]])
    degrees = np.array([0.0, 90.0, 180.0, 270.0, -1.0, 45.0])
    segments, lines = crossings(starts, stops, np.radians(degrees))
    pairs = {(int(s), int(line)) for s, line in zip(segments, lines, strict=True)}
    assert pairs == {(0, 0), (0, 4), (0, 5), (1, 1), (1, 5), (2, 2), (3, 3)}
    assert crossings(starts, stops, np.zeros(0))[0].size == 0


@pytest.mark.parametrize(
    ("camera", "directions", "needle"),
    [
        ([0.0, 0.0, 0.3], [[1.0, 0.0, 0.0]], "outside the ellipsoid"),
        ([0.0, 0.0, 0.0], [[1.0, 0.0, 0.0]], "origin"),
        ([0.0, 0.0, 3.0], [[1.0, 0.0, 0.0], [0.0, 0.0, -2.0]], r"directions \[1\] lie along"),
        ([0.0, 0.0, 3.0], [[np.nan, 0.0, 0.0]], "finite"),
        ([0.0, 0.0, 3.0], [1.0, 0.0, 0.0], "shape"),
    ],
)
def test_a_limb_that_is_none_is_refused(camera: list[float], directions: object, needle: str) -> None:
    with pytest.raises(InputError, match=needle):
        limb(ELLIPSOID, camera, directions)  # type: ignore[arg-type]


def test_a_point_has_a_place_and_neither_size_nor_limb() -> None:
    point = Point(name="far asteroid")
    assert (point.circumscribing_radius_km, point.mean_radius_km, point.albedo) == (0.0, 0.0, None)
    assert point.sha256 == Point().sha256
    with pytest.raises(InputError, match="Point"):
        limb(point, [0.0, 0.0, 3.0], [[1.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="far asteroid"):
        _ = point.best_fit_ellipsoid
    assert isinstance(limb(sphere(1.0), [0.0, 0.0, 3.0], np.zeros((0, 3))), Limb)
