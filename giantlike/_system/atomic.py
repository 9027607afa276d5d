"""Atomic writes: a file is replaced as a whole or not at all, even when the process is killed."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from giantlike.core.errors import DataError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Context manager that yields a temporary path, which becomes ``path`` by one rename when the block ends.

    A reader sees the old content or the new one, never a part; when the block raises, the old file stays.
    The data are not forced onto the disk: this guards against a killed process, not against a power cut.
    """
    target = Path(path)
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        yield part
        os.replace(part, target)
    except OSError as error:
        raise DataError(target, f"cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def write_bytes_atomic(path: str | Path, data: bytes) -> None:
    """Write a file as a whole or not at all; see :func:`replacing`.

    Parameters
    ----------
    path : path-like
    data : bytes

    Raises
    ------
    DataError
        The folder does not exist, or the file system refused the write; an old file is untouched.
    """
    with replacing(path) as part:
        part.write_bytes(data)


def write_text_atomic(path: str | Path, text: str) -> None:
    """Write a text as a whole or not at all, as UTF-8 with its line ends as they are; see :func:`replacing`.

    Parameters
    ----------
    path : path-like
    text : str

    Raises
    ------
    DataError
        The folder does not exist, or the file system refused the write; an old file is untouched.
    """
    write_bytes_atomic(path, text.encode("utf-8"))


def append_text(path: Path, text: str) -> None:
    """Append to a file in UTF-8; it is made where there is none."""
    try:
        with path.open("a", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise DataError(path, f"cannot be written: {error.strerror or error}") from error


def make_folder(path: Path) -> None:
    """Make a folder and those above it; it may exist."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(path, f"cannot make this folder: {error.strerror or error}") from error
