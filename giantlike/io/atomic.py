"""Whole files or none: writes that a kill of the process cannot leave half done."""

from __future__ import annotations

import os
import uuid
from pathlib import Path

from giantlike.core.errors import DataError


def write_bytes_atomic(path: str | Path, data: bytes) -> None:
    """Write ``data`` to ``path`` through a temporary file in the same folder and one rename.

    A reader sees the old content or the new one, never a part. The data are not forced onto the disk:
    this guards against a killed process, not against a power cut.

    Raises
    ------
    DataError
        The folder does not exist, or the file system refused the write; the old file is untouched.
    """
    target = Path(path)
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        part.write_bytes(data)
        os.replace(part, target)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise DataError(target, f"cannot be written: {error.strerror or error}") from error


def write_text_atomic(path: str | Path, text: str) -> None:
    """Write ``text`` as UTF-8, line ends as given; see :func:`write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode("utf-8"))
