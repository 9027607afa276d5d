"""CSV files with named columns, and errors that name file, line and column."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike._system.reading import reads
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotation_from_xyzw
from giantlike.core.time import et_from_time, time_from_utc

if TYPE_CHECKING:
    from astropy.time import Time


Value = TypeVar("Value")

_UNIT_NORM = 1e-3  # unit vectors to this: some digits were rounded off; a larger error is a wrong column or unit


@dataclass(frozen=True, slots=True)
class CsvRow:
    """One row of a CSV file."""

    path: Path
    line: int  # line in the file; the header is line 1
    cells: dict[str, str]  # text by column, without blanks around it

    def error(self, column: str, problem: str) -> DataError:
        """Return a :class:`DataError` that names file, line, column and value."""
        return DataError(self.path, f"line {self.line}, column {column}: {problem}, got {self.cells.get(column, '')!r}")

    def require(self, value: Value | None, columns: Sequence[str]) -> Value:
        """Return the value of cells that must not be empty."""
        if value is None:
            raise self.error(columns[0], f"{', '.join(columns)} must be filled in every row")
        return value

    def text(self, column: str) -> str | None:
        """Text of a cell. Returns None when it is empty or there is no such column."""
        return self.cells.get(column) or None

    def number(self, column: str) -> float | None:
        """Finite number of a cell. Returns None when it is empty or there is no such column."""
        text = self.text(column)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            raise self.error(column, "a number is needed") from None
        if not math.isfinite(value):
            raise self.error(column, "a finite number is needed")
        return value

    def vector(self, columns: Sequence[str]) -> Float | None:
        """Numbers of columns that are filled together. Returns (n,), None when all are empty."""
        numbers = [self.number(column) for column in columns]
        filled = [number for number in numbers if number is not None]
        if not filled:
            return None
        if len(filled) < len(numbers):
            empty = columns[numbers.index(None)]
            raise self.error(empty, f"{', '.join(columns)} must be filled together")
        return np.array(filled)

    def rotation(self, columns: Sequence[str]) -> Rotation | None:
        """Rotation of four quaternion columns, scalar last. Returns None when all are empty."""
        values = self.vector(columns)
        if values is None:
            return None
        try:
            return rotation_from_xyzw(values, "the quaternion")
        except InputError as error:
            raise self.error(columns[0], f"{', '.join(columns)}: {error}") from error

    def direction(self, columns: Sequence[str]) -> Float | None:
        """Unit vector of three columns. Returns (3,), None when all are empty."""
        values = self.vector(columns)
        if values is None:
            return None
        norm = float(np.linalg.norm(values))
        if not abs(norm - 1.0) < _UNIT_NORM:
            raise self.error(columns[0], f"{', '.join(columns)} must make a unit vector, the norm is {norm:.6g}")
        return values / norm

    def et(self) -> float:
        """Epoch of the columns ``et`` or ``epoch_utc``."""
        et, epoch = self.number("et"), self.utc("epoch_utc")
        if et is not None:
            return et
        if epoch is None:
            raise self.error("et" if "et" in self.cells else "epoch_utc", "epoch_utc or et is needed")
        return et_from_time(epoch)

    def utc(self, column: str) -> Time | None:
        """Epoch of an ISO 8601 UTC cell. Returns None when it is empty or there is no such column."""
        text = self.text(column)
        if text is None:
            return None
        try:
            return time_from_utc(text)
        except InputError:
            raise self.error(column, "an ISO 8601 UTC epoch such as 2018-12-01T10:07:11.123 is needed") from None


@reads("a CSV table in UTF-8")
def read_csv_rows(path: str | Path, columns: Sequence[str], required: Sequence[str]) -> list[CsvRow]:
    """Read a CSV file whose first line names the columns; empty lines are skipped."""
    source = Path(path)
    reader = csv.reader(io.StringIO(source.read_text(encoding="utf-8-sig"), newline=""), strict=True)
    rows: list[CsvRow] = []
    names: list[str] = []
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if not any(stripped):
                continue
            if not names:
                names = stripped
                _check_names(source, names, columns, required)
            elif len(stripped) != len(names):
                problem = f"{len(names)} cells are needed as in the header, got {len(stripped)}"
                raise DataError(source, f"line {reader.line_num}: {problem}")
            else:
                rows.append(CsvRow(source, reader.line_num, dict(zip(names, stripped, strict=True))))
    except csv.Error as error:
        raise DataError(source, f"line {reader.line_num}: not valid CSV: {error}") from error
    if not names:
        raise DataError(source, f"the table is empty: a header with {', '.join(required)} is needed")
    return rows


def read_timed_rows(path: str | Path, columns: Sequence[str], required: Sequence[str]) -> tuple[Float, list[CsvRow]]:
    """Read a CSV file with a column ``epoch_utc`` or ``et``: epochs (n,), n >= 1, all different, and rows."""
    rows = read_csv_rows(path, ("epoch_utc", "et", *columns), required)
    if not rows:
        raise DataError(path, "the table has no rows")
    times = [name for name in ("epoch_utc", "et") if name in rows[0].cells]
    if len(times) != 1:
        raise DataError(path, "line 1: one of the columns epoch_utc and et is needed, not both")
    et = np.array([row.et() for row in rows])
    order = np.argsort(et, kind="stable").tolist()
    for before, after in pairwise(order):
        if et[before] == et[after]:
            raise rows[after].error(times[0], f"an epoch other than that of line {rows[before].line} is needed")
    return et[order], [rows[k] for k in order]


def write_csv_rows(path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[str | float | None]]) -> None:
    """Write a CSV file atomically, with numbers at full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text_atomic(path, text.getvalue())


def _check_names(path: Path, names: list[str], columns: Sequence[str], required: Sequence[str]) -> None:
    unknown = [name for name in names if name not in columns]
    if unknown:
        raise DataError(path, f"line 1: unknown column {unknown[0]!r}; columns are {', '.join(columns)}")
    repeated = [name for name in names if names.count(name) > 1]
    if repeated:
        raise DataError(path, f"line 1: column {repeated[0]!r} occurs more than once")
    missing = [name for name in required if name not in names]
    if missing:
        raise DataError(path, f"line 1: column {missing[0]!r} is missing")
