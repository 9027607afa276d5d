"""Estimators on one image of the gauntlet, and the verdict on each answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from giantlike.core.arrays import Float, finite_or_none
from giantlike.core.causes import IN_IMAGE, IN_POSITION, Cause, sum_parts
from giantlike.core.outcomes import AttitudeFix, CenterFix, Failure, PositionFix
from giantlike.gauntlet.rule import STARS, Facts, Verdict, facts_of, fits, solvable
from giantlike.gauntlet.stage import Stage
from giantlike.io.tables import column
from giantlike.relative import ESTIMATORS
from giantlike.relative.place import place_jacobian
from giantlike.stars import StarNavigation

RIGHT_SIGMAS, WRONG_SIGMAS = 4.0, 5.0
"""Limits, sigma: an ok answer within the first is correct, beyond the second an undetected failure if it also
matters."""
WRONG_PX, WRONG_RANGE = 0.5, 0.005  # errors of the center, px, and of the range, relative, from which on they matter
VAGUE_FACTOR = 3.0  # ratio of sigma to the nominal one above which an answer is vague
NAMES = (*ESTIMATORS, STARS)  # names of all estimators of the gauntlet, the star chain last
_STATED = (Cause.CAMERA, Cause.SHAPE_SCALE, Cause.POLE, Cause.SPIN, Cause.ORIENTATION, Cause.ABERRATION, Cause.EPOCH)
"""Parts of a covariance that are declared with the image, not measured in it."""
_SURFACE_PX = 180.0  # least diameter for surface_features: landmarks need a few hundred facets each
_SMALL_PX = 12.0  # largest diameter, px, of bodies on which unresolved is tried
Outcome: TypeAlias = AttitudeFix | CenterFix | Failure  # result of the star chain or an estimator
_OK, _SUSPECT, _FAILED, _RAISED = "ok", "suspect", "failed", "raised"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialRow:
    """One row per image and estimator of the gauntlet."""

    image: int = column("Number of the image, from 0.")
    kind: str = column("Kind of the image.")
    estimator: str = column("Estimator, or `stars`.")
    verdict: str = column("Verdict.")
    status: str = column("`ok`, `suspect`, `failed`, or `raised` for an exception.")
    reason: str | None = column("Reason of a failure; flags that make a fix suspect, joined by `|`.")
    solvable: int = column("1 where the rule demanded an answer beforehand.")
    sigmas: float | None = column("Largest error over its sigma: center (two axes together), range, roll.")
    error_px: float | None = column("Error of the center; of stars, of the boresight.", "px")
    sigma_px: float | None = column("One sigma of it by axis.", "px")
    nominal_sigma_px: float | None = column("The same without what is wrong with the image.", "px")
    range_error: float | None = column("Relative error of the range; of stars, of the roll at the edge in px.")
    range_sigma: float | None = column("One sigma of it.")
    nominal_range_sigma: float | None = column("The same without what is wrong with the image.")
    cpu_s: float = column("Computing time of the estimator.", "s")
    detail: str | None = column("Reason of a failure in words.")


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Outcome of an estimator, in numbers."""

    status: str  # ok, suspect, failed or raised
    reason: str = ""
    detail: str = ""
    error_px: float = math.nan  # error_px, sigma_px: of the center: length of the error, and sigma by axis
    sigma_px: float = math.nan
    range_error: float = math.nan  # range_error, range_sigma: relative, or NaN; of stars, roll in px at the edge
    range_sigma: float = math.nan
    center_sigmas: float = math.nan  # center_sigmas, range_sigmas: errors / sigmas
    range_sigmas: float = math.nan
    prior_px: float = 0.0  # prior_px, prior_range: sigmas of the errors declared with the image
    prior_range: float = 0.0
    cpu_s: float = 0.0

    @property
    def sigmas(self) -> float:
        """Largest error over its sigma."""
        return float(np.nanmax([self.center_sigmas, self.range_sigmas])) if self.status in (_OK, _SUSPECT) else math.nan

    @property
    def own_px(self) -> float:
        """Sigma of the center without the declared errors, px."""
        return math.sqrt(max(self.sigma_px**2 - self.prior_px**2, 0.0))

    @property
    def own_range(self) -> float:
        """Sigma of the range without the declared errors; 0 where the range is not estimated."""
        return 0.0 if math.isnan(self.range_sigma) else math.sqrt(max(self.range_sigma**2 - self.prior_range**2, 0.0))


def names_for(stage: Stage, facts: Facts) -> tuple[str, ...]:
    """Return the estimators that apply to an image."""
    names: list[str] = [STARS] if stage.kind.stars else []
    if stage.scene is None:
        return tuple(names)
    skipped = set()
    if facts.told_diameter_px > _SMALL_PX:
        skipped.add("unresolved")
    if facts.told_ellipsoid or facts.told_diameter_px < _SURFACE_PX:
        skipped.add("surface_features")
    return (*names, *(name for name in ESTIMATORS if name not in skipped))


def answer_of(stage: Stage, name: str) -> Answer:
    """Run an estimator on an image and compare with the truth."""

    def estimate() -> Outcome:
        if name == STARS:
            assert stage.catalog is not None
            return StarNavigation(stage.camera, stage.catalog).solve(stage.image)
        assert stage.scene is not None
        return ESTIMATORS[name]().estimate(stage.image, stage.camera, stage.scene)

    fix, answer = outcome_of(estimate)
    if fix is None or isinstance(fix, Failure):
        return answer
    compared = attitude_error(stage, fix) if isinstance(fix, AttitudeFix) else place_error(stage, fix)
    return replace(compared, status=answer.status, reason=answer.reason, cpu_s=answer.cpu_s)


def outcome_of(estimate: Callable[[], Outcome]) -> tuple[Outcome | None, Answer]:
    """Run an estimator, and return its status, reason and time."""
    began = time.process_time()
    try:
        fix = estimate()
    except Exception as error:  # noqa: BLE001 - the border of a worker: one image must never end a run
        detail = " ".join(str(error).split())
        spent = time.process_time() - began
        return None, Answer(status=_RAISED, reason=type(error).__name__, detail=detail, cpu_s=spent)
    spent = time.process_time() - began
    if isinstance(fix, Failure):
        return fix, Answer(status=_FAILED, reason=str(fix.reason), detail=fix.detail, cpu_s=spent)
    suspect = "|".join(flag for flag in fix.flags.names() if type(fix.flags)[flag.upper()].suspect)
    return fix, Answer(status=_SUSPECT if suspect else _OK, reason=suspect, cpu_s=spent)


def place_error(stage: Stage, fix: CenterFix) -> Answer:
    """Compare the position of a body with the truth: its center in the image, if there, and its range.

    Range errors count with all parts between the pixels and camera axes; attitude and ephemeris are not measured.
    """
    error = fix.center_px - stage.world.center_px
    parts = fix.parts or {Cause.NOISE: _own_covariance(stage, fix)}
    stated = {cause: part for cause, part in parts.items() if cause in _STATED}
    prior = sum_parts(stated | _zero(parts), Cause)
    seen = sum_parts({cause: part for cause, part in stated.items() if cause in IN_IMAGE} | _zero(parts), Cause)
    answer = _of_center(error, fix.covariance_px2, seen[:2, :2])
    if not isinstance(fix, PositionFix):
        return answer
    ratio, sigma = math.log(fix.range_km / stage.world.range_km), math.sqrt(sum_parts(parts, IN_POSITION)[2, 2])
    return replace(
        answer,
        range_error=ratio,
        range_sigma=sigma,
        range_sigmas=abs(ratio) / max(sigma, 1e-12),
        prior_range=math.sqrt(float(prior[2, 2])),
    )


def _zero(parts: Mapping[Cause, Float]) -> dict[Cause, Float]:
    """A zero part, so that an empty sum has the correct size."""
    return {Cause.EPOCH: np.zeros_like(next(iter(parts.values())))}


def _own_covariance(stage: Stage, fix: CenterFix) -> Float:
    """Covariance of x, y and, where it is estimated, the logarithm of the range, of a fix without parts."""
    if not isinstance(fix, PositionFix):
        return fix.covariance_px2
    jacobian = place_jacobian(stage.camera.model, fix.position_camera_km)
    return np.asarray(jacobian @ fix.covariance_camera_km2 @ jacobian.T, dtype=float)


def _of_center(error: Float, covariance: Float, prior: Float) -> Answer:
    """Length of an error, sigma by axis, and the error over its sigma (Mahalanobis distance)."""
    floor = covariance + 1e-12 * np.eye(2)
    return Answer(
        status=_OK,
        error_px=float(np.hypot(*error)),
        sigma_px=math.sqrt(0.5 * float(np.trace(covariance))),
        center_sigmas=math.sqrt(float(error @ np.linalg.solve(floor, error))),
        prior_px=math.sqrt(0.5 * float(np.trace(prior))),
    )


def attitude_error(stage: Stage, fix: AttitudeFix) -> Answer:
    """Compare an attitude with the truth: the boresight in px, and the roll in px at the edge of the frame."""
    error = (stage.world.attitude * fix.camera_from_inertial.inv()).as_rotvec()
    focal, edge = stage.world.view.focal_px, 0.5 * stage.world.view.columns
    roll, sigma = abs(float(error[2])), math.sqrt(float(fix.covariance_rad2[2, 2]))
    prior = sum((part for cause, part in fix.parts.items() if cause in _STATED), np.zeros((3, 3)))
    return replace(
        _of_center(focal * error[:2], focal**2 * fix.covariance_rad2[:2, :2], focal**2 * prior[:2, :2]),
        range_error=edge * roll,
        range_sigma=edge * sigma,
        range_sigmas=roll / max(sigma, 1e-15),
        prior_range=edge * math.sqrt(float(prior[2, 2])),
    )


def verdict_of(answer: Answer, facts: Facts, *, demanded: bool, stars: bool = False) -> Verdict:
    """Judge an answer, but for its vagueness."""
    if answer.status != _OK:
        if demanded:
            return Verdict.NEEDLESS_REFUSAL
        raised = answer.status == _RAISED
        true = answer.status == _SUSPECT or (not raised and fits(answer.reason, facts))
        return Verdict.HONEST if true else Verdict.MISLEADING
    if facts.absent and not stars:
        return Verdict.SILENT_WRONG
    center = answer.center_sigmas > WRONG_SIGMAS and answer.error_px > WRONG_PX
    limit = WRONG_PX if stars else WRONG_RANGE
    distance = answer.range_sigmas > WRONG_SIGMAS and abs(answer.range_error) > limit
    if center or distance or not math.isfinite(answer.center_sigmas):
        return Verdict.SILENT_WRONG
    return Verdict.RIGHT if answer.sigmas <= RIGHT_SIGMAS else Verdict.DOUBTFUL


def is_vague(answer: Answer, nominal: Answer) -> bool:
    """True if sigmas are more than 3 times those of a nominal fix, if any, both without the declared errors."""
    if nominal.status not in (_OK, _SUSPECT):
        return False
    center = answer.own_px > VAGUE_FACTOR * nominal.own_px
    distance = answer.own_range > VAGUE_FACTOR * nominal.own_range
    return bool(center or distance)


def trial(stage: Stage, estimators: Sequence[str] = ()) -> list[TrialRow]:
    """Run all estimators that apply to an image."""
    facts = facts_of(stage.plan, stage.signal_dn, undisturbed=stage.kind.undisturbed)
    return [_row(stage, facts, name) for name in names_for(stage, facts) if not estimators or name in estimators]


def _row(stage: Stage, facts: Facts, name: str) -> TrialRow:
    answer = answer_of(stage, name)
    demanded = solvable(name, facts)
    verdict = verdict_of(answer, facts, demanded=demanded, stars=name == STARS)
    nominal = None
    if verdict is Verdict.RIGHT:
        nominal = answer if stage.kind.undisturbed else answer_of(stage.undisturbed, name)
        if is_vague(answer, nominal):
            verdict = Verdict.VAGUE
    numbers = {each: getattr(answer, each) for each in ("sigmas", "error_px", "sigma_px", "range_error", "range_sigma")}
    if nominal is not None:
        numbers |= {"nominal_sigma_px": nominal.sigma_px, "nominal_range_sigma": nominal.range_sigma}
    return TrialRow(
        image=stage.index,
        kind=stage.kind.name,
        estimator=name,
        verdict=str(verdict),
        status=answer.status,
        reason=answer.reason or None,
        solvable=int(demanded),
        cpu_s=answer.cpu_s,
        detail=answer.detail or None,
        **{each: finite_or_none(float(value)) for each, value in numbers.items()},
    )
