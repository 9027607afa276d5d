"""Columns of numbers from tables in CSV, ECSV, FITS, Parquet and VOTable files."""

from __future__ import annotations

import io
import math
import mmap
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check, check_declared_bytes, decompress_gzip
from giantlike.catalogs.readers.rows import parse_number
from giantlike.core.arrays import Mask
from giantlike.core.errors import DataError
from giantlike.core.fits_structure import require_whole_fits
from giantlike.core.values import Value

MISSING = ("", "null", "nan", "none", "na", "n/a", "--", "\\n")  # words that stand for a missing value, in lower case
_DEEPEST_XML = 100  # elements within elements of a VOTable, which has 6
_LONGEST_CELL = 100_000  # values of one cell of a VOTable: catalogs have numbers and names


class Table(Protocol):
    """A table whose columns are read one by one; a column that is not as it should be is a ``ValueError``."""

    @property
    def names(self) -> Sequence[str]:
        """Names of the columns."""
        ...

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Values (n,) of a column, NaN where missing."""
        ...

    def integers(self, name: str) -> NDArray[np.int64]:
        """Values (n,) of a column of identifiers."""
        ...

    def record(self, row: int) -> str:
        """Name of a row in error messages."""
        ...


def open_table(path: Path) -> Table:
    """Open a table of the kind that its file name extension says; ``.gz`` may follow for CSV, ECSV, FITS and VOTable.

    CSV has a header line of names; lines that begin with ``#`` before it are left out, and separators are commas
    unless the header line has tabs or semicolons. ECSV [1]_ states its separator in its header. Of FITS files the first
    binary or ASCII table is read, of VOTables the first table.

    References
    ----------
    .. [1] Astropy Proposal for Enhancement 6: Enhanced Character Separated Values.
    """
    ends = [end.lower() for end in path.suffixes[-2:]]
    kind = ends[0] if len(ends) == 2 and ends[1] == ".gz" else (ends or [""])[-1]
    readers: Mapping[str, Callable[[Path], Table]] = {
        ".csv": _csv_table, ".ecsv": _csv_table, ".txt": _csv_table, ".tsv": _csv_table,
        ".fits": _fits_table, ".fit": _fits_table, ".parquet": _parquet_table,
        ".vot": _votable, ".votable": _votable, ".xml": _votable,
    }  # fmt: skip
    if kind not in readers:
        raise DataError(path, f"is not a table that can be read: its name must end in one of {', '.join(readers)}")
    return readers[kind](path)


@dataclass(frozen=True, slots=True, eq=False)
class _TextTable(Value):
    """Columns of text, the line of the first row, and the lines of the file that are blank."""

    columns: Mapping[str, Any]
    first_line: int
    blank_lines: Sequence[int]

    @property
    def names(self) -> Sequence[str]:
        return tuple(self.columns)

    def numbers(self, name: str) -> NDArray[np.float64]:
        return np.asarray(self._convert(name, "double", float), dtype=np.float64)

    def integers(self, name: str) -> NDArray[np.int64]:
        return np.asarray(self._convert(name, "int64", int), dtype=np.int64)

    def record(self, row: int) -> str:
        line = row + self.first_line
        for blank in self.blank_lines:
            line += blank <= line
        return f"line {line}"

    def _convert(self, name: str, kind: str, of_text: Callable[[str | bytes], float]) -> NDArray[Any]:
        import pyarrow as pa
        import pyarrow.compute as pc

        text = pc.utf8_trim_whitespace(self.columns[name])
        absent = pc.is_in(pc.utf8_lower(text), value_set=pa.array(MISSING))
        present = pc.if_else(absent, pa.scalar(None, pa.string()), text)
        try:
            values = pc.cast(present, kind)
        except pa.ArrowInvalid:
            numbers = [None if word is None else parse_number(word, of_text) for word in present.to_pylist()]
            for row, (word, number) in enumerate(zip(present.to_pylist(), numbers, strict=True)):
                if number is None and word is not None:
                    raise ValueError(f"{self.record(row)}: column {name!r} must be a number, got {word!r}") from None
            values = pa.array(numbers, kind)
        if kind == "int64":
            _require_identifiers(self, name, values.is_null().to_numpy(zero_copy_only=False))
        return np.asarray(values.to_numpy(zero_copy_only=False))


def _require_identifiers(table: Table, name: str, missing: Mask) -> None:
    if missing.any():
        row = table.record(int(np.argmax(missing)))
        raise ValueError(f"{row}: column {name!r} holds identifiers, and this one is empty")


def _csv_table(path: Path) -> Table:
    return text_table(path.read_bytes())


def text_table(content: bytes) -> Table:
    """Open a table in CSV or ECSV."""
    import pyarrow as pa
    import pyarrow.csv

    content = decompress_gzip(content)
    comments, start = [], 0
    while content[start : start + 1] == b"#":
        end = content.find(b"\n", start)
        end = len(content) if end < 0 else end + 1
        comments.append(content[start:end])
        start = end
    header_end = content.find(b"\n", start)
    header = content[start : header_end if header_end >= 0 else None].decode("utf-8-sig", errors="replace").strip()
    check(bool(header), "the table is empty: expected a header line with the names of the columns")
    delimiter = _delimiter(b"".join(comments).decode(errors="replace"), header)
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    for name in names:
        check(names.count(name) <= 1, f"column {name!r} appears twice")
    first_line, body = len(comments) + 2, content[header_end + 1 :] if header_end >= 0 else b""
    check(bool(body.strip()), "the table holds a header but no rows")
    blank = []
    if re.search(rb"(?:^|\n) *\r?\n", body):  # the parser leaves empty lines out, and stumbles over blanks in them
        blank = [number for number, line in enumerate(body.split(b"\n"), start=first_line) if not line.strip(b" \r")]
        body = re.sub(rb"(?m)^ +(\r?)$", rb"\1", body)
    try:
        table = pyarrow.csv.read_csv(
            io.BytesIO(body),
            read_options=pyarrow.csv.ReadOptions(column_names=names),
            parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter, newlines_in_values=False),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid as error:
        raise ValueError(f"{error} (rows counted from line {first_line})") from error
    return _TextTable({name: table.column(name).combine_chunks() for name in names}, first_line, blank)


def _delimiter(comments: str, header: str) -> str:
    """Separator that an ECSV header states, else the first of the usual ones in the line of names."""
    stated = re.search(r"^#\s*+(?:-\s*+)?\{?\s*+delimiter:\s*['\"]?([,; |\t])", comments, re.MULTILINE)
    if stated:
        return stated[1]
    if comments.startswith("# %ECSV"):
        return " "
    return next((mark for mark in (",", "\t", ";", "|") if mark in header), ",")


@dataclass(frozen=True, slots=True, eq=False)
class _ArrayTable(Value):
    """Columns that are arrays already, masked where values are missing."""

    columns: Mapping[str, Callable[[], Any]]

    @property
    def names(self) -> Sequence[str]:
        return tuple(self.columns)

    def numbers(self, name: str) -> NDArray[np.float64]:
        values = np.ma.asanyarray(self.columns[name]())
        try:
            numbers = values.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"column {name!r} must hold numbers: {error}") from error
        check(numbers.ndim == 1, f"column {name!r} must hold one number per row, got shape {numbers.shape}")
        return np.asarray(np.ma.filled(numbers, np.nan), dtype=np.float64)

    def integers(self, name: str) -> NDArray[np.int64]:
        values = np.ma.asanyarray(self.columns[name]())
        if values.dtype.kind not in "iu":
            raise ValueError(f"column {name!r} must hold integers to serve as identifiers, got {values.dtype}")
        _require_identifiers(self, name, np.ma.getmaskarray(values))
        return np.asarray(values, dtype=np.int64)

    def record(self, row: int) -> str:
        return f"row {row + 1}"


def _fits_table(path: Path) -> Table:
    from astropy.io import fits

    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as stored:
        packed = stored[:2] == b"\x1f\x8b"
        content = decompress_gzip(stored[:]) if packed else b""
        require_whole_fits(content if packed else stored)
    with fits.open(io.BytesIO(content) if packed else path) as file:
        found = next((hdu for hdu in file if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)), None)
        if found is None:
            raise ValueError("it holds no FITS table extension")
        data = {name: (np.array(found.data[name]), found.columns[name].null) for name in found.columns.names}
    return _array_table((name, _mask_null(values, null)) for name, (values, null) in data.items())


def _mask_null(values: NDArray[Any], null: int | None) -> NDArray[Any]:
    if null is None or values.dtype.kind not in "iu":
        return values
    return np.ma.masked_equal(values, null)


def _votable(path: Path) -> Table:
    from astropy.io import votable

    content = decompress_gzip(path.read_bytes())
    _check_votable(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # astropy warns of every deviation from the standard
        table = votable.parse_single_table(io.BytesIO(content))
    return _array_table((field.name, table.array[field.ID]) for field in table.fields)


def _check_votable(content: bytes) -> None:
    """Refuse a VOTable whose data are elsewhere, or that declares more than it holds, before astropy reads it."""
    depth = 0

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        check(depth <= _DEEPEST_XML, f"its elements are nested more than {_DEEPEST_XML} deep")
        name, given = tag.rpartition(":")[2].upper(), {key.lower(): value for key, value in attributes.items()}
        if name == "STREAM" and "href" in given:
            raise ValueError(f"its data are at {given['href'][:100]!r}: save the table with its data in the file")
        if name == "TABLE" and (rows := given.get("nrows", "0").strip()).isdecimal():
            check_declared_bytes(8 * int(rows[:20]), len(content))
        if name == "FIELD":
            sizes = [int(size[:20]) for size in re.findall(r"[0-9]++", given.get("arraysize", "1")[:200])]
            check(math.prod(sizes) <= _LONGEST_CELL, f"a column has cells of {'x'.join(map(str, sizes))} values")

    def end(_tag: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.Parse(content, True)


def _parquet_table(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet

    file = pyarrow.parquet.ParquetFile(path)
    check_declared_bytes(8 * file.metadata.num_rows, path.stat().st_size)

    def read(name: str) -> Any:
        kind = file.schema_arrow.field(name).type
        numeric = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
        check(numeric, f"column {name!r} must hold numbers, got {kind}")
        column = file.read(columns=[name]).column(name).combine_chunks()
        values = column.fill_null(0) if column.null_count and pa.types.is_integer(column.type) else column
        array = values.to_numpy(zero_copy_only=False)
        return np.ma.array(array, mask=column.is_null().to_numpy(zero_copy_only=False)) if column.null_count else array

    return _ArrayTable({name: partial(read, name) for name in file.schema_arrow.names})


def _array_table(columns: Iterable[tuple[str, Any]]) -> Table:
    return _ArrayTable({name: partial(np.asanyarray, values) for name, values in columns})
