"""A plan beside the run of its images: what was predicted, and what came."""

from __future__ import annotations

import json
import math
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giantlike.campaign.plan.write import PLAN_FILE
from giantlike.campaign.store.results import load_result
from giantlike.core.arrays import require
from giantlike.core.errors import DataError
from giantlike.core.reasons import Outcome
from giantlike.io.csv_rows import write_csv_rows
from giantlike.io.tables import column, columns_of


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFixRow:
    """Row of a comparison: a planned fix and the one that was obtained."""

    file: str = column("Image file")
    estimator: str = column("Estimator")
    outcome: str = column("Outcome in the run")
    failure_probability: float | None = column("Planned probability of no usable fix")
    planned_sigma_px: float | None = column("Planned sigma of the center", unit="px")
    obtained_sigma_px: float | None = column("Sigma that the fix states", unit="px")
    difference_x_px: float | None = column("Fix minus planned center, column", unit="px")
    difference_y_px: float | None = column("Fix minus planned center, row", unit="px")
    normalized_square: float | None = column("Squared difference by the planned covariance, over its dimension")
    planned_stars: float | None = column("Planned number of stars")
    obtained_stars: int | None = column("Number of detected stars")


def compare_plan(plan: Path, run: Path) -> list[PlannedFixRow]:
    """Compare a plan with the run of its images."""
    path = plan / PLAN_FILE if plan.is_dir() else plan
    try:
        content = json.loads(path.read_bytes())
        images = [(image, image["fixes"].items()) for image in content["images"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(path, "cannot be read as a plan: give the folder that giantlike plan wrote") from error
    result = load_result(run)
    detected = {Path(record.path).name: record.n_detected for record in result.attitudes}
    found = {
        (Path(record.file).name, record.estimator): record
        for record in result.observations
        if record.target == content["target"]
    }
    rows = []
    for image, fixes in images:
        for estimator, fix in fixes:
            record = found.get((image["file"], estimator))
            if record is not None:
                rows.append(_row(image, estimator, fix, record, detected.get(image["file"])))
    require(bool(rows), f"{run} has no fix of an image of {plan}: images are matched by name, estimators too")
    return rows


def _row(image: dict[str, Any], estimator: str, fix: dict[str, Any], record: Any, stars: int | None) -> PlannedFixRow:
    planned = None if fix["covariance"] is None else np.array(fix["covariance"])
    cells: dict[str, Any] = {}
    if planned is not None:
        cells["planned_sigma_px"] = math.sqrt(0.5 * float(np.trace(planned[:2, :2])))
    if record.center_px is not None and record.covariance_px2 is not None:
        cells["obtained_sigma_px"] = math.sqrt(0.5 * float(np.trace(np.array(record.covariance_px2))))
        difference = np.subtract(record.center_px, [image["x_px"], image["y_px"]])
        cells |= {"difference_x_px": float(difference[0]), "difference_y_px": float(difference[1])}
        if planned is not None:
            if len(planned) == 3 and record.range_km is not None:
                difference = np.append(difference, math.log(record.range_km / image["range_km"]))
            size = len(difference)
            square = difference @ np.linalg.solve(planned[:size, :size], difference) / size
            cells["normalized_square"] = float(square)
    return PlannedFixRow(
        file=image["file"],
        estimator=estimator,
        outcome=str(record.outcome),
        failure_probability=fix["failure_probability"],
        planned_stars=image["stars"],
        obtained_stars=stars,
        **cells,
    )


def summary_of(rows: list[PlannedFixRow]) -> dict[str, Any]:
    """Numbers of a comparison by estimator: ratio of sigmas, NEES, Brier score."""
    summary: dict[str, Any] = {}
    for name in dict.fromkeys(row.estimator for row in rows):
        mine = [row for row in rows if row.estimator == name]
        usable = [row for row in mine if Outcome(row.outcome).is_usable]
        ratios = [
            row.planned_sigma_px / row.obtained_sigma_px
            for row in usable
            if row.planned_sigma_px is not None and row.obtained_sigma_px
        ]
        squares = [row.normalized_square for row in usable if row.normalized_square is not None]
        misses = [
            (row.failure_probability - (not Outcome(row.outcome).is_usable)) ** 2
            for row in mine
            if row.failure_probability is not None
        ]
        summary[name] = {
            "images": len(mine),
            "usable": len(usable),
            "planned_over_stated_sigma": None if not ratios else float(np.median(ratios)),
            "nees": None if not squares else float(np.mean(squares)),
            "brier": None if not misses else float(np.mean(misses)),
        }
    return summary


def write_comparison(path: Path, rows: list[PlannedFixRow]) -> None:
    """Write a comparison as CSV."""
    write_csv_rows(path, [each.name for each in columns_of(PlannedFixRow)], map(astuple, rows))
