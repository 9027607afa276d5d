"""What the paper leaves open, and what was assumed instead."""

from __future__ import annotations

from giantlike.missions.osiris_rex.comparisons import LIMB_PX, UNRESOLVED_PX
from giantlike.missions.osiris_rex.setup import Mission, UserInputs
from giantlike.missions.replay import ReplaySettings


def assumptions_of(mission: Mission, inputs: UserInputs, settings: ReplaySettings) -> tuple[str, ...]:
    """Return the assumptions of a replay, one sentence or two each.

    Parameters
    ----------
    mission : Mission
    inputs : UserInputs
    settings : ReplaySettings

    Returns
    -------
    tuple of str
    """
    detector, pointing, body = mission.detector, mission.pointing, mission.body
    shape = (
        "Bennu is made up: a spinning top of the published axes with lumps, craters and boulders."
        if inputs.shape is None
        else f"The shape of Bennu is {inputs.shape.name}, with made-up relief finer than its facets."
    )
    trajectory = (
        "The whole trajectory is simulated: distances from the sizes that the paper states, phase angles assumed."
        if inputs.kernels is None
        else "Where the kernels do not cover a visit (before 8 November and after 17 December 2018) the "
        "trajectory is simulated: "
        "distances from the sizes that the paper states, phase angles assumed. The attitude of the "
        "spacecraft is simulated throughout."
    )
    lines = (
        "No value was tuned to meet a number of the paper. All inputs are in mission.toml, each marked as "
        "the paper's, known or assumed.",
        "The paper's figures show no data that could be compared: its sentences about them are what is compared.",
        "Residuals are against the truth. The paper's are against the best fit of an orbit determination to "
        "these and other "
        "measurements, which takes up part of their errors and adds its own.",
        shape,
        f"Images: Hapke's law and albedo of {body.albedo_rms:.0%}, which estimators do not know (they assume "
        f"McEwen's law and let others "
        "mix in); the Sun is a point. Estimators get the shape model of the phase: coarser, with errors of "
        "one pixel of the phase's best "
        "images (two in Approach) and of scale (the published uncertainty of the mean radius, three times "
        "that in Approach).",
        trajectory,
        "Visits are fewer than in the mission: the paper does not tell the number of its images.",
        f"Detectors (gain {detector.gain_e_per_dn:g} e/DN, read noise {detector.read_noise_e:g} e, 12 bits), "
        f"point spread functions "
        f"(Gaussian of {detector.psf_sigma_px:g} px, told as {detector.told_psf_sigma_px:g}), exposures and "
        f"zero points are assumed from "
        "apertures; the paper has none of them. They decide how many faint stars there are, and so the size "
        "of star residuals.",
        f"Pointing: the a priori attitude is wrong by {pointing.attitude_error_deg:g} deg per axis; the turn "
        f"from the long to the short "
        f"exposure, {pointing.pair_gap_s:g} s, is told but for {pointing.jitter_arcsec_per_sqrt_s:g} arcsec "
        f"per root second.",
        "Stars: the default catalog (Gaia, Hipparcos) instead of UCAC4, without errors of its own; for "
        "PolyCam a made-up sky as dense as "
        "the real one to magnitude 13.5, where that catalog ends at 10.",
        "Temperatures of calibration images are spread evenly over 40 degrees; the paper does not tell its "
        "own. The principal "
        "points of PolyCam and MapCam are held at 511.5, as in Table 1.",
        "Star images: detections above 8 sigma of the matched filter, q-method, all stars; the paper "
        "thresholds single pixels at 8 sigma, "
        "and fits Gaussians without weights. Estimators here fit whole templates and profiles, so that "
        "centers are better than by a "
        "correlation peak alone; the first section has the peak.",
        f"Unresolved is used up to {UNRESOLVED_PX:g} px across and limbs from {LIMB_PX:g} px on; the paper "
        f"gives no limits.",
        "Surface features: the paper shows no result of them, so that none is compared.",
    )
    small = ("This is a small replay: one camera calibrated, two campaigns of one or two visits, coarse shapes.",)
    return (*lines, *small) if settings.small else lines
