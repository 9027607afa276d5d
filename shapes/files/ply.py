"""Binary PLY files, read straight into arrays: a general parser takes a gigabyte for a large model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from giantlike.core.arrays import Float
from giantlike.shapes.mesh import Faces, TriangleMesh
from giantlike.shapes.surface import Surface, split_polygons

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 200  # lines, and bytes of a line; files with more are left to trimesh


@dataclass(frozen=True, slots=True, kw_only=True)
class _Element:
    """An element of the header: name, count, and the words of its property rows."""

    name: str
    count: int
    properties: tuple[tuple[str, ...], ...]


def read_binary_ply(path: Path) -> Surface | None:
    """Read a binary PLY of vertices and of facets with three or four corners; None of others, for trimesh."""
    with path.open("rb") as file:
        header = _header(file)
        if header is None:
            return None
        order, (vertices, facets) = header
        vertex_type = np.dtype([(row[-1], order + _TYPES[row[0]]) for row in vertices.properties])
        table = _array(file, vertex_type, vertices.count)
        points: Float = np.stack([table[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        corners = _corners(file, order, facets)
    return Surface(vertices=points, faces=split_polygons(corners))


def write_ply(path: Path, mesh: TriangleMesh) -> None:
    """Write binary little-endian PLY in km, vertices in float64."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment written by giantlike, coordinates in km\n"
        f"element vertex {len(mesh.vertices_km)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    facets = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    facets["count"], facets["corners"] = 3, mesh.faces
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(np.ascontiguousarray(mesh.vertices_km, dtype="<f8").data)
        file.write(facets.data)


def _header(file: BinaryIO) -> tuple[str, tuple[_Element, _Element]] | None:
    """Byte order and elements; None unless binary, with vertices of scalars and then facets of one list each."""
    order, elements = "", list[_Element]()
    for _ in range(_LONGEST_HEADER):
        words = file.readline(_LONGEST_HEADER).decode("ascii", errors="replace").split()
        if words == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) == 3:
            order = _ORDERS.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append(_Element(name=words[1], count=int(words[2]), properties=()))
        elif words[:1] == ["property"] and elements:
            last = elements.pop()
            elements.append(_Element(name=last.name, count=last.count, properties=(*last.properties, tuple(words[1:]))))
    else:
        return None
    if not order or [element.name for element in elements] != ["vertex", "face"]:
        return None
    vertices, facets = elements
    scalars = all(len(row) == 2 and row[0] in _TYPES for row in vertices.properties)
    names = [row[-1] for row in vertices.properties]
    (corners,) = facets.properties if len(facets.properties) == 1 else [()]
    one_list = (
        len(corners) == 4 and corners[0] == "list" and all(_TYPES.get(word, "f")[0] in "iu" for word in corners[1:3])
    )
    if not (scalars and one_list and {"x", "y", "z"} <= {*names} and len({*names}) == len(names)):
        return None
    return order, (vertices, facets)


def _corners(file: BinaryIO, order: str, facets: _Element) -> Faces:
    """Indices (m, 3), or (m, 4) with -1 where a triangle has no fourth corner."""
    _, count, index, _ = facets.properties[0]
    start = file.tell()
    first = _array(file, np.dtype(order + _TYPES[count]), min(facets.count, 1))
    sides = int(first[0]) if first.size else 3
    file.seek(start)
    row = np.dtype([("count", order + _TYPES[count]), ("corners", order + _TYPES[index], max(sides, 1))])
    if sides in (3, 4) and _bytes_left(file) >= row.itemsize * facets.count:
        table = _array(file, row, facets.count)
        if (table["count"] == sides).all():
            return table["corners"].astype(np.int64)
    file.seek(start)
    return _mixed_corners(file.read(), np.dtype(order + _TYPES[count]), np.dtype(order + _TYPES[index]), facets.count)


def _mixed_corners(data: bytes, count: np.dtype[Any], index: np.dtype[Any], facets: int) -> Faces:
    """Corners of triangles and quadrilaterals in any order, one after the other."""
    if facets * (count.itemsize + 3 * index.itemsize) > len(data):
        raise ValueError(f"{len(data)} bytes cannot hold {facets} facets: is it cut short?")
    corners = np.full((facets, 4), -1, dtype=np.int64)
    at = 0
    for facet in range(facets):
        sides = int(np.frombuffer(data, count, 1, at)[0])
        if sides not in (3, 4):
            raise ValueError(f"needed facets of 3 or 4 corners, facet {facet + 1} has {sides}")
        corners[facet, :sides] = np.frombuffer(data, index, sides, at + count.itemsize)
        at += count.itemsize + sides * index.itemsize
    return corners


def _array(file: BinaryIO, row: np.dtype[np.void], count: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """The next ``count`` rows of the file."""
    needed = row.itemsize * count
    if (there := _bytes_left(file)) < needed:
        raise ValueError(f"needed {count} rows of {row.itemsize} bytes, found {there} bytes: is it cut short?")
    return np.frombuffer(file.read(needed), row)


def _bytes_left(file: BinaryIO) -> int:
    start = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(start)
    return end - start
