"""Functions that are called in a process of their own, as C libraries behave that meet a damaged file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.frames import rotate

Arrays = Mapping[str, NDArray[Any]]


def ends(paths: Sequence[Path]) -> Arrays:
    """End the process as a library does that meets a wrong pointer."""
    os.abort()


def leaves(paths: Sequence[Path]) -> Arrays:
    """End the process as a library does that calls exit()."""
    os._exit(1)


def spins(paths: Sequence[Path]) -> Arrays:
    """Never return."""
    while True:
        pass


def fills(paths: Sequence[Path]) -> Arrays:
    """Take more memory than a small file can need."""
    return {"much": np.ones(200_000_000)}


def fails(paths: Sequence[Path]) -> Arrays:
    """Call the package wrongly: a mistake in code, not in a file."""
    return {"none": rotate(None, np.ones(3))}  # type: ignore[arg-type]


def doubles(paths: Sequence[Path]) -> Arrays:
    """Return twice the bytes of the file."""
    return {"bytes": 2.0 * np.frombuffer(paths[0].read_bytes(), np.uint8)}
