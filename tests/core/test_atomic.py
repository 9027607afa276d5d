"""Files are written whole, where they were meant to be, and what the file system refuses is one line."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from giantlike._system.atomic import append_text, name_of_file, write_text_atomic
from giantlike.core.errors import DataError


def test_a_file_system_that_is_read_only_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "write_bytes", refused)
    monkeypatch.setattr(Path, "unlink", refused)  # as the kernel does, even where there is no file
    with pytest.raises(DataError, match=r"a\.txt: cannot be written: Read-only file system"):
        write_text_atomic(tmp_path / "a.txt", "x")


def test_a_log_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    other, log = tmp_path / "other", tmp_path / "log.jsonl"
    other.write_text("mine")
    log.symlink_to(other)
    with pytest.raises(DataError, match="symbolic link"):
        append_text(log, "line")
    assert other.read_text() == "mine"
    log.unlink()
    append_text(log, "one\n")
    append_text(log, "two\n")
    assert log.read_text() == "one\ntwo\n"


@pytest.mark.parametrize(
    "text", ["../../x", "/etc/x", "..", ".hidden", "a\\b", "C:x", "a\0b\n", "", "é" * 900, "67P/C-G"]
)
def test_a_name_of_a_file_stays_in_its_folder(text: str, tmp_path: Path) -> None:
    name = name_of_file(text)
    path = tmp_path / name
    assert path.parent == tmp_path
    assert path.resolve().parent == tmp_path.resolve()
    assert not name.startswith(".")
    (tmp_path / name[:100]).write_text("")


def test_names_that_are_fine_stay() -> None:
    assert name_of_file("image 12-b_ROCK.v2") == "image 12-b_ROCK.v2"
