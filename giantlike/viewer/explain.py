"""Explanation of an image of a run, or of a fix, in words: prediction, results, rejections, decisive check."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from giantlike.campaign.store.fix_differences import difference_of
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, Problem, TargetRecord
from giantlike.core.attribute_docs import attribute_docs
from giantlike.core.causes import Cause
from giantlike.core.outcomes import AttitudeFix, CenterFix, Failure, Quality, Reason
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.relative.judge import FALSE_ALARM, Alternative
from giantlike.viewer.session import SeenImage, chosen_fix

_SOURCES = {
    "stars": "from its own stars",
    "interpolated": "from the star images before and after it",
    "a_priori": "as given beforehand: no stars were solved",
}


def explain(answer: SeenImage | AttitudeFix | CenterFix | Failure) -> str:
    """Explain the results of an image of a run, or the result of an estimator or of star navigation.

    Returns
    -------
    str
        Paragraphs of plain text.
    """
    if isinstance(answer, SeenImage):
        return _explained_image(answer)
    if isinstance(answer, Failure):
        return _problem(answer)
    lines = [repr(answer), f"Observations used: {answer.n_used}, {answer.n_rejected} rejected."]
    checks = answer.findings.checks if isinstance(answer, CenterFix) else {}
    lines += [*_causes(answer.parts, checks), *_flags(answer.flags.names()), *_tests(checks)]
    return "\n".join(lines)


def _explained_image(seen: SeenImage) -> str:
    """Paragraphs on an image of a run."""
    lines = [*_image(seen.record), *_attitude(seen.record)]
    for name in dict.fromkeys(one.target for one in seen.observations):
        there = [one for one in seen.observations if one.target == name]
        known = next((target for target in seen.targets if target.target == name), None)
        lines += ["", *_target(name, there, known)]
        for one in there:
            lines += [f"  {one.estimator}: {one.outcome.words}", *(f"    {line}" for line in _observation(one))]
        lines += [f"  {line}" for line in _together(seen, name, there)]
    for edit in seen.edits:
        lines += ["", f"{edit.decision} ({edit.name}): {edit.who}, {edit.when_utc}: {edit.why}"]
        if edit.action == "accept" and edit.name not in seen.names_accepted:
            lines.append("  The result is another one since: accept it again where it is right.")
    return "\n".join(lines)


def _image(record: AttitudeRecord) -> Iterator[str]:
    if not record.readable:
        yield f"{record.file}: could not be read."
        return
    epoch = "no epoch" if record.epoch_utc is None else record.epoch_utc
    exposure = "exposure unknown" if record.exposure_s is None else f"exposure {record.exposure_s:g} s"
    yield f"{record.file}: {record.columns} x {record.rows} px, {epoch}, {exposure}."
    yield from (f"Note: {note}." for note in record.notes)


def _attitude(record: AttitudeRecord) -> Iterator[str]:
    yield ""
    if record.problem is not None:
        yield f"Attitude: {record.outcome.words}. {_problem(record.problem)}"
        if record.n_detected is not None:
            yield f"  {record.n_detected} detections, {record.n_matched or 0} of them identified."
        return
    attitude = record.attitude
    if attitude is None:
        return
    yield f"Attitude: {record.status}, {_SOURCES.get(attitude.source, attitude.source)}."
    if record.ra_deg is not None:
        yield f"  Boresight at right ascension {record.ra_deg:.5f} deg, declination {record.dec_deg:.5f} deg."
    sigma = attitude.sigma_rad * ARCSEC_PER_RAD
    if np.isfinite(sigma).all():
        yield f"  Sigma about the camera axes {sigma[0]:.3g}, {sigma[1]:.3g}, {sigma[2]:.3g} arcsec."
    if record.n_matched:
        yield (
            f"  {record.n_detected} detections, {record.n_matched} matched with catalog stars, "
            f"{record.n_rejected or 0} matches rejected; residual rms {record.rms_px:.3f} px."
        )
        if record.false_match_probability is not None:
            chance = max(record.false_match_probability, sys.float_info.min)
            yield f"  Chance that the identification is false: at most {chance:.1g}."
    if record.attitude_shares:
        shares = ", ".join(f"{file} ({share:.0%})" for file, share in record.attitude_shares.items())
        yield f"  Made of {shares}."
    yield from (f"  {line}" for line in [*_flags(record.flags), *_acceptance(record)])


def _target(name: str, there: Sequence[ObservationRecord], known: TargetRecord | None) -> Iterator[str]:
    predicted = next((one for one in there if one.predicted_px is not None), None)
    if predicted is None or predicted.predicted_px is None:
        yield f"{name}: its place in the image is not known beforehand."
        return
    text = f"{name}: predicted at ({predicted.predicted_px[0]:.2f}, {predicted.predicted_px[1]:.2f}) px"
    if predicted.predicted_camera_km is not None:
        text += f", range {_digits(math.hypot(*predicted.predicted_camera_km), 6)} km"
        if known is not None and known.sighting is not None:
            text += f", phase angle {_phase_deg(predicted.predicted_camera_km, known):.1f} deg"
    if known is not None and known.view is not None and known.view.diameter_px is not None:
        text += f", {known.view.diameter_px:.1f} px across (the sphere of its volume)"
    yield f"{text}."
    if known is not None and known.note:
        yield f"  Note: {known.note}."


def _phase_deg(position_camera_km: Sequence[float], known: TargetRecord) -> float:
    assert known.sighting is not None
    position = np.array(position_camera_km)
    cosine = -float(np.array(known.sighting.sun_direction_camera) @ position) / float(np.linalg.norm(position))
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))


def _observation(one: ObservationRecord) -> Iterator[str]:
    words = {"start": "Started by hand", "masked": "Masked", "landmarks_rejected": "Landmarks rejected by hand"}
    by_hand = [f"{words[name]}: {one.provenance[name]}." for name in words if name in one.provenance]
    if one.problem is not None:
        yield _problem(one.problem)
        yield from by_hand
        return
    yield from [*by_hand, *_place(one)]
    if one.n_used is not None:
        rejected = "" if not one.n_rejected else f", {one.n_rejected} rejected"
        yield f"Observations used: {one.n_used}{rejected}."
    yield from _causes(one.parts or {}, one.checks)
    yield from [*_flags(one.flags), *_acceptance(one)]
    yield from _tests(one.checks)
    if not one.checks and "checks" in one.provenance:  # a run of an earlier version
        yield f"Numbers of its checks: {one.provenance['checks']}."
    if "checked_by" in one.provenance:
        yield f"Checked by {one.provenance['checked_by']}."


def _place(one: ObservationRecord) -> Iterator[str]:
    if one.center_px is None or one.covariance_px2 is None:
        return
    sigma = np.sqrt(np.diag(np.array(one.covariance_px2)))
    text = f"Center at ({one.center_px[0]:.3f}, {one.center_px[1]:.3f}) px, sigma ({sigma[0]:.2g}, {sigma[1]:.2g}) px"
    if one.predicted_px is not None:
        off = np.subtract(one.center_px, one.predicted_px)
        text += f"; observed minus predicted ({off[0]:+.3f}, {off[1]:+.3f}) px"
    yield f"{text}."
    if one.range_km is not None and one.sigma_range_km is not None:
        text = f"Range {_digits(one.range_km, 8)} km, sigma {_digits(one.sigma_range_km, 2)} km"
        if one.predicted_camera_km is not None:
            predicted = math.hypot(*one.predicted_camera_km)
            text += f"; observed minus predicted {_digits(one.range_km - predicted, 4, '+')} km"
        yield f"{text}."


def _digits(value: float, digits: int, sign: str = "") -> str:
    """A number rounded to so many digits, without an exponent where it is large: 73094089, 74000."""
    if abs(value) < 10.0**digits:
        return f"{value:{sign}.{digits}g}"
    return f"{float(f'{value:.{digits}g}'):{sign}.0f}"


def _causes(parts: Mapping[Cause, Any], checks: Mapping[str, float]) -> Iterator[str]:
    """Fractions of the causes in the variance, largest first, with the inflation for a mismatch of image and render."""
    sizes = {str(cause): float(np.trace(np.array(part)[:2, :2])) for cause, part in parts.items()}
    total = sum(sizes.values())
    if total > 0:
        ranked = sorted(sizes.items(), key=lambda item: -item[1])
        shares = [f"{cause} {size / total:.0%}" for cause, size in ranked if size >= 0.01 * total]
        yield f"Variance by cause: {', '.join(shares)}."
    tension = checks.get("tension", 1.0)
    if tension > 1.0:
        yield (
            f"The parts that only this fix has were multiplied by {tension:.3g} (tension): rendered at the fix, the "
            "body matches the image better when it is moved, strained or smeared."
        )


def _tests(checks: Mapping[str, float]) -> Iterator[str]:
    """Likelihood ratios of other models and of another position, and p-value of the offset from the prediction."""
    odds = {one: checks[f"{one}_log_odds"] for one in Alternative if f"{one}_log_odds" in checks}
    if odds:
        ranked = sorted(odds.items(), key=lambda item: -item[1])
        limit = _power(math.log(len(Alternative) / FALSE_ALARM))
        listed = ", ".join(f"{one} {_power(number)}" for one, number in ranked)
        yield f"Odds of other models of the image: {listed} (suspect where their sum exceeds {limit})."
    if "other_place_log_odds" in checks:
        place, limit = _power(checks["other_place_log_odds"]), _power(math.log(FALSE_ALARM))
        yield f"Odds of another place in the search region: {place} (suspect above {limit})."
    if "prediction_chance" in checks:
        chance = checks["prediction_chance"]
        yield f"Probability that a right prediction is off by as much: {chance:.2g} (suspect below {FALSE_ALARM:g})."


def _power(logarithm: float) -> str:
    """A number of which the natural logarithm is known, as a power of ten."""
    return f"10^{logarithm / math.log(10.0):.1f}"


def _flags(flags: Sequence[str]) -> Iterator[str]:
    meanings = attribute_docs(Quality)
    for flag in flags:
        kind = "Suspect because" if Quality[flag.upper()].suspect else "Note"
        yield f"{kind}: {flag}. {meanings[flag.upper()]}"


def _acceptance(record: AttitudeRecord | ObservationRecord) -> Iterator[str]:
    if record.accepted is not None:
        yield f"It was {str(record.accepted).rstrip('.')}."


def _problem(problem: Problem | Failure) -> str:
    meaning = attribute_docs(Reason)[Reason(problem.reason).name]
    return f"{problem.reason}: {problem.detail.rstrip('.')}. {meaning}"


def _together(seen: SeenImage, target: str, there: Sequence[ObservationRecord]) -> Iterator[str]:
    """Recommended fix, and the differences of the others from it."""
    best = chosen_fix(seen, target)
    if best is None or best.center_px is None or best.covariance_px2 is None:
        yield "No estimator made a fix."
        return
    yield f"Smallest sigma of the fixes to trust: {best.estimator}."
    for other in there:
        apart = None if other is best else difference_of(other, best)
        if apart is None:
            continue
        text = f"{other.estimator} minus {best.estimator}: ({apart.offset[0]:+.3f}, {apart.offset[1]:+.3f}) px"
        if len(apart.offset) > 2:
            text += f", range {math.expm1(apart.offset[2]):+.3%}"
        yield f"{text}: {apart.sigmas:.1f} sigma, as large by chance once in {1.0 / max(apart.chance, 1e-9):.3g}."
