"""Yield and silent errors of the estimators side by side, on real and made-up images.

``run`` writes a row of JSON for each image, variant and estimator, with all numbers of the fix and of the truth, so
that every way of scoring can be applied to it later; ``score`` prints a table of rows. A check that refuses more fixes
shows in the yield, one that lets more pass in the silent errors. What can be answered is in ``answerable.csv``, which
``answerable`` writes by truth and picture alone (frames that it lacks are run by the same rule); of made-up images
``giantlike.gauntlet.rule.solvable`` says it.

    python benchmarks/yield.py run --set real2 --output real2.jsonl.gz [--processes 2] [--frames PART,..]
        [--variants NAME;..] [--estimators NAME,..] [--fresh-auto]
    python benchmarks/yield.py run --set gauntlet --seed 7001 --images 150 --output gauntlet.jsonl.gz
    python benchmarks/yield.py score real.jsonl.gz real2.jsonl.gz [--json] [--flags] [--by-frame]
    python benchmarks/yield.py score --compare OLD.jsonl.gz NEW.jsonl.gz
    python benchmarks/yield.py answerable > benchmarks/answerable.csv

Terms:

- *correct*: the Mahalanobis distance of the center is at most 3, and the range is within 3 sigma, each with the
  uncertainty of the truth;
- *yield*: share of correct and ``ok`` ones among the runs that can be answered; failures and exceptions count;
- *useful*: the sigma is also at most 1 px or 2 % of the radius;
- *`ok` of all correct*, and the columns after it as far as the silent errors, count runs that are not demanded as well;
- *silent*: ``ok``, beyond 5 sigma, and beyond 0.5 px or 0.5 % of range; and every ``ok`` fix of a body that is not
  there. Kinds of the gauntlet whose error no image shows are counted apart;
- *bits*: log2 of the density of the truth under the fix over that under the prediction (the declared one, else uniform
  over the search), both widened by the covariance of the truth; in x, y and, where the fix has one, ln range. 0 for a
  fix that is suspect or failed, at least -500. Mean over the variants of a frame, then over frames. *All bodies*
  counts runs that are not demanded as well, at most beside a search around the truth: a declared prediction may be
  wrong there.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import json
import math
import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yield_frames as images
from scipy.special import ndtr
from yield_frames import NAMES, Trial

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.causes import IN_IMAGE, IN_POSITION, sum_parts
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.image import Image
from giantlike.relative import Auto, AutoOptions, Estimator
from giantlike.scene import Scene

CORRECT_SIGMAS, WRONG_SIGMAS, WRONG_PX, WRONG_RANGE = 3.0, 5.0, 0.5, 0.005
USEFUL_PX, USEFUL_RADIUS = 1.0, 0.02
LEAST_BITS = -500.0
RESAMPLED = 2000
LIST = Path(__file__).parent / "answerable.csv"
SETS = ("real", "real2", "gauntlet", "stress")
Row = dict[str, Any]


# Running


class _Known:
    """An estimator that returns a known outcome for one image and scene, and runs on any other."""

    name: ClassVar[str] = "known"

    def __init__(self, estimator: Estimator, image: Image, scene: Scene, outcome: CenterFix | Failure) -> None:
        self.options = estimator.options
        self._estimator, self._image, self._scene, self._outcome = estimator, image, scene, outcome

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> CenterFix | Failure:
        """Return the outcome."""
        if image is self._image and scene is self._scene:
            return self._outcome
        return self._estimator.estimate(image, camera, scene, target)


class _SharedAuto(Auto):
    """``auto`` that does not repeat what was run with the same options on the same image.

    An ``auto`` that does not make its estimators by ``_estimator`` runs all of them itself.
    """

    def __init__(self, options: AutoOptions, trial: Trial, outcomes: Mapping[str, CenterFix | Failure]) -> None:
        super().__init__(options)
        self._trial, self._outcomes = trial, outcomes

    def _estimator(self, name: str) -> Estimator:
        estimator = super()._estimator(name)
        known = self._trial.estimators.get(name)
        if name not in self._outcomes or known is None or known.options != estimator.options:
            return estimator
        return _Known(estimator, self._trial.image, self._trial.scene, self._outcomes[name])


def rows_of(trial: Trial, names: Sequence[str], *, fresh_auto: bool) -> list[Row]:
    """Rows of all estimators on a trial."""
    outcomes: dict[str, CenterFix | Failure] = {}
    common = _common(trial)
    rows = []
    for name, estimator in trial.estimators.items():
        if names and name not in names:
            continue
        if isinstance(estimator, Auto) and not fresh_auto:
            estimator = _SharedAuto(estimator.options, trial, outcomes)
        began = time.process_time()
        try:
            fix = estimator.estimate(trial.image, trial.camera, trial.scene)
        except Exception as error:  # noqa: BLE001 - one exception must not end the run
            numbers = _raised(error)
        else:
            outcomes[name] = fix
            numbers = _numbers(trial, fix)
        rows.append({**common, "estimator": name, "cpu_s": time.process_time() - began, **numbers})
    return rows


def _common(trial: Trial) -> Row:
    """What all rows of a trial share."""
    try:
        prediction = trial.prediction()
    except Exception:  # noqa: BLE001 - a lens or a scene that the package refuses: the estimators say so
        prediction = None
    row: Row = {
        "set": trial.collection,
        "frame": trial.frame,
        "variant": trial.variant,
        "present": trial.present,
        "observable": trial.observable,
        "radius_px": trial.radius_px,
        "truth": {
            "center_px": trial.center_px,
            "range_km": trial.range_km,
            "covariance": trial.covariance,
        },
        "search": trial.search,
        "answerable": trial.answerable,
    }
    if prediction is not None:
        center, range_km, covariance = prediction
        row["prediction"] = {"center_px": center, "range_km": range_km, "covariance": covariance}
    return row


def _raised(error: Exception) -> Row:
    """Row of an exception."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(where.filename).name}:{where.lineno}"
    return {"status": "raised", "reason": type(error).__name__, "detail": f"{error} ({place})"}


def _numbers(trial: Trial, fix: CenterFix | Failure) -> Row:
    """Numbers of a fix."""
    if isinstance(fix, Failure):
        return {"status": "failed", "reason": str(fix.reason), "detail": fix.detail}
    numbers: Row = {
        "status": "suspect" if fix.flags.suspect else "ok",
        "flags": list(fix.flags.names()),
        "suspect": [flag for flag in fix.flags.names() if type(fix.flags)[flag.upper()].suspect],
        "center_px": fix.center_px,
        "covariance_px2": fix.covariance_px2,
        "covariance": _covariance(trial, fix),
        "parts": {str(cause): part for cause, part in fix.parts.items()},
        "n_used": fix.n_used,
        "n_rejected": fix.n_rejected,
        "score": fix.score,
        "provenance": {key: text for key, text in fix.provenance.items() if key != "options"},
    }
    if isinstance(fix, PositionFix):
        numbers |= {"range_km": fix.range_km, "sigma_range_km": fix.sigma_range_km}
    return numbers


def _covariance(trial: Trial, fix: CenterFix) -> Float:
    """Covariance of x, y and, where it is estimated, ln range, of the errors beside the truth of a trial.

    The center is that seen in the image, whatever the camera is; the range follows from the camera as well. Where
    attitude and camera belong to the truth, all parts count.
    """
    if trial.total:
        return fix.covariance_total
    if not isinstance(fix, PositionFix):
        return fix.covariance_px2
    if not fix.parts:
        position = fix.position_camera_km
        jacobian = np.vstack([trial.camera.model.project_jacobian(position), position / (position @ position)])
        return np.asarray(jacobian @ fix.covariance_camera_km2 @ jacobian.T)
    covariance = sum_parts(fix.parts, IN_IMAGE)
    covariance[2, 2] = sum_parts(fix.parts, IN_POSITION)[2, 2]
    return covariance


def _plain(value: object) -> object:
    """Arrays and numpy numbers for JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"no JSON of {type(value).__name__}")


@dataclass(frozen=True)
class _Job:
    """One image and variant of a set, and how to run it."""

    given: argparse.Namespace
    frame: str
    variant: str

    def trial(self) -> Trial | None:
        """The trial; None where the variant does not apply."""
        data, cache = self.given.data, self.given.output.parent
        if self.given.set == "real":
            return images.real_trial(data, cache, self.frame, self.variant)
        if self.given.set == "real2":
            return images.real2_trial(data, self.frame, self.variant)
        if self.given.set == "gauntlet":
            return images.gauntlet_trial(self.frame)
        return images.stress_trial(self.frame, self.variant)


def _jobs(given: argparse.Namespace) -> list[_Job]:
    """All images and variants of a set that are wanted."""
    if given.set == "real":
        pairs = images.real_jobs(given.data, given.output.parent, every=given.all)
    elif given.set == "real2":
        pairs = images.real2_jobs(given.data)
    elif given.set == "gauntlet":
        pairs = images.gauntlet_jobs(given.seed, given.images)
    else:
        pairs = images.stress_jobs(range(given.first, given.first + given.views), given.draws)
    parts, only = given.frames.split(","), [one.strip() for one in given.variants.split(";") if one.strip()]
    return [
        _Job(given, frame, variant)
        for frame, variant in pairs
        if any(part in frame for part in parts) and (not only or variant in only)
    ]


def _run_job(job: _Job) -> list[Row]:
    """Rows of a job; where its inputs are refused, one of an exception for every estimator."""
    warnings.simplefilter("ignore")
    names = [one for one in job.given.estimators.split(",") if one]
    try:
        trial = job.trial()
    except Exception as error:  # noqa: BLE001 - one image must not end the run
        row: Row = {"set": job.given.set, "frame": job.frame, "variant": job.variant, **_raised(error), "cpu_s": 0.0}
        return [{**row, "estimator": name} for name in NAMES if not names or name in names]
    if trial is None:
        return []
    if trial.answerable is None and (trial.collection, trial.frame, trial.variant) not in read_list():
        trial = replace(trial, answerable=images.demanded(trial).names)
    return rows_of(trial, names, fresh_auto=job.given.fresh_auto)


def run(given: argparse.Namespace) -> None:
    """Run a set and write its rows as they come."""
    given.output.parent.mkdir(parents=True, exist_ok=True)
    jobs = _jobs(given)
    opened = gzip.open if given.output.suffix == ".gz" else open
    pool = ProcessPoolExecutor(given.processes, mp_context=get_context("fork")) if given.processes > 1 else None
    each: Callable[..., Iterable[list[Row]]] = map if pool is None else pool.map
    with opened(given.output, "wt") as lines:
        for number, rows in enumerate(each(_run_job, jobs), 1):
            lines.writelines(json.dumps(row, default=_plain) + "\n" for row in rows)
            lines.flush()
            print(f"{number} of {len(jobs)}", end="\r", file=sys.stderr, flush=True)
    if pool is not None:
        pool.shutdown()


# The list


def write_list(given: argparse.Namespace) -> None:
    """Print the list of what can be answered on real frames."""
    lines = csv.writer(sys.stdout, lineterminator="\n")
    lines.writerow(["set", "frame", "variant", "estimators", "why_not"])
    cache = given.output.parent
    trials: Iterator[Trial | None] = (
        images.real_trial(given.data, cache, *pair) for pair in images.real_jobs(given.data, cache, every=True)
    )
    real2 = (images.real2_trial(given.data, *pair) for pair in images.real2_jobs(given.data))
    for trial in (*trials, *real2):
        if trial is not None:
            demand = images.demanded(trial)
            why = "; ".join([demand.why_not] * bool(demand.why_not) + [f"{k}: {v}" for k, v in demand.reasons.items()])
            lines.writerow([trial.collection, trial.frame, trial.variant, " ".join(demand.names), why])


@lru_cache(maxsize=1)
def read_list() -> dict[tuple[str, str, str], tuple[str, ...]]:
    """Estimators of which an answer is demanded, by set, frame and variant."""
    with LIST.open(encoding="utf-8") as lines:
        return {
            (line["set"], line["frame"], line["variant"]): tuple(line["estimators"].split())
            for line in csv.DictReader(lines)
        }


# Scoring


@dataclass(frozen=True, kw_only=True)
class Score:
    """One row, judged."""

    row: Row
    answerable: bool
    center_sigmas: float = math.nan
    range_sigmas: float = math.nan
    error_px: float = math.nan
    range_error: float = math.nan
    sigma_px: float = math.nan
    nees: float = math.nan
    fix_bits: float = 0.0
    """Information of the fix, whatever its status."""
    search_bits: float = 0.0
    """Information beside a uniform search around the truth, whatever was declared."""

    @property
    def status(self) -> str:
        """ok, suspect, failed or raised."""
        return str(self.row["status"])

    @property
    def ok(self) -> bool:
        """True for a fix without a suspect flag."""
        return self.status == "ok"

    @property
    def present(self) -> bool:
        """True where the body is in the image."""
        return bool(self.row.get("present", True))

    @property
    def fixed(self) -> bool:
        """True for a fix, ``ok`` or suspect."""
        return self.status in ("ok", "suspect")

    @property
    def sigmas(self) -> float:
        """Larger of the errors of center and range over their sigmas."""
        return float(np.nanmax([self.center_sigmas, self.range_sigmas, -1.0])) if self.fixed else math.nan

    @property
    def correct(self) -> bool:
        """True for a fix of a body that is there, within 3 sigma."""
        return self.fixed and self.present and self.center_sigmas <= CORRECT_SIGMAS and self.sigmas <= CORRECT_SIGMAS

    @property
    def useful(self) -> bool:
        """True for a sigma of at most 1 px or 2 % of the radius."""
        return self.sigma_px <= max(USEFUL_PX, USEFUL_RADIUS * float(self.row["radius_px"]))

    @property
    def wrong(self) -> bool:
        """True for a fix beyond 5 sigma and beyond 0.5 px or 0.5 % of range, or of a body that is not there."""
        if not self.fixed:
            return False
        center = not self.center_sigmas <= WRONG_SIGMAS and not self.error_px <= WRONG_PX
        distance = self.range_sigmas > WRONG_SIGMAS and abs(self.range_error) > WRONG_RANGE
        return not self.present or center or distance

    @property
    def bits(self) -> float:
        """Information that a user gets."""
        return self.fix_bits if self.ok else 0.0

    @property
    def outcome(self) -> str:
        """Status, and whether the fix is correct or wrong."""
        return f"{self.status} {'correct' if self.correct else 'wrong' if self.wrong else 'beyond 3 sigma'}"[
            : None if self.fixed else len(self.status)
        ]


def scored(rows: Iterable[Row], listed: Mapping[tuple[str, str, str], tuple[str, ...]]) -> list[Score]:
    """Judge rows; where the inputs of a frame that is not listed were refused, everything was demanded."""
    found = []
    for row in rows:
        names = row.get("answerable")
        if names is None:
            names = listed.get((row["set"], row["frame"], row["variant"]), NAMES)
        found.append(_score(row, row["estimator"] in names))
    return found


def _score(row: Row, answerable: bool) -> Score:
    """Judge a row."""
    if row["status"] not in ("ok", "suspect") or not row["present"]:
        return Score(row=row, answerable=answerable)
    truth = {key: np.asarray(value, dtype=float) for key, value in row["truth"].items()}
    covariance = np.asarray(row["covariance"], dtype=float)
    ranged = len(covariance) == 3 and math.isfinite(truth["covariance"][2, 2])
    size = 3 if ranged else 2
    error = np.asarray(row["center_px"]) - truth["center_px"]
    if ranged:
        error = np.append(error, math.log(row["range_km"] / float(truth["range_km"])))
    covariance, known = covariance[:size, :size], truth["covariance"][:size, :size]
    total = covariance + known + 1e-12 * np.eye(size)
    square = _squared(error, total)
    density = _log2_density(square, total)
    return Score(
        row=row,
        answerable=answerable,
        center_sigmas=math.sqrt(_squared(error[:2], total[:2, :2])),
        range_sigmas=abs(float(error[2])) / math.sqrt(float(total[2, 2])) if ranged else math.nan,
        error_px=float(np.hypot(*error[:2])),
        range_error=float(error[2]) if ranged else math.nan,
        sigma_px=math.sqrt(0.5 * float(np.trace(covariance[:2, :2]))),
        nees=square / size,
        fix_bits=max(density - _prior_log2(row, truth, known), LEAST_BITS),
        search_bits=max(density + float(np.sum(np.log2(2.0 * _search(row, size)))), LEAST_BITS),
    )


def _squared(error: Float, covariance: Float) -> float:
    """Squared Mahalanobis distance; infinite where the covariance is none."""
    try:
        square = float(error @ np.linalg.solve(covariance, error))
    except np.linalg.LinAlgError:
        return math.inf
    return square if square >= 0.0 else math.inf


def _log2_density(square: float, covariance: Float) -> float:
    """Log2 of a normal density at a squared distance; that of nothing where the covariance is none."""
    sign, log_determinant = np.linalg.slogdet(covariance)
    if sign <= 0 or not math.isfinite(square):
        return -math.inf
    return -0.5 * (square + len(covariance) * math.log(2.0 * math.pi) + float(log_determinant)) / math.log(2.0)


def _prior_log2(row: Row, truth: Mapping[str, Float], known: Float) -> float:
    """Log2 of the density of the truth under the declared prediction, or uniform over the search."""
    prediction, size = row["prediction"], len(known)
    error = np.asarray(prediction["center_px"], dtype=float) - truth["center_px"]
    error = np.append(error, math.log(prediction["range_km"] / float(truth["range_km"])))[:size]
    if prediction["covariance"] is not None:
        covariance = np.asarray(prediction["covariance"], dtype=float)[:size, :size] + known
        return _log2_density(_squared(error, covariance), covariance)
    half = _search(row, size)
    sigma = np.sqrt(np.diag(known)) + 1e-12
    share = ndtr((half - error) / sigma) - ndtr((-half - error) / sigma)
    return float(np.sum(np.log2(np.maximum(share, 1e-300) / (2.0 * half))))


def _search(row: Row, size: int) -> Float:
    """Half widths of the search in x, y and ln range."""
    return np.array([row["search"][0], row["search"][0], row["search"][1]])[:size]


def information(scores: Iterable[Score], bits: Callable[[Score], float] = lambda one: one.bits) -> tuple[float, Float]:
    """Mean over the variants of a frame, then over frames, and its 95 % interval when frames are drawn again."""
    by_frame = defaultdict(list)
    for one in scores:
        by_frame[one.row["set"], one.row["frame"]].append(bits(one))
    means = np.array([float(np.mean(values)) for values in by_frame.values()])
    if not means.size:
        return math.nan, np.full(2, math.nan)
    drawn = np.random.default_rng(1).integers(means.size, size=(RESAMPLED, means.size))
    return float(means.mean()), np.quantile(means[drawn].mean(axis=1), [0.025, 0.975])


def summary(scores: Sequence[Score]) -> dict[str, Any]:
    """Numbers of one line of the table."""
    asked = [one for one in scores if one.answerable]
    good = [one for one in asked if one.ok]
    present = [one for one in scores if one.ok and one.present]
    negatives = [one for one in scores if not one.present]
    silent = [one for one in scores if one.ok and one.wrong]
    mean, interval = information(asked)
    said, _ = information(asked, lambda one: one.fix_bits if one.ok or one.correct else 0.0)
    seen = [one for one in scores if one.present and one.row.get("observable", True)]
    everywhere, _ = information(seen, lambda one: min(one.bits, one.search_bits) if one.ok else 0.0)
    count = max(len(asked), 1)
    correct = [one for one in scores if one.correct]
    sigmas, radii = [one.sigma_px for one in good], [one.row["radius_px"] for one in good]
    return {
        "answerable": len(asked),
        "correct": sum(one.correct for one in asked),
        "yield": sum(one.correct and one.ok for one in asked) / count,
        "useful": sum(one.correct and one.ok and one.useful for one in asked) / count,
        "correct_suspect": sum(one.correct and not one.ok for one in asked),
        "failed": sum(one.status == "failed" for one in asked),
        "raised": sum(one.status == "raised" for one in asked),
        "correct_anywhere": len(correct),
        "correct_anywhere_ok": sum(one.ok for one in correct) / max(len(correct), 1),
        "ok": len(present),
        "ok_beyond_3": sum(not one.correct for one in present),
        "ok_beyond_5": sum(not one.sigmas <= WRONG_SIGMAS for one in present),
        "silent": sum(one.row.get("observable", True) for one in silent),
        "silent_not_observable": sum(not one.row.get("observable", True) for one in silent),
        "sigma_over_radius": float(np.median(sigmas) / np.median(radii)) if good else None,
        "nees": float(np.mean([one.nees for one in good])) if good else None,
        "bits": mean,
        "bits_95": interval.tolist(),
        "bits_if_correct_were_ok": said,
        "bits_everywhere": everywhere,
        "not_demanded_ok": sum(one.ok for one in scores if one.present and not one.answerable),
        "negatives": len(negatives),
        "negatives_ok": sum(one.ok for one in negatives),
        "cpu_s": float(np.sum([one.row["cpu_s"] for one in scores])),
    }


def groups(scores: Sequence[Score]) -> dict[str, list[Score]]:
    """Scores by set, those of real frames together as well."""
    found = {name: [one for one in scores if one.row["set"] == name] for name in SETS}
    both = [one for one in scores if one.row["set"] in ("real", "real2")]
    if found["real"] and found["real2"]:
        found = {"real and real2": both, **found}
    return {name: some for name, some in found.items() if some}


def estimators_of(scores: Iterable[Score]) -> list[str]:
    """Estimators that have scores, ``auto`` first."""
    names = dict.fromkeys(one.row["estimator"] for one in scores)
    return sorted(names, key=lambda name: name != "auto")


HEAD = (
    "estimator",
    "answerable",
    "correct",
    "yield",
    "useful",
    "correct, suspect",
    "failed (raised)",
    "`ok` of all correct",
    "`ok`",
    "> 3 sigma",
    "> 5 sigma",
    "silent (not observable)",
    "sigma / radius",
    "NEES",
    "bits [95 %]",
    "bits, all correct `ok`",
    "bits, all bodies",
    "negatives `ok`",
)


def table(scores: Sequence[Score]) -> Iterator[str]:
    """Lines of a table by estimator."""
    yield "| " + " | ".join(HEAD) + " |"
    yield "|" + " --- |" * len(HEAD)
    for name in estimators_of(scores):
        cell = summary([one for one in scores if one.row["estimator"] == name])
        low, high = cell["bits_95"]
        ratio, nees = cell["sigma_over_radius"], cell["nees"]
        values = [
            f"`{name}`",
            cell["answerable"],
            cell["correct"],
            f"{cell['yield']:.1%}",
            f"{cell['useful']:.1%}",
            cell["correct_suspect"],
            f"{cell['failed'] + cell['raised']} ({cell['raised']})",
            f"{cell['correct_anywhere_ok']:.0%} of {cell['correct_anywhere']}",
            cell["ok"],
            cell["ok_beyond_3"],
            cell["ok_beyond_5"],
            f"{cell['silent']} ({cell['silent_not_observable']})",
            "" if ratio is None else f"{ratio:.2%}",
            "" if nees is None else f"{nees:.2f}",
            f"{cell['bits']:.1f} [{low:.1f}, {high:.1f}]",
            f"{cell['bits_if_correct_were_ok']:.1f}",
            f"{cell['bits_everywhere']:.1f}",
            f"{cell['negatives_ok']} of {cell['negatives']}",
        ]
        yield "| " + " | ".join(str(value) for value in values) + " |"


def flag_lines(scores: Sequence[Score]) -> Iterator[str]:
    """How often each flag stands on correct fixes that are not ok, and on wrong ones; failures by reason."""
    correct = Counter(flag for one in scores if one.answerable and one.correct for flag in one.row["suspect"])
    alone = Counter(
        one.row["suspect"][0] for one in scores if one.answerable and one.correct and len(one.row["suspect"]) == 1
    )
    wrong = Counter(flag for one in scores if one.wrong for flag in one.row["suspect"])
    yield "| flag | on correct fixes that can be demanded | alone | on wrong fixes |"
    yield "| --- | --- | --- | --- |"
    for flag in sorted({*correct, *wrong}, key=lambda name: -correct[name]):
        yield f"| `{flag}` | {correct[flag]} | {alone[flag]} | {wrong[flag]} |"
    reasons = Counter(one.row["reason"] for one in scores if one.answerable and not one.fixed)
    yield ""
    yield "Failed where an answer is demanded: " + ", ".join(
        f"`{name}` {count}" for name, count in reasons.most_common()
    )


def frame_lines(scores: Sequence[Score]) -> Iterator[str]:
    """Frames as they are: each estimator's status and error over sigma; * marks what is not demanded."""
    base = [one for one in scores if one.row["variant"] == "base"]
    names = estimators_of(base)
    yield "| frame | " + " | ".join(names) + " |"
    yield "|" + " --- |" * (len(names) + 1)
    for frame in dict.fromkeys((one.row["set"], one.row["frame"]) for one in base):
        cells = {one.row["estimator"]: one for one in base if (one.row["set"], one.row["frame"]) == frame}
        texts = []
        for name in names:
            one = cells.get(name)
            if one is None:
                texts.append("")
                continue
            number = f" {one.sigmas:.1f} ({one.error_px:.2f} px)" if one.fixed and one.present else ""
            texts.append(f"{one.status}{number}{'' if one.answerable else '*'}")
        yield f"| {frame[1]} | " + " | ".join(texts) + " |"


def wrong_lines(scores: Sequence[Score]) -> Iterator[str]:
    """A line for each silent error."""
    for one in scores:
        if one.ok and one.wrong:
            row = one.row
            yield (
                f"- {row['set']} | {row['frame']} | {row['variant']} | `{row['estimator']}`: "
                + (
                    f"{one.error_px:.2f} px, {one.center_sigmas:.1f} sigma; range {one.range_error:+.2%}, "
                    if one.present
                    else ""
                )
                + (f"{one.range_sigmas:.1f} sigma" if one.present else "not there")
                + ("" if row.get("observable", True) else " (not observable)")
            )


def read_rows(path: Path) -> list[Row]:
    """Rows of a file; an unfinished last line of a run that still goes on is left out."""
    opened = gzip.open if path.suffix == ".gz" else open
    rows: list[Row] = []
    with opened(path, "rt") as lines:
        try:
            for line in lines:
                rows.append(json.loads(line))
        except (EOFError, json.JSONDecodeError) as error:
            print(f"{path}: {len(rows)} rows, then {error}", file=sys.stderr)
    return rows


def compare(old: Path, new: Path, listed: Mapping[tuple[str, str, str], tuple[str, ...]]) -> Iterator[str]:
    """Lines of rows whose status or correctness changed."""
    before, after = (
        {tuple(one.row[key] for key in ("set", "frame", "variant", "estimator")): one for one in scored(rows, listed)}
        for rows in (read_rows(old), read_rows(new))
    )
    changes: Counter[str] = Counter()
    common = [key for key in before if key in after]
    for key in common:
        one, other = before[key], after[key]
        if one.outcome == other.outcome:
            continue
        changes[f"{one.outcome} -> {other.outcome}"] += 1
        flags = [" ".join(each.row.get("suspect") or [str(each.row.get("reason", ""))]) for each in (one, other)]
        yield (
            f"{' | '.join(key)}: {one.outcome} -> {other.outcome}; sigmas {one.sigmas:.1f} -> {other.sigmas:.1f}; "
            f"{flags[0]} -> {flags[1]}{'' if one.answerable else ' (not demanded)'}"
        )
    yield f"{sum(changes.values())} of {len(common)} changed" + "".join(
        f"\n  {n} {text}" for text, n in changes.most_common()
    )


def score(given: argparse.Namespace) -> None:
    """Print what was asked for of rows."""
    listed = read_list()
    if given.compare:
        if len(given.files) != 2:
            sys.exit("--compare takes two files")
        print("\n".join(compare(given.files[0], given.files[1], listed)))
        return
    scores = scored((row for path in given.files for row in read_rows(path)), listed)
    if given.json:
        found = {
            name: {
                estimator: summary([one for one in some if one.row["estimator"] == estimator])
                for estimator in estimators_of(some)
            }
            for name, some in groups(scores).items()
        }
        print(json.dumps(found, indent=1))
        return
    for name, some in groups(scores).items():
        print(f"\n**{name}**: {len({(one.row['set'], one.row['frame']) for one in some})} frames, {len(some)} runs\n")
        print("\n".join(table(some)))
        for wanted, lines in ((given.flags, flag_lines), (given.by_frame, frame_lines), (given.silent, wrong_lines)):
            if wanted:
                print("\n" + "\n".join(lines(some)))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    data = Path(__file__).parents[2] / "shared" / "data"
    one = commands.add_parser("run", help="run estimators and write their rows")
    one.add_argument("--set", required=True, choices=SETS)
    one.add_argument("--output", type=Path, required=True, help="file of rows; outlines of real frames are kept beside")
    one.add_argument("--data", type=Path, default=data)
    one.add_argument("--frames", default="", help="parts of names of frames, separated by commas")
    one.add_argument("--variants", default="", help="names of variants, separated by semicolons")
    one.add_argument("--estimators", default="", help="names, separated by commas")
    one.add_argument("--all", action="store_true", help="real: every frame in every variant")
    one.add_argument("--seed", type=int, default=7001, help="gauntlet")
    one.add_argument("--images", type=int, default=150, help="gauntlet")
    one.add_argument("--views", type=int, default=4, help="stress: views of a case")
    one.add_argument("--first", type=int, default=0, help="stress: number of the first view")
    one.add_argument("--draws", type=int, default=1, help="stress: noise draws of a view")
    one.add_argument("--processes", type=int, default=1)
    one.add_argument("--fresh-auto", action="store_true", help="let auto run its estimators again")
    one.set_defaults(command=run)
    two = commands.add_parser("score", help="print the table of rows")
    two.add_argument("files", type=Path, nargs="+")
    two.add_argument("--json", action="store_true")
    two.add_argument("--flags", action="store_true", help="flags on correct and on wrong fixes")
    two.add_argument("--by-frame", action="store_true", help="frames as they are, one by one")
    two.add_argument("--silent", action="store_true", help="each silent error")
    two.add_argument("--compare", action="store_true", help="rows of the second file that differ from the first")
    two.set_defaults(command=score)
    three = commands.add_parser("answerable", help="print the list of what can be answered")
    three.add_argument("--data", type=Path, default=data)
    three.add_argument("--output", type=Path, default=Path("outlines/list"), help="outlines are kept beside")
    three.set_defaults(command=write_list)
    given = parser.parse_args()
    given.command(given)


if __name__ == "__main__":
    main()
