"""Catalogs of the user's own, as a CSV file."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.table import StarTable
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError

REQUIRED_COLUMNS = ("ra_deg", "dec_deg", "magnitude")
OPTIONAL_COLUMNS: Mapping[str, float] = MappingProxyType(
    {
        "pm_ra_mas_yr": 0.0,
        "pm_dec_mas_yr": 0.0,
        "parallax_mas": 0.0,
        "radial_velocity_km_s": 0.0,
        "epoch_jyear": 2000.0,
        "color_bv": float("nan"),
        "color_bp_rp": float("nan"),
        "sigma_mas": 0.0,
        "sigma_pm_mas_yr": 0.0,
        "is_double": 0.0,
    }
)
"""Columns that may be absent, or empty in a row, and what they then are."""
TEXT_COLUMNS = ("name", "source", "comment")
"""Columns that are for people and not read."""
_LIMITS = {"ra_deg": (-360.0, 720.0), "dec_deg": (-90.0, 90.0), "epoch_jyear": (1800.0, 2300.0)}


def read_csv_catalog(path: Path) -> MemoryCatalog:
    """Read a star catalog with the columns of :class:`~giantlike.catalogs.StarTable`.

    ``ra_deg``, ``dec_deg`` and ``magnitude`` are required; ``ids`` are row numbers from 1 when absent.
    The band is whatever the file's magnitudes are; it is called ``user``.

    Raises
    ------
    DataError
        The file is missing, a column is unknown or missing, or a value is no number or out of range;
        the message names the line.
    """
    try:
        content = path.read_bytes()
        rows = list(csv.reader(content.decode("utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(path, f"cannot be read as a CSV star catalog: {error}") from error
    if not rows:
        raise DataError(path, "is empty; expected a header line such as ra_deg,dec_deg,magnitude")
    header = [name.strip() for name in rows[0]]
    _check_header(path, header)
    lines = [(number, row) for number, row in enumerate(rows[1:], start=2) if any(cell.strip() for cell in row)]
    for number, row in lines:
        if len(row) != len(header):
            raise DataError(path, f"line {number}: expected {len(header)} values as in the header, got {len(row)}")
    if not lines:
        raise DataError(path, "holds a header but no stars")
    columns: dict[str, Any] = {}
    for name, default in (dict.fromkeys(REQUIRED_COLUMNS) | dict(OPTIONAL_COLUMNS)).items():
        place = header.index(name) if name in header else None
        columns[name] = _numbers(path, name, place, lines, default)
    ids = _integers(path, header.index("ids"), lines) if "ids" in header else np.arange(1, len(lines) + 1)
    digest = hashlib.sha256(content).hexdigest()
    stars = StarTable(ids=ids, **columns)
    return MemoryCatalog(stars, name=path.name, band="user", version=f"{path.name} sha256:{digest}")


def _check_header(path: Path, header: list[str]) -> None:
    known = ("ids", *REQUIRED_COLUMNS, *OPTIONAL_COLUMNS, *TEXT_COLUMNS)
    for name in header:
        if name not in known:
            raise DataError(path, f"unknown column {name!r}; columns are {', '.join(known)}")
        if header.count(name) > 1:
            raise DataError(path, f"column {name!r} appears twice")
    missing = [name for name in REQUIRED_COLUMNS if name not in header]
    if missing:
        raise DataError(path, f"column {missing[0]!r} is missing; required are {', '.join(REQUIRED_COLUMNS)}")


def _numbers(
    path: Path, name: str, place: int | None, lines: list[tuple[int, list[str]]], default: float | None
) -> Float:
    """Values (n,) of one column; empty cells take ``default``, which None forbids."""
    values = np.empty(len(lines))
    low, high = _LIMITS.get(name, (-np.inf, np.inf))
    for k, (number, row) in enumerate(lines):
        text = row[place].strip() if place is not None else ""
        if not text and default is not None:
            values[k] = default
            continue
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and low <= value <= high):
            limits = f" in [{low:g}, {high:g}]" if name in _LIMITS else ""
            raise DataError(path, f"line {number}: {name} must be a number{limits}, got {text!r}")
        values[k] = value
    return values


def _integers(path: Path, place: int, lines: list[tuple[int, list[str]]]) -> NDArray[np.int64]:
    values = np.empty(len(lines), dtype=np.int64)
    for k, (number, row) in enumerate(lines):
        try:
            values[k] = int(row[place])
        except (ValueError, OverflowError) as error:
            raise DataError(path, f"line {number}: ids must be a 64-bit integer, got {row[place]!r}") from error
    if np.unique(values).size != values.size:
        raise DataError(path, "ids must be unique")
    return values
