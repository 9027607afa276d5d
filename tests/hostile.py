"""Hostile files: damaged in many ways, read in a process of its own whose end, hang or memory is noticed.

``python -m tests.hostile KIND FIRST COUNT SEED`` reads files and writes one JSON line before and after each;
:func:`attack` runs it and counts.
"""

from __future__ import annotations

import json
import os
import re
import resource
import selectors
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

MOST_BYTES = 500_000_000  # of memory that reading a small file may take
HANGS_AFTER_S = 60.0
_NUMBERS = (
    "1e999",
    "-1",
    "0",
    "nan",
    "99999999999999999999",
    "1" * 5000,
    "inf",
    "-0.0",
    "1e-320",
    "0x7f",
    "2147483648",
)
_NESTS = ("[" * 3000, "{" * 3000, "(" * 3000, "a." * 3000, "<a>" * 3000, "'" * 101, "- " * 3000)
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eEdD][+-]?\d+)?")


@dataclass
class Tally:
    """Outcomes of hostile files: numbers by outcome, and the problems with the kind and number of the file."""

    outcomes: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    @property
    def files(self) -> int:
        """Number of files that were tried."""
        return self.outcomes.total()


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """Content damaged in one to three ways."""
    for _ in range(int(random.integers(1, 4))):
        content = _damages[int(random.integers(len(_damages)))](bytearray(content), random)
    return content


def _flipped(content: bytearray, random: np.random.Generator) -> bytes:
    for place in random.integers(max(len(content), 1), size=int(random.integers(1, 9)) if content else 0):
        content[place] ^= 1 << int(random.integers(8))
    return bytes(content)


def _overwritten(content: bytearray, random: np.random.Generator) -> bytes:
    start = int(random.integers(max(len(content), 1)))
    value = (b"\x00", b"\xff", b"\x7f", b"\x80", random.bytes(1))[int(random.integers(5))]
    length = int(random.integers(1, 9))
    content[start : start + length] = value * min(length, len(content) - start)
    return bytes(content)


def _cut(content: bytearray, random: np.random.Generator) -> bytes:
    return bytes(content[: int(random.integers(len(content) + 1))])


def _removed(content: bytearray, random: np.random.Generator) -> bytes:
    start = int(random.integers(max(len(content), 1)))
    del content[start : start + int(random.integers(1, 200))]
    return bytes(content)


def _repeated(content: bytearray, random: np.random.Generator) -> bytes:
    start, length = int(random.integers(max(len(content), 1))), int(random.integers(1, 200))
    content[start:start] = content[start : start + length] * int(random.integers(1, 50))
    return bytes(content)


def _other_number(content: bytearray, random: np.random.Generator) -> bytes:
    found = list(_NUMBER.finditer(content))
    if not found:
        return _flipped(content, random)
    match = found[int(random.integers(len(found)))]
    content[match.start() : match.end()] = _NUMBERS[int(random.integers(len(_NUMBERS)))].encode()
    return bytes(content)


def _nested(content: bytearray, random: np.random.Generator) -> bytes:
    place = int(random.integers(len(content) + 1))
    content[place:place] = _NESTS[int(random.integers(len(_NESTS)))].encode()
    return bytes(content)


def _swapped(content: bytearray, random: np.random.Generator) -> bytes:
    lines = bytes(content).split(b"\n")
    first, second = random.integers(len(lines), size=2)
    lines[first], lines[second] = lines[second], lines[first]
    return b"\n".join(lines)


_damages = (_flipped, _overwritten, _cut, _removed, _repeated, _other_number, _nested, _swapped)


def _random(kind: str, number: int, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, number, *kind.encode()])


def attack(kinds: Sequence[str], count: int, *, seed: int) -> Tally:
    """Read ``count`` hostile files of each kind.

    Parameters
    ----------
    kinds : sequence of str
        Keys of :data:`tests.hostile_seeds.KINDS`.
    count : int
    seed : int

    Returns
    -------
    Tally
        Outcomes are ``read``, ``refused``, ``foreign`` (another exception than those of this package, or a text of
        several lines), ``ended`` (the process), ``hung`` and ``memory``.
    """
    tally, jobs = Tally(), [(kind, 0) for kind in kinds]
    while jobs:
        done = list(_outcomes(jobs, count, seed))
        for kind, number, outcome, text in done:
            tally.outcomes[outcome] += 1
            if outcome not in ("read", "refused"):
                tally.problems.append(f"{kind} {number}: {outcome} {text}".rstrip())
        last_kind, last_number = (done[-1][0], done[-1][1]) if done else (jobs[0][0], count)
        place = [kind for kind, _ in jobs].index(last_kind)
        jobs = jobs[place:] if last_number + 1 < count else jobs[place + 1 :]
        if jobs and jobs[0][0] == last_kind:
            jobs[0] = (last_kind, last_number + 1)
    return tally


def _outcomes(jobs: list[tuple[str, int]], count: int, seed: int) -> Iterator[tuple[str, int, str, str]]:
    """Outcomes of the files of one process: up to the one that ended, hung or filled it."""
    command = [sys.executable, "-m", "tests.hostile", json.dumps(jobs), str(count), str(seed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        current = yield from _told(process, jobs[0])
        code = process.wait()
    if current is not None:
        yield (*current, "ended", f"with code {code}")
    elif code > 0:
        raise RuntimeError(f"the process that reads hostile files did not start: code {code}")


def _told(
    process: subprocess.Popen[bytes], first: tuple[str, int]
) -> Generator[tuple[str, int, str, str], None, tuple[str, int] | None]:
    """Outcomes that a process tells; returns the file that it was at when it ended."""
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    current: tuple[str, int] | None = None
    buffer = b""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while True:
            if not selector.select(HANGS_AFTER_S if current else 6 * HANGS_AFTER_S):
                process.kill()
                yield (*(current or first), "hung", "")
                return None
            chunk = process.stdout.read()
            if not chunk:
                return current
            *lines, buffer = (buffer + chunk).split(b"\n")
            for line in lines:
                kind, number, outcome, text = json.loads(line)
                current = (kind, number) if outcome == "started" else None
                if outcome != "started":
                    yield kind, number, outcome, text


def _tell(kind: str, number: int, outcome: str, text: str = "") -> None:
    os.write(3, (json.dumps([kind, number, outcome, text]) + "\n").encode())


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

    before = _peak_bytes()
    try:
        KINDS[kind].read(path)
        outcome, text = "read", ""
    except OpNavError as error:
        several = "\n" in str(error)
        outcome, text = ("foreign", f"several lines: {str(error)[:200]!r}") if several else ("refused", "")
    except Exception as error:  # noqa: BLE001  every other exception is what is looked for
        last = traceback.extract_tb(error.__traceback__)[-1]
        ours = [frame for frame in traceback.extract_tb(error.__traceback__) if "giantlike" in frame.filename]
        place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else f"{last.filename}:{last.lineno}"
        outcome, text = "foreign", f"{type(error).__name__} at {place}: {str(error)[:100]}"
    taken = _peak_bytes() - before
    return ("memory", f"{taken / 1e6:.0f} MB") if taken > MOST_BYTES else (outcome, text)


def main(jobs: str, count: str, seed: str) -> None:
    """Read the files of all jobs; outcomes go to standard output, which nothing else can write to."""
    os.dup2(1, 3)
    os.dup2(2, 1)
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as name:
        from tests.hostile_seeds import KINDS

        for kind, first in json.loads(jobs):
            folder = Path(name) / kind.replace(" ", "_")
            folder.mkdir()
            path = folder / KINDS[kind].file
            KINDS[kind].write(path)
            content = path.read_bytes()
            for number in range(first, int(count)):
                path.write_bytes(content if number == 0 else mutated(content, _random(kind, number, int(seed))))
                _tell(kind, number, "started")
                _tell(kind, number, *_try(kind, path))


if __name__ == "__main__":
    main(*sys.argv[1:])
