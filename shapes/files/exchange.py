"""OBJ, PLY and STL files: read through trimesh, but for plain OBJ and binary PLY; OBJ is written with all digits."""

from __future__ import annotations

import logging
import warnings
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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


_BLANKS, _DIGITS = b" \t\r\n", b"0123456789"
_VERTEX_BYTES, _FACET_BYTES = b"v+-.eE" + _DIGITS + _BLANKS, b"f" + _DIGITS + _BLANKS
_WORDS = 4  # of a row: its letter and three numbers


def read_plain_obj(content: bytes) -> Surface | None:
    """Read an OBJ of comments, then rows ``v x y z``, then rows ``f i j k``; None of any other."""
    while content.startswith(b"#"):
        content = content[content.find(b"\n") + 1 :] if b"\n" in content else b""
    end = content.find(b"\nf") + 1
    vertices = _rows(content[:end], b"v", _VERTEX_BYTES, np.float64)
    faces = _rows(content[end:], b"f", _FACET_BYTES, np.int64)
    if vertices is None or faces is None:
        return None
    return Surface(vertices=vertices.astype(np.float64), faces=faces.astype(np.int64) - 1)


def _rows(text: bytes, letter: bytes, allowed: bytes, dtype: type[np.number]) -> NDArray[np.number] | None:
    """Numbers (n, 3) of rows that all are the letter and three numbers; None if one is not."""
    if not text or text.translate(None, allowed):
        return None
    codes = np.frombuffer(text, dtype=np.uint8)
    word = codes > ord(" ")  # of the allowed codes, blanks are those up to the space
    starts = np.flatnonzero(word[1:] & ~word[:-1]) + 1
    starts = starts if not word[0] else np.append(0, starts)
    letters = codes == letter[0]
    if starts.size % _WORDS or np.count_nonzero(letters) * _WORDS != starts.size or not letters[starts[::_WORDS]].all():
        return None
    rows = np.searchsorted(np.flatnonzero(codes == ord("\n")), starts)  # the line of each word
    if (rows.reshape(-1, _WORDS) != rows[::_WORDS, None]).any() or (np.diff(rows[::_WORDS]) < 1).any():
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy's word for a number that is none
        try:
            values: NDArray[np.number] = np.fromstring(text.replace(letter, b" ").decode("ascii"), dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return values.reshape(-1, 3) if values.size * _WORDS == 3 * starts.size else None
