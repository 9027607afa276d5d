"""Replays of flight systems at full size: how many comparisons agree by kind, the ones that do not, and CPU time.

Usage: python benchmarks/replays.py OUTPUT [NAME ...]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from giantlike.missions import REPLAYS, ReplaySettings, run_replay, save_replay


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
        report[name] = {
            "counts": summary["counts"],
            "cpu_s": round(time.process_time() - start, 1),
            "disagree": [
                {key: each[key] for key in ("reference", "what", "paper", "ours", "kind")}
                for each in summary["comparisons"]
                if each["agrees"] is False
            ],
        }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
