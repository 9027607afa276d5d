r"""SPC text models: the implicitly connected quadrilateral (ICQ) form.

The first row holds Q, then follow the vertices of the six faces of a cube, (Q + 1)^2 of each, I running fastest, then
J, then the face; the quadrilateral (I, J) has the corners (I, J), (I, J+1), (I+1, J+1), (I+1, J). Vertices on an edge
of the cube are written with each of its faces: vertex (I, J) of a face is named by its point on the surface of a
lattice of (Q + 1)^3 points.

Source: Stereophotoclinometry wiki, "SHAPE.TXT", https://web.psi.edu/spc_wiki/SHAPE.TXT: numbering, facets, edges.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from giantlike._system.reading import check
from giantlike.core.arrays import require
from giantlike.shapes.albedo import VertexAlbedo
from giantlike.shapes.files.text import numbers, text_rows, write_rows
from giantlike.shapes.mesh import Faces, TriangleMesh
from giantlike.shapes.surface import Surface, split_polygons

_LARGEST_Q = 2048  # 50 million facets: bounds the memory that a damaged first row can request
_COPY_TOLERANCE = 1e-3
"""Largest difference of copies of a vertex, over the largest coordinate: they are rounded text of one number."""


def is_icq(path: Path) -> bool:
    """Return True if a text file begins as an ICQ model: one number Q in the first row, 6 (Q + 1)^2 rows after it."""
    with path.open(encoding="ascii", errors="replace") as file:
        try:
            q = int(next(file, ""))
        except ValueError:
            return False
        return 1 <= q <= _LARGEST_Q and sum(1 for line in file if line.strip()) == 6 * (q + 1) ** 2


def read_icq(path: Path) -> Surface:
    """Read an ICQ model; a fourth column is the relative albedo of the vertices."""
    rows = text_rows(path)
    q = int(rows[0]) if rows else 0
    check(1 <= q <= _LARGEST_Q, f"needed Q in [1, {_LARGEST_Q}] in the first row, got {q}")
    if len(rows) != 1 + 6 * (q + 1) ** 2:
        raise ValueError(f"needed 6 (Q + 1)^2 = {6 * (q + 1) ** 2} vertices for Q = {q}, found {len(rows) - 1}")
    table = numbers(rows[1:], (3, 4))
    first, names, quadrilaterals = _lattice(q)
    copies = table[:, :3]
    with np.errstate(invalid="ignore"):
        difference = np.abs(copies - copies[first][names]).max()
        if difference > _COPY_TOLERANCE * np.abs(copies).max():
            raise ValueError(f"vertices that two faces of the cube share differ by up to {difference:.3g}")
    albedo = VertexAlbedo(table[first, 3]) if table.shape[1] == 4 else None
    return Surface(vertices=copies[first], faces=split_polygons(names[quadrilaterals]), albedo=albedo)


def write_icq(path: Path, mesh: TriangleMesh) -> None:
    """Write an ICQ model in km, float64 to the last bit; albedo by vertex becomes a fourth column."""
    q = math.isqrt(len(mesh.faces) // 12)
    require(
        1 <= q <= _LARGEST_Q and 12 * q * q == len(mesh.faces),
        f"an ICQ model has 12 Q^2 facets connected as grids on a cube, but {mesh.name!r} has "
        f"{len(mesh.faces)} facets: choose another format",
    )
    _, names, quadrilaterals = _lattice(q)
    faces = split_polygons(names[quadrilaterals])
    same = np.array_equal(mesh.faces, faces) or np.array_equal(mesh.faces[:, ::-1], faces)
    require(same, f"{mesh.name!r} is not connected as an ICQ model, grids on a cube: choose another format")
    table = mesh.vertices_km
    if isinstance(mesh.albedo, VertexAlbedo):
        table = np.column_stack([table, mesh.albedo.values])
    write_rows(path, f"{q}\n", [("", table[names])])


def _lattice(q: int) -> tuple[Faces, Faces, Faces]:
    """First row (v,) of each vertex, the vertex (6 (q+1)^2,) of each row, and the rows (6 q^2, 4) of the corners."""
    j, i = (grid.ravel() for grid in np.meshgrid(np.arange(q + 1), np.arange(q + 1), indexing="ij"))
    zero, full = np.zeros_like(i), np.full_like(i, q)
    places = [
        (i, j, full),
        (i, full, q - j),
        (zero, i, q - j),
        (q - i, zero, q - j),
        (full, q - i, q - j),
        (i, q - j, zero),
    ]
    x, y, z = (np.concatenate([place[axis] for place in places]) for axis in range(3))
    _, first, inverse = np.unique(x + (q + 1) * (y + (q + 1) * z), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    row = np.arange(6 * (q + 1) ** 2).reshape(6, q + 1, q + 1)  # [face, J, I]
    corners = np.stack([row[:, :-1, :-1], row[:, 1:, :-1], row[:, 1:, 1:], row[:, :-1, 1:]], axis=-1)
    return first[order], rank[inverse], corners.reshape(-1, 4)
