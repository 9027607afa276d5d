"""Calls of C libraries that a damaged file can end: made in a process of their own, with limits on time and memory.

CSPICE trusts the pointers and texts of its kernels. A function is named by its module; it takes a path and returns
arrays by name, which come back as an ``.npz`` archive.
"""

from __future__ import annotations

import importlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.errors import OpNavError
from giantlike.core.reading import is_of_content, library_message

Arrays = Mapping[str, NDArray[Any]]
_BASE_CPU_S, _CPU_S_PER_MB = 5, 1
"""Limit of CPU time: s, and s more for each MB of the files; Python and CSPICE start in 1 s."""
_BASE_BYTES, _BYTES_PER_BYTE = 500_000_000, 20
"""Limit of memory: bytes, and bytes more for each byte of the files; a DSK takes 6 bytes for each of its own."""
_REFUSED = "refused"  # name of the array that holds the text of an error
_TRACEBACK = b"Traceback (most recent call last)"
_PROGRAM = "from giantlike.core.child import main; main()"


def in_child(function: Callable[[Sequence[Path]], Arrays], paths: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Call a function of files in a process of its own.

    Parameters
    ----------
    function : callable
        Function of a module; takes the paths and returns arrays by name.
    paths : sequence of Path

    Returns
    -------
    dict of str to array

    Raises
    ------
    ValueError
        The function refused the files, or its process ended, took too long or too much memory.
    RuntimeError
        The function has a mistake; its traceback.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _PROGRAM, function.__module__, function.__name__, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    if done.returncode != 0 and _TRACEBACK in done.stderr:  # a library that breaks down may exit with any code
        raise RuntimeError(done.stderr.decode(errors="replace"))
    if done.returncode != 0:
        raise ValueError("the library that reads it broke down; the file is damaged")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as archive:
        arrays = dict(archive)
    if _REFUSED in arrays:
        raise ValueError(str(arrays[_REFUSED]))
    return arrays


def main() -> None:
    """Call the function of the command line and write its arrays to standard output."""
    module, name, *files = sys.argv[1:]
    paths = [Path(file) for file in files]
    output = os.dup(1)
    os.dup2(2, 1)  # what libraries print must not come between the arrays
    function = getattr(importlib.import_module(module), name)
    _limit(sum(path.stat().st_size for path in paths if path.exists()))
    try:
        arrays = dict(function(paths))
    except Exception as error:
        if not is_of_content(error):
            raise
        own = isinstance(error, OpNavError) or type(error) is ValueError
        arrays = {_REFUSED: np.array(library_message(error) + ("" if own else "; the file is damaged"))}
    with os.fdopen(output, "wb") as stream:
        np.savez(stream, **arrays)


def _limit(size: int) -> None:
    """Bound CPU time and memory of this process, where the system can."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    wanted = {
        resource.RLIMIT_CPU: _BASE_CPU_S + _CPU_S_PER_MB * size // 1_000_000,
        resource.RLIMIT_DATA: _BASE_BYTES + _BYTES_PER_BYTE * size,
    }
    for kind, most in wanted.items():
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)  # a limit of the system cannot be raised
        resource.setrlimit(kind, (most, most))
