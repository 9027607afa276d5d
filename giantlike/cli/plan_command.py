"""``giantlike plan``: plan images, and compare a plan with the run of its images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from giantlike.campaign.plan.compare import compare_plan, summary_of, write_comparison
from giantlike.campaign.plan.file import PlanSetup
from giantlike.campaign.plan.write import PlanRow, plan_row, write_plan
from giantlike.cli.arguments import Json
from giantlike.cli.outcome import ExitCode, say, show_result
from giantlike.core.arrays import require
from giantlike.core.outcomes import Failure

_COMPARE = "compare"


def plan(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PLAN.toml | compare PLAN RUN", help="Plan file; or a plan and the run of its images."),
    ],
    output: Annotated[
        Path | None, typer.Option(help="Folder of the plan; compare: table of all images.", metavar="DIR|FILE.csv")
    ] = None,
    json: Json = False,
) -> ExitCode:
    """Predict what images will show before they are taken, and choose which to take.

    The folder has plan.csv, plan.json and plan.html, a scene file for giantlike render and a campaign for giantlike
    run. giantlike plan compare PLAN RUN compares such a folder with the run of its images.
    """
    if str(paths[0]) == _COMPARE:
        require(len(paths) == 3, "giantlike plan compare needs a plan and a run: giantlike plan compare PLAN RUN")
        return _compare(paths[1], paths[2], output, json=json)
    require(len(paths) == 1, f"giantlike plan takes one plan file, got {len(paths)}")
    setup = PlanSetup.load(paths[0])
    for warning in setup.warnings:
        say(f"warning: {warning}")
    made = setup.plan()
    if isinstance(made, Failure):
        text = f"{made.reason}: {made.detail}"
        return show_result({"failure": str(made.reason), "detail": made.detail}, text, json=json, failed=True)
    every, chosen = made
    folder = output or setup.path.parent / setup.content.plan.output
    stars = setup.content.stars
    write_plan(
        chosen,
        folder,
        catalog="default"
        if stars is None or stars.catalog == "default"
        else str((setup.path.parent / stars.catalog).resolve()),
        max_magnitude=None if stars is None else stars.max_magnitude,
    )
    rows = [plan_row(chosen, image) for image in chosen.images]
    refused = [plan_row(every, image) for image in every.images if image.failure is not None]
    return show_result(
        {"folder": str(folder), "images": [asdict(row) for row in rows], "refused": [asdict(row) for row in refused]},
        [*_lines(rows, refused, len(every.images)), f"wrote {folder}; giantlike render {folder / 'scene.toml'}"],
        json=json,
    )


def _lines(rows: list[PlanRow], refused: list[PlanRow], candidates: int) -> Iterator[str]:
    """Counts, a line for each image of use, and one for each of no use."""
    reasons = Counter(row.reason for row in refused)
    counts = "".join(f", {count} {str(reason).replace('_', ' ')}" for reason, count in reasons.items())
    chosen = len([row for row in rows if row.reason is None])
    yield f"{candidates} candidates: {candidates - len(refused)} of use{counts}; {chosen} planned"
    yield from (f"{row.file}: {row.reason}: {row.detail}" for row in refused)
    for row in rows:
        if row.reason is None:
            words = [f"{row.diameter_px:.4g} px", f"phase {row.phase_deg:.3g} deg", f"{row.exposure_s:g} s"]
            words += [f"peak {row.peak_dn:.3g} DN"] if row.peak_dn is not None else []
            words += [f"{row.stars:.3g} stars"] if row.stars is not None else []
            words += [f"sigma {row.sigma_x_px:.2g}, {row.sigma_y_px:.2g} px"] if row.sigma_x_px is not None else []
            words += [f"gain {row.gain:.3g}"] if row.gain is not None else []
            yield f"{row.file}: {', '.join(words)}"


def _compare(planned: Path, run: Path, output: Path | None, *, json: bool) -> ExitCode:
    rows = compare_plan(planned, run)
    if output is not None:
        write_comparison(output, rows)
    summary = summary_of(rows)

    def number(value: float | None) -> str:
        return "unknown" if value is None else f"{value:.3g}"

    lines = [
        f"{name}: {each['usable']} of {each['images']} usable; planned / stated sigma "
        f"{number(each['planned_over_stated_sigma'])}; NEES {number(each['nees'])}; Brier {number(each['brier'])}"
        for name, each in summary.items()
    ]
    return show_result({"estimators": summary, "images": [asdict(row) for row in rows]}, lines, json=json)
