"""Landmarks: maplets in SPC's binary format, catalogs in files, places chosen on shapes, and the command."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.relative.landmarks.selection import LandmarkBuildOptions, build_landmarks, landmarks_of
from giantlike.shapes import (
    LocalMap,
    TriangleMesh,
    VertexAlbedo,
    irregular_body,
    mesh_from_ellipsoid,
    save_shape,
    sphere,
)
from giantlike.shapes.files.maplet import read_maplet
from giantlike.shapes.landmarks import Landmark, LandmarkCatalog, landmark_of, load_landmarks, save_landmarks
from tests.tolerances import FLOAT32, FLOAT64, FLOAT64_ROOT

BODY = irregular_body(3, facets=5000)


def spc_maplet(
    center: Float, axes: Float, scale_km: float, heights: Float, albedo: Float, *, first: bytes = b"UNUSED"
) -> bytes:
    """The bytes of a maplet, pixel by pixel as SPC writes them.

    ``axes`` has Ux, Uy and Uz in its rows; ``heights`` [i, j], in units of the scale, lies i pixels along Uy and j
    along Ux from the first corner.
    """
    half = (len(heights) - 1) // 2
    step = max(1.0, float(np.abs(heights).max())) / 30000
    record = first + struct.pack(">f", scale_km) + struct.pack("<H", half) + bytes([50, 50, 50])
    record += struct.pack(">12f", *center, *axes.ravel()) + struct.pack(">f", step) + struct.pack(">f", 50.0) + b"\0"
    assert len(record) == 72
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            there = albedo[i, j] > 0.0
            height = round(heights[i, j] / step) if there else 0
            record += struct.pack(">hB", height, round(100 * albedo[i, j]))
    return record + bytes(-len(record) % 72)


def south_east_up(longitude: float, latitude: float) -> Float:
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    return np.stack([np.cross(east, up), east, up])


def test_a_maplet_has_its_heights_where_spc_means_them(tmp_path: Path) -> None:
    axes, center, scale_km, half = south_east_up(1.6, 0.2), np.array([0.1, 0.9, 0.2]), 0.01, 5
    i, j = np.mgrid[-half : half + 1, -half : half + 1]
    heights, albedo = 0.3 * i - 0.1 * j + 0.02 * i * j, 1.0 + 0.05 * i
    heights[0, 3] = albedo[0, 3] = 0.0
    path = tmp_path / "EE0001.MAP"
    path.write_bytes(spc_maplet(center, axes, scale_km, heights, albedo))
    local = read_maplet(path)
    assert local.name == "EE0001"
    assert local.heights_km.shape == (11, 11)
    points = local._grid()
    seen = np.isfinite(points[:, 2])
    assert np.count_nonzero(~seen) == 1
    along_x, along_y = (points[seen, :2] / scale_km).T
    expected = 0.3 * along_y - 0.1 * along_x + 0.02 * along_x * along_y
    step_km = scale_km * np.abs(heights).max() / 30000
    assert_allclose(points[seen, 2], scale_km * expected, rtol=0, atol=step_km)
    body = local.to_body(points[seen])
    direct = center + points[seen, :1] * axes[0] + points[seen, 1:2] * axes[1] + points[seen, 2:] * axes[2]
    assert_allclose(body, direct, rtol=0, atol=FLOAT32)
    assert local.albedo is not None
    assert_allclose(local.albedo.ravel()[seen], 1.0 + 0.05 * along_y, rtol=0, atol=0.0051)  # hundredths
    assert local.mesh().normals @ axes[2] == pytest.approx(1.0, abs=0.2)


def test_a_damaged_maplet_is_refused_in_words(tmp_path: Path) -> None:
    flat, ones, axes = np.zeros((5, 5)), np.ones((5, 5)), south_east_up(0.3, 0.4)
    good = spc_maplet(np.ones(3), axes, 0.01, flat, ones)
    cases = {
        "bytes": good[:100],
        "at least": good[:50],
        "axes": spc_maplet(np.ones(3), 1.5 * axes, 0.01, flat, ones),
        "right-handed": spc_maplet(np.ones(3), axes[[1, 0, 2]], 0.01, flat, ones),
        "no maplet": spc_maplet(np.ones(3), axes, -0.01, flat, ones),
        "three corners": spc_maplet(np.ones(3), axes, 0.01, flat, 0.0 * ones),
        "double precision": spc_maplet(np.ones(3), axes, 0.01, flat, ones, first=b"DOUBLE"),
    }
    for needle, content in cases.items():
        path = tmp_path / "BAD001.MAP"
        path.write_bytes(content)
        with pytest.raises(DataError, match=needle):
            read_maplet(path)
    with pytest.raises(DataError, match="no such file"):
        read_maplet(tmp_path / "NONE.MAP")


def test_a_folder_of_maplets_is_a_catalog(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    for number in range(3):
        axes = south_east_up(number, 0.3)
        heights = random.normal(size=(9, 9))
        path = tmp_path / f"AA000{number}.{'MAP' if number else 'map'}"
        path.write_bytes(spc_maplet(axes[2], axes, 0.01, heights, np.ones((9, 9))))
    catalog = load_landmarks(tmp_path)
    assert [landmark.name for landmark in catalog.landmarks] == ["AA0000", "AA0001", "AA0002"]
    assert catalog.shape_sha256 == ""
    assert catalog.landmarks[0].size_km == pytest.approx(0.08, rel=FLOAT32)
    assert len(load_landmarks(tmp_path / "AA0001.MAP")) == 1
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no maplet"):
        load_landmarks(tmp_path / "empty")


def painted() -> TriangleMesh:
    ball = mesh_from_ellipsoid(sphere(1.0), facets=5000)
    x, y, z = ball.vertices_km.T
    return ball.with_albedo(VertexAlbedo(1.0 + 0.4 * np.sin(9 * x) * np.sin(9 * y) * (z > 0.0)))


def test_a_catalog_is_the_same_after_a_file(tmp_path: Path) -> None:
    catalog = build_landmarks(painted(), LandmarkBuildOptions(count=12, samples=9))
    bare = Landmark(LocalMap(
        center_body_km=np.ones(3),
        body_from_map=Rotation.identity(),
        heights_km=np.array([[0.0, 0.1, np.nan], [0.2, 0.0, 0.1]]),
        spacing_km=0.2,
        name="bare",
    ), 0.1)  # fmt: skip
    catalog = LandmarkCatalog((bare, *catalog.landmarks), catalog.body_name, catalog.shape_sha256)
    path = tmp_path / "landmarks.npz"
    save_landmarks(catalog, path)
    again = load_landmarks(path)
    assert (again.body_name, again.shape_sha256) == (catalog.body_name, catalog.shape_sha256)
    for one, other in zip(catalog.landmarks, again.landmarks, strict=True):
        assert (one.name, one.texture, one.map.spacing_km) == (other.name, other.texture, other.map.spacing_km)
        assert_allclose(other.map.heights_km, one.map.heights_km, rtol=0, atol=FLOAT64_ROOT / 10)  # float32 of 0.1 km
        assert_allclose(other.point_body_km, one.point_body_km, rtol=0, atol=FLOAT64_ROOT / 10)
        assert_allclose(other.normal_body, one.normal_body, rtol=0, atol=FLOAT64)
        assert (one.map.albedo is None) == (other.map.albedo is None)
        if one.map.albedo is not None and other.map.albedo is not None:
            assert_allclose(other.map.albedo, one.map.albedo, rtol=0, atol=FLOAT32)
    with pytest.raises(InputError, match="overwrite"):
        save_landmarks(catalog, path)
    assert np.load(path, allow_pickle=False)["names"].dtype.kind == "U"


def test_what_is_no_catalog_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "shape.npz"
    save_shape(BODY, path)
    with pytest.raises(DataError, match="holds no landmarks"):
        load_landmarks(path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(DataError, match="cannot be read as a catalog of landmarks"):
        load_landmarks(path)
    for name, error in (("none.npz", DataError), ("none.txt", InputError)):
        with pytest.raises(error):
            load_landmarks(tmp_path / name)
    with pytest.raises(InputError, match="at least one"):
        LandmarkCatalog(())
    twice = landmark_of(LocalMap(
        center_body_km=np.ones(3), body_from_map=Rotation.identity(), heights_km=np.zeros((3, 3)), spacing_km=0.1
    ))  # fmt: skip
    with pytest.raises(InputError, match="one name"):
        LandmarkCatalog((twice, twice))


def test_landmarks_of_a_shape_lie_on_it_apart_and_all_around() -> None:
    catalog = build_landmarks(BODY, LandmarkBuildOptions(count=60))
    places = np.array([landmark.point_body_km for landmark in catalog.landmarks])
    normals = np.array([landmark.normal_body for landmark in catalog.landmarks])
    assert len(places) == 60
    assert catalog.shape_sha256 == BODY.sha256
    hits = tracer_for(BODY).intersect(places + 0.05 * normals, -normals)
    distance = np.abs(np.linalg.norm(hits.points_km - places - 0.05 * normals, axis=1) - 0.05)
    sizes = np.array([landmark.size_km for landmark in catalog.landmarks])
    assert np.all(distance < 0.5 * sizes)  # a place is at the mean height of its map
    for landmark in catalog.landmarks[:10]:
        ground = landmark.grid_body_km(5)
        up = landmark.normal_body
        found = tracer_for(BODY).intersect(ground + 0.01 * up, np.broadcast_to(-up, ground.shape)).points_km
        assert_allclose(found, ground, rtol=0, atol=FLOAT64_ROOT)  # float32 picks the facet, float64 the point
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) + np.eye(60)
    assert gaps.min() > 0.4 * np.sqrt(BODY.area_km2 / 60)
    assert np.linalg.norm((places / np.linalg.norm(places, axis=1, keepdims=True)).mean(axis=0)) < 0.4
    texture = [landmark.texture for landmark in catalog.landmarks]
    assert texture == sorted(texture, reverse=True)


def test_on_a_smooth_ball_landmarks_go_where_the_albedo_varies() -> None:
    catalog = build_landmarks(painted(), LandmarkBuildOptions(count=10, size_km=0.4, samples=15))
    heights = np.array([landmark.point_body_km[2] for landmark in catalog.landmarks])
    texture = np.array([landmark.texture for landmark in catalog.landmarks])
    assert np.all(heights[:5] > -0.2)  # a landmark reaches 0.28 from its place
    assert texture[heights > 0.2].min() > 2.0 * np.max(texture[heights < -0.3], initial=0.0)


def test_landmarks_of_a_mesh_are_chosen_once() -> None:
    mesh = irregular_body(4, facets=2000)
    assert landmarks_of(mesh) is landmarks_of(mesh)


def test_a_landmark_as_large_as_the_body_is_refused() -> None:
    with pytest.raises(InputError, match="size_km"):
        build_landmarks(BODY, LandmarkBuildOptions(size_km=1.0))
    with pytest.raises(InputError, match="count"):
        LandmarkBuildOptions(count=0)


def test_the_command_writes_what_the_estimator_reads(tmp_path: Path) -> None:
    save_shape(BODY, tmp_path / "rock.ply")
    arguments = ["shape", "landmarks", str(tmp_path / "rock.ply"), str(tmp_path / "rock-landmarks.npz")]
    options = ["--count", "20", "--size-km", "0.04"]
    result = CliRunner().invoke(app, [*arguments, *options, "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    catalog = load_landmarks(tmp_path / "rock-landmarks.npz")
    assert said["landmarks"] == len(catalog) == 20
    assert said["sha256"]
    assert said["shape_sha256"] == catalog.shape_sha256
    assert catalog.landmarks[0].size_km == pytest.approx(0.04)
    again = CliRunner().invoke(app, [*arguments, *options])
    assert again.exit_code == 2
    assert "--overwrite" in again.stderr
    assert CliRunner().invoke(app, [*arguments, *options, "--overwrite"]).exit_code == 0
    maplet = tmp_path / "AB0001.MAP"
    axes = south_east_up(0.3, 0.4)
    maplet.write_bytes(spc_maplet(axes[2], axes, 0.01, np.zeros((9, 9)), np.ones((9, 9))))
    collected = CliRunner().invoke(app, ["shape", "landmarks", str(maplet), str(tmp_path / "maps.npz")])
    assert collected.exit_code == 0, collected.output
    assert load_landmarks(tmp_path / "maps.npz").landmarks[0].name == "AB0001"
    refused = CliRunner().invoke(app, ["shape", "landmarks", str(maplet), str(tmp_path / "x.npz"), "--count", "3"])
    assert refused.exit_code == 2
