"""Number of worker processes, and how they start."""

from __future__ import annotations

import multiprocessing
import os
import sys
from multiprocessing.context import BaseContext


def process_count(workers: int | None, jobs: int) -> int:
    """Return how many processes to start.

    Parameters
    ----------
    workers : int or None
        As asked for; None for one per CPU that this process may use.
    jobs : int
        No more processes than these.

    Returns
    -------
    int
        At least 1.
    """
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(workers, jobs))


def worker_context(*modules: str) -> BaseContext:
    """Way in which worker processes start.

    On Linux they are forked from a server that has imported the modules once, in milliseconds; elsewhere, where system
    libraries do not bear that, each imports them anew, which takes more than a second.

    Parameters
    ----------
    *modules : str
        What workers need; they must not start threads when they are imported.

    Returns
    -------
    BaseContext
        Of ``multiprocessing``.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(modules))
    return context
