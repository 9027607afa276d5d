"""Replays of flight systems at full size: how many comparisons agree by kind, and CPU time.

Usage: python benchmarks/replays.py OUTPUT [NAME ...]

All comparisons of a replay are written to ``benchmarks/results/replay_NAME.csv``.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from pathlib import Path

from giantlike.missions import REPLAYS, ReplaySettings, run_replay, save_replay

RESULTS = Path(__file__).parent / "results"
COLUMNS = ("reference", "what", "paper", "ours", "kind", "agrees", "fails_with", "reason")
WORDS = {True: "yes", False: "no", None: "not compared"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    report = {}
    for name in given.names or REPLAYS:
        start = time.process_time()
        settings = ReplaySettings(output=given.output / name, seed=given.seed)
        summary = save_replay(run_replay(name, settings), settings)
        report[name] = {"counts": summary["counts"], "cpu_s": round(time.process_time() - start, 1)}
        with (RESULTS / f"replay_{name}.csv").open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n")
            table.writeheader()
            table.writerows({**each, "agrees": WORDS[each["agrees"]]} for each in summary["comparisons"])
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
