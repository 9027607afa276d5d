"""Threads in which independent parts of the work on one image are done at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

from giantlike._system.processes import one_thread
from giantlike.core.arrays import require

Result = TypeVar("Result")

ALLOWED: ContextVar[int] = ContextVar("threads", default=1)
"""Number of threads available in this context. A new thread begins with 1, so that it starts no others."""


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Context manager in which independent estimators of one image run at once, each in a thread.

    ``auto`` then runs the chosen estimator and the one that checks it in parallel. All results are bit for bit the same
    as with one thread. It applies to the thread that enters it.

    Parameters
    ----------
    count : int; threads at most; 1 is the default everywhere

    Yields
    ------
    None

    Raises
    ------
    InputError
        The number is below 1.

    Examples
    --------
    >>> import giantlike as gl
    >>> with gl.threads(2):  # doctest: +SKIP
    ...     fix = gl.Auto().estimate(image, camera, scene)
    """
    require(count >= 1, f"threads must be >= 1, got {count}")
    token = ALLOWED.set(count)
    try:
        yield
    finally:
        ALLOWED.reset(token)


@contextlib.contextmanager
def at_once(jobs: Mapping[str, Callable[[], Result]]) -> Iterator[Callable[[str], Result]]:
    """Context manager of independent jobs: started at once where there are several threads, else when requested."""
    count = min(ALLOWED.get(), len(jobs))
    if count < 2:
        yield lambda name: jobs[name]()
        return
    with one_thread(), ThreadPoolExecutor(count) as pool:  # held here, as jobs that end would give it back too early
        begun = {name: pool.submit(job) for name, job in jobs.items()}
        yield lambda name: begun[name].result()
