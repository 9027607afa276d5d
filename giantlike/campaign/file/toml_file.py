"""TOML files read and checked by a pydantic model of their keys; an error is one line; line numbers of keys."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from giantlike._system.reading import toml_table
from giantlike.core.errors import DataError, InputError

Content = TypeVar("Content", bound=BaseModel)


class TomlSection(BaseModel):
    """Base of the tables of a file: types are strict, unknown keys are refused, values are immutable.

    The text below a field describes its key.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, use_attribute_docstrings=True)


@contextmanager
def prefix_errors(where: str) -> Iterator[None]:
    """Put the name of a key or table before the text of an error raised inside a ``with`` block."""
    try:
        yield
    except (InputError, DataError) as error:
        raise InputError(f"{where}{error}") from error


Completion: TypeAlias = Callable[[Path, Mapping[str, Any]], dict[str, Any]]
"""A function of the file and its table that returns the table with its defaults added."""


def read_toml(
    path: Path, model: type[Content], what: str, *, complete: Completion | None = None
) -> tuple[Content, dict[str, Any]]:
    """Parse a TOML file and check keys and types."""
    table = toml_table(path, what)
    try:
        return checked_table(table if complete is None else complete(path, table), model), table
    except ValidationError as error:
        raise DataError(path, _first_problem(error, model)) from error
    except InputError as error:
        raise DataError(path, str(error)) from error
    except RecursionError as error:
        raise DataError(path, "its brackets are nested too deeply") from error


def checked_table(table: dict[str, Any], model: type[Content]) -> Content:
    """Check a plain table by the model of its keys."""
    # Strict JSON rules fit TOML: they allow text for an enumeration, but no text for a number.
    return model.model_validate_json(json.dumps(table, default=_refuse_dates))


def problems_of(error: ValidationError, model: type[BaseModel]) -> list[tuple[str, str]]:
    """Every problem of a table."""
    return [(key_text(problem["loc"]), _one_problem(problem, model)) for problem in error.errors()]


def _refuse_dates(value: object) -> Any:
    raise InputError(f"dates and times are not expected here, got {value}: if text is meant, put it in quotes")


def _first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    # An unknown key explains a missing one (it is misspelt), so it comes first.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    more = len(problems) - 1
    return _one_problem(problems[0], model) + (f" (and {more} more)" if more else "")


def _one_problem(problem: ErrorDetails, model: type[BaseModel]) -> str:
    """One line for a pydantic error: the key, the expectation and the finding."""
    location = problem["loc"]
    key = key_text(location)
    if problem["type"] == "extra_forbidden":
        known = _section(location, model).model_fields
        return f"unknown key {key}{nearest(str(location[-1]), known)}; keys there are {', '.join(known)}"
    if problem["type"] == "missing":
        return f"key {key} is missing"
    if problem["type"] in {"too_short", "string_too_short"} and not problem["input"]:
        return f"{key}: must not be empty, got {problem['input']!r}"
    if problem["type"] == "value_error":  # raised by a validator of ours; options name the key inside their table
        text = str(problem["ctx"]["error"])
        return key + (text if text.startswith((":", ".")) else f": {text}")
    expected = problem["msg"].removeprefix("Input should be ")
    return f"{key}: expected {expected}, got {problem['input']!r}"


def _section(location: tuple[int | str, ...], model: type[BaseModel]) -> type[BaseModel]:
    """Model of the table that holds a key."""
    section = model
    for part in location[:-1]:
        if isinstance(part, str) and part in section.model_fields:
            section = model_in(section.model_fields[part].annotation) or section
    return section


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Model inside an annotation such as ``list[...]``, ``dict[str, ...]`` or ``... | None``; None without one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (model_in(inner) for inner in get_args(annotation))
    return next((inner for inner in found if inner is not None), None)


def key_text(location: tuple[int | str, ...]) -> str:
    """Dotted name of a key, with positions in lists counted from 0.

    >>> key_text(("targets", 0, "units"))
    'targets[0].units'
    """
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


_HEADER = re.compile(r"\s*(\[\[?)([^\[\]]++)\]\]?\s*(#.*)?$")
_KEY = re.compile(r"""\s*([A-Za-z0-9_\-."']+)\s*=""")


def lines_of_keys(text: str) -> dict[str, int]:
    r"""Lines of the tables and keys of a TOML file.

    >>> lines_of_keys("[a]\nb = 1\n[[c]]\nd.e = 2\n[[c]]\n")
    {'a': 1, 'a.b': 2, 'c[0]': 3, 'c[0].d.e': 4, 'c[1]': 5}
    """
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    depth = 0
    for number, line in enumerate(text.splitlines(), start=1):
        header = _HEADER.match(line) if depth == 0 else None
        if header is not None:
            table = _full_name(header.group(2).strip(), counts)
            if header.group(1) == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = f"{table}[{counts[table]}]"
            lines.setdefault(table, number)
            continue
        key = _KEY.match(line) if depth == 0 else None
        if key is not None:
            lines.setdefault(f"{table}.{key.group(1)}".strip("."), number)
        bare = re.sub(r"\"[^\"]*\"|'[^']*'|#.*", "", line)
        depth = max(0, depth + bare.count("[") + bare.count("{") - bare.count("]") - bare.count("}"))
    return lines


def line_of(key: str, lines: Mapping[str, int]) -> int | None:
    """Line of a key or, where it has none, of the nearest key or table around it."""
    while key:
        if key in lines:
            return lines[key]
        key = re.sub(r"(\[\d+\]|\.?[^.\[\]]+|.)$", "", key)
    return None


def _full_name(name: str, counts: Mapping[str, int]) -> str:
    """Name of a table with the positions of the arrays that it is in."""
    full = ""
    parts = [part.strip().strip("\"'") for part in name.split(".")]
    for place, part in enumerate(parts):
        full = f"{full}.{part}".strip(".")
        if full in counts and place < len(parts) - 1:
            full = f"{full}[{counts[full]}]"
    return full


_LIKENESS = 0.7  # share of letters by which a name is suggested: a slip in six; 0.6 suggests `stars` for `estimators`


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint at the name that may be meant.

    >>> nearest("limb_maching", ["limb_matching", "moment"])
    " (did you mean 'limb_matching'?)"
    >>> nearest("x", ["limb_matching"])
    ''
    """
    found = difflib.get_close_matches(name, list(known), n=1, cutoff=_LIKENESS)
    return f" (did you mean {found[0]!r}?)" if found else ""
