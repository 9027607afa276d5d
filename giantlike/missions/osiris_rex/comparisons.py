"""Comparisons of the paper and the replay, with the rules that decide on agreement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.missions.osiris_rex.calibrations import CameraCalibration
from giantlike.missions.osiris_rex.campaigns import CampaignResult
from giantlike.missions.osiris_rex.phases import OrbitFit, Residual
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.missions.osiris_rex.setup import MissionSetup, PhaseSetup
from giantlike.missions.replay import DERIVED, INDEPENDENT, INPUT, SELF_CHECK, Comparison, ComparisonKind, Stated

AROUND = 2.0  # factor within which a number agrees with one that the paper calls "near" or "around": it gives one digit
TYPICAL_SHARE = 0.9  # fraction of the residuals, per axis, required below the limit that the paper calls typical
_FALSE_ALARM = 0.001  # probability of chi-square below which errors contradict their covariance
UNRESOLVED_PX = 5.0
"""Apparent diameter, px, up to which Bennu counts as unresolved, twice the width of the point spread function; the
paper gives no limit."""
LIMB_PX = 20.0  # apparent diameter, px, from which limbs are looked at: about 60 px of outline
STAR_PX, CENTER_PX = 0.1, 1.0
"""The paper's words: star residuals "around 0.1 pixels", centers "typically less than 1 pixel"."""
SIZE_SHARE = 0.2  # relative difference up to which a size agrees that the paper calls "approximately"


def fixes(residuals: Sequence[Residual], estimators: Sequence[str]) -> tuple[Residual, ...]:
    """Return the results of estimators where the paper uses them, suspect or not: the paper flags nothing."""
    made_for = {"unresolved": (0.0, UNRESOLVED_PX), "limb_matching": (LIMB_PX, np.inf)}
    found = []
    for each in residuals:
        low, high = made_for.get(each.estimator, (UNRESOLVED_PX, np.inf))
        if each.estimator in estimators and low < each.diameter_px <= high:
            found.append(each)
    return tuple(found)


def table_comparison(calibration: CameraCalibration) -> Comparison:
    """A row of Table 1: parameters that were put in are found again within their covariance."""
    size = len(calibration.truth)
    distance = calibration.squared_distance
    limit = float(chi2.ppf(1.0 - _FALSE_ALARM, size))
    sigma = np.sqrt(np.diag(calibration.result.covariance))
    worst = int(np.argmax(np.abs(calibration.found - calibration.truth) / sigma))
    name = calibration.result.estimated[worst]
    return Stated(
        "Table 1",
        f"{calibration.label}: parameters of the camera model",
        _format_values(calibration.result.estimated, calibration.truth),
        _format_values(calibration.result.estimated, calibration.found),
        INPUT,
    ).agrees(
        distance < limit,
        f"put in and found again from {len(calibration.result.images)} of {calibration.images} simulated images: "
        f"squared distance {distance:.1f} for {size} parameters, agrees below {limit:.1f}; furthest off is {name}, "
        f"by {(calibration.found - calibration.truth)[worst] / sigma[worst]:+.1f} sigma. Rows run down here, so "
        "f_y and p_1 have the other sign than in the paper.",
    )


def calibration_comparison(calibration: CameraCalibration, reference: str) -> Comparison:
    """Figs. 2 to 6: the size of the residuals."""
    return _around(
        f"{calibration.label}: standard deviation of calibration residuals, px",
        calibration.residual_std_px,
        "near 0.1",
        f"{calibration.result.n_used} stars of {calibration.images} images",
        reference,
    )


def structure_comparison(calibrations: Sequence[CameraCalibration]) -> Comparison:
    """Residuals without structure, in all cameras together."""
    parts = [calibration.structure() for calibration in calibrations]
    total, number = sum(part[0] for part in parts), sum(part[1] for part in parts)
    limit = float(chi2.ppf(1.0 - _FALSE_ALARM, number))
    return Stated(
        "Figs. 2-6",
        "structure of calibration residuals: squared means in 4 x 4 cells over their variances, per number",
        "largely random without structure",
        total / number,
        INPUT,
    ).agrees(
        total < limit,
        f"1 for random residuals; agrees below {limit / number:.2f}. The model that makes the images is "
        f"the one fitted.",
    )


def square_pixels_comparison(mission: MissionSetup) -> Comparison:
    """MapCam V of Table 1 against the squareness of all other pixels of the table."""
    setups = mission.cameras.values()
    most = max(abs(each.model.fy_px / each.model.fx_px - 1.0) for each in setups if each.printed_fy_px is None)
    (odd,) = [each for each in setups if each.printed_fy_px is not None]
    assert odd.printed_fy_px is not None
    printed = abs(odd.printed_fy_px) / odd.model.fx_px - 1.0
    return Stated(
        "Table 1",
        f"{odd.label}: |f_y| over f_x, less one",
        printed,
        f"at most {most:.1e} in the other cameras",
        DERIVED,
    ).agrees(
        abs(printed) <= 3.0 * most,
        "agrees within three times the largest of the others. The same pixels under another filter cannot be "
        f"oblong by 0.7 %: {odd.printed_fy_px} is taken for a slip of a digit, and {-odd.model.fy_px} "
        f"({odd.model.fy_px / odd.model.fx_px - 1.0:.1e} from square) was put in.",
    )


def star_comparison(result: CampaignResult, phase: PhaseSetup, reference: str) -> Comparison:
    """Residuals of stars of a phase and camera."""
    stars = result.stars
    what = f"{phase.title}, {result.label}: standard deviation of star residuals, px"
    basis = f"{len(stars.residuals_px)} stars of {stars.solved} of {stars.images} images"
    if not len(stars.residuals_px):
        return _nothing(what, "around 0.1", reference)
    deviation = float(np.std(stars.residuals_px))
    if phase.key != "orbital_a":
        return _around(what, deviation, "around 0.1", basis, reference)
    return Stated(reference, what, "less than 0.1", deviation, INPUT).agrees(
        deviation < STAR_PX, f"{basis}; agrees below {STAR_PX} px. {_WHY_STARS}"
    )


_WHY_STARS = (
    "It follows from signal to noise: detections reach down to the paper's 8 sigma, where a place is good to a tenth "
    "of a pixel, and from the depth of the catalog, which was set after a first result. The paper's centroids are "
    "unweighted fits to thresholded pixels, ours are weighted by the noise."
)


def _around(what: str, ours: float, paper: str, basis: str, reference: str) -> Comparison:
    return Stated(reference, what, paper, ours, INPUT).agrees(
        STAR_PX / AROUND <= ours <= STAR_PX * AROUND, f"{basis}; agrees within a factor of {AROUND:g}. {_WHY_STARS}"
    )


def center_comparison(
    where: str, orbit: OrbitFit, found: Sequence[Residual], words: tuple[str, str, str], reference: str
) -> Comparison:
    """Residuals of centers; ``words``: technique, judgement of the paper, change that breaks the agreement, if any."""
    technique, judgement, change = words
    kind = INDEPENDENT if change else DERIVED
    what = f"{where}: residuals of {technique} against the fitted orbit, px"
    if not found or orbit.solution is None:
        return _nothing(what, judgement, reference, orbit.refused, kind, change)
    residuals, truth = (np.array([getattr(each, name) for each in found]) for name in ("fit_px", "truth_px"))
    share = float(np.mean(np.abs(residuals) < CENTER_PX))
    return Stated(reference, what, judgement, f"rms {_rms(residuals):.3f}, {share:.0%} below 1", kind, change).agrees(
        share >= TYPICAL_SHARE if orbit.redundant else None,
        f"{_format_counts(found)}; agrees where {TYPICAL_SHARE:.0%} per axis are below {CENTER_PX:g} px. "
        f"Against the truth: rms {_rms(truth):.3f} px, {np.mean(np.abs(truth) < CENTER_PX):.0%} below 1. {_of(orbit)}",
    )


def range_comparison(
    where: str, phase: PhaseSetup, orbit: OrbitFit, found: Sequence[Residual], reference: str
) -> Comparison:
    """Residuals of ranges from limbs."""
    limit_percent = 1.0 if phase.key == "approach" else 0.01
    what, paper = (
        f"{where}: residuals of the range against the fitted orbit, % of the range",
        f"less than {limit_percent:g}",
    )
    found = [each for each in found if np.isfinite(each.sigma_percent)]
    if not found or orbit.solution is None:
        return _nothing(what, paper, reference, orbit.refused, INDEPENDENT, "poor_shape")
    percent, truth = (np.array([getattr(each, name) for each in found]) for name in ("fit_percent", "truth_percent"))
    share = float(np.mean(np.abs(percent) < limit_percent))
    reason = f"{_format_counts(found)}; agrees where {TYPICAL_SHARE:.0%} are below {limit_percent:g} %. "
    reason += f"Against the truth: rms {_rms(truth):.3f} %, mean {np.mean(truth):+.3f} %. "
    if phase.key != "approach":
        radius_px = 0.5 * float(np.median([each.diameter_px for each in found]))
        reason += (
            f"0.01 % is {1e-4 * radius_px:.3f} px of the radius, and 2.5 cm on Bennu. The scale of the shape errs "
            f"by {100.0 * phase.model.scale:.3f} %, its heights by {phase.model.error_m:g} m, finer relief is "
            "not in it, and limbs have noise: the fixes' own sigmas are "
            f"{np.median([each.sigma_percent for each in found]):.3f} % (median). "
        )
    ours = f"rms {_rms(percent):.3f}, {share:.0%} below {limit_percent:g}"
    return Stated(reference, what, paper, ours, INDEPENDENT, "poor_shape").agrees(
        share >= TYPICAL_SHARE if orbit.redundant else None, reason + _of(orbit)
    )


def maneuver_comparison(phase: PhaseSetup, orbit: OrbitFit) -> Comparison:
    """Estimated maneuvers against those that were executed."""
    what = f"{phase.title}: errors of estimated maneuvers, squared, by their covariance, per component"
    paper = "(not in the paper)"
    if orbit.solution is None or not len(orbit.maneuver_errors_km_s):
        return Stated("", what, paper, "none estimated", SELF_CHECK).agrees(
            None, orbit.refused or "no maneuver between images"
        )
    errors = orbit.maneuver_errors_km_s.ravel()
    squared = float(errors @ np.linalg.solve(orbit.solution.covariance[9:, 9:], errors))
    low, high = (float(chi2.ppf(tail, len(errors))) / len(errors) for tail in (_FALSE_ALARM / 2, 1 - _FALSE_ALARM / 2))
    return Stated("", what, paper, squared / len(errors), SELF_CHECK).agrees(
        low <= squared / len(errors) <= high,
        f"agrees from {low:.2f} to {high:.2f}. Of {len(orbit.maneuver_errors_km_s)}: planned ones err by "
        f"{1e6 * _rms(orbit.planned_errors_km_s):.2f} mm/s rms, estimated ones by {1e6 * _rms(errors):.2f} mm/s; the "
        f"trajectory by {1e3 * _rms(orbit.position_error_km):.1f} m rms at the images. {_of(orbit)}",
    )


def feature_comparison(where: str, found: Sequence[Residual], images: int) -> Comparison:
    """Surface feature navigation, of which the paper shows no result, against the truth."""
    what = f"{where}: surface feature navigation against the truth, px"
    if not found:
        return Stated("", what, "described, no result shown", "nothing found", SELF_CHECK).agrees(False, "no image.")
    truth = np.array([each.truth_px for each in found])
    percent = np.array([each.truth_percent for each in found])
    share = float(np.mean(np.abs(truth) < CENTER_PX))
    ours = f"{len(found)} of {images} images, rms {_rms(truth):.3f}, range {_rms(percent):.3f} %"
    return Stated("", what, "described, no result shown", ours, SELF_CHECK).agrees(
        share >= TYPICAL_SHARE and 2 * len(found) > images,
        f"{_format_counts(found)}; agrees where more than half of the images have one and {TYPICAL_SHARE:.0%} of the "
        f"errors per axis are below {CENTER_PX:g} px ({share:.0%} are). Landmarks are chosen on the shape model; the "
        "truth has albedo and boulders that it lacks.",
    )


def _of(orbit: OrbitFit) -> str:
    """Sentence on the fit."""
    assert orbit.solution is not None
    chi, number = orbit.solution.chi2, orbit.solution.n_residuals
    return f"The orbit is fitted to {orbit.n_fixes} fixes: chi-square {chi:.0f} of {number} residuals."


def range_error_comparisons(study: RangeErrorStudy) -> tuple[Comparison, Comparison]:
    """The study of wrong ranges: correlation becomes biased, and the other way does not."""
    right = int(np.argmin(np.abs(study.range_errors)))
    moved, kept = (
        np.linalg.norm(each - each[:, right : right + 1], axis=2) for each in (study.correlation_px, study.fitted_px)
    )
    largest = 100.0 * float(np.abs(study.range_errors).max())
    worst, held = float(np.nanmax(moved)), float(np.nanmax(kept))
    own = float(np.nanmax(np.linalg.norm(study.correlation_px[:, right], axis=1)))
    lost = int(np.isnan(kept).sum())
    return (
        Stated(
            "Template Matching, ref. 22",
            f"shift of the correlation peak by range errors up to {largest:.0f} %, px",
            "can begin to become biased",
            worst,
            INDEPENDENT,
            "range_known",
        ).agrees(
            worst > own,
            f"agrees where the shift exceeds the error without a range error, {own:.2f} px, which unlisted relief "
            "of 1 % and another law of reflection cause. The lit part of a body grows away from its center.",
        ),
        Stated(
            "Template Matching, ref. 22",
            f"shift of the template fitted in range too, at the same errors up to {largest:.0f} %, px",
            "an alternative template matching technique",
            held,
            SELF_CHECK,
        ).agrees(
            held < 0.1 * worst and not lost,
            f"agrees where it is less than a tenth of the other and none is lost ({lost} of {kept.size} are). The "
            "technique of ref. 22 itself is not in the paper: this is the package's own.",
        ),
    )


def size_comparison(
    phase: PhaseSetup, key: str, paper: str, sizes: tuple[Float, Float], low: float, high: float
) -> Comparison:
    """Apparent diameters in a phase: ``sizes`` as flown and by kernels, px; the latter NaN where there are none."""
    flown, known = sizes
    covered = np.isfinite(known)
    size = np.where(covered, known, flown)
    whence = f"{covered.sum()} of {len(size)} by the mission's trajectory kernels, the others as flown here"
    if not covered.any():
        whence = "as flown here, by waypoints that were chosen for the paper's sizes"
    return Stated(
        phase.title,
        f"{phase.title}, {key}: apparent diameter of Bennu, px",
        paper,
        f"{size.min():.0f}-{size.max():.0f}",
        DERIVED if covered.all() else INPUT,
    ).agrees(
        low * (1.0 - SIZE_SHARE) <= size.min() and size.max() <= high * (1.0 + SIZE_SHARE),
        f"{whence}; agrees from {low:g} to {high:g} within {SIZE_SHARE:.0%}.",
    )


def mapcam_field_comparison(mission: MissionSetup) -> Comparison:
    """Compare the size of Bennu with the field of MapCam in Detailed Survey."""
    ratio = mission.cameras["mapcam"].model.focal_length_px / mission.cameras["navcam1"].model.focal_length_px
    low, high, side = 200.0 * ratio, 600.0 * ratio, float(mission.cameras["mapcam"].columns)
    return Stated(
        "Detailed Survey",
        "Detailed Survey: apparent diameter of Bennu in MapCam, px of 1024",
        "larger than the field of view",
        f"{low:.0f}-{high:.0f}",
        DERIVED,
    ).agrees(
        low > side,
        f"the paper's 200-600 px in NavCam 1 times {ratio:.2f}, the ratio of focal lengths of Table 1; agrees "
        f"where even the smallest exceeds {side:.0f}. Below {side / ratio:.0f} px in NavCam 1 Bennu fits into "
        "MapCam: the sentence holds for most of the phase, not for its farthest images.",
    )


def _format_values(names: Sequence[str], values: Float) -> str:
    return ", ".join(f"{name} {value:.6g}" for name, value in zip(names, values.tolist(), strict=True))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _format_counts(found: Sequence[Residual]) -> str:
    suspect = sum(each.status == "suspect" for each in found)
    return f"{len(found)} fixes" + (f", {suspect} of them flagged suspect" if suspect else "")


def _nothing(
    what: str, paper: str, reference: str, why: str = "", kind: ComparisonKind = INDEPENDENT, change: str = ""
) -> Comparison:
    return Stated(reference, what, paper, "nothing found", kind, change).agrees(
        False, why or "agrees only where something was found."
    )
