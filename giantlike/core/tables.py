"""Checks of the tables of TOML files: keys and numbers, with the name of the table in every message."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from giantlike.core.errors import InputError

Record = TypeVar("Record")


def checked_table(table: object, where: str, known: Iterable[str], required: Iterable[str] = ()) -> Mapping[str, Any]:
    """Return a table of a TOML file after a check of its keys."""
    if not isinstance(table, Mapping):
        raise InputError(f"{where} must be a table, got {table!r}")
    names, prefix = tuple(known), f"{where}: " if where else ""
    for key in table:
        if key not in names:
            raise InputError(f"{prefix}unknown key {key!r}; the keys are {', '.join(names)}")
    for key in required:
        if key not in table:
            raise InputError(f"{prefix}key {key!r} is missing")
    return table


def record_of_numbers(kind: type[Record], table: object, where: str) -> Record:
    """Build a dataclass whose fields are all numbers from a table of a TOML file."""
    entries = fields(kind)  # type: ignore[arg-type]
    required = [entry.name for entry in entries if entry.default is MISSING]
    checked = checked_table(table, where, [entry.name for entry in entries], required)
    for key, value in checked.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{where}: {key} must be a number, got {value!r}")
    return kind(**{key: float(value) for key, value in checked.items()})


def table_of_numbers(record: object) -> dict[str, float]:
    """Return the fields of a dataclass of numbers as a table without infinite values, which mean unknown."""
    values = {entry.name: float(getattr(record, entry.name)) for entry in fields(record)}  # type: ignore[arg-type]
    return {key: value for key, value in values.items() if math.isfinite(value)}
