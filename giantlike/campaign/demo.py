"""The demonstration: a simulated approach, run like any campaign and compared with the truth."""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from scipy.stats import chi2

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.making import Progress
from giantlike.campaign.run.runner import run_campaign, silent
from giantlike.campaign.store.results import group_by
from giantlike.catalogs import load_catalog
from giantlike.core.arrays import finite_or_none, require
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Reason
from giantlike.core.values import Value
from giantlike.simulation import ApproachOptions, plan_approach, write_approach
from giantlike.simulation.compare import (
    ErrorSummary,
    ObservationError,
    TruthComparison,
    compare_run,
    score_attitudes,
    score_observations,
)
from giantlike.simulation.write import BODY_IMAGE, CAMPAIGN_FILE, ESTIMATORS, TRUTH_FILE

_MARKER = ".giantlike-demo"  # file that marks a folder as made by a demonstration
_MARKER_TEXT = "giantlike demo made this folder, and clears what it wrote here when it is run again.\n"
_WRITTEN = ("images", "shapes", "run", "camera.toml", "geometry.csv", CAMPAIGN_FILE, TRUTH_FILE)
_CONSISTENT = 0.001  # two-sided probability of chi-square that contradicts covariances: one false alarm in 1,000
_SMALL_PHASE_DEG = 90.0  # up to which the goal of ``unresolved`` holds: half of the disk is illuminated
_ATTITUDE_SHARE = 0.95  # share of the images that need an attitude: of 39, one may be lost
_BODY_SHARE = 0.8  # of bodies that an estimator is made for and has to find: one that suspects more is of no use
_MADE_FOR_PX = MappingProxyType(
    {
        "unresolved": (0.0, 8.0),
        "cross_correlation": (0.0, math.inf),
        "limb_matching": (60.0, math.inf),
        "ellipsoid_cra": (60.0, math.inf),
    }
)
"""Minimum and maximum diameter, px, of the bodies that each estimator has to find."""
_WHY = MappingProxyType(
    {
        Reason.NOT_UNRESOLVED: "the body is resolved: ",
        Reason.NO_LIMB: "too small or too dark a limb: ",
        Reason.WRONG_SHAPE: "the body is no ellipsoid: ",
    }
)
"""Meaning of the reasons that are usual in an approach."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """A requirement on the demonstration."""

    text: str
    value: float  # value reached; NaN if nothing could be measured
    high: float
    low: float = 0.0  # low, high: limits, inclusive
    unit: str = ""

    @property
    def met(self) -> bool:
        """True if the value lies within the limits; NaN does not."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DemoReport(Value):
    """Result of the demonstration."""

    output: Path  # folder with everything that was written
    comparison: TruthComparison  # every attitude and every observation against the truth
    simulate_s: float  # simulate_s, run_s: computing time of the images and of the campaign
    run_s: float

    def attitude_scores(self) -> dict[str, ErrorSummary]:
        """Attitude scores, by source of the attitude."""
        by_source = group_by(self.comparison.attitudes, lambda error: error.source)
        return {source or "none": score_attitudes(errors) for source, errors in by_source.items()}

    def estimator_scores(self) -> dict[tuple[str, str], ErrorSummary]:
        """Scores by target and estimator."""
        by_pair = group_by(self.comparison.observations, lambda error: (error.target, error.estimator))
        return {pair: score_observations(errors) for pair, errors in by_pair.items()}

    @property
    def goals(self) -> tuple[Goal, ...]:
        """Requirements on the demonstration, with the values reached."""
        return (*_yield_goals(self.comparison), *_accuracy_goals(self.comparison), *self._consistency_goals())

    @property
    def met(self) -> bool:
        """True if every goal is met."""
        return all(goal.met for goal in self.goals)

    def _consistency_goals(self) -> Iterable[Goal]:
        for source, score in self.attitude_scores().items():
            if score.dof:
                yield _consistency(f"attitude ({source}): squared errors over variances", score.chi2, score.dof)
        for estimator, errors in group_by(self.comparison.observations, lambda error: error.estimator).items():
            score = score_observations(errors)
            if score.dof:
                yield _consistency(f"{estimator}, center: squared errors over variances", score.chi2, score.dof)
            if score.n_ranges:
                yield _consistency(
                    f"{estimator}, range: squared errors over variances", score.range_chi2, score.n_ranges
                )

    def text(self) -> str:
        """Text tables: every observation, then each estimator, then the goals."""
        lines = ["Every fix: error against truth +- the sigma that the estimator stated", ""]
        lines += _observation_lines(self.comparison.observations)
        lines += ["", "Attitude: error and stated sigma as a shift of the image", ""]
        lines += _score_lines("source", self.attitude_scores())
        lines += ["", "Bodies: root mean square error beside root mean square sigma", ""]
        lines += _score_lines(
            "target  estimator", {f"{t:<7} {e}": score for (t, e), score in self.estimator_scores().items()}
        )
        lines += ["", *_failure_lines(self.estimator_scores()), "Goals", ""]
        lines += [_goal_line(goal) for goal in self.goals]
        lines += [
            "",
            f"{self.simulate_s:.1f} s to take the images, {self.run_s:.1f} s for the campaign;"
            f" report: {self.output / 'run' / 'report.html'}",
        ]
        return "\n".join(lines) + "\n"

    def to_json(self) -> str:
        """Goals and scores as JSON; numbers that do not exist are null."""
        table = {
            "output": str(self.output),
            "met": self.met,
            "goals": [
                {
                    "goal": g.text,
                    "value": finite_or_none(g.value),
                    "low": g.low,
                    "high": g.high,
                    "unit": g.unit,
                    "met": g.met,
                }
                for g in self.goals
            ],
            "attitudes": {source: _score_table(score) for source, score in self.attitude_scores().items()},
            "estimators": [
                {"target": target, "estimator": estimator, **_score_table(score)}
                for (target, estimator), score in self.estimator_scores().items()
            ],
            "simulate_s": self.simulate_s,
            "run_s": self.run_s,
        }
        return json.dumps(table, indent=2)


def run_demo(
    output: Path,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    options: ApproachOptions | None = None,
) -> DemoReport:
    """Simulate an approach and its images, run the campaign and compare the results with the truth."""
    start = time.perf_counter()
    _clear(output)

    show = progress or silent
    threads = workers or os.cpu_count() or 1
    approach = plan_approach(options or ApproachOptions())
    campaign = write_approach(
        approach, output, load_catalog("default"), workers=threads, progress=partial(show, "taking images")
    )
    middle = time.perf_counter()
    result = run_campaign(Campaign.load(campaign), workers=workers, progress=progress)
    end = time.perf_counter()
    comparison = compare_run(result.folder, output / TRUTH_FILE, approach.camera)
    return DemoReport(output=output, comparison=comparison, simulate_s=middle - start, run_s=end - middle)


def _clear(output: Path) -> None:
    """Mark an empty folder, or clear a marked one, even of an interrupted demonstration; refuse all others."""
    marker = output / _MARKER
    try:
        output.mkdir(parents=True, exist_ok=True)
        if not marker.is_file():
            found = sorted(path.name for path in output.iterdir())
            require(
                not found,
                f"{output}: the folder holds {', '.join(found[:3])} and no earlier demonstration (no {_MARKER}): "
                "name an empty folder",
            )
            marker.write_text(_MARKER_TEXT, encoding="utf-8")
        for path in (output / name for name in _WRITTEN):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(output, f"cannot be written: {error.strerror or error}") from error


def _yield_goals(comparison: TruthComparison) -> Iterable[Goal]:
    """Goals of the fraction of fixes that are ok among all that are observable by the truth, reported or not."""
    solved = {error.file for error in comparison.attitudes if error.status == "ok"}
    yield _share("attitude", [row.file in solved for row in comparison.truth], _ATTITUDE_SHARE)
    found = {(e.estimator, e.target, e.file) for e in comparison.observations if e.status == "ok"}
    for estimator, (least, largest) in _MADE_FOR_PX.items():
        hits = [
            (estimator, row.target, row.file) in found
            for row in comparison.truth
            if row.kind == BODY_IMAGE
            and least <= row.diameter_px <= largest
            and estimator in ESTIMATORS.get(row.target, ())
        ]
        if hits:
            limits = f" from {least:g} px" * (least > 0.0) + f" to {largest:g} px" * math.isfinite(largest)
            yield _share(f"{estimator}, bodies{limits}", hits, _BODY_SHARE)


def _share(text: str, hits: Sequence[bool], low: float) -> Goal:
    """Goal of the fraction of observable bodies that are found; NaN, which is not met, where there are none."""
    share = sum(hits) / len(hits) if hits else math.nan
    return Goal(text=f"{text}: share with a good fix ({sum(hits)} of {len(hits)})", value=share, low=low, high=1.0)


def _accuracy_goals(comparison: TruthComparison) -> list[Goal]:
    of = group_by(comparison.observations, lambda error: error.estimator)
    attitudes = score_attitudes(comparison.attitudes)
    correlation = score_observations(of.get("cross_correlation", []))
    limb = score_observations(of.get("limb_matching", []))
    small = [error for error in of.get("unresolved", []) if error.phase_deg < _SMALL_PHASE_DEG]
    unresolved = score_observations(small)
    return [
        Goal(text="attitude, rms per axis", value=float(attitudes.rms_px.max()), high=0.1, unit="px"),
        Goal(text="cross_correlation, rms per axis", value=float(correlation.rms_px.max()), high=0.1, unit="px"),
        Goal(text="limb_matching, rms per axis", value=float(limb.rms_px.max()), high=0.2, unit="px"),
        Goal(text="limb_matching, rms of range", value=100.0 * limb.range_rms, high=0.1, unit="%"),
        Goal(
            text=f"unresolved below {_SMALL_PHASE_DEG:.0f} deg phase, rms per axis",
            value=float(unresolved.rms_px.max()),
            high=0.3,
            unit="px",
        ),
    ]


def _consistency(text: str, total: float, dof: int) -> Goal:
    """Goal of a mean squared normalized error: its range if the reported covariances are correct."""
    low, high = (float(chi2.ppf(p, dof)) / dof for p in (_CONSISTENT / 2, 1.0 - _CONSISTENT / 2))
    return Goal(text=f"{text} ({dof})", value=total / dof, low=low, high=high)


def _observation_lines(errors: Sequence[ObservationError]) -> list[str]:
    header = f"{'image':<20}{'px':>5}{'phase':>7}  {'estimator':<18}{'x (px)':>17}{'y (px)':>17}{'range (%)':>19}"
    lines = [header]
    for error in errors:
        if error.error_px is None or error.sigma_px is None:
            continue
        center = [f"{e:+.3f} +- {s:.3f}" for e, s in zip(error.error_px, error.sigma_px, strict=True)]
        reach = ""
        if error.range_error is not None and error.range_sigma is not None:
            reach = f"{100 * error.range_error:+.3f} +- {100 * error.range_sigma:.3f}"
        mark = "" if error.status == "ok" else f"  {error.status}"
        lines.append(
            f"{error.file:<20}{error.diameter_px:>5.0f}{error.phase_deg:>7.0f}  {error.estimator:<18}"
            f"{center[0]:>17}{center[1]:>17}{reach:>19}{mark}"
        )
    return lines


def _score_lines(title: str, scores: dict[str, ErrorSummary]) -> list[str]:
    width = max([len(title), *(len(key) for key in scores)]) + 2
    header = (
        f"{title:<{width}}{'fixes':>6}{'error x':>9}{'y':>7}{'sigma x':>9}{'y':>7} px"
        f"{'NEES/dof':>10}{'range error':>13}{'sigma':>7} %{'NEES/dof':>10}"
    )
    lines = [header]
    for key, score in scores.items():
        if not score.n_fixes:
            lines.append(f"{key:<{width}}{0:>6}")
            continue
        (x, y), (sigma_x, sigma_y) = score.rms_px, score.sigma_px
        nees = f"{score.chi2 / score.dof:.2f}" if score.dof else ""
        line = f"{key:<{width}}{score.n_fixes:>6}{x:>9.4f}{y:>7.4f}{sigma_x:>9.4f}{sigma_y:>7.4f}   {nees:>10}"
        if score.n_ranges:
            nees = f"{score.range_chi2 / score.n_ranges:.2f}"
            line += f"{100 * score.range_rms:>13.3f}{100 * score.range_sigma:>7.3f}  {nees:>10}"
        lines.append(line.rstrip())
    return lines


def _failure_lines(scores: dict[tuple[str, str], ErrorSummary]) -> list[str]:
    """Counts of failures by reason; empty if there are none."""
    lines = []
    for (target, estimator), score in scores.items():
        label = f"{target:<7} {estimator:<18}"
        for reason, count in score.failures.items():
            lines.append(f"{label}{count:>3} of {score.n_images} images: {_WHY.get(Reason(reason), '')}{reason}")
        if score.n_suspect:
            lines.append(f"{label}{score.n_suspect:>3} of {score.n_images} images: suspect, not counted above")
    return ["Images that an estimator left to the others", "", *lines, ""] if lines else []


def _goal_line(goal: Goal) -> str:
    limit = f"<= {goal.high:g} {goal.unit}" if goal.low == 0.0 else f"in {goal.low:.2f} to {goal.high:.2f}"
    return (
        f"{'met   ' if goal.met else 'MISSED'}  {goal.text}: {goal.value:.3g} {goal.unit}".rstrip()
        + f" ({limit.strip()})"
    )


def _score_table(score: ErrorSummary) -> dict[str, Any]:
    return {
        "images": score.n_images,
        "fixes": score.n_fixes,
        "suspect": score.n_suspect,
        "failures": dict(score.failures),
        "rms_px": [finite_or_none(v) for v in score.rms_px.tolist()],
        "sigma_px": [finite_or_none(v) for v in score.sigma_px.tolist()],
        "nees_per_dof": finite_or_none(score.chi2 / score.dof if score.dof else math.nan),
        "range_rms": finite_or_none(score.range_rms),
        "range_sigma": finite_or_none(score.range_sigma),
        "range_nees": finite_or_none(score.range_chi2 / score.n_ranges if score.n_ranges else math.nan),
    }
