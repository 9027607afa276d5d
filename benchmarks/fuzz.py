"""Hostile files in large numbers: every kind of file that is read, damaged, counted by outcome; prints JSON.

``python benchmarks/fuzz.py --files 1000 --seed 1`` reads 1000 damaged files of each kind in processes that may end.
Kernels and DSKs take half a second each, because the package reads them in a process of their own: ``--kinds``
chooses. The exit code is 1 where a file ended the process, hung it, took over 500 MB or raised an exception that is
none of the package's.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.hostile import attack
from tests.hostile_seeds import KINDS


def main() -> int:
    """Attack the kinds one by one and print the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=1000, help="files of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    arguments = parser.parse_args()
    result, problems = {}, []
    for kind in arguments.kinds:
        start = time.perf_counter()
        tally = attack([kind], arguments.files, seed=arguments.seed)
        result[kind] = dict(tally.outcomes) | {"time_s": round(time.perf_counter() - start, 1)}
        problems += tally.problems
        print(f"{kind}: {result[kind]}", file=sys.stderr)
    print(json.dumps({"kinds": result, "problems": problems}, indent=1))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
