"""The user's cache folder, for files that are slow to make and can always be rebuilt."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path


def cache_folder() -> Path:
    """Folder for derived files: ``GIANTLIKE_CACHE``, else ``XDG_CACHE_HOME/giantlike``, else ``~/.cache/giantlike``.

    The folder need not exist or be writable: everything in it is only a saving of time.
    """
    own = os.environ.get("GIANTLIKE_CACHE")
    if own:
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "giantlike"


def write_to_cache(name: str, write: Callable[[Path], None]) -> bool:
    """Write a file into the cache folder, all of it or nothing. Returns False when the folder cannot be written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as scratch:
            part = Path(scratch) / name
            write(part)
            part.replace(folder / name)
    except OSError:
        return False
    return True
