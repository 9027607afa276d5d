"""Atomic writes: a file is replaced as a whole or not at all, even when the process is killed."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from giantlike.core.errors import DataError

_LONGEST_NAME = 200  # characters: file systems take 255 bytes


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path, renamed to ``path`` when the block ends; where it raises, the old file stays."""
    target = Path(path)
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        yield part
        os.replace(part, target)
    except OSError as error:
        raise DataError(target, f"cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # a file system that is read-only refuses this even where there is no file
            part.unlink(missing_ok=True)


def write_bytes_atomic(path: str | Path, data: bytes) -> None:
    """Write a file as a whole or not at all; see :func:`replacing`."""
    with replacing(path) as part:
        part.write_bytes(data)


def write_text_atomic(path: str | Path, text: str) -> None:
    """Write a text as a whole or not at all, as UTF-8 with its line ends as they are; see :func:`replacing`."""
    write_bytes_atomic(path, text.encode("utf-8"))


def append_text(path: Path, text: str) -> None:
    """Append to a file in UTF-8; it is made where there is none. A symbolic link is refused, not followed."""
    try:
        with open(path, "a", encoding="utf-8", opener=_open_no_link) as stream:
            stream.write(text)
    except OSError as error:
        problem = "it is a symbolic link, which is not followed" if path.is_symlink() else error.strerror or error
        raise DataError(path, f"cannot be written: {problem}") from error


def _open_no_link(path: str, flags: int) -> int:
    """Open a file that is not a symbolic link."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def name_of_file(text: str) -> str:
    """Return a name that denotes a file in a folder, made of any text: without separators and leading dots.

    >>> name_of_file("../67P/C-G")
    '_67P_C-G'
    """
    return re.sub(r"[/\\:\x00-\x1f]+", "_", text).lstrip(".")[:_LONGEST_NAME] or "_"


def make_folder(path: str | Path) -> Path:
    """Make a folder and those above it, which may exist, and return it."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(path, f"cannot make this folder: {error.strerror or error}") from error
    return path
