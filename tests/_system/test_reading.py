"""The border of file readers: damaged content becomes a DataError with the path, mistakes in our code stay visible."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from giantlike._system.reading import reads
from giantlike.core.errors import DataError, InputError

PATH = Path("some") / "file.dat"


def raised_by(error: Exception) -> DataError:
    @reads("a table")
    def read(path: Path) -> None:
        raise error

    with pytest.raises(DataError) as caught:
        read(PATH)
    return caught.value


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (FileNotFoundError(2, "No such file or directory"), "there is no such file"),
        (PermissionError(13, "Permission denied"), "cannot be read as a table: Permission denied"),
        (ValueError("needed 3\nnumbers"), "cannot be read as a table: needed 3 numbers"),
        (KeyError("version"), "'version' is missing"),
        (struct.error("unpack requires 4 bytes"), "unpack requires 4 bytes"),
        (MemoryError(), "MemoryError"),
        (InputError("radii must be > 0"), "radii must be > 0"),
    ],
)
def test_what_content_causes_names_the_file_and_what_was_needed(error: Exception, said: str) -> None:
    caught = raised_by(error)
    assert caught.path == PATH
    assert said in str(caught)
    assert "\n" not in str(caught)


def test_a_data_error_of_the_reader_itself_is_kept() -> None:
    assert str(raised_by(DataError(PATH, "line 3: no number"))) == f"{PATH}: line 3: no number"


def test_a_mistake_in_our_own_code_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "__name__", "giantlike.made_up_reader")

    @reads("a table")
    def read(path: Path) -> Any:
        return path.no_such_attribute  # type: ignore[attr-defined]

    with pytest.raises(AttributeError):
        read(PATH)


def test_the_same_exception_inside_a_library_is_damage() -> None:
    @reads("a table")
    def read(path: Path) -> Any:
        return json.loads(7)  # type: ignore[arg-type]

    with pytest.raises(DataError):
        read(PATH)
