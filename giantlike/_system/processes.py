"""Number of worker processes, their start method, and their use of memory."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import sys
from collections.abc import Iterator
from functools import cache
from multiprocessing.context import BaseContext

from threadpoolctl import ThreadpoolController

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_OWN_PAGES_BYTES = 32 * 2**20  # arrays from this size get separate pages, freed at once; the largest limit of glibc
_KEPT_BYTES = 64 * 2**20  # free memory, bytes, above which a process returns it to the system; 256 MB are no faster
_COLLECTED_AFTER = 10_000
"""Threshold of the garbage collector, in objects allocated and not freed: 80 collections in a campaign of 255 images.
Python's default of 700 gives 2,000, which take 1 to 2 % of the CPU. Images leave few objects in cycles."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # numbers of these settings in ``mallopt`` of glibc (malloc.h)


def process_count(workers: int | None, jobs: int) -> int:
    """Return how many processes to start. Returns at least 1."""
    return max(1, min(available_cpus() if workers is None else workers, jobs))


def available_cpus() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def one_thread_each() -> Iterator[None]:
    """Context manager in which processes start that do arithmetic with one thread, unless variables are set already."""
    missing = {name: "1" for name in _THREAD_VARIABLES if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Context manager and decorator: linear algebra of the libraries that are loaded is done with one thread.

    On busy cores several threads took up to eleven times the CPU of an estimate, and the last bits of sums differed.
    """
    with _linear_algebra().limit(limits=1):
        yield


@cache
def _linear_algebra() -> ThreadpoolController:
    return ThreadpoolController()


def start_server(*modules: str) -> None:
    """Start the server of :func:`worker_context`, if any: it imports modules while this process does other things."""
    if sys.platform == "linux":
        from multiprocessing import forkserver  # not on all systems

        with one_thread_each():
            worker_context(*modules)
            forkserver.ensure_running()


def worker_context(*modules: str) -> BaseContext:
    """Context in which workers start: forked from a server with the modules imported (on Linux), or anew."""
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(modules))
    return context


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Context manager for imports without garbage collection, which is rarer afterwards and skips imported objects."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(_COLLECTED_AFTER, *gc.get_threshold()[1:])
        if enabled:
            gc.enable()


def keep_memory() -> None:
    """Keep the memory of freed arrays in this process for the next image; only glibc can do that."""
    if sys.platform == "linux":
        import ctypes  # not needed by other commands

        set_option = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
        if set_option is not None:
            set_option(_MMAP_THRESHOLD, _OWN_PAGES_BYTES)
            set_option(_TRIM_THRESHOLD, _KEPT_BYTES)
