"""Sections of the report: template matching, calibration and the four phases, in the order of the paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from giantlike.missions.osiris_rex import comparisons, figures
from giantlike.missions.osiris_rex.calibrations import CameraCalibration
from giantlike.missions.osiris_rex.campaigns import CampaignResult
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.missions.osiris_rex.setup import MissionSetup, PhaseSetup
from giantlike.missions.replay import Comparison, ReplayFigure, Section

CALIBRATION_FIGURES = {"polycam": 2, "mapcam": 3, "mapcam_v": 4, "navcam1": 5, "navcam2": 6}
"""Number of the paper's figure by camera."""
PHASE_FIGURES = {
    ("approach", "polycam"): (7, 9, 11, 13),
    ("approach", "mapcam"): (8, 10, 12, 14),
    ("preliminary_survey", "mapcam"): (15, 17, 19, 21),
    ("preliminary_survey", "navcam1"): (16, 18, 20, 22),
    ("orbital_a", "navcam1"): (23, 24, 25, 26),
    ("detailed_survey", "navcam1"): (27, 28, 29, 30),
}
"""Numbers of the paper's figures by phase and camera: stars, centers, centers by limb, ranges by limb."""
_SURVEY_SIZES = {"preliminary_survey": (100.0, 250.0), "detailed_survey": (200.0, 600.0)}
"""Apparent diameters in NavCam 1 that the paper states, px."""
_CENTERS = ("unresolved", "cross_correlation")


def range_error_section(study: RangeErrorStudy) -> Section:
    """The study of wrong ranges."""
    figure = ReplayFigure(
        "ref. 22",
        "Template matching at a wrong range",
        "A body of 200 px from the independent renderer, with relief of 1 % and a law of reflection that the "
        "template does not have, looked for with the predicted range in error.",
        figures.range_error_figure(study),
    )
    return Section(
        title="Template matching",
        text=(
            "The paper names a range error as the weakness of cross-correlation and refers to its reference 22 for "
            "another technique, without numbers. Here the peak of the correlation with one template stands beside the "
            "estimator cross_correlation of the package, which goes on to fit center, range, brightness and law."
        ),
        figures=(figure,),
        comparisons=comparisons.range_error_comparisons(study),
    )


def calibration_section(mission: MissionSetup, calibrations: Sequence[CameraCalibration]) -> Section:
    """Table 1 and Figs. 2 to 6."""
    made, compared = [], [comparisons.table_comparison(each) for each in calibrations]
    compared.append(comparisons.square_pixels_comparison(mission))
    for each in sorted(calibrations, key=lambda one: CALIBRATION_FIGURES[one.key]):
        reference = f"Fig. {CALIBRATION_FIGURES[each.key]}"
        made.append(
            ReplayFigure(
                reference,
                f"Calibration residuals of {each.label}",
                f"{each.result.n_used} stars of {len(each.result.images)} simulated images, "
                f"{each.result.n_rejected} rejected. The paper: near 0.1 px, largely random.",
                figures.calibration_figure(each),
            )
        )
        compared.append(comparisons.calibration_comparison(each, reference))
    compared.append(comparisons.structure_comparison(calibrations))
    return Section(
        title="Camera calibration",
        text=(
            "Star fields are simulated with the cameras of Table 1 at several temperatures and calibrated "
            "from a nominal focal length, "
            "no distortion and the middle of the frame. The phases below use the cameras found here, not those put in."
        ),
        figures=tuple(made),
        comparisons=tuple(compared),
    )


_Panel = tuple[int, str, str, Figure | None, Comparison]
"""Number, title and caption of a figure of the paper, the figure, None where nothing was found, and its comparison."""


def phase_section(mission: MissionSetup, phase: PhaseSetup, results: Sequence[CampaignResult]) -> Section:
    """A phase: its figures in the order of the paper, and the sizes that the paper states."""
    panels = sorted((panel for result in results for panel in _panels(phase, result)), key=lambda panel: panel[0])
    made = tuple(
        ReplayFigure(f"Fig. {number}", title, caption, figure)
        for number, title, caption, figure, _ in panels
        if figure is not None
    )
    compared = (*_sizes(mission, phase, results), *(comparison for *_, comparison in panels))
    return Section(title=phase.title, text=_text(phase, results), figures=made, comparisons=compared)


def _panels(phase: PhaseSetup, result: CampaignResult) -> tuple[_Panel, ...]:
    star_number, center_number, limb_number, range_number = PHASE_FIGURES[result.phase, result.camera]
    centers, limbs = (comparisons.fixes(result, names) for names in (_CENTERS, ("limb_matching",)))
    where, less = f"{phase.title}, {result.label}", "typically less than 1"
    stars = "less than" if phase.key == "orbital_a" else "around"
    bars = "Bars are the standard deviations that the fixes state, hollow marks are flagged suspect."
    return (
        (
            star_number,
            f"{where}: stars",
            f"{len(result.stars.residuals_px)} stars of {result.stars.solved} images. The paper: {stars} 0.1 px.",
            figures.star_figure(result) if len(result.stars.residuals_px) else None,
            comparisons.star_comparison(result, phase, f"Fig. {star_number}"),
        ),
        (
            center_number,
            f"{where}: centers",
            f"Observed less true. The paper: {less} px. {bars}",
            figures.center_figure(result, centers, f"{where}: centers") if centers else None,
            comparisons.center_comparison(result, phase, centers, ("center finding", less), f"Fig. {center_number}"),
        ),
        (
            limb_number,
            f"{where}: centers from limbs",
            f"Observed less true. The paper: excellent. {bars}",
            figures.center_figure(result, limbs, f"{where}: centers from limbs") if limbs else None,
            comparisons.center_comparison(
                result, phase, limbs, ("limb centers", "excellent (taken as: less than 1)"), f"Fig. {limb_number}"
            ),
        ),
        (
            range_number,
            f"{where}: ranges from limbs",
            f"Observed less true. The paper: less than {'1' if phase.key == 'approach' else '0.01'} %. {bars}",
            figures.range_figure(result, limbs, f"{where}: ranges from limbs") if limbs else None,
            comparisons.range_comparison(result, phase, limbs, f"Fig. {range_number}"),
        ),
    )


def _sizes(mission: MissionSetup, phase: PhaseSetup, results: Sequence[CampaignResult]) -> tuple[Comparison, ...]:
    """Comparisons of apparent sizes that the paper states of a phase, where all its visits were made."""
    planned = {setup.camera: len(setup.visits) for setup in phase.campaigns}
    if {result.camera: len(result.visits) for result in results} != planned:
        return ()
    if phase.key == "approach":
        return (comparisons.approach_size_comparison(mission, results),)
    if phase.key == "orbital_a":
        return (comparisons.orbit_size_comparison(mission, phase),)
    sizes = tuple(
        comparisons.survey_size_comparison(result, phase, _SURVEY_SIZES[phase.key])
        for result in results
        if result.camera == "navcam1"
    )
    return sizes if phase.key != "detailed_survey" else (*sizes, comparisons.mapcam_field_comparison(mission))


def _text(phase: PhaseSetup, results: Sequence[CampaignResult]) -> str:
    """Description of a phase."""
    visits = [visit for result in results for visit in result.visits]
    kernels = sum(visit.from_kernels for visit in visits)
    text = (
        f"{len(visits)} pairs of a long and a short exposure, {kernels} of them on the trajectory of the mission's "
        f"kernels and {len(visits) - kernels} on one rebuilt from the paper (simulated). Estimators get a shape model "
        f"of {phase.model.facets:,} facets with errors of {phase.model.error_m:g} m, a scale wrong by "
        f"{100.0 * phase.model.scale:g} % and a prime meridian wrong by {phase.model.meridian_deg:g} deg."
    )
    moments = [error for result in results for error in comparisons.fixes(result, ("moment",))]
    if moments:
        rms = float(np.sqrt(np.mean(comparisons.errors_px(moments) ** 2)))
        text += (
            f" The moment algorithm with eq. 3, of which the paper shows no results, has an rms of {rms:.2f} "
            f"px per axis."
        )
    features = [error for result in results for error in comparisons.fixes(result, ("surface_features",))]
    if features:
        percent = 100.0 * np.array([error.range_error for error in features if error.range_error is not None])
        rms = float(np.sqrt(np.mean(comparisons.errors_px(features) ** 2)))
        text += (
            f" Surface feature navigation, of which the paper shows no results, finds {len(features)} of {len(visits)} "
            f"images with an rms of {rms:.2f} px per axis and {np.sqrt(np.mean(percent**2)):.3f} % of the range."
        )
    return text
