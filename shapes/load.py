"""Read shape models: OBJ, PLY, STL, plate tables and SPICE DSK, all to one mesh in km."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, require
from giantlike.core.errors import DataError, InputError
from giantlike.shapes.mesh import Faces, TriangleMesh

_KM_PER_UNIT = {"km": 1.0, "m": 1e-3}
_MAX_OPENNESS = 0.01
_SURELY_KM, _SURELY_M = 30.0, 3000.0
_DSK_TYPE = 2
_PARSER_ERRORS = (
    ValueError, IndexError, KeyError, TypeError, AttributeError, EOFError, NotImplementedError, AssertionError,
    struct.error, MemoryError,
)  # fmt: skip


def load_shape(path: str | Path, *, units: str = "km") -> TriangleMesh:
    """Read a closed triangle mesh.

    Parameters
    ----------
    path : path-like
        ``.obj``, ``.ply``, ``.stl``; plate tables ``.tab``, ``.txt``, ``.plt``; SPICE DSK type 2 ``.bds``, ``.dsk``.
    units : {"km", "m", "auto"}
        Unit of the coordinates in the file; a DSK is always in km. ``auto`` takes a largest radius below 30 as km
        and one above 3000 as m, and refuses what lies between, where both exist (Bennu is 290 m, Vesta 290 km).

    Returns
    -------
    TriangleMesh
        In km, named after the file and carrying its SHA-256; coincident vertices are merged.

    Raises
    ------
    InputError
        ``units`` or the file type is not known.
    DataError
        The file is missing, damaged, holds no facets or a surface that is not closed, or ``auto`` cannot decide.

    Notes
    -----
    A plate table holds either ``v x y z`` and ``f i j k`` rows, or counts, vertex rows and plate rows, each with
    or without a leading row number. Indices start at 0 if a 0 occurs among them, else at 1.
    """
    path = Path(path)
    require(units in ("km", "m", "auto"), f"units must be km, m or auto, got {units!r}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: shape files end in {', '.join(sorted(_READERS))}, not {path.suffix!r}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(path, f"cannot read the shape file: {error.strerror}") from error
    if not content:
        raise DataError(path, "the shape file is empty")
    vertices, faces = reader(path)
    if reader is not _read_dsk:
        vertices = vertices * _km_per_unit(path, vertices, units)
    try:
        mesh = TriangleMesh(*_merged(vertices, faces), path.stem, hashlib.sha256(content).hexdigest())
    except InputError as error:
        raise DataError(path, f"not a usable triangle mesh: {error}") from error
    if mesh.openness > _MAX_OPENNESS:
        raise DataError(
            path,
            f"the surface is not closed (its area vectors sum to {mesh.openness:.0%} of its area): "
            "facets are missing; is the file cut short?",
        )
    return mesh


def _km_per_unit(path: Path, vertices: Float, units: str) -> float:
    if units != "auto":
        return _KM_PER_UNIT[units]
    radius = float(np.linalg.norm(vertices, axis=1).max(initial=0.0))
    if _SURELY_KM < radius < _SURELY_M:
        raise DataError(path, f'a largest radius of {radius:.4g} can be km or m: state units = "km" or "m"')
    return _KM_PER_UNIT["km" if radius <= _SURELY_KM else "m"]


def _merged(vertices: Float, faces: Faces) -> tuple[Float, Faces]:
    """Merge vertices with equal coordinates, keeping the order of first appearance."""
    if faces.size == 0 or vertices.size == 0 or not np.isfinite(vertices).all():
        return vertices, faces  # TriangleMesh says what is wrong
    if faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    return vertices[first[order]], rank[inverse.reshape(-1)][faces]


def _read_trimesh(path: Path) -> tuple[Float, Faces]:
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
        vertices = np.array(mesh.vertices, dtype=np.float64)
        faces = np.array(mesh.faces, dtype=np.int64)
    except _PARSER_ERRORS as error:
        raise DataError(path, f"damaged {path.suffix.lower()[1:].upper()} file: {_one_line(error)}") from error
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def _read_table(path: Path) -> tuple[Float, Faces]:
    try:
        rows = [line.split() for line in path.read_text(encoding="ascii").splitlines()]
        rows = [row for row in rows if row and not row[0].startswith("#")]
        if rows and rows[0][0].lower() in ("v", "f"):
            vertices, faces = _letter_rows(rows)
        else:
            vertices, faces = _counted_rows(rows)
    except ValueError as error:
        raise DataError(path, f"damaged plate table: {_one_line(error)}") from error
    if faces.size and faces.min() > 0:
        faces = faces - 1
    return vertices, faces


def _letter_rows(rows: list[list[str]]) -> tuple[Float, Faces]:
    """Rows that begin with v or f."""
    numbers: dict[str, list[list[str]]] = {"v": [], "f": []}
    for row in rows:
        letter = row[0].lower()
        if letter not in numbers or len(row) != 4:
            raise ValueError(f"needed 'v x y z' or 'f i j k', got {' '.join(row)[:60]!r}")
        numbers[letter].append(row[1:])
    return _floats(numbers["v"]), _integers(numbers["f"])


def _counted_rows(rows: list[list[str]]) -> tuple[Float, Faces]:
    """Number of vertices (and plates), vertex rows, (number of plates,) plate rows; rows may be numbered."""
    counts = [int(word) for word in rows[0]] if rows else []
    if len(counts) not in (1, 2) or counts[0] < 1:
        raise ValueError("needed rows of 'v' and 'f', or the number of vertices (and plates) in the first row")
    n_vertices, at = counts[0], 1
    vertices = rows[at : at + n_vertices]
    at += n_vertices
    if len(counts) == 1:
        if at >= len(rows) or len(rows[at]) != 1:
            raise ValueError(f"needed the number of plates after {n_vertices} vertices")
        counts.append(int(rows[at][0]))
        at += 1
    plates = rows[at:]
    if len(vertices) != n_vertices or len(plates) != counts[1]:
        raise ValueError(f"needed {counts[0]} vertices and {counts[1]} plates, found {len(vertices)} and {len(plates)}")
    return _floats([row[-3:] for row in vertices]), _integers([row[-3:] for row in plates])


def _floats(rows: list[list[str]]) -> Float:
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _integers(rows: list[list[str]]) -> Faces:
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def _read_dsk(path: Path) -> tuple[Float, Faces]:
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    try:
        handle = spiceypy.dasopr(str(path))
        try:
            segments = _dsk_segments(spiceypy, path, handle)
        finally:
            spiceypy.dascls(handle)
    except SpiceyError as error:
        raise DataError(path, f"damaged DSK file: {_one_line(error)}") from error
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in segments])
    faces = [plates + start for (_, plates), start in zip(segments, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in segments]), np.concatenate(faces)


def _dsk_segments(spice: Any, path: Path, handle: int) -> list[tuple[Float, Faces]]:
    """Vertices and plates, from 0, of every segment of an open DSK."""
    from spiceypy.utils.exceptions import NotFoundError

    segments: list[tuple[Float, NDArray[np.int64]]] = []
    descriptor = spice.dlabfs(handle)
    while True:
        kind = spice.dskgd(handle, descriptor).dtype
        if kind != _DSK_TYPE:
            raise DataError(path, f"needed DSK segments of type {_DSK_TYPE}, got type {kind}")
        n_vertices, n_plates = spice.dskz02(handle, descriptor)
        vertices = np.array(spice.dskv02(handle, descriptor, 1, n_vertices), dtype=np.float64)
        plates = np.array(spice.dskp02(handle, descriptor, 1, n_plates), dtype=np.int64) - 1
        segments.append((vertices.reshape(-1, 3), plates.reshape(-1, 3)))
        try:
            descriptor = spice.dlafns(handle, descriptor)
        except NotFoundError:
            return segments


def _one_line(error: BaseException) -> str:
    """The most telling line of an error message (SPICE frames its own with rules and a traceback)."""
    lines = [line.strip() for line in str(error).splitlines()]
    telling = [line for line in lines if line and not line.startswith(("===", "Toolkit version")) and "-->" not in line]
    return " ".join(telling)[:200] or type(error).__name__


_READERS: Mapping[str, Callable[[Path], tuple[Float, Faces]]] = MappingProxyType(
    dict.fromkeys((".obj", ".ply", ".stl"), _read_trimesh)
    | dict.fromkeys((".tab", ".txt", ".plt"), _read_table)
    | dict.fromkeys((".bds", ".dsk"), _read_dsk)
)
