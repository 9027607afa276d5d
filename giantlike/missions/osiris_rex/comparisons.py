"""Comparisons of the paper and the replay, with the rules that decide on agreement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.missions.osiris_rex.calibrations import CameraCalibration
from giantlike.missions.osiris_rex.campaigns import CampaignResult
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.missions.osiris_rex.setup import MissionSetup, PhaseSetup
from giantlike.missions.replay import DERIVED, INDEPENDENT, INPUT, SELF_CHECK, Comparison, Stated
from giantlike.simulation.compare import ObservationError

AROUND = 2.0
"""Factor within which a number agrees with one that the paper calls "near" or "around": it gives one digit."""
TYPICAL_SHARE = 0.9
"""Fraction of the residuals, per axis, required below the limit that the paper calls typical."""
_FALSE_ALARM = 0.001
"""Probability of chi-square below which errors contradict their covariance."""
UNRESOLVED_PX = 5.0
"""Apparent diameter, px, up to which Bennu counts as unresolved, twice the width of the point spread function; the
paper gives no limit."""
LIMB_PX = 20.0
"""Apparent diameter, px, from which limbs are looked at: about 60 px of outline."""
STAR_PX, CENTER_PX = 0.1, 1.0
"""The paper's words: star residuals "around 0.1 pixels", centers "typically less than 1 pixel"."""
SIZE_SHARE = 0.2
"""Relative difference up to which a size agrees that the paper calls "approximately"."""


def fixes(result: CampaignResult, estimators: Sequence[str]) -> tuple[ObservationError, ...]:
    """Return the results of estimators where the paper uses them, suspect or not: the paper flags nothing.

    Images without an attitude from stars have no residual of the center and are left out.
    """
    made_for = {"unresolved": (0.0, UNRESOLVED_PX), "limb_matching": (LIMB_PX, np.inf)}
    found = []
    for error in result.observations:
        low, high = made_for.get(error.estimator, (UNRESOLVED_PX, np.inf))
        if error.estimator in estimators and error.error_px is not None and low < error.diameter_px <= high:
            found.append(error)
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
    result: CampaignResult,
    phase: PhaseSetup,
    errors: Sequence[ObservationError],
    words: tuple[str, str],
    reference: str,
) -> Comparison:
    """Residuals of centers; ``words`` are our name of the technique and the paper's judgement."""
    technique, judgement = words
    rendered = technique != "limb centers"  # images and templates then are of one renderer
    kind, change = (SELF_CHECK, "") if rendered else (INDEPENDENT, "poor_shape")
    what = f"{phase.title}, {result.label}: residuals of {technique}, px"
    if not errors:
        return _nothing(what, judgement, reference)
    residuals = np.abs(errors_px(errors))
    share = float(np.mean(residuals < CENTER_PX))
    goal = f"{TYPICAL_SHARE:.0%} of the residuals per axis are below {CENTER_PX:g} px"
    reason = f"{_format_counts(errors)}; agrees where {goal}."
    if phase.key != "approach":  # where sizes differ by a factor of ten thousand
        reason += (
            f" They are {_rms_m(errors, result.diameter_km):.2f} m rms on Bennu; the heights of the shape model err by "
            f"{phase.model.error_m:g} m."
        )
    return Stated(reference, what, judgement, f"rms {_rms(residuals):.3f}, {share:.0%} below 1", kind, change).agrees(
        share >= TYPICAL_SHARE, reason
    )


def range_comparison(
    result: CampaignResult, phase: PhaseSetup, errors: Sequence[ObservationError], reference: str
) -> Comparison:
    """Residuals of ranges from limbs."""
    limit_percent = 1.0 if phase.key == "approach" else 0.01
    what = f"{phase.title}, {result.label}: residuals of the range, % of the range"
    paper = f"less than {limit_percent:g}"
    if not errors:
        return _nothing(what, paper, reference)
    percent = 100.0 * np.array([error.range_error for error in errors], dtype=np.float64)
    share = float(np.mean(np.abs(percent) < limit_percent))
    reason = f"{_format_counts(errors)}; agrees where {TYPICAL_SHARE:.0%} are below {limit_percent:g} %."
    if phase.key != "approach":
        radius_px = 0.5 * float(np.median([error.diameter_px for error in errors]))
        reason += (
            f" 0.01 % is {1e-4 * radius_px:.3f} px of the radius, and 2.5 cm on Bennu. The scale of the shape model is "
            f"uncertain by {100.0 * phase.model.scale:.3f} %, which a limb turns into range, as it does the mean of "
            f"errors of height: mean {np.mean(percent):+.3f} %. Around it they scatter by {np.std(percent):.3f} %: "
            f"errors of height of {phase.model.error_m:g} m, relief finer than facets of the model, noise of the limb. "
            "Orbit determination that estimates the scale takes out the mean only."
        )
    return Stated(
        reference,
        what,
        paper,
        f"rms {_rms(percent):.3f}, {share:.0%} below {limit_percent:g}",
        INDEPENDENT,
        "poor_shape",
    ).agrees(share >= TYPICAL_SHARE, reason)


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


def approach_size_comparison(mission: MissionSetup, results: Sequence[CampaignResult]) -> Comparison:
    """Bennu grows to more than 1,000 px in PolyCam by the end of Approach."""
    last = min((visit for result in results for visit in result.visits), key=lambda visit: visit.range_km)
    focal_px = mission.cameras["polycam"].model.focal_length_px
    largest = 2.0 * mission.body.mean_radius_km * focal_px / last.range_km
    return Stated(
        "Approach",
        "Approach: apparent diameter of Bennu in PolyCam at the end, px",
        "greater than 1000",
        largest,
        DERIVED if last.from_kernels else INPUT,
    ).agrees(
        largest > 1000.0,
        f"mean diameter of 0.490 km at {last.range_km:.1f} km, {_whence(last.from_kernels)}; agrees above 1,000.",
    )


def survey_size_comparison(result: CampaignResult, phase: PhaseSetup, limits: tuple[float, float]) -> Comparison:
    """Apparent diameters in NavCam 1 during a survey."""
    low, high = float(result.diameters_px.min()), float(result.diameters_px.max())
    known = all(visit.from_kernels for visit in result.visits)
    return Stated(
        phase.title,
        f"{phase.title}, {result.label}: apparent diameter of Bennu, px",
        f"approximately {limits[0]:.0f}-{limits[1]:.0f}",
        f"{low:.0f}-{high:.0f}",
        DERIVED if known else INPUT,
    ).agrees(
        limits[0] * (1.0 - SIZE_SHARE) <= low and high <= limits[1] * (1.0 + SIZE_SHARE),
        f"{_whence(known)}; agrees where both ends lie within {SIZE_SHARE:.0%} of the paper's.",
    )


def orbit_size_comparison(mission: MissionSetup, phase: PhaseSetup) -> Comparison:
    """Apparent diameter in NavCam 1 from the radius of the orbit."""
    range_km = phase.campaigns[0].visits[0].range_km
    size = 2.0 * mission.body.mean_radius_km * mission.cameras["navcam1"].model.focal_length_px / range_km
    return Stated(
        "Orbital A", "Orbital A: apparent diameter of Bennu in NavCam 1, px", "approximately 1000", size, DERIVED
    ).agrees(
        abs(size / 1000.0 - 1.0) <= SIZE_SHARE,
        f"f_x of Table 1 and the orbit's radius of {range_km:g} km, with the known diameter of 0.490 km; "
        f"agrees within {SIZE_SHARE:.0%}.",
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


def _whence(kernels: bool) -> str:
    return "by the mission's trajectory kernels" if kernels else "simulated trajectory, rebuilt from the paper's sizes"


def errors_px(errors: Sequence[ObservationError]) -> Float:
    """Residuals (n, 2) of centers, px."""
    return np.array([error.error_px for error in errors], dtype=np.float64)


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rms_m(errors: Sequence[ObservationError], diameter_km: float) -> float:
    """Root mean square of residuals on Bennu, m, per axis."""
    scale = np.array([1e3 * diameter_km / error.diameter_px for error in errors])
    return _rms(errors_px(errors) * scale[:, None])


def _format_counts(errors: Sequence[ObservationError]) -> str:
    suspect = sum(error.status == "suspect" for error in errors)
    return f"{len(errors)} fixes against the truth" + (f", {suspect} of them flagged suspect" if suspect else "")


def _nothing(what: str, paper: str, reference: str) -> Comparison:
    return Stated(reference, what, paper, "nothing found", INDEPENDENT).agrees(
        False, "agrees only where something was found."
    )
