"""OBJ, PLY and STL files: read through trimesh, but for plain OBJ and binary PLY; OBJ is written with all digits."""

from __future__ import annotations

import logging
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np

from giantlike.shapes.files.obj import read_plain_obj
from giantlike.shapes.files.ply import read_binary_ply
from giantlike.shapes.files.text import write_rows
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface

_STL_HEADER_BYTES, _STL_FACET_BYTES = 80, 50  # of binary STL: comment; 12 float32 and an attribute of 16 bit
_COMMENT = "written by giantlike, coordinates in km"


def read_exchange(path: Path) -> Surface:
    """Read OBJ, PLY or STL; polygons are split into triangles, materials and textures left out."""
    kind = path.suffix.lower().removeprefix(".")
    if kind == "ply" and (surface := read_binary_ply(path)) is not None:
        return surface
    content = path.read_bytes()
    if kind == "obj" and (surface := read_plain_obj(content)) is not None:
        return surface
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it also logs the messages of its exceptions
    source = BytesIO(content) if kind == "ply" else _text_or_binary(content, kind)
    mesh = trimesh.load(source, file_type=kind, force="mesh", process=False, skip_materials=True)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    return Surface(vertices=vertices, faces=faces)


def _text_or_binary(content: bytes, kind: str) -> StringIO | BytesIO:
    """The content as trimesh takes it without guessing at an encoding, for which it would want another package."""
    if kind == "obj":
        return StringIO(content.decode("utf-8", errors="replace"))
    facets = int.from_bytes(content[_STL_HEADER_BYTES : _STL_HEADER_BYTES + 4], "little")
    if len(content) != _STL_HEADER_BYTES + 4 + facets * _STL_FACET_BYTES and not content.isascii():
        raise ValueError(f"{len(content)} bytes are no binary STL of {facets} facets, and no text")
    return BytesIO(content)


def write_obj(path: Path, mesh: TriangleMesh) -> None:
    """Write an OBJ file with ``v`` and ``f`` rows in km, float64 to the last bit."""
    write_rows(path, f"# {_COMMENT}\n", [("v ", mesh.vertices_km), ("f ", mesh.faces + 1)])


def write_stl(path: Path, mesh: TriangleMesh) -> None:
    """Write binary STL in km; the format is single precision: coordinates are rounded by up to 6e-8 of their size."""
    facets = np.zeros(len(mesh.faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["normal"], facets["corners"] = mesh.normals, mesh.vertices_km[mesh.faces]
    with path.open("wb") as file:
        file.write(_COMMENT.encode("ascii").ljust(_STL_HEADER_BYTES))
        file.write(np.uint32(len(facets)).astype("<u4").tobytes())
        file.write(facets.data)
