"""A pool of worker processes in which the death of a process costs one image and no more."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait as wait_for_end
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, Self, TypeVar

import cv2

from giantlike._system.processes import keep_memory, one_thread, one_thread_each, worker_context
from giantlike._system.threads import threads
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run import WORKER_MODULES
from giantlike.campaign.run.worker_context import Workbench
from giantlike.core.arrays import require
from giantlike.core.errors import InputError

Job = TypeVar("Job")
Job_co = TypeVar("Job_co", covariant=True)
Answer = TypeVar("Answer")

_QUEUED_PER_WORKER = 2  # jobs handed out per worker: one at work and one waiting, so that few are lost with it


class Jobs(Protocol[Job_co]):
    """Jobs by their position: a sequence, or an object that makes each on request."""

    def __len__(self) -> int: ...

    def __getitem__(self, position: int, /) -> Job_co: ...


class Pool(Protocol):
    """Executor of the work of a run; used in a ``with`` block."""

    def __enter__(self) -> Self:
        """Start the workers."""
        ...

    def __exit__(self, *_: object) -> None:
        """End it."""
        ...

    def run(self, function: Callable[[Workbench, Job], Answer], jobs: Jobs[Job]) -> Iterator[tuple[int, Answer | None]]:
        """Yield the position and answer of each job, None if the process died of it, in the order of completion."""
        ...


class WorkerPool:
    """Runs jobs on images in this process (one worker) or in several; use it in a ``with`` block.

    When a process dies, ``concurrent.futures`` breaks the whole pool. The jobs in flight are then rerun one by one in a
    separate process; one that kills this as well is given up. Results do not depend on the number of processes, and
    workers end when the process that started them is gone.
    """

    def __init__(self, bench: Workbench, workers: int, *, cores: int | None = None) -> None:
        require(workers >= 1, f"workers must be >= 1, got {workers}")
        self._cores = max(workers, cores or workers)
        self._bench = bench
        self._workers = workers
        self._executors: dict[int, ProcessPoolExecutor] = {}
        self._others: set[BaseProcess] = set()
        self._settings = contextlib.ExitStack()

    def __enter__(self) -> Self:
        self._others = set(multiprocessing.active_children())
        if self._workers == 1:
            self._settings.enter_context(one_thread())
            self._settings.callback(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(1)
        else:
            self._settings.enter_context(one_thread_each())
        return self

    def __exit__(self, *raised: object) -> None:
        if any(isinstance(one, KeyboardInterrupt) for one in raised):
            for child in set(multiprocessing.active_children()) - self._others:
                child.terminate()  # what they work on is lost anyway
        for size in list(self._executors):
            self._executors.pop(size).shutdown(wait=True, cancel_futures=True)
        self._settings.close()

    def run(self, function: Callable[[Workbench, Job], Answer], jobs: Jobs[Job]) -> Iterator[tuple[int, Answer | None]]:
        """Yield the position and answer of each job, None if the process died of it; other processes begin at once."""
        each = self._cores // max(1, min(self._workers, len(jobs)))
        if self._workers == 1:
            return ((place, _in_threads(each, function, self._bench, jobs[place])) for place in range(len(jobs)))
        waiting = deque(range(len(jobs)))
        running: dict[Future[Answer], int] = {}

        def hand_out() -> None:
            while waiting and len(running) < _QUEUED_PER_WORKER * self._workers:
                job = jobs[waiting[0]]
                with _signals_held():
                    future = self._executor(self._workers).submit(_call, each, function, job)
                running[future] = waiting.popleft()

        def answers() -> Iterator[tuple[int, Answer | None]]:
            while waiting or running:
                try:
                    hand_out()
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in done:
                        answer = future.result()
                        yield running.pop(future), answer
                except BrokenProcessPool:
                    self._drop(self._workers)
                    suspects = sorted(running.values())
                    running.clear()
                    for position in suspects:
                        yield position, self._alone(function, jobs[position])

        with contextlib.suppress(BrokenProcessPool):  # raised again with the first result
            hand_out()
        return answers()

    def _alone(self, function: Callable[[Workbench, Job], Answer], job: Job) -> Answer | None:
        try:
            return self._executor(1).submit(_call, 1, function, job).result()
        except BrokenProcessPool:
            self._drop(1)
            self._check_start()
            return None

    def _check_start(self) -> None:
        """Raise unless an idle process can start: then it was the job that killed the last one."""
        try:
            self._executor(1).submit(_ready).result()
        except BrokenProcessPool as error:
            raise InputError(
                "worker processes cannot be started; use one worker, or see above what ended them (a script that "
                "runs a campaign must do so under if __name__ == '__main__')"
            ) from error

    def _executor(self, size: int) -> ProcessPoolExecutor:
        if size not in self._executors:
            self._executors[size] = ProcessPoolExecutor(
                size, worker_context(*WORKER_MODULES), _start_worker, (self._bench.campaign,)
            )
        return self._executors[size]

    def _drop(self, size: int) -> None:
        self._executors.pop(size).shutdown(wait=True)


@contextlib.contextmanager
def _signals_held() -> Iterator[None]:
    """Context manager in which signals that end this process wait, so that no process is left half started."""
    _hold_signals(True)
    try:
        yield
    finally:
        _hold_signals(False)


def _hold_signals(hold: bool) -> None:
    if sys.platform != "win32":
        how = signal.SIG_BLOCK if hold else signal.SIG_UNBLOCK
        signal.pthread_sigmask(how, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))


_bench_of_this_process: list[Workbench] = []


def _start_worker(campaign: Campaign) -> None:
    _hold_signals(False)  # a process inherits what is held while it starts
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches all processes: the others end without a traceback
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    keep_memory()
    _bench_of_this_process.append(Workbench.load(campaign, trusted=True))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for_end([parent.sentinel])
        os._exit(1)


def _ready() -> bool:
    return bool(_bench_of_this_process)


def _call(count: int, function: Callable[[Workbench, Any], Answer], job: Any) -> Answer:
    return _in_threads(count, function, _bench_of_this_process[0], job)


def _in_threads(count: int, function: Callable[[Workbench, Job], Answer], bench: Workbench, job: Job) -> Answer:
    with threads(count):
        return function(bench, job)
