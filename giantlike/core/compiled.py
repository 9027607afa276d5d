"""Functions that are compiled to machine code when they are called first: loops that numpy cannot take together."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., object])

_turn = threading.RLock()
_held: set[str] = set()


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays.

    The code is kept for later processes, beside the module or in the cache of the user; where neither can be written,
    each process compiles it anew. Where it can, of processes that need it at once (those of a first run) one compiles
    and the others wait for its code, except on Windows. Divisions by zero give infinities, as in numpy. It is compiled
    again when its own module changes, not when one does whose functions it calls: ``make clean`` deletes what is kept.
    """
    options = {"error_model": "numpy", "nogil": True}
    try:
        loop: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache
        result: Function = numba.njit(**options)(function)
        return result
    compile_or_load, source = loop.compile, function.__code__.co_filename

    def compile_once(signature: object) -> object:
        with _alone_with(source):
            return compile_or_load(signature)

    loop.compile = compile_once
    kept: Function = loop
    return kept


@contextlib.contextmanager
def _alone_with(source: str) -> Iterator[None]:
    """Context manager in which no other process compiles functions of a file: the file itself is locked."""
    with _turn, contextlib.ExitStack() as until:
        if source not in _held and sys.platform != "win32":
            import fcntl  # not on all systems

            with contextlib.suppress(OSError):  # modules in archives, file systems without locks
                file = until.enter_context(Path(source).open("rb"))
                fcntl.flock(file, fcntl.LOCK_EX)
                until.callback(fcntl.flock, file, fcntl.LOCK_UN)  # children may hold the file open
            _held.add(source)
            until.callback(_held.discard, source)
        yield
