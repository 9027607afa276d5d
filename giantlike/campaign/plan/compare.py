"""A plan beside the run of its images: what was predicted, and what came."""

from __future__ import annotations

import json
import math
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giantlike.campaign.plan.write import PLAN_FILE
from giantlike.campaign.store.records import ObservationRecord
from giantlike.campaign.store.results import load_result
from giantlike.core.arrays import Float, as_floats, require
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _PlannedFix:
    """A fix of ``plan.json``: its covariance (k, k) is of x, y, px, and of the logarithm of the range."""

    file: str
    estimator: str
    place: Float  # (3,): x, y, px, and the logarithm of the range
    stars: float | None
    failure_probability: float
    covariance: Float | None


def _read_plan(path: Path) -> tuple[str, list[_PlannedFix]]:
    """Target and fixes of a ``plan.json``."""
    fixes = []
    try:
        content = json.loads(path.read_bytes())
        for image in content["images"]:
            for estimator, fix in image["fixes"].items():
                planned = None if fix["covariance"] is None else as_floats(fix["covariance"], (), "covariance")
                if planned is not None:
                    require(planned.shape in ((2, 2), (3, 3)), f"covariance: 2 x 2 or 3 x 3, got {planned.shape}")
                    np.linalg.cholesky(planned)
                stars = None if image["stars"] is None else float(image["stars"])
                place = np.array([float(image["x_px"]), float(image["y_px"]), math.log(float(image["range_km"]))])
                fixes.append(
                    _PlannedFix(
                        file=str(image["file"]),
                        estimator=estimator,
                        place=place,
                        stars=stars,
                        failure_probability=float(fix["failure_probability"]),
                        covariance=planned,
                    )
                )
        return str(content["target"]), fixes
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise DataError(path, "cannot be read as a plan: give the folder that giantlike plan wrote") from error


def compare_plan(plan: Path, run: Path) -> list[PlannedFixRow]:
    """Compare a plan with the run of its images."""
    target, fixes = _read_plan(plan / PLAN_FILE if plan.is_dir() else plan)
    result = load_result(run)
    detected = {Path(record.path).name: record.n_detected for record in result.attitudes}
    found = {
        (Path(record.file).name, record.estimator): record for record in result.observations if record.target == target
    }
    rows = [
        _compare_fix(fix, found[fix.file, fix.estimator], detected.get(fix.file))
        for fix in fixes
        if (fix.file, fix.estimator) in found
    ]
    require(bool(rows), f"{run} has no fix of an image of {plan}: images are matched by name, estimators too")
    return rows


def _compare_fix(fix: _PlannedFix, record: ObservationRecord, stars: int | None) -> PlannedFixRow:
    cells: dict[str, float] = {}
    if fix.covariance is not None:
        cells["planned_sigma_px"] = math.sqrt(0.5 * float(np.trace(fix.covariance[:2, :2])))
    if record.center_px is not None and record.covariance_px2 is not None:
        cells["obtained_sigma_px"] = math.sqrt(0.5 * float(np.trace(np.array(record.covariance_px2))))
        ranged = [] if record.range_km is None else [math.log(record.range_km)]
        difference = np.array([*record.center_px, *ranged]) - fix.place[: 2 + len(ranged)]
        cells |= {"difference_x_px": float(difference[0]), "difference_y_px": float(difference[1])}
        if fix.covariance is not None:
            size = min(len(difference), len(fix.covariance))
            difference, covariance = difference[:size], fix.covariance[:size, :size]
            cells["normalized_square"] = float(difference @ np.linalg.solve(covariance, difference)) / size
    return PlannedFixRow(
        file=fix.file,
        estimator=fix.estimator,
        outcome=str(record.outcome),
        failure_probability=fix.failure_probability,
        planned_stars=fix.stars,
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
