"""Columns of numbers out of tables in CSV, ECSV, FITS, Parquet and VOTable files."""

from __future__ import annotations

import gzip
import io
import re
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from giantlike.core.errors import DataError
from giantlike.core.values import Value

MISSING = ("", "null", "nan", "none", "na", "n/a", "--", "\\n")
"""Text that stands for a missing value, in small letters."""


class Table(Protocol):
    """A table whose columns are read one by one."""

    @property
    def names(self) -> Sequence[str]:
        """Names of its columns."""
        ...

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The values (n,) of a column, NaN where missing."""
        ...

    def integers(self, name: str) -> NDArray[np.int64]:
        """The values (n,) of a column of identifiers."""
        ...

    def record(self, row: int) -> str:
        """How errors call a row."""
        ...


def open_table(path: Path) -> Table:
    """Open a table by the end of its name; ``.gz`` may follow for CSV, ECSV, FITS and VOTable.

    CSV has a header line of names; lines that begin with ``#`` before it are left out, and separators are commas
    unless the header line has tabs or semicolons. ECSV [1]_ says its separator in its header. Of FITS files the first
    binary or ASCII table is read, of VOTables the first table.

    Raises
    ------
    DataError
        The file is missing, of none of these kinds, or damaged.

    References
    ----------
    .. [1] Astropy Proposal for Enhancement 6: Enhanced Character Separated Values.
    """
    ends = [end.lower() for end in path.suffixes[-2:]]
    kind = ends[0] if len(ends) == 2 and ends[1] == ".gz" else (ends or [""])[-1]
    readers: Mapping[str, Callable[[Path], Table]] = {
        ".csv": _text_table, ".ecsv": _text_table, ".txt": _text_table, ".tsv": _text_table,
        ".fits": _fits_table, ".fit": _fits_table, ".parquet": _parquet_table,
        ".vot": _votable, ".votable": _votable, ".xml": _votable,
    }  # fmt: skip
    if kind not in readers:
        raise DataError(path, f"is no table that can be read: its name must end in one of {', '.join(readers)}")
    try:
        return readers[kind](path)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(path, f"cannot be read: {error}") from error


@dataclass(frozen=True, slots=True, eq=False)
class _TextTable(Value):
    """Columns of text; ``first_line`` is that of the first row."""

    path: Path
    columns: Mapping[str, Any]
    first_line: int

    @property
    def names(self) -> Sequence[str]:
        return tuple(self.columns)

    def numbers(self, name: str) -> NDArray[np.float64]:
        return np.asarray(self._converted(name, "double", float), dtype=np.float64)

    def integers(self, name: str) -> NDArray[np.int64]:
        return np.asarray(self._converted(name, "int64", int), dtype=np.int64)

    def record(self, row: int) -> str:
        return f"line {row + self.first_line}"

    def _converted(self, name: str, kind: str, of_text: Callable[[str], float]) -> NDArray[Any]:
        import pyarrow as pa
        import pyarrow.compute as pc

        text = pc.utf8_trim_whitespace(self.columns[name])
        absent = pc.is_in(pc.utf8_lower(text), value_set=pa.array(MISSING))
        present = pc.if_else(absent, pa.scalar(None, pa.string()), text)
        try:
            values = pc.cast(present, kind)
        except pa.ArrowInvalid:
            for row, word in enumerate(present.to_pylist()):
                if word is not None and not _converts(word, of_text):
                    raise DataError(
                        self.path, f"{self.record(row)}: column {name!r} must be a number, got {word!r}; mend the file"
                    ) from None
            values = pa.array([None if word is None else of_text(word) for word in present.to_pylist()], kind)
        if kind == "int64" and values.null_count:
            row = int(np.argmax(values.is_null().to_numpy(zero_copy_only=False)))
            raise DataError(self.path, f"{self.record(row)}: column {name!r} holds identifiers, and this one is empty")
        result: NDArray[Any] = values.to_numpy(zero_copy_only=False)
        return result


def _text_table(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.csv

    content = _unzipped(path)
    comments, start = [], 0
    while content[start : start + 1] == b"#":
        end = content.find(b"\n", start)
        end = len(content) if end < 0 else end + 1
        comments.append(content[start:end])
        start = end
    header_end = content.find(b"\n", start)
    header = content[start : header_end if header_end >= 0 else None].decode("utf-8-sig", errors="replace").strip()
    if not header:
        raise DataError(path, "holds no table: expected a header line with the names of the columns")
    delimiter = _delimiter(b"".join(comments).decode(errors="replace"), header)
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    first_line = len(comments) + 2
    try:
        table = pyarrow.csv.read_csv(
            io.BytesIO(content[header_end + 1 :] if header_end >= 0 else b""),
            read_options=pyarrow.csv.ReadOptions(column_names=names),
            parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter, newlines_in_values=False),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid as error:
        if "Empty CSV" in str(error):
            raise DataError(path, "holds a header but no rows") from error
        raise DataError(path, f"cannot be read as CSV, rows counted from line {first_line}: {error}") from error
    return _TextTable(path, {name: table.column(name).combine_chunks() for name in names}, first_line)


def _delimiter(comments: str, header: str) -> str:
    said = re.search(r"^#\s*(?:-\s*)?\{?\s*delimiter:\s*['\"]?([,; |\t])", comments, re.MULTILINE)
    if said:
        return said[1]
    if comments.startswith("# %ECSV"):
        return " "
    return next((mark for mark in (",", "\t", ";", "|") if mark in header), ",")


def _unzipped(path: Path) -> bytes:
    content = path.read_bytes()
    return gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content


@dataclass(frozen=True, slots=True, eq=False)
class _ArrayTable(Value):
    """Columns that are arrays already, masked where values are missing."""

    path: Path
    columns: Mapping[str, Callable[[], Any]]

    @property
    def names(self) -> Sequence[str]:
        return tuple(self.columns)

    def numbers(self, name: str) -> NDArray[np.float64]:
        values = np.ma.asanyarray(self.columns[name]())
        try:
            numbers = values.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise DataError(self.path, f"column {name!r} must hold numbers: {error}") from error
        if numbers.ndim != 1:
            raise DataError(self.path, f"column {name!r} must hold one number per row, got shape {numbers.shape}")
        return np.asarray(np.ma.filled(numbers, np.nan), dtype=np.float64)

    def integers(self, name: str) -> NDArray[np.int64]:
        values = np.ma.asanyarray(self.columns[name]())
        if values.dtype.kind not in "iu":
            raise DataError(
                self.path, f"column {name!r} must hold integers to serve as identifiers, got {values.dtype}"
            )
        if np.ma.is_masked(values):
            row = int(np.argmax(np.ma.getmaskarray(values)))
            raise DataError(self.path, f"{self.record(row)}: column {name!r} holds identifiers, and this one is empty")
        return np.asarray(values, dtype=np.int64)

    def record(self, row: int) -> str:
        return f"row {row + 1}"


def _fits_table(path: Path) -> Table:
    from astropy.io import fits

    with fits.open(path) as file:
        found = next((hdu for hdu in file if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)), None)
        if found is None:
            raise DataError(path, "holds no FITS table extension")
        data = {name: (np.array(found.data[name]), found.columns[name].null) for name in found.columns.names}
    return _array_table(path, ((name, _masked(values, null)) for name, (values, null) in data.items()))


def _masked(values: NDArray[Any], null: int | None) -> NDArray[Any]:
    if null is None or values.dtype.kind not in "iu":
        return values
    return np.ma.masked_equal(values, null)


def _votable(path: Path) -> Table:
    from astropy.io import votable

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # astropy warns of every deviation from the standard
            table = votable.parse_single_table(path)
    except (votable.exceptions.VOTableSpecError, ValueError, IndexError) as error:
        raise DataError(path, f"cannot be read as a VOTable: {error}") from error
    return _array_table(path, ((field.name, table.array[field.ID]) for field in table.fields))


def _parquet_table(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet

    try:
        file = pyarrow.parquet.ParquetFile(path)
        names = file.schema_arrow.names
    except pa.ArrowInvalid as error:
        raise DataError(path, f"cannot be read as Parquet: {error}") from error

    def read(name: str) -> Any:
        column = file.read(columns=[name]).column(name).combine_chunks()
        values = column.fill_null(0) if column.null_count and pa.types.is_integer(column.type) else column
        array = values.to_numpy(zero_copy_only=False)
        return np.ma.array(array, mask=column.is_null().to_numpy(zero_copy_only=False)) if column.null_count else array

    return _ArrayTable(path, {name: partial(read, name) for name in names})


def _array_table(path: Path, columns: Iterable[tuple[str, Any]]) -> Table:
    return _ArrayTable(path, {name: partial(np.asanyarray, values) for name, values in columns})


def _converts(word: str, of_text: Callable[[str], float]) -> bool:
    try:
        of_text(word)
    except ValueError:
        return False
    return True
