"""Hostile files: damaged in many ways, read in a process of its own whose end, hang or memory is noticed.

``python -m tests.hostile JOBS COUNT SEED`` imports the readers once and forks a worker, which reads file after file and
writes one JSON line before and after each; where it ends or hangs, the next fork goes on at the next file.
:func:`attack` runs it and counts.
"""

from __future__ import annotations

import json
import os
import re
import resource
import selectors
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from tests.hostile_damage import mutated

MOST_BYTES = 500_000_000  # of memory that reading a small file may take
HANGS_AFTER_S = 60.0  # of CPU time for one file: a busy machine makes nothing hang
_SILENT_AFTER_S = 10 * HANGS_AFTER_S  # of the clock: a worker that waits for what never comes takes no CPU time
_HARD_LIMIT_BYTES = 8_000_000_000  # of a worker: the machine stays usable whatever a reader takes
_Outcome = tuple[str, int, str, str]  # kind, number, outcome, text


@dataclass
class Tally:
    """Outcomes of hostile files: numbers by kind and outcome, and the problems with the kind and number of the file."""

    by_kind: dict[str, Counter[str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def outcomes(self) -> Counter[str]:
        """Numbers by outcome, of all kinds."""
        return sum(self.by_kind.values(), Counter())

    @property
    def files(self) -> int:
        """Number of files that were tried."""
        return self.outcomes.total()

    def add(self, kind: str, number: int, outcome: str, text: str) -> None:
        """Count a file."""
        self.by_kind.setdefault(kind, Counter())[outcome] += 1
        if outcome not in ("read", "refused"):
            self.problems.append(f"{kind} {number}: {outcome} {text}".rstrip())


def damaged(kind: str, content: bytes, number: int, seed: int) -> bytes:
    """File number ``number`` of a kind, made from a valid one; number 0 is that itself."""
    return mutated(content, np.random.default_rng([seed, number, *kind.encode()])) if number else content


def attack(kinds: Sequence[str], count: int, *, seed: int, first: int = 0) -> Tally:
    """Read ``count`` hostile files of each kind.

    Parameters
    ----------
    kinds : sequence of str
        Keys of :data:`tests.hostile_seeds.KINDS`.
    count, seed : int
    first : int
        Number of the first file of each kind.

    Returns
    -------
    Tally
        Outcomes are ``read``, ``refused``, ``foreign`` (another exception than those of this package, or a text of
        several lines), ``ended`` (the process), ``hung`` and ``memory``.
    """
    tally = Tally()
    jobs = json.dumps([[kind, first, first + count] for kind in kinds])
    command = [sys.executable, "-m", "tests.hostile", jobs, str(seed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        for line in process.stdout:
            tally.add(*json.loads(line))
        assert process.stderr is not None
        told = process.stderr.read()
    if process.returncode:
        raise RuntimeError(f"the process that reads hostile files broke down: {told.decode(errors='replace')}")
    return tally


def main(jobs: str, seed: str) -> None:
    """Read the files of all jobs in forks of this process; outcomes go to standard output."""
    from tests.hostile_seeds import KINDS

    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as name:
        for kind, first, end in json.loads(jobs):
            folder = Path(name) / kind.replace(" ", "_")
            folder.mkdir()
            KINDS[kind].write(folder / KINDS[kind].file)
            content = (folder / KINDS[kind].file).read_bytes()
            number = first
            while number < end:
                for outcome in _outcomes_of_fork(kind, content, range(number, end), folder, int(seed)):
                    print(json.dumps(outcome), flush=True)
                    number = outcome[1] + 1


def _outcomes_of_fork(kind: str, content: bytes, numbers: range, folder: Path, seed: int) -> Iterator[_Outcome]:
    """Outcomes of the files that one worker reads: all, or up to the one that ended it, hung it or filled it."""
    reading, writing = os.pipe()
    worker = os.fork()
    if worker == 0:
        os.close(reading)
        _work(kind, content, numbers, folder, seed, writing)
    os.close(writing)
    started, hung = None, False
    with os.fdopen(reading, "rb", buffering=0) as pipe:
        for line in _lines(pipe):
            if line is None:
                os.kill(worker, signal.SIGKILL)
                hung = True
                continue
            number, outcome, text = json.loads(line)
            started = number if outcome == "started" else None
            if outcome != "started":
                yield kind, number, outcome, text
    _, status = os.waitpid(worker, 0)
    if started is not None:
        yield kind, started, "hung" if hung else "ended", "" if hung else f"with status {status}"
    elif status:
        raise RuntimeError(f"the worker ended between files of kind {kind}: status {status}")


def _lines(pipe: IO[bytes]) -> Iterator[bytes | None]:
    """Lines from a worker; None where it was silent for too long."""
    buffer = b""
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        while True:
            if not selector.select(_SILENT_AFTER_S):
                yield None
            chunk = pipe.read(65536)
            if not chunk:
                return
            *lines, buffer = (buffer + chunk).split(b"\n")
            yield from lines


def _work(kind: str, content: bytes, numbers: range, folder: Path, seed: int, output: int) -> None:
    """Read files, tell of each, end this process."""
    code = 1
    try:
        resource.setrlimit(resource.RLIMIT_AS, (_HARD_LIMIT_BYTES, _HARD_LIMIT_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        path = folder / _file_of(kind)
        for number in numbers:
            path.write_bytes(damaged(kind, content, number, seed))
            os.write(output, (json.dumps([number, "started", ""]) + "\n").encode())
            os.write(output, (json.dumps([number, *_try(kind, path)]) + "\n").encode())
        code = 0
    finally:
        _end_children()
        os._exit(code)


def _file_of(kind: str) -> str:
    from tests.hostile_seeds import KINDS

    return KINDS[kind].file


def _end_children() -> None:
    """End the process that reads kernels, which nothing else does where Python's own end is left out."""
    from giantlike._system.child import end_template

    end_template()


def _peak_bytes() -> int:
    """Largest memory of this process since the last call that reset it, bytes; of all time where that is not told."""
    try:
        status = Path("/proc/self/status").read_text()
        Path("/proc/self/clear_refs").write_text("5")
        return 1024 * int(re.search(r"VmHWM:\s*(\d+)", status)[1])  # type: ignore[index]
    except OSError:
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _try(kind: str, path: Path) -> tuple[str, str]:
    from giantlike.core.errors import OpNavError
    from tests.hostile_seeds import KINDS

    before, start = _peak_bytes(), time.process_time()
    try:
        KINDS[kind].read(path)
        outcome, text = "read", ""
    except OpNavError as error:
        several = "\n" in str(error)
        outcome, text = ("foreign", f"several lines: {str(error)[:200]!r}") if several else ("refused", "")
    except Exception as error:  # noqa: BLE001  every other exception is what is looked for
        outcome, text = "foreign", _described(error)
    taken, busy = _peak_bytes() - before, time.process_time() - start
    if busy > HANGS_AFTER_S:
        return "hung", f"{busy:.0f} s"
    return ("memory", f"{taken / 1e6:.0f} MB") if taken > MOST_BYTES else (outcome, text)


def _described(error: Exception) -> str:
    """Class, place in the package and begin of the text of an exception."""
    frames: list[Any] = list(traceback.extract_tb(error.__traceback__))
    ours = [frame for frame in frames if "giantlike" in frame.filename]
    place = (
        f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else f"{frames[-1].filename}:{frames[-1].lineno}"
    )
    return f"{type(error).__name__} at {place}: {str(error)[:100]!r}"


if __name__ == "__main__":
    main(*sys.argv[1:])
