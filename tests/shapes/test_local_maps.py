"""Local maps: alone, and laid over a coarse body, where they must look like a body that is fine throughout."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.ray_tracing.tracer import Hits, tracer_for
from giantlike.shapes import (
    AlbedoMap,
    FacetAlbedo,
    LocalMap,
    TriangleMesh,
    VertexAlbedo,
    mesh_from_ellipsoid,
    overlaid,
    sphere,
)
from giantlike.shapes.generate import geodesic_directions
from tests.tolerances import FLOAT64_DIGIT, FLOAT64_SUM, SAMPLED

CENTER = np.array([0.36, 0.48, 0.80])  # a unit vector
BODY_FROM_MAP = Rotation.from_matrix(np.column_stack([[0.8, -0.6, 0.0], np.cross(CENTER, [0.8, -0.6, 0.0]), CENTER]))
SPACING_KM = 0.005
HALF_KM = 0.15  # the map is 60 cells wide
ABOVE = 5.0 * CENTER
ROUNDING_KM = 1e-12  # float64, body of 1 km
FLOAT32_KM = 1e-6  # where a ray passes between two facets is decided in float32


def _hills(directions: np.ndarray) -> np.ndarray:
    """Radius (n,), km, of a body with hills 0.01 km high and some 0.3 km wide."""
    return np.asarray(
        1.0 + 0.01 * np.sin(20.0 * directions @ [1.0, 0.3, -0.2]) * np.cos(18.0 * directions @ [0.2, -0.9, 0.5])
    )


@cache
def _body(facets: int) -> TriangleMesh:
    directions, faces = geodesic_directions(facets)
    return TriangleMesh(directions * _hills(directions)[:, None], faces)


def _map(**changes: Any) -> LocalMap:
    """A map of the hills: heights where lines along its z axis leave the body, by fixed-point steps on the radius."""
    places = np.arange(-30, 31) * SPACING_KM
    x, y = np.meshgrid(places, places)
    height = np.zeros_like(x)
    for _ in range(60):
        points = rotate(BODY_FROM_MAP, np.stack([x, y, height], axis=-1).reshape(-1, 3)) + CENTER
        radius = np.linalg.norm(points, axis=1)
        height -= (radius - _hills(points / radius[:, None])).reshape(x.shape)
    fields = {"heights_km": height, "spacing_km": SPACING_KM, "name": "hills", **changes}
    return LocalMap(center_body_km=CENTER, body_from_map=BODY_FROM_MAP, **fields)


COARSE, MAP = _body(1000), _map()
FINE_FACETS = 200_000
LAID = overlaid(COARSE, [MAP])
MAP_FACETS = 2 * 60 * 60


def _look(body: TriangleMesh, half_km: float, count: int = 300, origin: np.ndarray = ABOVE) -> tuple[Hits, np.ndarray]:
    """Hits of a bundle of rays at the plane of the map, ``half_km`` to each side, and the rays."""
    random = np.random.default_rng(1)
    places = np.column_stack([random.uniform(-half_km, half_km, size=(count**2, 2)), np.zeros(count**2)])
    rays = rotate(BODY_FROM_MAP, places) + CENTER - origin
    return tracer_for(body).intersect(origin, rays), rays


def test_a_map_alone_has_its_heights_at_its_places_and_faces_up() -> None:
    heights = np.array([[0.0, 0.1, 0.2], [0.3, np.nan, 0.1]])
    local = LocalMap(center_body_km=CENTER, body_from_map=BODY_FROM_MAP, heights_km=heights, spacing_km=0.5)
    assert local.half_extent_km == (0.5, 0.25)
    mesh = local.mesh()
    corners = local.to_map(mesh.vertices_km)
    assert_allclose(
        corners[[0, 2, 3]], [[-0.5, -0.25, 0.0], [0.5, -0.25, 0.2], [-0.5, 0.25, 0.3]], rtol=0, atol=FLOAT64_DIGIT
    )
    assert 4 not in mesh.faces
    whole = MAP.mesh()
    assert len(whole.faces) == MAP_FACETS
    assert np.all(whole.normals @ CENTER > 0.5)
    assert_allclose(np.linalg.norm(whole.vertices_km, axis=1), _hills(whole.vertices_km / np.linalg.norm(
        whole.vertices_km, axis=1, keepdims=True)), rtol=0, atol=ROUNDING_KM)  # fmt: skip


def test_within_the_map_nothing_of_the_global_body_is_seen_and_the_surface_is_the_fine_one() -> None:
    laid, rays = _look(LAID, 0.97 * HALF_KM)
    fine, _ = _look(_body(FINE_FACETS), 0.97 * HALF_KM)
    on_map = LAID.vertices_km[LAID.faces[laid.facets]].mean(axis=1)
    assert laid.hit.all()
    centroids = {tuple(row) for row in np.round(MAP.mesh().vertices_km[MAP.mesh().faces].mean(axis=1), 9)}
    assert {tuple(row) for row in np.round(on_map, 9)} <= centroids
    sagitta_km = (2.0 * SPACING_KM) ** 2 / 8 * 10.0  # hills bend by up to 0.01 * 27**2 = 7 per km, the body by 1
    depth = np.linalg.norm(laid.points_km - fine.points_km, axis=1)
    assert depth.max() < 3.0 * sagitta_km
    coarse, _ = _look(COARSE, 0.97 * HALF_KM)
    assert np.median(np.linalg.norm(coarse.points_km - fine.points_km, axis=1)) > 10.0 * np.median(depth)
    cos_laid, cos_fine = (np.einsum("ij,ij->i", hits.normals, -rays) / 4.0 for hits in (laid, fine))
    assert abs(np.mean(cos_laid - cos_fine)) < 1e-3


def test_the_map_has_the_shadows_of_the_fine_body_and_no_others() -> None:
    sun = rotate(BODY_FROM_MAP, [np.cos(0.12), 0.0, np.sin(0.12)])  # 7 deg over the horizon; slopes reach 11 deg
    dark = [tracer_for(body).is_shadowed(_look(body, 0.8 * HALF_KM)[0], sun) for body in (LAID, _body(FINE_FACETS))]
    assert 0.2 < np.mean(dark[1]) < 0.8
    assert np.mean(dark[0] != dark[1]) < 0.03  # along the edges of shadows, where facets differ
    high = rotate(BODY_FROM_MAP, [np.cos(1.0), 0.0, np.sin(1.0)])
    assert not tracer_for(LAID).is_shadowed(_look(LAID, 0.97 * HALF_KM)[0], high).any()


@pytest.mark.parametrize("lift_km", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("slant", [0.0, 1.0])
def test_no_ray_gets_in_through_the_seam_even_where_the_map_lies_too_high_or_low(lift_km: float, slant: float) -> None:
    body = overlaid(COARSE, [_map(heights_km=MAP.heights_km + lift_km)])
    origin = CENTER + rotate(BODY_FROM_MAP, [4.0 * slant, 1.5 * slant, 4.0])
    hits, rays = _look(body, 1.5 * HALF_KM, origin=origin)
    assert hits.hit.all()
    facing = -np.einsum("ij,ij->i", hits.normals, rays) / np.linalg.norm(rays, axis=1)
    assert np.sum(facing < 0.0) <= 3  # of 90,000; cracks of float32 vertices, 1e-7 of the radius, let in 0.02 of them
    height = MAP.to_map(hits.points_km)[:, 2]
    assert np.quantile(np.abs(height), 0.9999) < 0.15  # a ray through a hole ends 2 km below


def test_outside_the_map_the_body_is_what_it_was() -> None:
    random = np.random.default_rng(2)
    away = random.normal(size=(5000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    away = away[np.abs(MAP.to_map(away)[:, :2]).max(axis=1) > 1.2 * HALF_KM]
    before, after = (tracer_for(body).intersect(3.0 * away, -away) for body in (COARSE, LAID))
    assert len(away) > 3000
    assert_allclose(after.points_km, before.points_km, rtol=0, atol=2 * FLOAT32_KM)
    assert LAID.name == COARSE.name
    assert LAID.volume_km3 == pytest.approx(COARSE.volume_km3, rel=0.02)
    far_side = tracer_for(LAID).intersect(-3.0 * CENTER, [CENTER])
    assert_allclose(
        far_side.points_km, tracer_for(COARSE).intersect(-3.0 * CENTER, [CENTER]).points_km, atol=FLOAT64_SUM
    )


def test_of_maps_that_overlap_the_last_one_is_seen() -> None:
    lower = _map(heights_km=MAP.heights_km - 0.02)
    for maps, expected in (([MAP, lower], -0.02), ([lower, MAP], 0.0)):
        hits, _ = _look(overlaid(COARSE, maps), 0.9 * HALF_KM, count=60)
        height = np.linalg.norm(hits.points_km, axis=1) - _hills(hits.points_km / np.linalg.norm(
            hits.points_km, axis=1, keepdims=True))  # fmt: skip
        assert np.median(height) == pytest.approx(expected, abs=SAMPLED)


def test_albedo_of_body_and_map_stays_in_its_place() -> None:
    pattern = 1.0 + 0.3 * np.sin(np.arange(61) / 5.0) * np.ones((61, 1))
    painted = _map(albedo=pattern)
    directions = COARSE.vertices_km / np.linalg.norm(COARSE.vertices_km, axis=1, keepdims=True)
    bodies = {
        "vertex": COARSE.with_albedo(VertexAlbedo(0.5 + 0.0 * directions[:, 0])),
        "facet": COARSE.with_albedo(FacetAlbedo(np.full(len(COARSE.faces), 0.5))),
        "map": COARSE.with_albedo(AlbedoMap(values=np.array([[0.5]]))),
    }
    for kind, body in bodies.items():
        laid = overlaid(body, [painted])
        hits, _ = _look(laid, 1.5 * HALF_KM, count=100)
        assert laid.albedo is not None
        found = laid.albedo.at(hits.points_km, hits.facets, laid.barycentric(hits.points_km, hits.facets))
        places = MAP.to_map(hits.points_km)
        inside = np.abs(places[:, :2]).max(axis=1) < 0.98 * HALF_KM
        outside = np.abs(places[:, :2]).max(axis=1) > 1.02 * HALF_KM
        expected = np.interp(places[inside, 0], np.arange(-30, 31) * SPACING_KM, pattern[0])
        assert_allclose(found[inside], expected, rtol=0, atol=1e-4, err_msg=kind)  # float32 choice of the facet
        assert_allclose(found[outside], 0.5, rtol=0, atol=FLOAT64_SUM, err_msg=kind)
    assert LAID.albedo is None
    assert painted.mesh().albedo is not None


@pytest.mark.parametrize(
    ("changes", "needle"),
    [
        ({"heights_km": np.zeros(5)}, "grid"),
        ({"heights_km": np.zeros((1, 5))}, "2 by 2"),
        ({"heights_km": np.full((3, 3), np.nan)}, "three corners"),
        ({"heights_km": np.full((3, 3), np.inf)}, "finite"),
        ({"spacing_km": 0.0}, "spacing_km"),
        ({"albedo": np.ones((3, 3))}, "albedo"),
    ],
)
def test_a_map_that_is_none_is_refused(changes: dict[str, object], needle: str) -> None:
    with pytest.raises(InputError, match=needle):
        _map(**changes)


def test_a_map_that_misses_the_body_or_has_gaps_is_not_laid_over_it() -> None:
    with pytest.raises(InputError, match="same axes and units"):
        overlaid(mesh_from_ellipsoid(sphere(100.0), facets=500), [MAP])
    with pytest.raises(InputError, match="gaps"):
        overlaid(COARSE, [_map(heights_km=np.where(MAP.heights_km == MAP.heights_km[3, 4], np.nan, MAP.heights_km))])
