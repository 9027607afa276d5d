"""Estimators under wrong models, against a truth that shares no code with them: prints JSON, writes ``stress.md``.

All rows of the table are in ``results/stress.csv``, the page has a summary. Every case is seen in several views (other
place, pose, Sun, body) with several draws of noise each. Of the fixes that are ``ok`` (no suspect flag): errors, stated
sigmas, and NEES per degree of freedom, the squared error over its covariance, which is 1 where the covariance is
consistent (3 degrees of freedom of a position, 2 of a center). Its interval is the 95 % range of the mean when views
are drawn again with replacement: draws of one view share the error of a model.

Usage: python benchmarks/stress.py [--cases plane,exact] [--estimators moment] [--views 25] [--first 0] [--draws 8]
[--output F] [--results R.json [--missing]]
       python benchmarks/stress.py --summary benchmarks/stress.md    # the page's table anew from results/stress.csv
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from stress_stars import CORNER_CASE, STAR_CASES, StarCase, StarSeen, corner_draws, star_draw, star_view
from stress_truth import CASES, Case, Draw, Seen, draw_of, view_of

from giantlike.core.arrays import Float
from giantlike.core.errors import OpNavError
from giantlike.core.outcomes import AttitudeFix, CenterFix, Failure, PositionFix
from giantlike.relative import ESTIMATORS, Estimator, LimbMatching, LimbMatchingOptions
from giantlike.relative.limb.fix import EdgeModel
from giantlike.stars import StarNavigation

BEYOND_SIGMAS, BEYOND_PX, BEYOND_RANGE = 5.0, 0.5, 0.005
"""A silent wrong answer: ok, beyond so many sigma in center or range, and beyond so much."""
RESAMPLED = 2000
_SECTION = "\n## "
TABLE = Path("results") / "stress.csv"
"""All rows, relative to the page."""
WANTED = (0.5, 2.0)
"""NEES per degree of freedom of a consistent covariance."""
Row = dict[str, str]
COLUMNS = (
    "case",
    "estimator",
    "draws",
    "ok",
    "center error, px",
    "stated, px",
    "range error, %",
    "stated, %",
    "NEES/dof of ok",
    "95 %",
    "silent wrong",
    "else",
)


INTRODUCTION = """# Estimators under wrong models
Every estimator measures bodies and star fields whose models are wrong in one way; an independent renderer
(`giantlike.independent`), which shares no code with the estimators, gives the truth. Bodies of 120 px unless the case
says another size, phase angles of 15, 60, 90 and 125 degrees in turn, 3,000 DN, read noise 5 DN, predictions up to 4 px
and 1 % of range off. Errors of pole and attitude are declared, all others are not unless the case says so.

[results/stress.csv](results/stress.csv) has every case: share of fixes that are `ok`; medians over these of the error
of the center per axis and of its sigma, of the error of range and its sigma; NEES per degree of freedom (1 is
consistent, wanted 0.5 to 2) with the 95 % range of its mean over views; silent errors (`ok`, beyond 5 sigma and beyond
0.5 px or 0.5 % of range); other outcomes. `python benchmarks/stress.py` makes it and the summary below: cases by their
NEES where at least 80 % of the fixes are `ok`, cases with fewer, and silent errors.

"""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What came of one draw, in numbers."""

    view: int
    status: str
    phase_deg: float = 0.0
    error_px: float = np.nan
    sigma_px: float = np.nan
    range_error: float = np.nan
    range_sigma: float = np.nan
    nees: float = np.nan
    cpu_s: float = 0.0


def estimator_of(name: str, case: Case) -> Estimator:
    """An estimator with its defaults, or with the options of the case."""
    if case.options == "step":
        options = LimbMatchingOptions()
        return LimbMatching(replace(options, scan=replace(options.scan, edges=EdgeModel.STEP)))
    return ESTIMATORS[name]()


def answer_of(draw: Draw, estimator: Estimator) -> Answer:
    """Run an estimator on a draw."""
    seen = draw.seen
    began = time.process_time()
    try:
        fix = estimator.estimate(draw.image, seen.camera, draw.scene)
    except (OpNavError, ValueError, ArithmeticError) as error_raised:
        return Answer(view=seen.number, status=f"raised {type(error_raised).__name__}: {error_raised}"[:90])
    return replace(judged(draw, fix), cpu_s=time.process_time() - began)


def judged(draw: Draw, fix: CenterFix | Failure) -> Answer:
    """Numbers of a fix beside the truth of a draw."""
    seen = draw.seen
    if isinstance(fix, Failure):
        return Answer(view=seen.number, status=str(fix.reason))
    status = "ok" if not fix.flags.suspect else "suspect:" + "+".join(_suspect_flags(fix))
    if seen.case.observed:
        return Answer(view=seen.number, status=status, phase_deg=seen.phase_deg, **_observed_less_computed(draw, fix))
    error = fix.center_px - seen.center_px
    numbers = {
        "error_px": float(np.hypot(*error)) / np.sqrt(2.0),
        "sigma_px": float(np.sqrt(0.5 * np.trace(fix.covariance_px2))),
    }
    if isinstance(fix, PositionFix):
        truth = float(np.linalg.norm(seen.position_camera_km))
        numbers |= {
            "range_error": fix.range_km / truth - 1.0,
            "range_sigma": fix.sigma_range_km / fix.range_km,
            "nees": _nees(fix.position_camera_km - seen.position_camera_km, fix.covariance_camera_km2),
        }
    else:
        numbers["nees"] = _nees(error, fix.covariance_px2)
    return Answer(view=seen.number, status=status, phase_deg=seen.phase_deg, **numbers)


def _observed_less_computed(draw: Draw, fix: CenterFix) -> dict[str, float]:
    """Errors with everything that stands between the pixels and inertial axes, beside the sum of all parts.

    Computed is the true position, turned by the attitude that was told, through the camera that was told.
    """
    told = draw.image.camera_from_inertial
    assert told is not None
    position = (told * draw.seen.attitude.inv()).apply(draw.seen.position_camera_km)
    error = fix.center_px - draw.seen.camera.model.project(position)
    covariance = fix.covariance_total
    numbers = {
        "error_px": float(np.hypot(*error)) / np.sqrt(2.0),
        "sigma_px": float(np.sqrt(0.5 * np.trace(covariance[:2, :2]))),
    }
    if isinstance(fix, PositionFix):
        ratio = fix.range_km / float(np.linalg.norm(position))
        error = np.append(error, np.log(ratio))
        numbers |= {"range_error": ratio - 1.0, "range_sigma": float(np.sqrt(covariance[2, 2]))}
    return numbers | {"nees": _nees(error, covariance[: error.size, : error.size])}


def _suspect_flags(fix: CenterFix | AttitudeFix) -> list[str]:
    return [name for name in fix.flags.names() if type(fix.flags)[name.upper()].suspect]


def _nees(error: Float, covariance: Float) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / error.size


def attitude_of(case: StarCase, seen: StarSeen, seed: int) -> Answer:
    """Solve the attitude of a draw of a star field; errors are of both axes across the boresight, as pixels."""
    image = star_draw(case, seen, seed)
    began = time.process_time()
    fix = StarNavigation(seen.camera, seen.catalog).solve(image)
    spent = time.process_time() - began
    if isinstance(fix, Failure):
        return Answer(view=seen.number, status=str(fix.reason), cpu_s=spent)
    error = (seen.attitude * fix.camera_from_inertial.inv()).as_rotvec()
    focal = seen.camera.model.focal_length_px
    return Answer(
        view=seen.number,
        status="suspect:" + "+".join(_suspect_flags(fix)) if fix.flags.suspect else "ok",
        error_px=float(np.hypot(*error[:2])) / np.sqrt(2.0) * focal,
        sigma_px=float(np.sqrt(0.5 * np.trace(fix.covariance_rad2[:2, :2]))) * focal,
        nees=_nees(error, fix.covariance_rad2),
        cpu_s=spent,
    )


def run_case(case: Case | StarCase, names: Sequence[str], views: range, draws: int) -> dict[str, list[Answer]]:
    """All answers of a case by estimator; every view is rendered once."""
    if isinstance(case, StarCase):
        skies = [star_view(case, number) for number in views]
        return {"stars": [attitude_of(case, seen, seed) for seen in skies for seed in range(draws)]}
    if case.name == CORNER_CASE.name:
        corners = [draw for number in views for draw in corner_draws(number, draws)]
        return {name: [answer_of(draw, estimator_of(name, case)) for draw in corners] for name in names}
    answers: dict[str, list[Answer]] = {name: [] for name in names}
    estimators = {name: estimator_of(name, case) for name in names}
    for number in views:
        seen: Seen = view_of(case, number)
        for seed in range(draws):
            draw = draw_of(seen, seed)
            for name in names:
                answers[name].append(answer_of(draw, estimators[name]))
    return answers


def summary(answers: Sequence[Answer]) -> dict[str, object]:
    """Numbers of one cell of the table."""
    good = [answer for answer in answers if answer.status == "ok"]
    others: dict[str, int] = {}
    for answer in answers:
        if answer.status != "ok":
            others[answer.status] = others.get(answer.status, 0) + 1
    result: dict[str, object] = {
        "draws": len(answers),
        "ok": round(len(good) / len(answers), 3),
        "cpu_s": _short(float(np.median([answer.cpu_s for answer in answers]))),
        "else": dict(sorted(others.items(), key=lambda item: -item[1])),
    }
    if not good:
        return result
    wrong = sum(_silently_wrong(answer) for answer in good)
    nees = np.array([answer.nees for answer in good])
    owners = np.array([answer.view for answer in good])
    ranged = any(not np.isnan(answer.range_error) for answer in good)
    return result | {
        "error_px": _short(float(np.median([answer.error_px for answer in good]))),
        "sigma_px": _short(float(np.median([answer.sigma_px for answer in good]))),
        "range_error_percent": _short(100 * float(np.nanmedian(np.abs([a.range_error for a in good]))))
        if ranged
        else None,
        "range_sigma_percent": _short(100 * float(np.nanmedian([a.range_sigma for a in good]))) if ranged else None,
        "nees": _short(float(nees.mean())),
        "nees_95": [_short(each) for each in _interval(nees, owners)],
        "nees_median": _short(float(np.median(nees))),
        "nees_by_phase": {
            f"{phase:g}": _short(float(np.mean([a.nees for a in good if a.phase_deg == phase])))
            for phase in sorted({answer.phase_deg for answer in good})
        },
        "silent_wrong": wrong,
    }


def _silently_wrong(answer: Answer) -> bool:
    center = answer.error_px > max(BEYOND_PX, BEYOND_SIGMAS * answer.sigma_px)
    distance = abs(answer.range_error) > max(BEYOND_RANGE, BEYOND_SIGMAS * answer.range_sigma)
    return bool(center or distance)


def _interval(nees: Float, owners: Float) -> Float:
    """Range (2,) of the mean when views are drawn with replacement."""
    rng = np.random.default_rng(1)
    each = np.unique(owners)
    sums = np.array([nees[owners == owner].sum() for owner in each])
    counts = np.array([(owners == owner).sum() for owner in each])
    chosen = rng.integers(len(each), size=(RESAMPLED, len(each)))
    means = sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
    return np.quantile(means, [0.025, 0.975])


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def row_of(case: str, estimator: str, cell: dict[str, object]) -> Row:
    """A line of the table."""
    band = cell.get("nees_95")
    others = ", ".join(f"{name} {count}" for name, count in list(dict(cell["else"]).items())[:3])  # type: ignore[call-overload]
    values = (
        case,
        estimator,
        cell["draws"],
        f"{100 * float(str(cell['ok'])):.0f} %",
        cell.get("error_px", ""),
        cell.get("sigma_px", ""),
        cell.get("range_error_percent") or "",
        cell.get("range_sigma_percent") or "",
        cell.get("nees", ""),
        f"{band[0]}-{band[1]}" if isinstance(band, list) else "",
        cell.get("silent_wrong", ""),
        others,
    )
    return dict(zip(COLUMNS, map(str, values), strict=True))


def table_of(report: dict[str, dict[str, dict[str, object]]]) -> list[Row]:
    """All lines of the table."""
    return [row_of(case, name, cell) for case, cells in report.items() for name, cell in cells.items()]


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write all lines as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def summary_table(rows: Sequence[Row]) -> str:
    """A line for each estimator, in Markdown."""
    head = ("estimator", "cases", "NEES/dof 0.5 to 2", "below", "above", "under 80 % `ok`", "median NEES/dof")
    lines = [f"| {' | '.join((*head, 'silent of answers'))} |", "|" + " --- |" * (len(head) + 1)]
    for name in dict.fromkeys(row["estimator"] for row in rows):
        own = [row for row in rows if row["estimator"] == name]
        often = [row for row in own if float(row["ok"].rstrip(" %")) >= 80.0 and row["NEES/dof of ok"]]
        nees = np.array([float(row["NEES/dof of ok"]) for row in often])
        below, above = int(np.sum(nees < WANTED[0])), int(np.sum(nees > WANTED[1]))
        counts = (len(own), len(often) - below - above, below, above, len(own) - len(often))
        silent, answers = sum(int(row["silent wrong"] or 0) for row in own), sum(int(row["draws"]) for row in own)
        words = (f"`{name}`", *map(str, counts), f"{np.median(nees):.2g}", f"{silent} of {answers:,}")
        lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines) + "\n"


def write_page(rows: Sequence[Row], page: Path) -> None:
    """Write the page; what stands below its table is kept."""
    page.write_text(INTRODUCTION + summary_table(rows) + _sections(page), encoding="utf-8")


def _sections(page: Path) -> str:
    """What is written by hand below the table of a page."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    return text[text.find(_SECTION) :] if _SECTION in text else ""


def _job(arguments: tuple[Case | StarCase, tuple[str, ...], range, int]) -> tuple[str, dict[str, dict[str, object]]]:
    warnings.simplefilter("ignore")
    case, names, views, draws = arguments
    return case.name, {name: summary(answers) for name, answers in run_case(case, names, views, draws).items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="", help="parts of names of cases, separated by commas; all if left out")
    parser.add_argument("--estimators", default="", help="names, separated by commas; those of each case if left out")
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--first", type=int, default=0, help="number of the first view: others than looked at before")
    parser.add_argument("--draws", type=int, default=8, help="noise draws by view")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--results", type=Path, help="JSON of earlier runs that this one is added to")
    parser.add_argument("--missing", action="store_true", help="only what --results lacks, as after an interrupted run")
    parser.add_argument("--output", type=Path, help="page to write, with results/stress.csv beside it")
    parser.add_argument("--summary", type=Path, help="page whose table is written anew from the CSV file beside it")
    wanted = parser.parse_args()
    if wanted.summary:
        with (wanted.summary.parent / TABLE).open(newline="", encoding="utf-8") as file:
            write_page(list(csv.DictReader(file)), wanted.summary)
        return
    parts = [part for part in wanted.cases.split(",") if part]
    known = (*CASES, *STAR_CASES, CORNER_CASE)
    chosen = [case for case in known if not parts or any(part in case.name for part in parts)]
    only = {name for name in wanted.estimators.split(",") if name}
    report: dict[str, dict[str, dict[str, object]]] = {}
    if wanted.results and wanted.results.exists():
        report = json.loads(wanted.results.read_text(encoding="utf-8"))
    done = {(case, name) for case, cells in report.items() for name in cells} if wanted.missing else set()
    jobs = [
        (case, names, range(wanted.first, wanted.first + wanted.views), wanted.draws)
        for case in chosen
        if (names := tuple(n for n in case.estimators if (not only or n in only) and (case.name, n) not in done))
    ]
    with ProcessPoolExecutor(wanted.workers) as pool:
        for name, cells in pool.map(_job, jobs):
            report[name] = report.get(name, {}) | cells
            report = {each.name: report[each.name] for each in known if each.name in report}
            print(json.dumps({name: cells}), file=sys.stderr, flush=True)
            if wanted.results:
                wanted.results.write_text(json.dumps(report, indent=1), encoding="utf-8")
            if wanted.output:
                rows = table_of(report)
                write_table(rows, wanted.output.parent / TABLE)
                write_page(rows, wanted.output)
    if not wanted.results:
        print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
