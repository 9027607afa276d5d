"""Assumptions where the paper gives no values."""

from __future__ import annotations

from giantlike.missions.osiris_rex.comparisons import LIMB_PX, UNRESOLVED_PX
from giantlike.missions.osiris_rex.setup import MissionSetup, UserInputs
from giantlike.missions.replay import ReplaySettings


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
