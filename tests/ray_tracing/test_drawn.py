"""Facets drawn into the rays of pixels: those that a test of every facet finds, and light where it falls."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.ray_tracing import Body, FocalPlane, RenderOptions, render, render_near, trace_silhouette
from giantlike.ray_tracing.drawn import PixelRays, drawn_sight
from giantlike.shapes import Ellipsoid, TriangleMesh, irregular_body, mesh_from_ellipsoid

SIDE = 3
TILTED = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
SUN = np.array([0.8, 0.1, -0.6]) / np.linalg.norm([0.8, 0.1, -0.6])
PINHOLE = PinholeModel(fx_px=2000.0, fy_px=2010.0, cx_px=100.0, cy_px=90.0)
BENT = BrownModel(fx_px=2000.0, fy_px=2010.0, cx_px=300.0, cy_px=90.0, skew_px=1.0, k1=-0.2, k2=0.05, p1=1e-3)
FISHEYE = BrownModel(fx_px=300.0, fy_px=300.0, cx_px=400.0, cy_px=400.0, k1=-0.3)
ON_EDGE = 1e-9  # of the size of a facet: rounding in float64
POINT_KM = 3e-7  # float32, body of 1 km; larger far off, where directions are cut to float32 as well
TILT_RAD = 2e-3  # what distortion within a facet of 5 px, taken as straight, may do to a point seen at a glance
LIGHT, MEAN_LIGHT = 0.01, 0.002  # of the brightest: 25 rays a pixel beside 144
BY_FACET = 0.003  # of the brightest: facets lit as a whole


def _body(shape: TriangleMesh, range_km: float = 30.0) -> Body:
    position = range_km * np.array([1e-3, 2e-3, 1.0])
    return Body(shape=shape, camera_from_body=TILTED, position_camera_km=position)


def _patterns() -> np.ndarray:
    """Places of rays: another random one in each cell of a pixel."""
    random = np.random.default_rng(5)
    patterns = np.zeros((SIDE, SIDE, SIDE, 2))
    for side in range(1, SIDE + 1):
        cells = np.moveaxis(np.mgrid[:side, :side], 0, -1)[..., ::-1]
        patterns[side - 1, :side, :side] = (cells + random.uniform(0.01, 0.99, (side, side, 2))) / side - 0.5
    return patterns


def _rays(body: Body, model: CameraModel, reach_px: int) -> tuple[PixelRays, np.ndarray]:
    """Rays of pixels around the middle of a body, 1 to 3 along a side, and their places (r, 2)."""
    columns, rows = np.meshgrid(*(np.arange(-reach_px, reach_px + 1),) * 2)
    pixels = np.rint(body.center_px(model)).astype(np.int64) + np.stack([columns.ravel(), rows.ravel()], axis=-1)
    sides = 1 + np.arange(len(pixels)) % SIDE
    patterns = _patterns()
    places = [p + patterns[s - 1, :s, :s].reshape(-1, 2) for p, s in zip(pixels, sides, strict=True)]
    return PixelRays(pixels=pixels, sides=sides, patterns_px=patterns), np.concatenate(places)


def _first_facets(body: Body, model: CameraModel, places_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Facets (r,) that rays meet first, by a test of every facet, and how sure that is: weight off any edge."""
    mesh = body.shape
    assert isinstance(mesh, TriangleMesh)
    corners = body.to_camera(mesh.vertices_km[mesh.faces]) + body.position_camera_km
    a, along, aside = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    found, sure = np.full(len(places_px), -1), np.full(len(places_px), np.inf)
    for ray, direction in enumerate(model.unproject(places_px)):
        across = np.cross(direction, aside)
        turn = np.einsum("ij,ij->i", along, across)
        u = np.einsum("ij,ij->i", -a, across) / turn
        other = np.cross(-a, along)
        v = other @ direction / turn
        distance = np.einsum("ij,ij->i", aside, other) / turn
        inside = np.minimum(np.minimum(u, v), 1.0 - u - v)
        near = np.where((inside >= 0.0) & (distance > 0.0), distance, np.inf)
        if np.isfinite(near.min()):
            found[ray] = near.argmin()
        sure[ray] = np.abs(inside[np.abs(inside) < 1.0]).min(initial=1.0)
    return found, sure


@pytest.mark.parametrize("model", [PINHOLE, BENT])
@pytest.mark.parametrize("range_km", [3.0, 100.0])
def test_drawn_facets_are_those_that_a_test_of_every_facet_finds(model: CameraModel, range_km: float) -> None:
    body = _body(irregular_body(3, facets=1000), range_km)
    rays, places_px = _rays(body, model, 22)
    seen = drawn_sight(body, model, rays)
    assert seen is not None
    facets, sure = _first_facets(body, model, places_px)
    drawn = np.where(seen.group >= 0, seen.sight.facets[seen.group], -1)
    clear = sure > (ON_EDGE if model is PINHOLE else TILT_RAD)
    assert np.mean(clear) > 0.5
    assert np.array_equal(drawn[clear], facets[clear])


def test_chosen_rays_meet_the_points_where_their_facets_are() -> None:
    body = _body(irregular_body(3, facets=20000))
    rays, places_px = _rays(body, PINHOLE, 80)
    seen = drawn_sight(body, PINHOLE, rays)
    assert seen is not None
    hits = body.tracer.intersect(body.camera_body_km, seen.directions[:, :3])
    same = hits.facets == seen.sight.facets
    assert np.mean(same) > 0.999
    assert np.abs(hits.points_km - seen.sight.points_km[:, :3])[same].max() < POINT_KM
    along = body.to_body(PINHOLE.unproject(places_px))
    nearest = np.full(len(seen.directions), -1.0)
    met = seen.group >= 0
    np.maximum.at(nearest, seen.group[met], np.einsum("ij,ij->i", along[met], seen.directions[seen.group[met], :3]))
    assert nearest.min() > 1.0 - 1e-12


@pytest.mark.parametrize("facets", [500, 20000, 200000])
def test_light_near_an_outline_is_that_of_a_whole_render(facets: int) -> None:
    """Whatever finds the hits, and however large facets are beside pixels."""
    body = _body(irregular_body(3, facets=facets))
    plane = FocalPlane(model=PINHOLE, columns=200, rows=200, psf=GaussianPsf(sigma_px=0.7))
    outline = trace_silhouette(body, PINHOLE, np.arange(360) * np.pi / 180.0, sun_direction_camera=SUN).points_px
    near = render_near(outline, body, plane, sun_direction_camera=SUN, rays_per_pixel_side=5, edges_px=outline)
    options = RenderOptions(rays_per_pixel_side=12)
    whole = render(body, PINHOLE, sun_direction_camera=SUN, psf=plane.psf, columns=200, rows=200, options=options)
    assert not isinstance(near, Failure)
    assert not isinstance(whole, Failure)
    image = whole.placed(plane.columns, plane.rows)
    columns, rows = np.rint(outline).astype(int).T
    x, y = near.corner_px.astype(int)
    differ = near.images[0][rows - y, columns - x] - image[rows, columns]
    assert np.abs(np.mean(differ)) < MEAN_LIGHT * image.max()
    assert np.sqrt(np.mean(differ**2)) < LIGHT * image.max()


def test_drawn_and_traced_light_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    body = _body(irregular_body(3, facets=20000))
    plane = FocalPlane(model=PINHOLE, columns=200, rows=200, psf=GaussianPsf(sigma_px=0.7))
    outline = trace_silhouette(body, PINHOLE, np.arange(360) * np.pi / 180.0, sun_direction_camera=SUN).points_px
    columns, rows = np.rint(outline).astype(int).T

    def light() -> np.ndarray:
        near = render_near(outline, body, plane, sun_direction_camera=SUN, rays_per_pixel_side=5, edges_px=outline)
        assert not isinstance(near, Failure)
        x, y = near.corner_px.astype(int)
        return np.asarray(near.images[0][rows - y, columns - x])

    drawn = light()
    monkeypatch.setattr("giantlike.ray_tracing.near_outline.drawn_sight", lambda *_: None)
    traced = light()
    assert np.sqrt(np.mean((drawn - traced) ** 2)) < BY_FACET * traced.max()


def test_facets_that_distortion_bends_are_left_to_rays() -> None:
    body = Body(
        shape=mesh_from_ellipsoid(Ellipsoid(radii_km=np.array([1.0, 0.8, 0.7])), facets=80),
        camera_from_body=TILTED,
        position_camera_km=np.array([1.5, 1.5, 3.0]),
    )
    rays, _ = _rays(body, FISHEYE, 60)
    assert drawn_sight(body, FISHEYE, rays) is None


def test_a_surface_that_is_not_closed_and_one_without_facets_are_left_to_rays() -> None:
    whole = irregular_body(3, facets=3000)
    cut = TriangleMesh(vertices_km=whole.vertices_km, faces=whole.faces[:-1])
    ellipsoid = Body(
        shape=Ellipsoid(radii_km=np.ones(3)), camera_from_body=TILTED, position_camera_km=np.array([0.0, 0.0, 30.0])
    )
    for body in (_body(cut), ellipsoid):
        rays, _ = _rays(body, PINHOLE, 30)
        assert drawn_sight(body, PINHOLE, rays) is None
