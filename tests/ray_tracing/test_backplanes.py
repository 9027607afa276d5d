"""What every pixel looks at, against closed forms and against the pixel's own place in the image."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.errors import InputError
from giantlike.ray_tracing import Body, trace_backplanes
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh, irregular_body, mesh_from_ellipsoid, sphere
from giantlike.shapes.detail import LevelsOfDetail
from tests.tolerances import FLOAT64, FLOAT64_CHAIN

PIXEL = 1e-6  # px: rays are interpolated to 1e-11 rad, 1e-8 px of this camera
POINT = 1e-9  # relative to the range

TILTED = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
SUN = np.array([0.8, 0.1, -0.6]) / np.linalg.norm([0.8, 0.1, -0.6])
CAMERA = BrownModel(fx_px=500.0, fy_px=510.0, cx_px=80.0, cy_px=60.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4)
ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.6]))
FRAME = (160, 120)


def _body(shape: Shape, position: list[float]) -> Body:
    return Body(shape=shape, camera_from_body=TILTED, position_camera_km=np.array(position))


@pytest.mark.parametrize(
    "shape", [ELLIPSOID, irregular_body(3, radii_km=(1.0, 0.7, 0.6), facets=5000)], ids=["ellipsoid", "mesh"]
)
@pytest.mark.parametrize("scale", [1.0, 1e5])
def test_every_point_projects_into_the_center_of_its_pixel(shape: Shape, scale: float) -> None:
    model = CAMERA.with_parameters(CAMERA.parameters * np.where(np.arange(CAMERA.parameters.size) < 2, scale, 1.0))
    body = _body(shape, [0.3 if scale == 1.0 else 0.0, 0.2 if scale == 1.0 else 0.0, 8.0 * scale])
    planes = trace_backplanes([body], model, sun_direction_camera=SUN, columns=FRAME[0], rows=FRAME[1])
    seen = planes.body == 0
    assert 2000 < seen.sum() < 15_000
    points = body.to_camera(planes.point_body_km[seen]) + body.position_camera_km
    rows, columns = np.nonzero(seen)
    assert_allclose(model.project(points), np.stack([columns, rows], axis=-1), rtol=0, atol=PIXEL)
    assert_allclose(planes.range_km[seen], np.linalg.norm(points, axis=1), rtol=POINT)
    assert_allclose(planes.depth_km[seen], points[:, 2], rtol=POINT)
    radius = np.linalg.norm(planes.point_body_km[seen], axis=1)
    longitude, latitude = planes.longitude_rad[seen], planes.latitude_rad[seen]
    east = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1)
    assert_allclose(radius[:, None] * east, planes.point_body_km[seen], rtol=0, atol=FLOAT64)
    assert longitude.min() >= 0.0
    assert longitude.max() < 2.0 * np.pi


def test_angles_on_an_ellipsoid_are_those_of_its_normals() -> None:
    body = _body(ELLIPSOID, [0.3, 0.2, 8.0])
    planes = trace_backplanes([body], CAMERA, sun_direction_camera=SUN, columns=FRAME[0], rows=FRAME[1])
    seen = planes.body == 0
    points = planes.point_body_km[seen]
    normals = points / ELLIPSOID.radii_km**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sun = body.to_body(SUN)
    toward = body.camera_body_km - points
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    assert_allclose(np.cos(planes.incidence_rad[seen]), normals @ sun, rtol=0, atol=FLOAT64_CHAIN)
    assert_allclose(np.cos(planes.emission_rad[seen]), np.sum(normals * toward, axis=1), rtol=0, atol=FLOAT64_CHAIN)
    assert_allclose(np.cos(planes.phase_rad[seen]), toward @ sun, rtol=0, atol=FLOAT64_CHAIN)
    assert np.array_equal(planes.shadowed[seen], planes.incidence_rad[seen] >= 0.5 * np.pi)
    assert planes.emission_rad[seen].max() <= 0.5 * np.pi


def test_slopes_and_resolution_are_those_of_closed_forms() -> None:
    """A sphere has no slope; off the axis of a pinhole a pixel covers cos^3 of its solid angle on the axis."""
    pinhole = PinholeModel(fx_px=500.0, fy_px=500.0, cx_px=80.0, cy_px=60.0)
    ball = trace_backplanes(
        [_body(sphere(1.0), [0.3, 0.2, 8.0])], pinhole, sun_direction_camera=SUN, columns=FRAME[0], rows=FRAME[1]
    )
    seen = ball.body == 0
    assert np.abs(ball.slope_rad[seen]).max() < 1e-7
    cosine = ball.depth_km[seen] / ball.range_km[seen]
    assert_allclose(ball.resolution_km[seen], ball.range_km[seen] * cosine**1.5 / 500.0, rtol=FLOAT64_CHAIN)
    oblique = ball.resolution_km[seen] / np.cos(ball.emission_rad[seen])
    assert_allclose(ball.oblique_resolution_km[seen], oblique, rtol=FLOAT64)
    body = _body(ELLIPSOID, [0.3, 0.2, 8.0])
    planes = trace_backplanes([body], CAMERA, sun_direction_camera=SUN, columns=FRAME[0], rows=FRAME[1])
    seen = planes.body == 0
    points = planes.point_body_km[seen]
    normals = points / ELLIPSOID.radii_km**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    up = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert_allclose(np.cos(planes.slope_rad[seen]), np.sum(normals * up, axis=1), rtol=0, atol=FLOAT64_CHAIN)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    downhill = normals - np.sum(normals * up, axis=1, keepdims=True) * up
    azimuth = planes.slope_azimuth_rad[seen][:, None]
    along = np.cos(azimuth) * np.cross(up, east) + np.sin(azimuth) * east
    assert_allclose(np.linalg.norm(downhill, axis=1)[:, None] * along, downhill, rtol=0, atol=1e-9)


def test_a_facet_tilted_to_the_east_slopes_down_to_the_east() -> None:
    """A plate at longitude 0 on the equator, turned by 10 degrees about north: its east side is lower."""
    tilt = np.radians(10.0)
    corners = np.array([[0.0, -1.0, -1.0], [0.0, 1.0, -1.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]])
    turned = corners @ Rotation.from_euler("z", tilt).as_matrix().T + [5.0, 0.0, 0.0]
    plate = TriangleMesh(vertices_km=turned, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    to_camera = Rotation.from_matrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]))
    body = Body(shape=plate, camera_from_body=to_camera, position_camera_km=np.array([0.0, 0.0, 50.0]))
    pinhole = PinholeModel(fx_px=500.0, fy_px=500.0, cx_px=20.0, cy_px=20.0)
    planes = trace_backplanes([body], pinhole, sun_direction_camera=-np.eye(3)[2], columns=41, rows=41)
    assert planes.slope_rad[20, 20] == pytest.approx(tilt, abs=1e-9)
    assert planes.slope_azimuth_rad[20, 20] == pytest.approx(0.5 * np.pi, abs=1e-9)


def test_off_the_bodies_there_is_nothing() -> None:
    body = _body(ELLIPSOID, [0.3, 0.2, 8.0])
    planes = trace_backplanes([body], CAMERA, sun_direction_camera=SUN, columns=FRAME[0], rows=FRAME[1])
    off = planes.body < 0
    assert off.any()
    assert np.array_equal(planes.facet < 0, off)
    assert not planes.shadowed[off].any()
    for name in ("range_km", "depth_km", "incidence_rad", "emission_rad", "phase_rad", "longitude_rad", "latitude_rad"):
        values = getattr(planes, name)
        assert values.shape == FRAME[::-1]
        assert np.array_equal(np.isnan(values), off)
        assert not values.flags.writeable
    nothing = trace_backplanes([], CAMERA, sun_direction_camera=SUN, columns=10, rows=5)
    assert nothing.body.shape == (5, 10)
    away = trace_backplanes([_body(ELLIPSOID, [0.0, 0.0, -8.0])], CAMERA, sun_direction_camera=SUN, columns=10, rows=5)
    assert np.all(away.body == -1)
    with pytest.raises(InputError, match="each of 1 bodies"):
        trace_backplanes([body], CAMERA, sun_direction_camera=np.zeros((2, 3)), columns=10, rows=5)
    with pytest.raises(InputError, match="columns and rows"):
        trace_backplanes([body], CAMERA, sun_direction_camera=SUN, columns=0, rows=5)


@pytest.mark.parametrize("swap", [False, True])
def test_the_nearest_body_is_seen_and_casts_its_shadow(swap: bool) -> None:
    sun = np.array([0.6, 0.0, -0.8])
    planet = _body(mesh_from_ellipsoid(sphere(1.0), facets=20_000), [0.0, 0.0, 10.0])
    moon = _body(sphere(0.3), (np.array([0.0, 0.0, 9.0]) + 1.5 * sun).tolist())
    order = [moon, planet] if swap else [planet, moon]
    number = 1 if swap else 0
    planes, alone = (
        trace_backplanes(bodies, CAMERA, sun_direction_camera=sun, columns=FRAME[0], rows=FRAME[1])
        for bodies in (order, [planet])
    )
    on_planet = planes.body == number
    on_moon = planes.body == 1 - number
    assert on_moon.sum() > 500
    assert np.array_equal(on_planet, (alone.body == 0) & ~on_moon)
    points = planet.to_camera(planes.point_body_km[on_planet]) + planet.position_camera_km
    toward = points - moon.position_camera_km
    from_axis = np.linalg.norm(toward - np.outer(toward @ sun, sun), axis=1)
    eclipsed = planes.shadowed[on_planet] & ~alone.shadowed[on_planet]
    lit = ~alone.shadowed[on_planet]
    clear = np.abs(from_axis - 0.3) > 1e-5  # a ray starts 1e-5 of the radius over the surface
    assert eclipsed.sum() > 100
    assert np.array_equal(eclipsed[clear & lit], (from_axis < 0.3)[clear & lit])


def test_a_distant_camera_sees_the_coarse_level_and_a_near_one_the_fine() -> None:
    meshes = tuple(mesh_from_ellipsoid(sphere(1.0), facets=facets) for facets in (500, 20_000))
    levels = LevelsOfDetail(meshes=meshes, facet_px=2.0)
    for distance, fine in ((2000.0, False), (8.0, True)):
        body = _body(levels, [0.0, 0.0, distance])
        planes = trace_backplanes([body], CAMERA, sun_direction_camera=SUN, columns=FRAME[0], rows=FRAME[1])
        assert (planes.facet.max() > 500) == fine
