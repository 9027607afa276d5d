"""Shape files: every format there and back, broken files and surfaces told and mended, numbers against trimesh."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from giantlike.core.errors import DataError, InputError
from giantlike.shapes import (
    Ellipsoid,
    FacetAlbedo,
    TriangleMesh,
    VertexAlbedo,
    irregular_body,
    load_shape,
    mesh_from_ellipsoid,
    save_shape,
    sphere,
)
from giantlike.shapes.decimate import decimate_mesh, deviation, surface_distances
from giantlike.shapes.defects import Defects, defects_of
from giantlike.shapes.files.dsk import DskIdentity
from giantlike.shapes.files.exchange import read_exchange, read_plain_obj
from giantlike.shapes.load import mesh_of, read_surface
from giantlike.shapes.measure import measure_mesh
from giantlike.shapes.repair import repair_surface
from giantlike.shapes.surface import Surface
from tests.tolerances import FLOAT32, FLOAT64, FLOAT64_CHAIN, FLOAT64_SUM, SAMPLED, SETTLED

AGREEMENT = 1e-9  # relative: what the issue asks of the numbers of trimesh
STORED = 1.2e-7  # relative: coordinates written in single precision
PHOBOS = DskIdentity(center=401, frame="IAU_PHOBOS", surface=7)

CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


@pytest.fixture(scope="module")
def rock() -> TriangleMesh:
    return irregular_body(11, facets=1280, radii_km=(2.1, 1.4, 1.2))


def rows_of(table: NDArray[np.generic], prefix: str = "") -> list[str]:
    return [prefix + " ".join(map(repr, row)) for row in table.tolist()]


def surface_of(mesh: TriangleMesh) -> Surface:
    return Surface(vertices=mesh.vertices_km.copy(), faces=mesh.faces.copy(), in_km=True)


def icq_file(path: Path, q: int, place: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Path:
    """An ICQ model made from the corners that the format description says the faces share, not from our lattice."""
    a, b, c, d = [-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, 1]
    e, f, g, h = [-1, 1, -1], [-1, -1, -1], [1, 1, -1], [1, -1, -1]
    corners = np.array(  # of each face at (I, J) = (0, 0), (0, Q), (Q, 0), (Q, Q)
        [[a, b, c, d], [b, e, d, g], [a, f, b, e], [c, h, a, f], [d, g, c, h], [e, f, g, h]], dtype=np.float64
    )
    j, i = (grid / q for grid in np.mgrid[: q + 1, : q + 1])
    weights = np.stack([(1 - i) * (1 - j), (1 - i) * j, i * (1 - j), i * j], axis=-1)
    points = place(np.einsum("jik,fkx->fjix", weights, corners).reshape(-1, 3))
    path.write_text("\n".join([f"      {q}", *rows_of(points)]) + "\n")
    return path


@pytest.mark.parametrize("suffix", ["obj", "ply", "tab", "plt", "npz", "bds"])
def test_a_mesh_comes_back_to_the_last_bit_with_its_facets_in_order(
    tmp_path: Path, rock: TriangleMesh, suffix: str
) -> None:
    path = tmp_path / f"rock.{suffix}"
    save_shape(rock, path, dsk=PHOBOS)
    back = load_shape(path)
    assert_array_equal(back.vertices_km, rock.vertices_km)
    assert_array_equal(back.faces, rock.faces)
    assert back.name == "rock"


def test_an_stl_file_keeps_single_precision_and_its_shared_vertices(tmp_path: Path, rock: TriangleMesh) -> None:
    save_shape(rock, tmp_path / "rock.stl")
    back = load_shape(tmp_path / "rock.stl")
    assert len(back.vertices_km) == len(rock.vertices_km)
    assert_allclose(
        back.vertices_km[back.faces], rock.vertices_km[rock.faces], rtol=0, atol=STORED * rock.circumscribing_radius_km
    )


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_other_programs_read_what_is_written(tmp_path: Path, rock: TriangleMesh, suffix: str) -> None:
    path = tmp_path / f"rock.{suffix}"
    save_shape(rock, path)
    other = trimesh.load(path, force="mesh")
    assert other.is_watertight
    assert_allclose(other.volume, rock.volume_km3, rtol=FLOAT32)  # STL coordinates have 24 bits


def test_albedo_by_facet_and_by_vertex_is_kept_in_npz(tmp_path: Path, rock: TriangleMesh) -> None:
    random = np.random.default_rng(2)
    by_facet = FacetAlbedo(random.uniform(0.5, 1.5, len(rock.faces)))
    by_vertex = VertexAlbedo(random.uniform(0.5, 1.5, len(rock.vertices_km)))
    for albedo in (by_facet, by_vertex):
        path = tmp_path / f"{type(albedo).__name__}.npz"
        save_shape(replace(rock, albedo=albedo, sha256=""), path)
        back = load_shape(path).albedo
        assert isinstance(back, type(albedo))
        assert_array_equal(back.values, albedo.values)


def test_a_shape_archive_of_another_kind_or_version_is_refused(tmp_path: Path, rock: TriangleMesh) -> None:
    np.savez(tmp_path / "other.npz", vertices=rock.vertices_km, faces=rock.faces)
    np.savez(tmp_path / "later.npz", format="giantlike shape", version=2)
    np.savez(tmp_path / "objects.npz", format=np.array([{"pickled": 1}], dtype=object))
    for name, needle in (("other", "holds no shape"), ("later", "version 1"), ("objects", "pickle")):
        with pytest.raises(DataError, match=needle):
            load_shape(tmp_path / f"{name}.npz")


def test_spice_finds_its_own_plates_and_identity_in_a_written_dsk(tmp_path: Path, rock: TriangleMesh) -> None:
    import spiceypy

    path = tmp_path / "rock.bds"
    save_shape(rock, path, dsk=PHOBOS)
    start, direction = np.array([9.0, -7.0, 5.0]), np.array([-9.0, 7.1, -5.2])
    handle = spiceypy.dasopr(str(path))
    try:
        segment = spiceypy.dlabfs(handle)
        descriptor = spiceypy.dskgd(handle, segment)
        _, point, found = spiceypy.dskx02(handle, segment, start, direction)
    finally:
        spiceypy.dascls(handle)
    assert (descriptor.center, descriptor.surfce, descriptor.dtype) == (401, 7, 2)
    assert spiceypy.frmnam(descriptor.frmcde) == "IAU_PHOBOS"
    assert descriptor.dclass == 1  # irregular_body is single-valued
    assert_allclose(descriptor.co3max, rock.circumscribing_radius_km, rtol=FLOAT64)
    places, _, _ = trimesh.Trimesh(rock.vertices_km, rock.faces, process=False).ray.intersects_location(
        [start], [direction], multiple_hits=False
    )
    assert found
    assert_allclose(point, places[0], rtol=0, atol=FLOAT32)  # km: trimesh may trace in single precision


def test_a_dsk_of_a_body_that_rays_meet_twice_is_of_the_general_class(tmp_path: Path, rock: TriangleMesh) -> None:
    import spiceypy

    save_shape(rock.translated([5.0, 0.0, 0.0]), tmp_path / "far.bds", dsk=PHOBOS)
    handle = spiceypy.dasopr(str(tmp_path / "far.bds"))
    try:
        assert spiceypy.dskgd(handle, spiceypy.dlabfs(handle)).dclass == 2
    finally:
        spiceypy.dascls(handle)


def test_a_dsk_must_say_what_it_describes_in_words_that_spice_knows(tmp_path: Path, rock: TriangleMesh) -> None:
    with pytest.raises(InputError, match="which body and frame"):
        save_shape(rock, tmp_path / "rock.bds")
    with pytest.raises(InputError, match="NOWHERE_FIXED"):
        save_shape(rock, tmp_path / "rock.bds", dsk=DskIdentity(center=401, frame="NOWHERE_FIXED"))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_unasked_and_a_failed_write_leaves_the_old_file(
    tmp_path: Path, rock: TriangleMesh
) -> None:
    path = tmp_path / "rock.icq"
    path.write_text("precious")
    with pytest.raises(InputError, match="exists"):
        save_shape(rock, path)
    with pytest.raises(InputError, match="ICQ model has 12"):
        save_shape(rock, path, overwrite=True)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("rock.icq", "precious")]
    with pytest.raises(InputError, match=r"not '\.blend'"):
        save_shape(rock, tmp_path / "rock.blend")
    with pytest.raises(DataError, match="cannot be written"):
        save_shape(rock, tmp_path / "nowhere" / "rock.obj")
    save_shape(rock, tmp_path / "rock.obj")
    save_shape(rock, tmp_path / "rock.obj", overwrite=True)


@pytest.mark.parametrize("layout", ["letters", "counted", "numbered"])
@pytest.mark.parametrize("mixed", [False, True])
def test_quadrilaterals_of_a_table_are_split_and_keep_their_order(tmp_path: Path, layout: str, mixed: bool) -> None:
    plates = rows_of(QUADS + 1)
    if mixed:
        plates[2:3] = ["1 5 6", "1 6 2"]
    vertices = rows_of(CUBE)
    if layout == "numbered":
        vertices, plates = ([f"{n + 1} {row}" for n, row in enumerate(rows)] for rows in (vertices, plates))
    if layout == "letters":
        rows = [f"v {row}" for row in vertices] + [f"f {row}" for row in plates]
    else:
        rows = [f"8 {len(plates)}", *vertices, *plates]
    path = tmp_path / "cube.tab"
    path.write_text("\r\n".join(rows))
    mesh = load_shape(path)
    assert len(mesh.faces) == 12
    assert_allclose(mesh.volume_km3, 8.0, rtol=FLOAT64)
    assert_array_equal(mesh.faces[4:6][:, [0, 1, 2]], load_shape(path).faces[4:6])
    assert set(mesh.faces[4:6].ravel()) == {0, 1, 4, 5}


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_quadrilaterals_of_exchange_formats_are_split(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cube.{suffix}"
    if suffix == "obj":
        rows = rows_of(CUBE, "v ") + rows_of(QUADS + 1, "f ")
    else:
        rows = ["ply", "format ascii 1.0", "element vertex 8", *[f"property double {axis}" for axis in "xyz"]]
        rows += ["element face 6", "property list uchar int vertex_indices", "end_header"]
        rows += rows_of(CUBE) + rows_of(QUADS, "4 ")
    path.write_text("\n".join(rows) + "\n")
    mesh = load_shape(path)
    assert len(mesh.faces) == 12
    assert_allclose(mesh.volume_km3, 8.0, rtol=FLOAT64)
    assert_allclose(mesh.area_km2, 24.0, rtol=FLOAT64)


def test_an_obj_may_have_comments_in_any_encoding(tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    path.write_bytes(
        "# Würfel\n".encode("latin-1") + "\n".join(rows_of(CUBE, "v ") + rows_of(QUADS + 1, "f ")).encode()
    )
    assert load_shape(path).volume_km3 == pytest.approx(8.0)


@pytest.mark.parametrize(
    "rows",
    [
        ["v 0 0 0 1", *rows_of(CUBE[1:], "v "), *rows_of(QUADS[:, :3] + 1, "f ")],
        [*rows_of(CUBE, "v "), "vn 0 0 1", *rows_of(QUADS[:, :3] + 1, "f ")],
        [*rows_of(CUBE, "v "), "f 1 2", "3 f 1 2 3"],
        [*rows_of(CUBE, "v "), "f 1 2 3 f 1 2 4"],
        [*rows_of(CUBE, "v "), "f 1/1 2/2 3/3"],
        [*rows_of(CUBE, "v "), "f 1 2 -1"],
        [*rows_of(CUBE, "v "), "f 1 2 3", "v 0 0 0"],
        [*rows_of(CUBE[:7], "v "), "v 1.2.3 0 0", "f 1 2 3"],
        [*rows_of(CUBE[:7], "v "), "v 1 e 0", "f 1 2 3"],
        ["f 1 2 3"],
        ["# nothing"],
        [],
    ],
)
def test_the_fast_reader_of_obj_leaves_all_but_plain_rows_to_the_general_one(rows: list[str]) -> None:
    assert read_plain_obj("\n".join(rows).encode()) is None


@pytest.mark.parametrize("end", ["\n", "\r\n", "\n\n"])
def test_the_fast_reader_of_obj_and_the_general_one_agree(
    tmp_path: Path, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = ["# two", "# comments", *rows_of(CUBE * np.pi, "v  "), *rows_of(QUADS[:, :3] + 1, "f ")]
    path = tmp_path / "open.obj"
    path.write_bytes(end.join(rows).encode())
    fast = read_exchange(path)
    monkeypatch.setattr("giantlike.shapes.files.exchange.read_plain_obj", lambda content: None)
    general = read_exchange(path)
    assert_array_equal(fast.vertices, general.vertices)
    assert_array_equal(fast.faces, general.faces)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("sides", [3, 4, "mixed"])
def test_binary_ply_of_either_byte_order_and_with_more_columns_is_read(
    tmp_path: Path, order: str, sides: int | str
) -> None:
    words = {"<": "little", ">": "big"}[order]
    header = ["ply", f"format binary_{words}_endian 1.0", "comment a cube", "element vertex 8"]
    header += ["property float red", *[f"property double {axis}" for axis in "zyx"]]
    corners = {4: QUADS.tolist(), 3: [[a, b, c] for q in QUADS for a, b, c in (q[:3], q[[0, 2, 3]])]}
    facets = corners[sides] if isinstance(sides, int) else corners[4][:3] + corners[3][6:]
    header += [f"element face {len(facets)}", "property list uchar uint vertex_indices", "end_header"]
    data = b"".join(struct.pack(f"{order}f3d", 0.5, z, y, x) for x, y, z in CUBE.tolist())
    data += b"".join(struct.pack(f"{order}B{len(facet)}I", len(facet), *facet) for facet in facets)
    path = tmp_path / "cube.ply"
    path.write_bytes("\n".join(header).encode() + b"\n" + data)
    mesh = load_shape(path)
    assert_array_equal(mesh.vertices_km, CUBE)
    assert len(mesh.faces) == 12
    assert_allclose(mesh.volume_km3, 8.0, rtol=FLOAT64)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DataError, match="cannot be read as a PLY"):
        load_shape(path)


def test_a_dsk_of_many_segments_is_read_and_one_cut_short_never_reaches_spice(tmp_path: Path) -> None:
    import spiceypy

    path = tmp_path / "many.bds"
    box, plates = CUBE.copy(), (np.array([[a, b, c] for q in QUADS for a, b, c in (q[:3], q[[0, 2, 3]])]) + 1)
    system = (1, np.zeros(10), -np.pi, np.pi, -np.pi / 2, np.pi / 2, 0.0, 1e4, -1e9, 1e9)
    handle = spiceypy.dskopn(str(path), "many", 0)
    for number in range(140):  # a directory of the file describes 123 of them
        vertices = box + np.array([3.0 * number, 0.0, 0.0])
        index = spiceypy.dskmi2(vertices, plates, 2.0, 2, 10_000, 10_000, 10_000, False, 130_000)
        spiceypy.dskw02(handle, 401, number + 1, 2, "IAU_PHOBOS", *system, vertices, plates, *index)
    spiceypy.dskcls(handle, False)
    mesh = load_shape(path)
    assert len(mesh.faces) == 140 * 12
    assert_allclose(mesh.volume_km3, 140 * 8.0, rtol=FLOAT64_SUM)
    whole = path.read_bytes()
    path.write_bytes(whole[: 3 * len(whole) // 4])
    with pytest.raises(DataError, match="is it cut short"):
        load_shape(path)


@pytest.mark.parametrize("start", [0, 1])
def test_the_numbering_of_a_table_whose_outer_vertices_are_unused_is_told_by_its_edges(
    tmp_path: Path, rock: TriangleMesh, start: int
) -> None:
    far = np.array([[90.0, 0.0, 0.0]])
    vertices = np.concatenate([far, rock.vertices_km, -far])
    path = tmp_path / "rock.tab"
    path.write_text("\n".join(rows_of(vertices, "v ") + rows_of(rock.faces + 1 + start, "f ")))
    mesh = load_shape(path)
    assert_array_equal(mesh.vertices_km[mesh.faces], rock.vertices_km[rock.faces])
    assert defects_of(read_surface(path)).unreferenced_vertices == 2


def test_tables_may_have_commas_tabulators_comments_and_the_exponents_of_fortran(tmp_path: Path) -> None:
    vertices = [row.replace("1.0", "0.1D+01").replace(" ", ", ") for row in rows_of(CUBE, "v ")]
    path = tmp_path / "cube.tab"
    plates = [row.replace(" ", "\t") for row in rows_of(QUADS, "f ")]
    path.write_text("\n".join(["# a cube", "", *vertices, *plates]))
    assert load_shape(path).volume_km3 == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("rows", "needle"),
    [
        (["v 0 0", "v 1 0 0"], "columns changed"),
        (["v 0 0 0", "f 1 2 1.5"], "vertex numbers, got 1.5"),
        (["v 0 0 0", "f 1 2 inf"], "vertex numbers, got inf"),
        (["v 0 0 0", "vn 1 2 3"], "'v x y z' or 'f i j k'"),
        (["v 0 0 0", "g 1 2 3"], "'v x y z' or 'f i j k'"),
        (["2 1", "1 0 0 0", "7 0 0 1", "1 2 3"], "or its number"),
        (["2 2", "0 0 0", "0 0 1", "1 2 3"], "2 vertices and 2 plates"),
    ],
)
def test_a_wrong_row_of_a_table_is_named(tmp_path: Path, rows: list[str], needle: str) -> None:
    path = tmp_path / "wrong.tab"
    path.write_text("\n".join(rows))
    with pytest.raises(DataError, match=needle):
        load_shape(path)


@pytest.mark.parametrize("suffix", ["icq", "txt", "tab"])
@pytest.mark.parametrize("q", [1, 2, 7])
def test_an_icq_model_of_a_cube_is_a_closed_cube(tmp_path: Path, q: int, suffix: str) -> None:
    path = icq_file(tmp_path / f"cube.{suffix}", q, lambda points: points)
    mesh, surface = load_shape(path), read_surface(path)
    assert (len(mesh.faces), len(mesh.vertices_km)) == (12 * q * q, 6 * q * q + 2)
    assert not defects_of(surface)
    assert_allclose([mesh.volume_km3, mesh.area_km2], [8.0, 24.0], rtol=FLOAT64)


def test_an_icq_model_comes_back_to_the_last_bit_with_its_albedo(tmp_path: Path) -> None:
    def lumpy(points: NDArray[np.float64]) -> NDArray[np.float64]:
        lengths: NDArray[np.float64] = np.linalg.norm(points, axis=1, keepdims=True)
        return (1.0 + 0.1 * np.sin(3.0 * points[:, :1]) * points[:, 1:2]) * points / lengths

    mesh = load_shape(icq_file(tmp_path / "lumpy.icq", 8, lumpy))
    albedo = VertexAlbedo(np.linspace(0.5, 1.5, len(mesh.vertices_km)))
    save_shape(replace(mesh, albedo=albedo, sha256=""), tmp_path / "back.txt")
    back = load_shape(tmp_path / "back.txt")
    assert_array_equal(back.vertices_km, mesh.vertices_km)
    assert_array_equal(back.faces, mesh.faces)
    assert isinstance(back.albedo, VertexAlbedo)
    assert_array_equal(back.albedo.values, albedo.values)


def test_an_icq_model_with_a_row_missing_or_a_torn_edge_is_refused(tmp_path: Path, rock: TriangleMesh) -> None:
    path = icq_file(tmp_path / "cube.icq", 4, lambda points: points)
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:-1]))
    with pytest.raises(DataError, match=r"needed 6 .* = 150 vertices for Q = 4, found 149"):
        load_shape(path)
    path.write_text("\n".join([*rows[:-1], "0 0 0"]))
    with pytest.raises(DataError, match="two faces of the cube share differ"):
        load_shape(path)
    path.write_text("\n".join(rows))
    cube = load_shape(path)
    with pytest.raises(InputError, match="not connected as an ICQ"):
        save_shape(TriangleMesh(cube.vertices_km, np.roll(cube.faces, 1, axis=0)), tmp_path / "rolled.icq")


CLEAN = dict.fromkeys(Defects.__dataclass_fields__, 0)


def broken(mesh: TriangleMesh, kind: str) -> tuple[Surface, dict[str, int]]:
    """A clean mesh with one kind of damage, and what must be counted."""
    vertices, faces = mesh.vertices_km.copy(), mesh.faces.copy()
    if kind == "stray vertices":
        return Surface(vertices=np.vstack([vertices, [[9.0, 9, 9], [8, 8, 8]]]), faces=faces), {
            "unreferenced_vertices": 2
        }
    if kind == "stray NaN":
        vertices = np.vstack([vertices, [[np.nan, 0.0, 0.0]]])
        return Surface(vertices=vertices, faces=faces), {"unreferenced_vertices": 1, "nonfinite_vertices": 1}
    if kind == "double facets":
        faces = np.vstack([faces, faces[3:5], faces[7:8, ::-1], np.roll(faces[9:10], 1, axis=1)])
        return Surface(vertices=vertices, faces=faces), {"duplicate_facets": 4}
    if kind == "flat facets":
        return Surface(vertices=vertices, faces=np.vstack([faces, [[0, 0, 1], [5, 5, 5]]])), {"degenerate_facets": 2}
    if kind == "invalid facets":
        wrong = [[0, 1, len(vertices)], [-1, 2, 3]]
        return Surface(vertices=vertices, faces=np.vstack([faces, wrong])), {"invalid_facets": 2}
    if kind == "holes":
        return Surface(vertices=vertices, faces=np.delete(faces, [10, 900], axis=0)), {"boundary_edges": 6, "holes": 2}
    if kind == "wrong winding":
        faces[10] = faces[10, ::-1]
        return Surface(vertices=vertices, faces=faces), {"inconsistent_edges": 3}
    fin = [[*faces[0, :2], len(vertices)]]
    return Surface(vertices=np.vstack([vertices, [[9.0, 9.0, 9.0]]]), faces=np.vstack([faces, fin])), {
        "boundary_edges": 2, "holes": 1, "nonmanifold_edges": 1,
    }  # fmt: skip


KINDS = ["stray vertices", "stray NaN", "double facets", "flat facets", "invalid facets", "holes", "wrong winding"]


@pytest.mark.parametrize("kind", [*KINDS, "fin"])
def test_each_defect_is_counted_and_nothing_else(rock: TriangleMesh, kind: str) -> None:
    surface, counts = broken(rock, kind)
    found = defects_of(surface)
    assert found == Defects(**CLEAN | counts)
    assert found
    assert all(name.replace("_", " ") in found.text() for name in counts)
    assert found.watertight == (not counts.keys() & {"boundary_edges", "nonmanifold_edges"})


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_broken_is_mended_without_moving_the_surface(rock: TriangleMesh, kind: str) -> None:
    result = repair_surface(broken(rock, kind)[0])
    assert not result.after, result.after.text()
    mesh = TriangleMesh(result.surface.vertices, result.surface.faces)
    assert_allclose(mesh.volume_km3, rock.volume_km3, rtol=FLOAT64)
    assert (result.facets_turned, result.holes_filled, result.facets_added) == {
        "wrong winding": (1, 0, 0), "holes": (0, 2, 2)
    }.get(kind, (0, 0, 0))  # fmt: skip


def test_a_clean_surface_has_no_defects_and_is_left_alone(rock: TriangleMesh) -> None:
    assert defects_of(surface_of(rock)) == Defects(**CLEAN)
    result = repair_surface(surface_of(rock))
    assert_array_equal(result.surface.faces, rock.faces)
    assert_array_equal(result.surface.vertices, rock.vertices_km)


def test_any_mix_of_windings_is_made_outward_piece_by_piece(rock: TriangleMesh) -> None:
    moon = rock.translated([10.0, 0.0, 0.0])
    faces = np.concatenate([rock.faces, moon.faces + len(rock.vertices_km)])
    turned = np.random.default_rng(4).random(len(faces)) < 0.5
    faces[turned] = faces[turned][:, ::-1]
    surface = Surface(vertices=np.concatenate([rock.vertices_km, moon.vertices_km]), faces=faces)
    result = repair_surface(surface)
    assert not result.after
    assert result.facets_turned == turned.sum()
    mesh = TriangleMesh(result.surface.vertices, result.surface.faces)
    assert_allclose(
        mesh.volume_km3, 2.0 * rock.volume_km3, rtol=FLOAT64_CHAIN / 10
    )  # the second body lies five radii off


def test_a_small_hole_is_closed_by_a_fan_and_missing_surface_is_not_made_up(rock: TriangleMesh) -> None:
    summit = int(rock.faces[0, 0])
    without_summit = Surface(vertices=rock.vertices_km, faces=rock.faces[(rock.faces != summit).all(axis=1)])
    result = repair_surface(without_summit)
    assert not result.after
    assert (result.holes_filled, len(result.surface.faces)) == (1, len(rock.faces))
    assert_allclose(
        TriangleMesh(result.surface.vertices, result.surface.faces).volume_km3, rock.volume_km3, rtol=SAMPLED
    )
    assert repair_surface(without_summit, max_hole_width=0.0).after.holes == 1
    half = Surface(vertices=rock.vertices_km, faces=rock.faces[(rock.vertices_km[rock.faces, 2] > 0.0).all(axis=1)])
    assert repair_surface(half).holes_filled == 0
    with pytest.raises(InputError, match="nothing to repair"):
        repair_surface(Surface(vertices=rock.vertices_km, faces=np.array([[1, 1, 1]])))


def test_a_moebius_strip_is_neither_turned_nor_called_consistent() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    across = 0.2 * (np.cos(angle / 2)[:, None] * ring + np.sin(angle / 2)[:, None] * [0.0, 0.0, 1.0])
    left, right = np.arange(12), np.arange(12) + 12
    next_left, next_right = np.append(left[1:], right[0]), np.append(right[1:], left[0])
    faces = np.concatenate([np.stack(c, axis=-1) for c in ((left, right, next_left), (right, next_right, next_left))])
    strip = Surface(vertices=np.concatenate([ring + across, ring - across]), faces=faces)
    assert defects_of(strip).inconsistent_edges > 0
    assert repair_surface(strip, max_hole_width=0.0).after.inconsistent_edges > 0


def test_the_numbers_of_a_mesh_agree_with_trimesh(rock: TriangleMesh) -> None:
    mesh = rock.translated([0.5, -1.0, 0.2])
    found, other = measure_mesh(mesh), trimesh.Trimesh(mesh.vertices_km, mesh.faces, process=False)
    assert_measures(found, other)


def assert_measures(found: object, other: trimesh.Trimesh) -> None:
    size = float(np.cbrt(other.volume))
    for name, value, scale in (
        ("volume_km3", other.volume, other.volume),
        ("area_km2", other.area, other.area),
        ("center_of_figure_km", other.center_mass, size),
        ("principal_moments", other.principal_inertia_components, other.volume * size**2),
        ("extents_km", other.extents, size),
        ("euler_number", other.euler_number, 1.0),
    ):
        assert_allclose(getattr(found, name), value, rtol=0, atol=AGREEMENT * abs(scale), err_msg=name)
    axes = np.abs(getattr(found, "principal_axes") @ np.asarray(other.principal_inertia_vectors).T)  # noqa: B009
    assert_allclose(axes, np.eye(3), rtol=0, atol=SETTLED)  # eigenvectors: rounding over the gap of the moments


def test_the_moments_of_an_ellipsoid_mesh_are_those_of_the_ellipsoid() -> None:
    a, b, c = 3.0, 2.0, 1.0
    found = measure_mesh(mesh_from_ellipsoid(Ellipsoid(radii_km=np.array([a, b, c])), facets=20_480))
    volume = 4.0 / 3.0 * np.pi * a * b * c
    expected = volume / 5.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    assert_allclose(found.principal_moments, expected, rtol=2e-3)  # sagitta of facets of 1.2 degrees, five lengths
    assert_allclose(found.best_fit_radii_km, [a, b, c], rtol=5e-4)  # facets of a sphere cut below its surface


@pytest.mark.slow
@pytest.mark.real_data
def test_every_real_shape_loads_and_its_numbers_agree_with_trimesh(data_dir: Path) -> None:
    files = sorted((data_dir / "shapes").iterdir())
    assert len(files) >= 9
    for path in files:
        surface = read_surface(path)
        mesh = mesh_of(path, surface)
        other = trimesh.Trimesh(mesh.vertices_km, mesh.faces, process=False)
        assert_measures(measure_mesh(mesh), other)
        assert defects_of(surface).watertight == other.is_watertight
        assert not repair_surface(surface).after, path.name


def test_a_decimated_body_is_closed_and_near_the_original(rock: TriangleMesh) -> None:
    coarse = decimate_mesh(rock, 400)
    change = deviation(rock, coarse)
    assert 390 <= len(coarse.faces) <= 400
    assert not defects_of(surface_of(coarse))
    assert abs(change.volume_change) < 0.02  # facets of 15 degrees lose some sin^2(7.5 deg) / 2
    assert 0.0 < change.rms_km < change.max_km < 0.1 * rock.mean_radius_km
    for facets in (3, len(rock.faces)):
        with pytest.raises(InputError, match="facets must be in"):
            decimate_mesh(rock, facets)


@pytest.mark.real_data
def test_a_body_that_is_torn_at_one_pace_of_decimation_survives_another(data_dir: Path) -> None:
    vesta = load_shape(data_dir / "shapes" / "vesta_5002.ply")
    coarse = decimate_mesh(vesta, 500)
    assert not defects_of(surface_of(coarse)).boundary_edges
    assert 480 <= len(coarse.faces) <= 500


def test_an_open_body_is_not_decimated_but_to_be_repaired(rock: TriangleMesh) -> None:
    with pytest.raises(InputError, match=r"is not closed \(3 boundary edges, 1 holes\): repair it first"):
        decimate_mesh(TriangleMesh(rock.vertices_km, rock.faces[1:], "rock"), 400)


def test_the_deviation_of_concentric_spheres_is_the_difference_of_their_radii() -> None:
    inner, outer = (mesh_from_ellipsoid(sphere(radius), facets=5120) for radius in (1.0, 1.01))
    change = deviation(inner, outer)
    assert_allclose([change.rms_km, change.max_km], 0.01, rtol=0, atol=1e-3)  # sagitta of facets of 2.2 degrees
    assert_allclose(change.volume_change, 1.01**3 - 1.0, rtol=FLOAT64 * 1e3)
    assert deviation(inner, inner).max_km < FLOAT64


def test_distances_from_a_surface_are_those_that_an_exhaustive_search_finds(rock: TriangleMesh) -> None:
    random = np.random.default_rng(8)
    points = random.choice(rock.vertices_km, 60) * random.uniform(0.85, 1.3, size=(60, 1))
    triangles = rock.vertices_km[rock.faces]
    exhaustive = [
        np.linalg.norm(trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1))) - point, axis=1)
        for point in points
    ]
    found, nearest = surface_distances(rock, points), np.min(exhaustive, axis=1)
    assert np.all(found >= nearest - FLOAT64)
    assert_allclose(found, nearest, rtol=0, atol=FLOAT64_SUM)


def test_vertices_of_a_pole_computed_many_times_are_one_after_repair() -> None:
    longitude, latitude = (grid.ravel() for grid in np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(-1, 1, 13)))
    latitude = latitude * np.pi / 2
    vertices = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
    row, column = (grid.ravel() for grid in np.mgrid[:12, :24])
    a, b = row * 24 + column, row * 24 + (column + 1) % 24
    faces = np.concatenate([np.stack([a, b, b + 24], axis=-1), np.stack([a, b + 24, a + 24], axis=-1)])
    surface = Surface(vertices=vertices, faces=faces)
    assert defects_of(surface).holes == 2  # cos(pi / 2) is 6e-17
    result = repair_surface(surface)
    assert not result.after
    assert len(result.surface.vertices) == 11 * 24 + 2


def exported(path: Path, rock: TriangleMesh, kind: str) -> Path:
    """A small file of a format, and of a text variant that others write."""
    if kind == "icq":
        return icq_file(path.with_suffix(".icq"), 3, lambda points: points)
    if kind.startswith("text "):
        mesh = trimesh.Trimesh(rock.vertices_km, rock.faces, process=False)
        name = kind.removeprefix("text ")
        data = (
            trimesh.exchange.stl.export_stl_ascii(mesh)
            if name == "stl"
            else mesh.export(file_type="ply", encoding="ascii")
        )
        path = path.with_suffix(f".{name}")
        path.write_bytes(data.encode() if isinstance(data, str) else data)
        return path
    path = path.with_suffix(f".{kind}")
    save_shape(rock, path, dsk=PHOBOS)
    return path


@pytest.mark.parametrize("kind", ["obj", "ply", "text ply", "stl", "text stl", "tab", "icq", "bds", "npz"])
def test_a_damaged_file_gives_a_data_error_or_a_mesh_and_never_anything_else(tmp_path: Path, kind: str) -> None:
    path = exported(tmp_path / "file", mesh_from_ellipsoid(sphere(1.0), facets=80), kind)
    content, random = path.read_bytes(), np.random.default_rng(5)
    refused = 0
    for trial in range(60):
        damaged = bytearray(content[: random.integers(len(content))] if trial % 2 else content)
        for place in random.integers(max(len(damaged), 1), size=int(random.integers(1, 6)) if damaged else 0):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged)
        try:
            surface = read_surface(path)
            defects_of(surface)
            assert np.isfinite(mesh_of(path, surface).volume_km3)
        except DataError as error:
            refused += "\n" not in str(error)
    assert refused >= 20  # what is cut off can hardly be whole
