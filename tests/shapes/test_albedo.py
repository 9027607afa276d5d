"""Relative albedo: by facet, by vertex and from maps, against linear functions, known pixels and the sphere."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.errors import InputError
from giantlike.shapes import (
    Albedo,
    AlbedoMap,
    Ellipsoid,
    FacetAlbedo,
    TriangleMesh,
    VertexAlbedo,
    mesh_from_ellipsoid,
    sphere,
)
from tests.tolerances import FLOAT32, FLOAT64, FLOAT64_CHAIN, FLOAT64_ROOT

FACETS = np.zeros(1, dtype=np.int64)


def _direction(longitude_deg: float, latitude_deg: float) -> np.ndarray:
    longitude, latitude = np.radians([longitude_deg, latitude_deg])
    level = np.cos(latitude)
    return np.array([[level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)]])


def _on(found: AlbedoMap, longitude_deg: float, latitude_deg: float, radius_km: float = 3.0) -> float:
    return float(found.at(radius_km * _direction(longitude_deg, latitude_deg), FACETS, None)[0])


def _points_on(mesh: TriangleMesh, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, their facets and their weights."""
    random = np.random.default_rng(1)
    facets = random.integers(len(mesh.faces), size=count)
    weights = random.dirichlet(np.ones(3), size=count)
    return np.einsum("nc,ncx->nx", weights, mesh.vertices_km[mesh.faces[facets]]), facets, weights


def test_barycentric_weights_rebuild_the_points_they_were_made_from() -> None:
    mesh = mesh_from_ellipsoid(Ellipsoid(radii_km=np.array([3.0, 2.0, 1.0])), facets=320)
    points, facets, weights = _points_on(mesh, 200)
    assert_allclose(mesh.barycentric(points, facets), weights, rtol=0, atol=FLOAT64_CHAIN / 10)


def test_albedo_by_vertex_is_exact_for_a_linear_pattern() -> None:
    mesh = mesh_from_ellipsoid(sphere(2.0), facets=320)
    slope = np.array([0.1, -0.2, 0.05])
    painted = mesh.with_albedo(VertexAlbedo(1.0 + mesh.vertices_km @ slope))
    points, facets, _ = _points_on(painted, 200)
    assert isinstance(painted.albedo, Albedo)
    found = painted.albedo.at(points, facets, painted.barycentric(points, facets))
    assert_allclose(found, 1.0 + points @ slope, rtol=0, atol=FLOAT64_CHAIN / 10)
    with pytest.raises(InputError, match="barycentric"):
        painted.albedo.at(points, facets, None)
    with pytest.raises(InputError, match="with_albedo"):
        VertexAlbedo(np.ones(3)).at(points, facets, None)


def test_albedo_by_facet_follows_the_facets_when_empty_ones_are_dropped() -> None:
    ball = mesh_from_ellipsoid(sphere(1.0), facets=20)
    faces = np.insert(ball.faces, 3, [0, 0, 1], axis=0)
    values = np.linspace(0.5, 1.5, 21)
    mesh = TriangleMesh(ball.vertices_km, faces, albedo=FacetAlbedo(values))
    assert mesh.albedo is not None
    found = mesh.albedo.at(np.zeros((20, 3)), np.arange(20), None)
    assert_allclose(found, np.delete(values, 3), rtol=0, atol=0)


@pytest.mark.parametrize("albedo", [FacetAlbedo(np.ones(7)), VertexAlbedo(np.ones(7))], ids=["facet", "vertex"])
def test_an_albedo_with_another_number_of_values_is_refused(albedo: Albedo) -> None:
    ball = mesh_from_ellipsoid(sphere(1.0), facets=20)
    with pytest.raises(InputError, match="got 7"):
        ball.with_albedo(albedo)
    with pytest.raises(InputError, match="no facets or vertices"):
        sphere(1.0).with_albedo(albedo)


def test_the_albedo_enters_the_hash_and_survives_pickling_with_its_mesh() -> None:
    ball = mesh_from_ellipsoid(sphere(1.0), facets=20)
    gray, dark = (ball.with_albedo(FacetAlbedo(np.full(20, value))) for value in (1.0, 0.5))
    assert len({ball.sha256, gray.sha256, dark.sha256}) == 3
    assert dark.with_albedo(None).sha256 == ball.sha256
    assert ball.with_albedo(AlbedoMap(values=np.ones((2, 4)))).sha256 not in {gray.sha256, dark.sha256}
    for shape in (dark, sphere(1.0).with_albedo(AlbedoMap(values=np.array([[0.5, 1.0]])))):
        assert isinstance(shape, TriangleMesh | Ellipsoid)
        back = pickle.loads(pickle.dumps(shape))  # noqa: S301
        assert back.sha256 == shape.sha256
        assert_allclose(back.albedo.values, shape.albedo.values, rtol=0, atol=0)  # type: ignore[union-attr]
    assert sphere(1.0).sha256 != sphere(1.0).with_albedo(AlbedoMap(values=np.ones((1, 1)))).sha256


def test_a_map_gives_its_pixels_at_their_centers_and_is_linear_between_them() -> None:
    values = np.arange(12.0).reshape(3, 4)
    found = AlbedoMap(values=values)  # columns 90 deg wide from 0 deg east, rows 60 deg from the north pole
    for row, latitude in enumerate((60.0, 0.0, -60.0)):
        for column, longitude in enumerate((45.0, 135.0, 225.0, 315.0)):
            assert _on(found, longitude, latitude) == pytest.approx(values[row, column], abs=FLOAT64_CHAIN / 10)
    assert _on(found, 90.0, 0.0) == pytest.approx(4.5, abs=FLOAT64_CHAIN / 10)
    assert _on(found, 45.0, 30.0) == pytest.approx(2.0, abs=FLOAT64_CHAIN / 10)
    assert _on(found, 45.0, 30.0, radius_km=1e-3) == pytest.approx(2.0, abs=FLOAT64_CHAIN / 10)


@pytest.mark.parametrize("west_deg", [0.0, -180.0, 123.0])
@pytest.mark.parametrize("latitude_deg", [0.0, 71.0, -89.9])
def test_a_global_map_has_no_seam_where_it_wraps_around(west_deg: float, latitude_deg: float) -> None:
    random = np.random.default_rng(2)
    west = np.radians(west_deg)
    found = AlbedoMap(values=random.uniform(size=(5, 8)), longitude_edges_rad=(west, west + 2 * np.pi))
    sides = [_on(found, west_deg + side, latitude_deg) for side in (-1e-7, 0.0, 1e-7)]
    assert_allclose(sides, sides[1], rtol=0, atol=FLOAT64_ROOT)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_pole_has_one_value_from_all_sides_the_mean_of_its_row(sign: float) -> None:
    random = np.random.default_rng(3)
    values = random.uniform(size=(5, 8))
    found = AlbedoMap(values=values)
    near = [_on(found, longitude, sign * (90.0 - 1e-6)) for longitude in np.arange(0.0, 360.0, 30.0)]
    assert_allclose(near, values[0 if sign > 0 else -1].mean(), rtol=0, atol=FLOAT32)


def test_a_map_that_counts_west_from_south_to_north_is_the_same_map() -> None:
    values = np.random.default_rng(4).uniform(size=(6, 10))
    usual = AlbedoMap(values=values)
    turned = AlbedoMap(
        values=values[::-1, ::-1], longitude_edges_rad=(2 * np.pi, 0.0), latitude_edges_rad=(-np.pi / 2, np.pi / 2)
    )
    points = np.random.default_rng(5).normal(size=(500, 3))
    facets = np.zeros(500, dtype=np.int64)
    assert_allclose(turned.at(points, facets, None), usual.at(points, facets, None), rtol=0, atol=FLOAT64_CHAIN / 10)


def test_a_map_of_a_part_ends_at_its_edges_and_crosses_the_zero_meridian() -> None:
    found = AlbedoMap(
        values=np.array([[2.0, 4.0, 6.0]]),
        longitude_edges_rad=(np.radians(350.0), np.radians(380.0)),
        latitude_edges_rad=(np.radians(20.0), 0.0),
        outside=0.25,
    )
    assert _on(found, -9.9, 10.0) == pytest.approx(2.0)  # flat beyond the last pixel center
    assert [_on(found, longitude, 10.0) for longitude in (0.0, 5.0, 19.9)] == pytest.approx([3.0, 4.0, 6.0])
    assert [_on(found, *place) for place in ((-10.1, 10.0), (20.1, 10.0), (5.0, 20.1), (5.0, -0.1))] == [0.25] * 4


def test_a_map_moves_with_the_mesh_it_lies_on() -> None:
    values = np.random.default_rng(6).uniform(size=(6, 10))
    mesh = mesh_from_ellipsoid(sphere(1.0), facets=80).with_albedo(AlbedoMap(values=values))
    offset = np.array([5.0, -2.0, 1.0])
    moved = mesh.translated(offset)
    assert mesh.albedo is not None
    assert moved.albedo is not None
    points, facets, _ = _points_on(mesh, 50)
    assert_allclose(
        moved.albedo.at(points + offset, facets, None),
        mesh.albedo.at(points, facets, None),
        rtol=0,
        atol=FLOAT64 * 100,
    )


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        ({"values": np.array([[-0.1]])}, ">= 0"),
        ({"values": np.array([[np.nan]])}, "finite"),
        ({"values": np.ones(3)}, "rows, columns"),
        ({"longitude_edges_rad": (0.0, 7.0)}, "not more than a turn"),
        ({"latitude_edges_rad": (0.0, 2.0)}, "pi/2"),
        ({"outside": -1.0}, "outside"),
        ({"center_body_km": np.array([0.0, np.nan, 0.0])}, "center_body_km"),
    ],
)
def test_a_map_that_is_none_is_refused(change: dict[str, object], needle: str) -> None:
    arguments: dict[str, object] = {"values": np.ones((2, 2)), **change}
    with pytest.raises(InputError, match=needle):
        AlbedoMap(**arguments)  # type: ignore[arg-type]
