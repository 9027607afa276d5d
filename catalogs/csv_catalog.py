"""Star catalogs of the user's own in CSV files."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check, reads
from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.readers.rows import REQUIRED, stars_of
from giantlike.catalogs.readers.tabular import Table, text_table
from giantlike.catalogs.table import COLUMN_TYPES

TEXT_COLUMNS = ("name", "source", "comment")  # columns for users, which are not read


@reads("a star catalog in CSV")
def read_csv_catalog(path: Path) -> MemoryCatalog:
    """Read a star catalog, band ``user``: ``ra_deg``, ``dec_deg``, ``magnitude``, other columns of ``StarTable``."""
    content = path.read_bytes()
    table = text_table(content)
    _check_names(table)
    columns: dict[str, NDArray[Any]] = {
        name: table.numbers(name) for name in table.names if name in COLUMN_TYPES and name != "ids"
    }
    count = len(columns["ra_deg"])
    for name in REQUIRED:
        empty = np.isnan(columns[name])
        if empty.any():
            raise ValueError(f"{table.record(int(empty.argmax()))}: column {name!r} must be a number, it is empty")
    columns["ids"] = table.integers("ids") if "ids" in table.names else np.arange(1, count + 1)
    check(np.unique(columns["ids"]).size == count, "ids must be unique")
    columns["sigma_pm_mas_yr"] = np.nan_to_num(columns.get("sigma_pm_mas_yr", np.zeros(count)))  # 0: taken as exact
    stars = stars_of(columns, band="user", record=table.record).stars
    digest = hashlib.sha256(content).hexdigest()
    return MemoryCatalog(stars, name=path.name, band="user", version=f"{path.name} sha256:{digest}")


def _check_names(table: Table) -> None:
    known = (*COLUMN_TYPES, *TEXT_COLUMNS)
    for name in table.names:
        check(name in known, f"unknown column {name!r}; columns are {', '.join(known)}")
    missing = [name for name in REQUIRED if name not in table.names]
    if missing:
        raise ValueError(f"column {missing[0]!r} is missing; required are {', '.join(REQUIRED)}")
