"""Plate tables: vertices and plates as rows of text, as the PDS keeps shape models.

Two forms are read: rows that begin with ``v`` or ``f``, and counts, vertex rows and plate rows, each with or
without a leading row number (NAIF's plate types 1 and 3). Plates have three corners or four.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from giantlike.core.arrays import Float
from giantlike.shapes.files.text import numbers, text_rows, whole_numbers, write_rows
from giantlike.shapes.mesh import Faces, TriangleMesh
from giantlike.shapes.surface import Surface, split_polygons


def read_plate_table(path: Path) -> Surface:
    """Read a plate table.

    Plates number the vertices from 0 where 0 occurs, and from 1 where the number of vertices does. Where neither
    does, the numbering with the shorter edges is taken.
    """
    rows = text_rows(path)
    if rows and rows[0][0] in "vVfF":
        vertices, corners = _letter_rows(rows)
    else:
        vertices, corners = _counted_rows(rows)
    faces = split_polygons(corners)
    return Surface(vertices=vertices, faces=faces - _first_number(vertices, faces))


def write_plate_table(path: Path, mesh: TriangleMesh) -> None:
    """Write ``v`` and ``f`` rows in km, plates numbering the vertices from 1, float64 to the last bit."""
    write_rows(path, "", [("v ", mesh.vertices_km), ("f ", mesh.faces + 1)])


def _letter_rows(rows: list[str]) -> tuple[Float, Faces]:
    """Rows that begin with v or f, in any order."""
    by_letter: dict[str, list[str]] = {"v": [], "f": []}
    for row in rows:
        letter = row[0].lower()
        if letter not in by_letter or not row[1:2].isspace():
            raise ValueError(f"needed 'v x y z' or 'f i j k', got {row[:60]!r}")
        by_letter[letter].append(row[1:])
    return numbers(by_letter["v"], (3,)), _corners(by_letter["f"])


def _counted_rows(rows: list[str]) -> tuple[Float, Faces]:
    """Read a table with counts: the number of plates is next to the number of vertices or before the plate rows."""
    counts = [int(word) for word in rows[0].split()] if rows else []
    if len(counts) not in (1, 2) or counts[0] < 1:
        raise ValueError("needed rows of 'v' and 'f', or the number of vertices (and plates) in the first row")
    end = 1 + counts[0]
    vertices, start = rows[1:end], end
    if len(counts) == 1:
        if end >= len(rows) or len(rows[end].split()) != 1:
            raise ValueError(f"needed the number of plates after {counts[0]} vertices")
        counts.append(int(rows[end]))
        start += 1
    plates = rows[start:]
    if len(vertices) != counts[0] or len(plates) != counts[1]:
        raise ValueError(f"needed {counts[0]} vertices and {counts[1]} plates, found {len(vertices)} and {len(plates)}")
    table = numbers(vertices, (3, 4))
    numbered = table.shape[1] == 4
    if numbered and not np.array_equal(table[:, 0], table[0, 0] + np.arange(len(table))):
        raise ValueError("needed three coordinates in a vertex row, or its number and three coordinates")
    return table[:, -3:], _corners(plates, skip=int(numbered))


def _corners(rows: list[str], *, skip: int = 0) -> Faces:
    """Plates (m, 3) or (m, 4), -1 for the missing corner of a triangle; ``skip`` leading columns are ignored."""
    wide = [len(row.split()) == 4 + skip for row in rows]
    if not any(wide) or all(wide):
        return whole_numbers(numbers(rows, (3 + skip, 4 + skip))[:, skip:])
    corners = np.full((len(rows), 4), -1, dtype=np.int64)
    four = np.array(wide)
    for width, chosen in ((3, ~four), (4, four)):
        part = [row for row, use in zip(rows, chosen.tolist(), strict=True) if use]
        corners[chosen, :width] = whole_numbers(numbers(part, (width + skip,))[:, skip:])
    return corners


def _first_number(vertices: Float, faces: Faces) -> int:
    """Number of the first vertex in the plates, 0 or 1."""
    if faces.size == 0 or faces.min() <= 0:
        return 0
    if faces.max() >= len(vertices):
        return 1
    edges = (np.diff(vertices[faces - first], axis=1) for first in (0, 1))
    from_0, from_1 = (np.nan_to_num(np.linalg.norm(edge, axis=2).sum(), nan=np.inf) for edge in edges)
    return int(from_1 <= from_0)
