"""Tables whose schema is a dataclass: CSV and Parquet files, the checks on reading, and descriptions of the columns.

A field of the dataclass is a column; :func:`column` adds unit, frame and description to it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, get_args, get_type_hints

from giantlike._system.atomic import write_bytes_atomic
from giantlike.io.csv_rows import CsvRow, read_csv_rows, write_csv_rows

Row = TypeVar("Row")

_KINDS: Mapping[Any, str] = MappingProxyType(
    {
        str: "text",
        bool: "true or false",
        int: "integer",
        float: "number",
        Sequence[str]: "texts",
        Sequence[float]: "numbers",
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of a table."""

    name: str
    kind: str  # text, true or false, integer, number, texts or numbers
    description: str
    unit: str  # unit, frame: empty where there is none
    frame: str
    csv: bool  # True if the CSV file has the column as well as the Parquet file
    required: bool  # True if no cell may be empty
    size: int = 0  # of lists that all have the same length, that length; else 0


def column(description: str, unit: str = "", frame: str = "", *, csv: bool = True, size: int = 0) -> Any:
    """Field of a dataclass that describes a column; the type of the field decides kind and emptiness."""
    metadata = {"description": description, "unit": unit, "frame": frame, "csv": csv, "size": size}
    return dataclasses.field(default=None, metadata=metadata)


def columns_of(kind: type[Any]) -> tuple[Column, ...]:
    """Columns of a table, in order."""
    hints = get_type_hints(kind)
    columns = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        optional = type(None) in get_args(hint)
        base = next(part for part in get_args(hint) if part is not type(None)) if optional else hint
        columns.append(Column(name=field.name, kind=_KINDS[base], required=not optional, **field.metadata))
    return tuple(columns)


def write_rows(stem: Path, kind: type[Row], rows: Sequence[Row]) -> None:
    """Write a table as CSV, with all digits, and as Parquet, whose columns have unit, frame and description."""
    columns = columns_of(kind)
    names = [column.name for column in columns if column.csv]
    write_csv_rows(stem.with_suffix(".csv"), names, ([getattr(row, name) for name in names] for row in rows))
    write_bytes_atomic(stem.with_suffix(".parquet"), _parquet(columns, rows))


def read_rows(path: Path, kind: type[Row]) -> list[Row]:
    """Read a table back from its CSV file; absent columns, and columns of Parquet alone, are None."""
    columns = [column for column in columns_of(kind) if column.csv]
    names = [column.name for column in columns]
    rows = read_csv_rows(path, names, [column.name for column in columns if column.required])
    return [kind(**{column.name: _cell(row, column) for column in columns}) for row in rows]


def _cell(row: CsvRow, column: Column) -> str | int | float | None:
    text = row.text(column.name)
    if column.required:
        row.require(text, (column.name,))
    if text is None or column.kind == "text":
        return text
    try:
        return int(text) if column.kind == "integer" else float(text)
    except ValueError:
        raise row.error(column.name, f"a value of kind {column.kind} is needed") from None


def arrow_schema(columns: Sequence[Column], metadata: Mapping[str, str] | None = None) -> Any:
    """Schema of a Parquet file."""
    import pyarrow as pa

    types = {
        "text": pa.string(),
        "true or false": pa.bool_(),
        "number": pa.float64(),
        "integer": pa.int64(),
        "texts": pa.list_(pa.string()),
        "numbers": pa.list_(pa.float64()),
    }
    fields = [
        pa.field(
            column.name,
            pa.list_(pa.float64(), column.size) if column.size else types[column.kind],
            metadata={"unit": column.unit, "frame": column.frame, "description": column.description},
        )
        for column in columns
    ]
    return pa.schema(fields, metadata=metadata)


def arrow_table(schema: Any, rows: Sequence[Any]) -> Any:
    """Rows of a dataclass as a table of a schema."""
    import pyarrow as pa

    arrays = [pa.array([getattr(row, field.name) for row in rows], type=field.type) for field in schema]
    return pa.Table.from_arrays(arrays, schema=schema)


def _parquet(columns: Sequence[Column], rows: Sequence[Any]) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    schema = arrow_schema(columns)
    sink = pa.BufferOutputStream()
    parquet.write_table(arrow_table(schema, rows), sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content
