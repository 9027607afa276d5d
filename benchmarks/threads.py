"""Wall time of ``auto`` on one image by one and by several threads, beside its error.

Rocks of 196,608 facets, as in ``speed_bodies.py``, from 120 to 1,600 px; the same images by one and by several threads
in turn. Rounds in which other processes took more than 6 % of a core are left out (Linux, by ``/proc/stat``), the least
wall time of the others counts: on a machine that is never free there is no figure. Fixes must be the same, bit for bit.

Usage: python benchmarks/threads.py [--threads 2] [--seconds 300] [--images FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from speed import IMAGES
from speed_bodies import GROWING_PX, ROCK, fresh, judge
from stress_truth import Draw

import giantlike as gl

SIZES_PX = (120.0, *(size for size in GROWING_PX if size > 120.0))
NUMBERS = (0, 3, 6, 9)
"""Views of one mesh, at phase angles of 20, 120, 90 and 60 degrees."""
ROUNDS = 5
MOST_OF_OTHERS = 0.06
"""Share of a core that other processes may take in a round that counts."""


def estimated(draw: Draw, count: int) -> Any:
    """Fix of ``auto`` by some threads."""
    with gl.threads(count):
        return gl.Auto().estimate(draw.image, draw.seen.camera, draw.scene)


def quiet_wall_s(draw: Draw, count: int) -> float | None:
    """Wall time of a fix, s; None where others were at work meanwhile."""
    before_s, began = _others_s(), time.perf_counter()
    estimated(draw, count)
    wall_s = time.perf_counter() - began
    spent_s = _others_s() - before_s
    return wall_s if spent_s <= 1.0 / os.sysconf("SC_CLK_TCK") + MOST_OF_OTHERS * wall_s else None


def _others_s() -> float:
    """CPU time of all processes but this one since the system started, s."""
    with Path("/proc/stat").open() as stream:
        user, nice, system, _, _, *interrupts = map(int, stream.readline().split()[1:8])
    return (user + nice + system + sum(interrupts)) / os.sysconf("SC_CLK_TCK") - time.process_time()


def same(one: Any, other: Any) -> bool:
    """Return True if two fixes are the same, bit for bit."""
    arrays = ("center_px", "covariance_px2", "residuals")
    texts = ("flags", "provenance", "score", "n_used", "n_rejected")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in arrays) and all(
        getattr(one, name) == getattr(other, name) for name in texts
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=300.0, help="after which no more rounds are tried, by size")
    parser.add_argument("--images", type=Path, help="folder that keeps images of the truth from run to run")
    parser.add_argument("--sizes", type=float, nargs="*", default=SIZES_PX, help="diameters, px")
    chosen = parser.parse_args()
    if chosen.images is not None:
        chosen.images.mkdir(parents=True, exist_ok=True)
        os.environ[IMAGES] = str(chosen.images)
    cv2.setNumThreads(1)
    for size in chosen.sizes:
        make = fresh(replace(ROCK, diameter_px=size, frame_px=max(1024, int(1.25 * size))))
        draws = [make(number) for number in NUMBERS]
        walls: dict[tuple[int, int], list[float]] = {(k, n): [] for k in range(len(draws)) for n in (1, chosen.threads)}
        fixes = [[estimated(draw, count) for count in (1, chosen.threads)] for draw in draws]
        end = time.perf_counter() + chosen.seconds
        while time.perf_counter() < end and min(map(len, walls.values())) < ROUNDS:
            for (number, count), known in walls.items():
                wall_s = quiet_wall_s(draws[number], count)
                if wall_s is not None:
                    known.append(wall_s)
        row: dict[str, Any] = {
            "diameter_px": size,
            "same": all(same(*pair) for pair in fixes),
            "errors_px": [
                round(getattr(judge(draw, one), "error", np.nan), 4)
                for draw, (one, _) in zip(draws, fixes, strict=True)
            ],
            "rounds": min(map(len, walls.values())),
        }
        if row["rounds"]:
            one, several = ([1e3 * min(walls[k, count]) for k in range(len(draws))] for count in (1, chosen.threads))
            row |= {"one_ms": np.round(one, 1).tolist(), "several_ms": np.round(several, 1).tolist()}
            row["times_as_fast"] = round(sum(one) / sum(several), 2)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
