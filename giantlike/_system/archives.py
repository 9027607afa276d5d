"""Numpy archives (``.npz``) from outside: ``numpy.load`` returns other things for a file that is damaged."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray


def open_archive_of_arrays(file: Path | IO[bytes]) -> NpzFile:
    """Open a numpy archive; use it in a ``with`` block, or keep it open as long as arrays are read."""
    archive = np.load(file, allow_pickle=False)
    if not isinstance(archive, NpzFile):
        raise ValueError("needed an archive of arrays (.npz), found a single array")
    return archive


def array_of(archive: NpzFile, name: str) -> NDArray[Any]:
    """Return an array of an archive."""
    array = archive[name]
    if not isinstance(array, np.ndarray):
        raise ValueError(f"the archive has a part {name!r} that is no array")
    return array


def single_value(arrays: Mapping[str, NDArray[Any]], name: str, kinds: str) -> Any:
    """Return the only value of an array of an archive, of one of the kinds of numpy: ``U`` a text, ``iu`` whole."""
    array = arrays[name]
    if not isinstance(array, np.ndarray) or array.size != 1 or array.dtype.kind not in kinds:
        raise ValueError(f"the archive needs a single value {name!r} of kind {kinds!r}")
    return array.item()


def unpacked_sizes(archive: NpzFile) -> dict[str, int]:
    """Return the bytes that each part of an open archive takes in memory, as its directory says."""
    directory = archive.zip
    assert directory is not None  # it is while the archive is open
    return {member.filename.removesuffix(".npy"): member.file_size for member in directory.infolist()}
