"""Progress on stderr: a bar on a terminal, elsewhere, in notebooks too, a line per so many images."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from giantlike.cli.outcome import say

Item = TypeVar("Item")


_MOST_LINES, _FEWEST_IMAGES = 20, 10  # lines per step in a log file, and least images per line


@contextlib.contextmanager
def progress_bar(*, lines: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar inside a ``with`` block."""
    if not sys.stderr.isatty() or _in_a_notebook():
        yield _ProgressLines() if lines else _nothing
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:>15}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, TaskID] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield update


def with_progress(stage: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield items one by one, and show how many are done."""
    with progress_bar() as progress:
        for number, item in enumerate(items):
            progress(stage, number, len(items))
            yield item
        progress(stage, len(items), len(items))


def _in_a_notebook() -> bool:
    """Return True for a command of a notebook (``!giantlike``), which shows control characters as they are."""
    return "JPY_PARENT_PID" in os.environ or "inline" in os.environ.get("MPLBACKEND", "")


class _ProgressLines:
    """A line per N images: 10, 20, 50, 100, ..., so that a step has at most about 20."""

    def __init__(self) -> None:
        self._start: dict[str, tuple[float, int]] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Write a line if it is time for one."""
        begun, before = self._start.setdefault(stage, (time.monotonic(), done))
        if done % images_per_line(total) or done == before:
            return
        spent_s = time.monotonic() - begun
        left_s = spent_s / (done - before) * (total - done)
        say(f"giantlike: {stage}: {done} of {total} images, {spent_s:.0f} s, about {left_s:.0f} s left")


def images_per_line(total: int) -> int:
    """Number of images from one line to the next.

    >>> [images_per_line(total) for total in (9, 300, 1000, 30_000)]
    [10, 20, 50, 2000]
    """
    steps = (factor * int(10**power) for power in itertools.count(1) for factor in (1, 2, 5))
    return next(step for step in steps if step >= _FEWEST_IMAGES and step * _MOST_LINES >= total)


def _nothing(stage: str, done: int, total: int) -> None:
    """Show nothing."""
