"""Shapes: real files against trimesh and SPICE, damaged ones against clear errors, generated ones against geometry."""

from __future__ import annotations

import pickle
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotate
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh, irregular_body, load_shape, mesh_from_ellipsoid, sphere
from giantlike.shapes.load import UnitsWarning
from tests.tolerances import FLOAT32, FLOAT64, FLOAT64_CHAIN, FLOAT64_ROOT, FLOAT64_SUM, SETTLED

MESH_FINENESS = 2e-3  # relative: 5,000 facets under a smooth surface, sagitta of 2.4 deg / 8

TETRAHEDRON = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
OUTWARD = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
VOLUME = 8.0 / 3.0  # of that tetrahedron


def _obj(vertices: np.ndarray, faces: np.ndarray) -> str:
    rows = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices] + [f"f {i} {j} {k}" for i, j, k in faces + 1]
    return "\n".join(rows) + "\n"


@pytest.fixture
def ball_obj(tmp_path: Path) -> Path:
    ball = mesh_from_ellipsoid(sphere(0.5), facets=500)
    path = tmp_path / "ball.obj"
    path.write_text(_obj(ball.vertices_km, ball.faces))
    return path


@pytest.mark.real_data
@pytest.mark.parametrize(
    "name",
    ["4179toutatis.obj", "BennuUntextured.obj", "ItokawaHayabusa.obj", "hyperion.obj", "ryugu_test.obj", "steins.obj",
     "vesta_5002.ply"],
)  # fmt: skip
def test_real_meshes_have_the_volume_area_and_extent_that_trimesh_finds(data_dir: Path, name: str) -> None:
    path = data_dir / "shapes" / name
    mesh = load_shape(path)
    other = trimesh.load(path, force="mesh", process=False, skip_materials=True)
    assert len(mesh.faces) == len(other.faces)
    assert_allclose(mesh.volume_km3, abs(other.volume), rtol=FLOAT64 * 10)
    assert_allclose(mesh.area_km2, other.area, rtol=FLOAT64)
    assert_allclose(np.ptp(mesh.vertices_km, axis=0), other.extents, rtol=FLOAT64)
    assert_allclose(
        mesh.center_of_figure_km, other.center_mass, atol=FLOAT64_SUM * mesh.circumscribing_radius_km, rtol=0
    )
    assert mesh.openness < 1e-12
    assert mesh.name == path.stem
    assert len(mesh.sha256) == 64


@pytest.mark.real_data
def test_the_eros_table_counts_its_vertices_from_zero(data_dir: Path) -> None:
    path = data_dir / "shapes" / "eros007790.tab"
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], dtype=float)
    faces = np.array([row[1:] for row in rows if row[0] == "f"], dtype=int)
    mesh, other = load_shape(path), trimesh.Trimesh(vertices, faces, process=False)
    assert (faces.min(), len(mesh.faces)) == (0, 7790)
    assert other.is_watertight
    assert_allclose(mesh.volume_km3, other.volume, rtol=FLOAT64 * 10)
    assert_allclose(mesh.area_km2, other.area, rtol=FLOAT64)


@pytest.mark.real_data
def test_a_dsk_has_the_radii_and_the_surface_points_that_spice_finds(data_dir: Path) -> None:
    import spiceypy

    path = data_dir / "shapes" / "phobos_lores.bds"
    mesh = load_shape(path)
    handle = spiceypy.dasopr(str(path))
    try:
        segment = spiceypy.dlabfs(handle)
        bounds = spiceypy.dskgd(handle, segment)
        plate_normals = np.array([spiceypy.dskn02(handle, segment, plate + 1) for plate in range(len(mesh.faces))])
        ray = np.array([0.3, -0.5, 0.81])
        _, point, _ = spiceypy.dskx02(handle, segment, 100.0 * ray, -ray)
    finally:
        spiceypy.dascls(handle)
    assert_allclose(mesh.circumscribing_radius_km, bounds.co3max, rtol=FLOAT64)
    assert_allclose(mesh.normals, plate_normals, rtol=0, atol=FLOAT64)
    distances = np.einsum("ij,ij->i", mesh.normals, point - mesh.vertices_km[mesh.faces[:, 0]])
    assert np.abs(distances).min() < 1e-10 * mesh.circumscribing_radius_km


@pytest.mark.parametrize("start", [0, 1])
@pytest.mark.parametrize("layout", ["letters", "counts", "counts_numbered", "two_counts_in_one_row"])
def test_plate_tables_are_read_in_every_layout_and_count(tmp_path: Path, layout: str, start: int) -> None:
    faces = OUTWARD + start
    numbered = layout == "counts_numbered"
    vertex_rows = [f"{n + 1 if numbered else ''} {x} {y} {z}" for n, (x, y, z) in enumerate(TETRAHEDRON)]
    plate_rows = [f"{n + 1 if numbered else ''} {i} {j} {k}" for n, (i, j, k) in enumerate(faces)]
    if layout == "letters":
        rows = ["v " + row for row in vertex_rows] + ["f " + row for row in plate_rows]
    elif layout == "two_counts_in_one_row":
        rows = ["4 4", *vertex_rows, *plate_rows]
    else:
        rows = ["4", *vertex_rows, "4", *plate_rows]
    path = tmp_path / "plates.tab"
    path.write_text("\n".join(rows))
    mesh = load_shape(path)
    assert_allclose(mesh.volume_km3, VOLUME, rtol=FLOAT64)
    assert_allclose(mesh.vertices_km, TETRAHEDRON, rtol=0, atol=0)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj"])
def test_exchange_formats_written_by_trimesh_come_back_with_shared_vertices(tmp_path: Path, suffix: str) -> None:
    mesh = mesh_from_ellipsoid(Ellipsoid(radii_km=np.array([2.0, 1.4, 1.2])), facets=320)
    path = tmp_path / f"body.{suffix}"
    trimesh.Trimesh(mesh.vertices_km, mesh.faces, process=False).export(path)
    back = load_shape(path)
    assert len(back.vertices_km) == len(mesh.vertices_km)
    assert_allclose(back.volume_km3, mesh.volume_km3, rtol=FLOAT32)


@pytest.mark.parametrize(
    ("file", "content", "needle"),
    [
        ("empty.obj", "", "empty"),
        ("no_faces.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "cannot be read|facet"),
        ("out_of_range.tab", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n", "indices"),
        ("nan.tab", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "not finite"),
        ("words.tab", "v one two three\n", "cannot be read as a plate table"),
        ("short.tab", "4\n0 0 0\n1 0 0\n", "plates after 4 vertices"),
        ("binary.tab", "\x00\x01 junk", "cannot be read as a plate table"),
        ("flat.tab", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 0 1 2\n", "area"),
        ("sheet.tab", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "not closed"),
        ("text.bds", "this is no DSK", "DSK"),
        ("text.ply", "this is no PLY", "PLY"),
        ("text.stl", "this is no STL", "STL|facet"),
    ],
)
def test_a_damaged_shape_file_ends_in_one_line_that_names_it(
    tmp_path: Path, file: str, content: str, needle: str
) -> None:
    path = tmp_path / file
    path.write_text(content)
    with pytest.raises(DataError, match=needle) as caught:
        load_shape(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_an_unknown_type_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.obj.*no such file"):
        load_shape(tmp_path / "nowhere.obj")
    with pytest.raises(DataError, match=r"nowhere\.bds"):
        load_shape(tmp_path / "nowhere.bds")
    with pytest.raises(InputError, match=r"\.blend"):
        load_shape(tmp_path / "body.blend")


def test_a_file_cut_short_is_refused_because_its_surface_is_open(ball_obj: Path) -> None:
    rows = ball_obj.read_text().splitlines()
    ball_obj.write_text("\n".join(rows[: int(0.8 * len(rows))]))
    with pytest.raises(DataError, match="not closed"):
        load_shape(ball_obj)


def test_a_truncated_binary_ply_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    ball = mesh_from_ellipsoid(sphere(1.0), facets=500)
    trimesh.Trimesh(ball.vertices_km, ball.faces, process=False).export(path)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(DataError, match=r"cut\.ply"):
        load_shape(path)


def test_units_scale_the_file_and_auto_refuses_to_guess_between_bennu_and_vesta(tmp_path: Path) -> None:
    ball = mesh_from_ellipsoid(sphere(1.0), facets=500)
    radii = {}
    for size, units in [(17.0, "km"), (17.0, "m"), (17.0, "auto"), (17_000.0, "auto")]:
        path = tmp_path / "ball.obj"
        path.write_text(_obj(ball.vertices_km * size, ball.faces))
        with pytest.warns(UnitsWarning, match=r"ball\.obj: took") if units == "auto" else nullcontext():
            radii[size, units] = load_shape(path, units=units).circumscribing_radius_km
    expected = {(17.0, "km"): 17.0, (17.0, "m"): 0.017, (17.0, "auto"): 17.0, (17_000.0, "auto"): 17.0}
    assert radii == pytest.approx(expected, rel=FLOAT64)
    path.write_text(_obj(ball.vertices_km * 290.0, ball.faces))
    with pytest.raises(DataError, match="state units"):
        load_shape(path, units="auto")
    with pytest.raises(InputError, match="miles"):
        load_shape(path, units="miles")


def test_a_mesh_turned_inside_out_is_turned_back() -> None:
    mesh = TriangleMesh(TETRAHEDRON, OUTWARD[:, ::-1])
    centroids = mesh.vertices_km[mesh.faces].mean(axis=1)
    assert mesh.volume_km3 == pytest.approx(VOLUME)
    assert np.all(np.einsum("ij,ij->i", centroids, mesh.normals) > 0)


def test_facets_without_area_are_dropped() -> None:
    mesh = TriangleMesh(TETRAHEDRON, np.vstack([OUTWARD, [[0, 0, 1], [2, 2, 2]]]))
    assert len(mesh.faces) == 4
    assert np.isfinite(mesh.normals).all()


@pytest.mark.parametrize(
    ("vertices", "faces", "needle"),
    [
        (TETRAHEDRON, np.zeros((0, 3), int), "at least one facet"),
        (TETRAHEDRON, [[0, 1, 4]], "indices 0 to 4"),
        (TETRAHEDRON, [[-1, 1, 2]], "indices -1 to 2"),
        (TETRAHEDRON, [[0.0, 1.0, 2.0]], "integers"),
        (TETRAHEDRON[:, :2], OUTWARD, "shape"),
        (np.where(TETRAHEDRON > 0, np.inf, TETRAHEDRON), OUTWARD, "not finite"),
    ],
)
def test_a_mesh_that_no_ray_tracer_could_take_is_refused(vertices: object, faces: object, needle: str) -> None:
    with pytest.raises(InputError, match=needle):
        TriangleMesh(vertices, faces)  # type: ignore[arg-type]


def test_a_mesh_is_a_value_that_survives_pickling() -> None:
    mesh = irregular_body(3, facets=2000)
    back = pickle.loads(pickle.dumps(mesh))  # noqa: S301
    assert back.sha256 == mesh.sha256
    assert_allclose(back.normals, mesh.normals, rtol=0, atol=0)
    for array in (back.vertices_km, mesh.faces, mesh.normals):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_the_best_fit_ellipsoid_of_an_ellipsoid_mesh_is_that_ellipsoid() -> None:
    radii, offset = np.array([2.0, 1.4, 1.2]), np.array([0.3, -0.1, 0.2])
    turn = Rotation.from_euler("zyx", [20.0, -35.0, 50.0], degrees=True)
    mesh = mesh_from_ellipsoid(Ellipsoid(radii_km=radii), facets=5000)
    moved = TriangleMesh(rotate(turn, mesh.vertices_km.copy()) + offset, mesh.faces)
    placed = moved.best_fit_ellipsoid
    assert_allclose(placed.ellipsoid.radii_km, radii, rtol=MESH_FINENESS)
    assert_allclose(placed.center_body_km, offset, rtol=0, atol=FLOAT64)
    misalignment = placed.body_from_axes.as_matrix().T @ turn.as_matrix()
    assert_allclose(np.abs(misalignment), np.eye(3), rtol=0, atol=SETTLED)
    assert np.linalg.det(placed.body_from_axes.as_matrix()) == pytest.approx(1.0)


def test_an_ellipsoid_knows_its_size_and_refuses_what_is_none() -> None:
    body: Shape = Ellipsoid(radii_km=np.array([3.0, 2.0, 1.0]))
    assert (body.circumscribing_radius_km, body.mean_radius_km) == pytest.approx((3.0, 6.0 ** (1 / 3)))
    assert body.best_fit_ellipsoid.ellipsoid is body
    assert body.sha256 != Ellipsoid(radii_km=np.array([3.0, 2.0, 1.1])).sha256
    for radii in ([1.0, 1.0, 0.0], [1.0, 1.0, -1.0], [1.0, 1.0], [1.0, 1.0, np.nan]):
        with pytest.raises(InputError):
            Ellipsoid(radii_km=np.array(radii))


@pytest.mark.parametrize("facets", [20, 80, 500, 20_480])
def test_a_geodesic_mesh_is_closed_and_approaches_its_ellipsoid_from_within(facets: int) -> None:
    ellipsoid = Ellipsoid(radii_km=np.array([3.0, 2.0, 1.0]))
    mesh = mesh_from_ellipsoid(ellipsoid, facets=facets)
    assert len(mesh.faces) == facets
    assert len(mesh.vertices_km) == facets / 2 + 2  # Euler's formula for a closed surface without handles
    assert_allclose(np.sum((mesh.vertices_km / ellipsoid.radii_km) ** 2, axis=1), 1.0, rtol=0, atol=FLOAT64)
    missing = 1.0 - mesh.volume_km3 / ellipsoid.volume_km3
    assert 0.0 < missing < 12.0 / facets


@pytest.mark.parametrize("seed", [1, 2, 17])
def test_a_generated_asteroid_is_star_shaped_closed_centerd_and_elongated(seed: int) -> None:
    body = irregular_body(seed, facets=20_000)
    corners = body.vertices_km[body.faces]
    outward = np.linalg.det(corners)
    assert np.all(outward > 0)  # every ray from the origin meets one facet, from within
    assert trimesh.Trimesh(body.vertices_km, body.faces, process=False).is_watertight
    assert_allclose(body.center_of_figure_km, 0.0, rtol=0, atol=FLOAT64)
    radii = body.best_fit_ellipsoid.ellipsoid.radii_km
    assert 1.2 < radii[0] / radii[1] < 1.9
    roundness = body.area_km2 / (4 * np.pi * body.mean_radius_km**2)
    assert 1.05 < roundness < 1.6  # rougher than the smooth ellipsoid of these axes (1.04), no hedgehog


def test_a_generated_asteroid_depends_on_its_seed_alone() -> None:
    first, again, other = (irregular_body(seed, facets=2000) for seed in (5, 5, 6))
    assert first.sha256 == again.sha256
    assert first.sha256 != other.sha256
    smooth = irregular_body(5, facets=2000, relief=0.0, roughness=0.0, radii_km=(2.0, 1.4, 1.2))
    assert_allclose(smooth.volume_km3, 4 / 3 * np.pi * 2.0 * 1.4 * 1.2, rtol=5 * MESH_FINENESS)
    with pytest.raises(InputError, match="relief"):
        irregular_body(5, relief=0.9)


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    st.tuples(*[st.floats(-50.0, 50.0)] * 3),
)
def test_volume_and_area_do_not_depend_on_where_a_mesh_lies(turn: tuple[float, ...], offset: tuple[float, ...]) -> None:
    moved = TriangleMesh(rotate(Rotation.from_rotvec(turn), TETRAHEDRON) + offset, OUTWARD)
    assert_allclose(moved.volume_km3, VOLUME, rtol=FLOAT64_CHAIN / 10)
    assert_allclose(moved.area_km2, 8.0 * np.sqrt(3.0), rtol=FLOAT64_CHAIN / 10)
    assert_allclose(moved.center_of_figure_km, offset, rtol=0, atol=FLOAT64_ROOT / 10)
