"""Number of worker processes."""

from __future__ import annotations

import os


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
