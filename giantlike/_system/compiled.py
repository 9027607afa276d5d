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
    """Compile a function of numbers and arrays, once for all processes where the cache is writable.

    Division by zero gives infinity, as in numpy. It is recompiled when its own module changes, not when a module whose
    functions it calls does: ``make clean`` deletes the cache.
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
