"""A progress bar for people: on stderr, and only when that is a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

Item = TypeVar("Item")


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar inside a ``with`` block.

    Yields
    ------
    callable
        Takes the name of the step, the number of images done, and of all.
    """
    if not sys.stderr.isatty():
        yield _nothing
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
    """Yield items one by one, and show how many are done.

    Parameters
    ----------
    stage : str
        Name of the step.
    items : sequence

    Yields
    ------
    item
    """
    with progress_bar() as progress:
        for number, item in enumerate(items):
            progress(stage, number, len(items))
            yield item
        progress(stage, len(items), len(items))


def _nothing(stage: str, done: int, total: int) -> None:
    """Show nothing."""
