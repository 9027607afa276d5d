"""Rows of numbers in text files: read fast, refused with the row that is wrong, and written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from giantlike.core.arrays import Float
from giantlike.shapes.mesh import Faces

_LARGEST_INDEX = 2.0**53  # float64 holds all whole numbers below it


def text_rows(path: Path) -> list[str]:
    """Rows of an ASCII file without blank lines and comments (#); commas count as blanks, Fortran's D as E."""
    with path.open(encoding="ascii") as file:
        rows = [line for line in map(str.strip, file) if line and not line.startswith("#")]
    return [row.replace(",", " ").replace("D", "E") if "," in row or "D" in row else row for row in rows]


def numbers(rows: Sequence[str], columns: tuple[int, ...]) -> Float:
    """Convert rows of text that all hold the same number of numbers. Returns (n, k)."""
    if not rows:
        return np.empty((0, columns[0]))
    table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    if table.shape[1] not in columns:
        raise ValueError(f"needed {' or '.join(map(str, columns))} numbers in a row, got {rows[0][:60]!r}")
    return table


def whole_numbers(table: Float) -> Faces:
    """Convert a table of vertex numbers to int64. ``table`` (m, k); returns (m, k)."""
    bad = ~(np.abs(table) < _LARGEST_INDEX) | (table != np.rint(table))
    if bad.any():
        raise ValueError(f"needed vertex numbers, got {float(table[bad][0])!r}")
    return table.astype(np.int64)


def write_rows(path: Path, header: str, tables: Sequence[tuple[str, Float | Faces]]) -> None:
    """Write a header and then tables of numbers, float64 to the last bit. ``tables`` sequence of (str, (n, k))."""
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(header)
        for prefix, table in tables:
            file.writelines(f"{prefix}{' '.join(map(repr, row))}\n" for row in table.tolist())
