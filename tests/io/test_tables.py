"""Tables whose schema is a dataclass: what is written comes back, and each column says what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from pyarrow import parquet

from giantlike.core.errors import DataError
from giantlike.io.tables import column, columns_of, read_rows, write_rows


@dataclass(frozen=True, kw_only=True)
class Row:
    name: str = column("Name.")
    count: int | None = column("Count.")
    range_km: float | None = column("Range.", "km", "camera")
    parts: Sequence[float] | None = column("Parts.", csv=False)


ROWS = [Row(name="a, b", count=3, range_km=0.1 + 0.2, parts=[1.0, 2.0]), Row(name="c")]


def test_rows_come_back_from_csv_with_all_their_digits_and_empty_cells_as_none(tmp_path: Path) -> None:
    write_rows(tmp_path / "t", Row, ROWS)
    first, second = read_rows(tmp_path / "t.csv", Row)
    assert (first.name, first.count, first.range_km, first.parts) == ("a, b", 3, 0.1 + 0.2, None)
    assert (second.count, second.range_km) == (None, None)


def test_parquet_holds_every_column_with_unit_frame_and_description(tmp_path: Path) -> None:
    write_rows(tmp_path / "t", Row, ROWS)
    schema = parquet.read_schema(tmp_path / "t.parquet")
    assert schema.names == [column.name for column in columns_of(Row)]
    assert schema.field("range_km").metadata == {b"unit": b"km", b"frame": b"camera", b"description": b"Range."}
    assert parquet.read_table(tmp_path / "t.parquet").to_pylist()[0]["parts"] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("name,length\na,1\n", "unknown column 'length'"),
        ("count\n1\n", "column 'name' is missing"),
        ("name,count\n,1\n", "column name: name must be filled in every row"),
        ("name,count\na,1.5\n", "column count: a value of kind integer is needed"),
    ],
)
def test_a_table_that_does_not_fit_is_refused_with_the_place(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DataError, match=problem):
        read_rows(tmp_path / "t.csv", Row)
