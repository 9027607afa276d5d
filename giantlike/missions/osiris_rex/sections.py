"""Sections of the report: template matching, calibration, the four phases in the order of the paper; assumptions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from giantlike.missions.osiris_rex import comparisons, figures
from giantlike.missions.osiris_rex.calibrations import CameraCalibration
from giantlike.missions.osiris_rex.campaigns import CampaignResult
from giantlike.missions.osiris_rex.comparisons import LIMB_PX, UNRESOLVED_PX
from giantlike.missions.osiris_rex.phases import PhaseResult
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.missions.osiris_rex.setup import MissionSetup, PhaseSetup, UserInputs
from giantlike.missions.osiris_rex.trajectory import kernel_ranges_km
from giantlike.missions.replay import Comparison, ReplayFigure, ReplaySettings, Section

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
_SIZES = {
    "approach": ("polycam", "greater than 1000 at the end", 1000.0, np.inf),
    "preliminary_survey": ("navcam1", "approximately 100-250", 100.0, 250.0),
    "orbital_a": ("navcam1", "approximately 1000", 1000.0, 1000.0),
    "detailed_survey": ("navcam1", "approximately 200-600", 200.0, 600.0),
}
"""Camera, words and limits of the apparent diameters that the paper states, px."""
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


def phase_section(mission: MissionSetup, phase: PhaseSetup, result: PhaseResult, kernels: Path | None) -> Section:
    """A phase: its figures in the order of the paper, the orbit, and the sizes that the paper states."""
    panels = sorted(
        (panel for each in result.campaigns for panel in _panels(phase, result, each)), key=lambda one: one[0]
    )
    made = [
        ReplayFigure(f"Fig. {number}", title, caption, figure)
        for number, title, caption, figure, _ in panels
        if figure is not None
    ]
    for each in result.campaigns:
        picture = figures.picture_figure(each)
        if picture is not None:
            title = "image, template and their difference"
            caption = (
                "Limb points of limb_matching (yellow) and landmarks on the image, as the independent renderer made it."
            )
            made.append(ReplayFigure(f"Picture, {phase.title}, {each.label}", title, caption, picture))
    if result.orbit.solution is not None:
        caption = (
            "Left: fitted minus true trajectory at the images. Right: velocity changes minus those that were executed."
        )
        title = "fitted to the observables"
        made.append(ReplayFigure(f"Orbit, {phase.title}", title, caption, figures.orbit_figure(result, "Trajectory")))
    compared = [*_sizes(mission, phase, result, kernels), *(comparison for *_, comparison in panels)]
    compared.append(comparisons.maneuver_comparison(phase, result.orbit))
    for each in result.campaigns:
        setup = next(one for one in phase.campaigns if one.camera == each.camera)
        if "surface_features" in setup.estimators:
            found = comparisons.fixes(result.residuals[each.camera], ("surface_features",))
            where = f"{phase.title}, {each.label}"
            compared.append(comparisons.feature_comparison(where, found, len(each.diameters_px)))
    return Section(title=phase.title, text=_text(phase, result), figures=tuple(made), comparisons=tuple(compared))


def _panels(phase: PhaseSetup, result: PhaseResult, campaign: CampaignResult) -> tuple[_Panel, ...]:
    star_number, center_number, limb_number, range_number = PHASE_FIGURES[phase.key, campaign.camera]
    residuals = result.residuals[campaign.camera]
    centers, limbs = (comparisons.fixes(residuals, names) for names in (_CENTERS, ("limb_matching",)))
    where, less = f"{phase.title}, {campaign.label}", "typically less than 1"
    stars = "less than" if phase.key == "orbital_a" else "around"
    bars = "Observed minus expected by the orbit fitted to the observables, and by the true one. Bars are the standard "
    bars += "deviations that the fixes state, hollow marks are flagged suspect."
    ranges, orbit = [each for each in limbs if np.isfinite(each.sigma_percent)], result.orbit
    drawn = (
        (center_number, "centers", f"{less} px", centers, "px"),
        (limb_number, "centers from limbs", "excellent", limbs, "px"),
        (
            range_number,
            "ranges from limbs",
            f"less than {'1' if phase.key == 'approach' else '0.01'} %",
            ranges,
            "percent",
        ),
    )
    words = ("center finding", less, "")
    limb_words = ("limb centers", "excellent (taken as: less than 1)", "poor_shape")
    compared = (
        comparisons.center_comparison(where, orbit, centers, words, f"Fig. {center_number}"),
        comparisons.center_comparison(where, orbit, limbs, limb_words, f"Fig. {limb_number}"),
        comparisons.range_comparison(where, phase, orbit, limbs, f"Fig. {range_number}"),
    )
    found = campaign.stars
    return (
        (
            star_number,
            f"{where}: stars",
            f"{len(found.residuals_px)} stars of {found.solved} images. The paper: {stars} 0.1 px.",
            figures.star_figure(campaign) if len(found.residuals_px) else None,
            comparisons.star_comparison(campaign, phase, f"Fig. {star_number}"),
        ),
        *(
            (
                number,
                f"{where}: {title}",
                f"The paper: {paper}. {bars}",
                figures.residual_figure(mine, quantity, f"{where}: {title}") if mine else None,
                comparison,
            )
            for (number, title, paper, mine, quantity), comparison in zip(drawn, compared, strict=True)
        ),
    )


def _sizes(
    mission: MissionSetup, phase: PhaseSetup, result: PhaseResult, kernels: Path | None
) -> tuple[Comparison, ...]:
    """Comparisons of apparent sizes that the paper states of a phase, where all its images were made."""
    if {each.camera: len(each.diameters_px) for each in result.campaigns} != {
        each.camera: len(each.images) for each in phase.campaigns
    }:
        return ()
    key, paper, low, high = _SIZES[phase.key]
    pixels_km = 2.0 * mission.body.mean_radius_km * mission.cameras[key].model.focal_length_px
    ets = sorted(result.flight.states)
    flown_km = np.array([np.linalg.norm(result.flight.states[et][:3]) for et in ets])
    sizes = pixels_km / flown_km, pixels_km / kernel_ranges_km(ets, kernels)
    if phase.key == "approach":  # the end of it
        sizes = sizes[0][-1:], sizes[1][-1:]
    compared = comparisons.size_comparison(phase, mission.cameras[key].label, paper, sizes, low, high)
    return (compared,) if phase.key != "detailed_survey" else (compared, comparisons.mapcam_field_comparison(mission))


def _text(phase: PhaseSetup, result: PhaseResult) -> str:
    """Description of a phase."""
    orbit, images = result.orbit, sum(len(each.diameters_px) for each in result.campaigns)
    planned = [1e6 * float(np.linalg.norm(each.planned_km_s)) for each in result.flight.maneuvers]
    text = (
        f"{images} pairs of a long and a short exposure along a flight with {len(planned)} maneuvers of "
        f"{min(planned):.3g} to {max(planned):.3g} mm/s, executed in error. Estimators get a shape model of "
        f"{phase.model.facets:,} facets with errors of {phase.model.error_m:g} m, a scale wrong by "
        f"{100.0 * phase.model.scale:g} % and a prime meridian wrong by {phase.model.meridian_deg:g} deg."
    )
    if orbit.solution is None:
        text += f" No orbit: {orbit.refused}."
    else:
        sunlight = orbit.solution.values[6] * 1e12
        text += (
            f" The orbit determination gets {orbit.n_fixes} preferred fixes, the planned maneuvers and an a priori "
            f"state; it finds sunlight of {sunlight:.1f} nm/s^2 at 1 au, and a trajectory wrong by "
            f"{1e3 * float(np.sqrt(np.mean(orbit.position_error_km**2))):.3g} m rms at the images."
        )
    moments = [one for found in result.residuals.values() for one in comparisons.fixes(found, ("moment",))]
    if moments:
        rms = float(np.sqrt(np.mean(np.array([each.truth_px for each in moments]) ** 2)))
        text += (
            f" The moment algorithm with eq. 3, of which the paper shows no results, has an rms of {rms:.2f} px per "
            "axis against the truth."
        )
    return text


def assumptions_of(mission: MissionSetup, inputs: UserInputs, settings: ReplaySettings) -> tuple[str, ...]:
    """Return the assumptions of a replay, one sentence or two each."""
    shape = (
        "Bennu is made up: a spinning top of the published axes with lumps, craters and boulders."
        if inputs.shape is None
        else f"The shape of Bennu is {inputs.shape.name}, with made-up relief finer than its facets."
    )
    trajectory = (
        ""
        if inputs.kernels is None
        else (
            "Apparent sizes are those of the mission's kernels where they cover an image; the trajectory is simulated."
        )
    )
    small = ("This is a small replay: one camera calibrated, one campaign of six pairs, coarse shapes.",)
    lines = (*_OPEN, shape, *([trajectory] if trajectory else []), *_lines_of_inputs(mission))
    return (*lines, *small) if settings.small else lines


_OPEN = (
    "No value was tuned to meet a number of the paper. All inputs are in mission.toml, each marked as the paper's, "
    "known or assumed. One was changed after a result had been seen: at first the catalog ended at magnitudes that are "
    "bright in PolyCam and MapCam images, and star residuals were 0.045 px; now the threshold of 8 sigma, which is the "
    "paper's, decides which stars there are, as with the paper's catalog, and they are 0.1 px in all cameras.",
    "The paper's figures come without data: its sentences about them are what is compared.",
    "Residuals of centers and ranges are against the orbit fitted to the preferred observables of the phase, images "
    "alone, while the paper's was fitted to radiometric and other measurements too. Images without stars have none.",
    "Images, light time, aberration, stars and flight are made by the independent renderer and integrator, which "
    "share no code with the estimators; the orbit and spin of Bennu and the places of catalog stars are input to both.",
    "Waypoints are chosen so that Bennu has the sizes that the paper states. Each maneuver is planned from the true "
    "state (navigation knows it well by then), with the sunlight that the fit is told; predictions of images err at "
    "random around the truth, in place of the fits of the days before.",
    "The paper does not tell the number of its images.",
    "The Sun is a point. The center of figure is the origin of all shapes; the paper's trajectories are about the "
    "center of mass.",
    "Stars: the default catalog (Gaia, Hipparcos) instead of UCAC4, without errors of its own; for PolyCam, which sees "
    "fainter stars than that holds, a made-up sky as dense as the real one.",
    "Temperatures of calibration images are spread evenly over 40 degrees; the paper does not tell its own. The "
    "principal points of PolyCam and MapCam are held at 511.5, as in Table 1.",
    "Star images: detections above 8 sigma of the matched filter, noise-weighted Gaussians, q-method, all stars; the "
    "paper thresholds single pixels at 8 sigma and fits Gaussians without weights. Estimators here fit whole templates "
    "and profiles, so that centers are better than by a correlation peak alone, which the first section has.",
    f"Unresolved is used up to {UNRESOLVED_PX:g} px across, cross-correlation above, and limbs from {LIMB_PX:g} px on; "
    "the paper gives no limits.",
    "Products of the prime team are not at hand: no comparison with them.",
)
"""Assumptions that do not depend on the inputs."""


def _lines_of_inputs(mission: MissionSetup) -> tuple[str, ...]:
    """Assumptions with numbers of the mission file."""
    detector, pointing, body, flight = mission.detector, mission.pointing, mission.body, mission.flight
    return (
        f"Flight: sunlight {flight.true_sunlight - 1.0:.0%} stronger than told, a gravitational parameter one sigma "
        f"from that told, a J4 that the fit lacks, maneuvers with errors of {flight.maneuver_error:.1%} and "
        f"{flight.maneuver_error_mm_s:g} mm/s on each axis, which is their a priori sigma in the fit, and an a priori "
        f"state {flight.state_error:.0%} off.",
        f"Images: Hapke's law and albedo of {body.albedo_rms:.0%} rms, which estimators do not know: they assume "
        "McEwen's law and let others mix in.",
        "Estimators get the shape model of the phase: coarser, with errors of one pixel of the phase's best images "
        "(two in Approach), of scale (the published uncertainty of the mean radius, 0.033 %; three times that in "
        "Approach), and of the prime meridian (0.02 to 0.1 deg; 0.19 deg before arrival).",
        f"Detectors (gain {detector.gain_e_per_dn:g} e/DN, read noise {detector.read_noise_e:g} e, 12 bits), point "
        f"spread functions (Gaussian of {detector.psf_sigma_px:g} px, told as {detector.told_psf_sigma_px:g}), "
        "exposures and zero points (from apertures) are assumed; the paper has none of them.",
        f"Pointing: the a priori attitude is wrong by {pointing.attitude_error_deg:g} deg per axis; the turn from the "
        f"long to the short exposure, {pointing.pair_gap_s:g} s, is told but for "
        f"{pointing.jitter_arcsec_per_sqrt_s:g} arcsec per root second.",
    )
