"""Tables of a TOML file to option dataclasses: names and types checked, one line per error."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import PlainValidator, TypeAdapter, ValidationError

from giantlike.campaign.file.toml_file import nearest, prefix_errors
from giantlike.core.arrays import require
from giantlike.core.errors import InputError

Options = TypeVar("Options")


def options_from_mapping(kind: type[Options], table: Mapping[str, Any], where: str) -> Options:
    """Build an options dataclass from a table of its fields."""
    require(isinstance(table, Mapping), f"{where}: expected a table of options, got {table!r}")
    hints = get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.init]  # type: ignore[arg-type]
    values = {}
    for name, value in table.items():
        options = ", ".join(known) or "none"
        require(name in known, f"{where}: unknown option {name!r}{nearest(name, known)}; options are {options}")
        hint = hints[name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            values[name] = options_from_mapping(hint, value, f"{where}.{name}")
        else:
            values[name] = _value(hint, value, f"{where}.{name}")
    with prefix_errors(f"{where}: "):
        return kind(**values)


def options_validator(kind: type[Any], *, elsewhere: tuple[str, ...] = ()) -> PlainValidator:
    """Annotation of a pydantic field whose table becomes an options dataclass."""

    def build(table: Any) -> Any:
        twice = [name for name in elsewhere if isinstance(table, Mapping) and name in table]
        if twice:
            raise InputError(f"{twice[0]} has a key of its own beside this table")
        return options_from_mapping(kind, table, "")

    return PlainValidator(build)


def with_files_found(options: Options, folder: Path, where: str) -> Options:
    """Return options whose relative paths are resolved against a folder."""
    paths = {}
    for field in dataclasses.fields(options):  # type: ignore[arg-type]
        value = getattr(options, field.name)
        if isinstance(value, Path):
            file = paths[field.name] = folder / value
            require(file.exists(), f"{where}.{field.name}: there is no {value.as_posix()!r} ({file})")
    return dataclasses.replace(options, **paths) if paths else options  # type: ignore[type-var]


def _value(hint: Any, value: Any, where: str) -> Any:
    try:
        return TypeAdapter(hint).validate_json(json.dumps(value, default=str), strict=True)
    except ValidationError as error:
        expected = error.errors()[0]["msg"].removeprefix("Input should be ")
        raise InputError(f"{where}: expected {expected}, got {value!r}") from error
