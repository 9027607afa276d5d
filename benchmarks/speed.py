"""Cost of an image, in U, with the error of its answer beside the stated sigma in the same run; prints JSON.

U is the CPU of the bare calls of embreex for one template of 300 px: 200,000 facets, four rays a pixel, shadows. It is
measured before every run that is timed, and a row is the median of the ratios. No input is timed twice: each is an
image and a geometry of its own. What a session has warm, meshes and catalogs, is warm.

Jobs come from the modules of ``MODULES``, each with a function ``jobs()``. ``--before`` takes
what an earlier run printed.

Usage: python benchmarks/speed.py [--jobs limb template] [--before FILE.json] [--table FILE.md] [--images FOLDER]
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

MODULES = ("speed_bodies", "speed_light", "speed_stars")
"""Modules beside this one with a function ``jobs()`` that returns a list of :class:`Job`."""

IMAGES = "GIANTLIKE_BENCHMARK_IMAGES"
"""Environment variable with the folder in which jobs may keep images of the truth from run to run."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Error of an answer and what it states, in the unit of its job, and its squared error over the covariance."""

    error: float
    sigma: float
    nees_over_dof: float


@dataclass(frozen=True, kw_only=True)
class Job:
    """Something to time.

    ``fresh(number)`` makes the input of a number, not timed; ``run(input)`` is timed, and ``judge(input, answer)``
    says how good the answer is, or in a text why there is none. The inputs ``warm`` are run once before.
    """

    name: str
    goal_u: float | None
    fresh: Callable[[int], Any]
    run: Callable[[Any], Any]
    judge: Callable[[Any, Any], Outcome | str]
    unit: str = "px"
    warm: Sequence[int] = (0, 1, 2)
    numbers: Sequence[int] = tuple(range(3, 12))


def measured(job: Job, bare: Callable[[], None]) -> dict[str, Any]:
    """Row of a job."""
    for number in job.warm:
        job.run(job.fresh(number))
    cpu_ms, unit_ms, found = [], [], []
    for number in job.numbers:
        given = job.fresh(number)
        unit_ms.append(min(_cpu_ms(bare)[0] for _ in range(2)))
        spent, answer = _cpu_ms(lambda given=given: job.run(given))  # type: ignore[misc]
        cpu_ms.append(spent)
        found.append(job.judge(given, answer))
    good = [one for one in found if not isinstance(one, str)]
    ratios = np.array(cpu_ms) / np.array(unit_ms)
    row: dict[str, Any] = {
        "job": job.name,
        "goal_u": job.goal_u,
        "u": _rounded(np.median(ratios)),
        "u_most": _rounded(ratios.max()),
        "cpu_ms": _rounded(np.median(cpu_ms)),
        "unit_ms": _rounded(np.median(unit_ms)),
        "inputs": len(found),
        "without_answer": [one for one in found if isinstance(one, str)],
        "unit": job.unit,
    }
    if good:
        errors, sigmas = (np.array([getattr(one, name) for one in good]) for name in ("error", "sigma"))
        row |= {
            "rms_error": _rounded(np.sqrt(np.mean(errors**2))),
            "median_sigma": _rounded(np.median(sigmas)),
            "nees_over_dof": _rounded(np.mean([one.nees_over_dof for one in good])),
        }
    return row


def least_cpu_ms(function: Callable[[], Any], runs: int) -> float:
    """Least CPU time of some runs, ms."""
    return min(_cpu_ms(function)[0] for _ in range(runs))


def _cpu_ms(function: Callable[[], Any]) -> tuple[float, Any]:
    began = time.process_time()
    answer = function()
    return 1e3 * (time.process_time() - began), answer


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def table(rows: Sequence[dict[str, Any]], before: dict[str, dict[str, Any]]) -> str:
    """Markdown table of rows, beside those of an earlier run."""
    names = (
        "job",
        "before, U",
        "now, U",
        "goal, U",
        "now, ms",
        "error before, now",
        "sigma before, now",
        "NEES/dof before, now",
    )
    lines = ["| " + " | ".join(names) + " |", "|" + " --- |" * len(names)]
    for row in rows:
        old = before.get(row["job"], {})

        def both(key: str, row: dict[str, Any] = row, old: dict[str, Any] = old) -> str:
            return f"{old.get(key, '')}, {row.get(key, 'none')}".lstrip(", ")

        lost = f" ({len(row['without_answer'])} of {row['inputs']} without answer)" if row["without_answer"] else ""
        cells = (
            row["job"] + lost,
            old.get("u", ""),
            row["u"],
            row["goal_u"] or "",
            row["cpu_ms"],
            f"{both('rms_error')} {row['unit']}",
            f"{both('median_sigma')} {row['unit']}",
            both("nees_over_dof"),
        )
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", nargs="*", default=[""], help="parts of the names of jobs to run; all by default")
    parser.add_argument("--growth", action="store_true", help="costs over numbers, and of other tools, instead of jobs")
    parser.add_argument("--before", type=Path, help="rows of an earlier run, to stand beside these")
    parser.add_argument("--table", type=Path, help="file for the table")
    parser.add_argument("--images", type=Path, help="folder that keeps images of the truth from run to run")
    chosen = parser.parse_args()
    if chosen.images is not None:
        chosen.images.mkdir(parents=True, exist_ok=True)
        os.environ[IMAGES] = str(chosen.images)
    from rendering import FACETS, bare_calls, body_of, irregular_body

    _, bare = bare_calls(body_of(irregular_body(1, facets=FACETS)))
    rows = []
    if chosen.growth:
        for module in map(importlib.import_module, MODULES):
            for row in module.growth(bare) if hasattr(module, "growth") else ():
                print(json.dumps(row), flush=True)
        return
    for module in MODULES:
        for job in importlib.import_module(module).jobs():
            if any(part in job.name for part in chosen.jobs):
                rows.append(measured(job, bare))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(json.dumps(rows, indent=2))
    if chosen.table is not None:
        before = json.loads(chosen.before.read_text()) if chosen.before is not None else []
        chosen.table.write_text(table(rows, {row["job"]: row for row in before}))


if __name__ == "__main__":
    main()
