"""Hostile files in large numbers: every kind of file that is read, damaged, counted by outcome; prints JSON.

``python benchmarks/fuzz.py --files 1000 --seed 1`` reads 1000 damaged files of each kind, in rounds over all kinds so
that an interrupted run has tried all; ``--kinds`` chooses, ``--hours`` ends it. The exit code is 1 where a file ended
the process, hung it, took over 500 MB or raised an exception that is none of the package's.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.hostile import attack
from tests.hostile_seeds import KINDS

_ROUND = 200  # files of each kind before the first kind comes again


def main() -> int:
    """Attack all kinds in rounds and print the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=1000, help="files of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument("--hours", type=float, default=1e9, help="no round starts later")
    arguments = parser.parse_args()
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in arguments.kinds}
    problems: list[str] = []
    start = time.monotonic()
    for first in range(0, arguments.files, _ROUND):
        if time.monotonic() - start > 3600 * arguments.hours:
            break
        tally = attack(arguments.kinds, min(_ROUND, arguments.files - first), seed=arguments.seed, first=first)
        for kind, count in tally.by_kind.items():
            counts[kind] += count
        problems += tally.problems
        for text in (*tally.problems, f"{time.monotonic() - start:.0f} s: {tally.files} files from {first}"):
            print(text, file=sys.stderr, flush=True)
    total = sum(counts.values(), Counter())
    result = {"files": total.total(), "outcomes": total, "kinds": counts, "problems": problems}
    print(json.dumps(result | {"time_s": round(time.monotonic() - start)}, indent=1))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
