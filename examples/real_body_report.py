"""Tables of ``real_body_variants.py``, as in ``docs/real_bodies.md``.

    python examples/real_body_report.py OUTPUT/variants.jsonl

Of each image as it is what every estimator makes of it; per estimator, image and variant the number of fixes that are
ok, suspect and failed, the median error of the ok ones, and those beyond 3 and 5 sigma of fix and truth together.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

NAMES = ("moment", "cross_correlation", "limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit", "auto")
SILENT, GROSS = 3.0, 5.0  # sigmas


def report(rows: list[dict[str, Any]]) -> str:
    """All tables as Markdown."""
    as_they_are = [row for row in rows if row["variant"] == "base"]
    spent_s = sum(row["cpu_s"] for row in rows)
    return "\n".join(
        [
            *base_table(as_they_are),
            "",
            *counted(rows),
            "",
            "```text",
            *offenders(rows),
            "```",
            "",
            f"{spent_s:.0f} s of CPU for {len(rows)} runs.",
            "",
        ]
    )


def base_table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """A line for each fix, and one for all failures of an image."""
    head = ["image", "estimator", "status", "error of the center, px (sigma)", "off, sigmas", "error of the range"]
    head.append("off, sigmas")
    yield "| " + " | ".join(head) + " |"
    yield "|" + " --- |" * len(head)
    for image in dict.fromkeys(row["image"] for row in rows):
        ours, title = [row for row in rows if row["image"] == image], image
        for row in ours:
            if row["status"] == "failed":
                continue
            flags = ", ".join(flag.replace("_", " ") for flag in row["flags"])
            cells = [title, row["estimator"], f"suspect: {flags}" if flags else "ok", "", "", "", ""]
            if math.isfinite(row["off"]):
                x, y = row["error_px"]
                cells[3], cells[4] = f"{x:+.1f}, {y:+.1f} ({_sigmas(row)})", f"{row['off']:.1f}"
            if "range_error" in row:
                cells[5], cells[6] = f"{100.0 * row['range_error']:+.1f} %", f"{row['range_off']:+.1f}"
            yield "| " + " | ".join(cells) + " |"
            title = ""
        reasons = [(row["estimator"], row["reason"].replace("_", " ")) for row in ours if row["status"] == "failed"]
        told = "; ".join(
            f"{', '.join(name for name, why in reasons if why == one)}: {one}"
            for one in dict.fromkeys(why for _, why in reasons)
        )
        if told:
            yield f"| {title} |  | {told} |  |  |  |  |"


def _sigmas(row: dict[str, Any]) -> str:
    return ", ".join(f"{one:.2g}" for one in row["sigma_px"])


def counted(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Lines of a table: numbers of fixes by estimator, and by variant."""
    head = ["", "ok", "suspect", "failed", "median, px", "ok > 3 sigma", "ok > 5 sigma"]
    yield "| " + " | ".join(head) + " |"
    yield "|" + " --- |" * len(head)
    groups: list[tuple[str, list[dict[str, Any]]]] = [("**all**", rows)]
    groups += [(f"*{name}*", [row for row in rows if row["estimator"] == name]) for name in NAMES]
    groups += [
        (name, [row for row in rows if row["image"] == name]) for name in dict.fromkeys(r["image"] for r in rows)
    ]
    groups += [
        (name, [row for row in rows if row["variant"] == name]) for name in dict.fromkeys(r["variant"] for r in rows)
    ]
    for name, group in groups:
        ok = [row for row in group if row["status"] == "ok"]
        errors = [math.hypot(*row["error_px"]) for row in ok if math.isfinite(row["off"])]
        number = [sum(row["status"] == status for row in group) for status in ("ok", "suspect", "failed")]
        beyond = [sum(row["worst"] > limit for row in ok) for limit in (SILENT, GROSS)]
        middle = f"{np.median(errors):.2f}" if errors else ""
        yield f"| {name} | {number[0]} | {number[1]} | {number[2]} | {middle} | {beyond[0]} | {beyond[1]} |"


def offenders(rows: list[dict[str, Any]]) -> Iterator[str]:
    """A line for each ``ok`` fix beyond 3 sigma, worst first."""
    for row in sorted(
        (row for row in rows if row["status"] == "ok" and row["worst"] > SILENT), key=lambda r: -r["worst"]
    ):
        ranges = f", range {row['range_error']:+.2%} ({row['range_off']:+.1f})" if "range_error" in row else ""
        chosen = f" [{row['chosen']}, checked by {row.get('checked_by', 'none')}]" if "chosen" in row else ""
        yield (
            f"{row['worst']:6.1f}  {row['image']} | {row['estimator']}{chosen} | {row['variant']} | "
            f"{row['error_px'][0]:+.2f}, {row['error_px'][1]:+.2f} px "
            f"(sigma {row['sigma_px'][0]:.2f}, {row['sigma_px'][1]:.2f}){ranges}"
        )


if __name__ == "__main__":
    print(report([json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]))
