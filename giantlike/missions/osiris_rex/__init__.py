"""OSIRIS-REx at Bennu, replayed: calibration of its cameras, and four phases from Approach to Detailed Survey.

References
----------
.. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission Using the Goddard
   Image Analysis and Navigation Tool.
"""

from __future__ import annotations

from giantlike.missions.replay import Replay, ReplaySettings

NAME = "osiris_rex"
CHANGES = {
    "poor_shape": "Heights and scale of the shape models err by twenty times as much.",
    "range_known": "Predicted ranges of the study of range errors err by a twentieth as much.",
}
"""Assumptions that can be altered."""
_SMALL_CAMERAS, _SMALL_IMAGES = ("mapcam",), 4  # cameras that a small replay calibrates, and the number of their images


def replay(settings: ReplaySettings) -> Replay:
    """Replay Liounis et al.: calibrations, then the phases as campaigns on simulated images."""
    from giantlike.missions.osiris_rex.body import true_body
    from giantlike.missions.osiris_rex.calibrations import calibrate_camera
    from giantlike.missions.osiris_rex.phases import PhaseInputs
    from giantlike.missions.osiris_rex.range_error import study_range_errors
    from giantlike.missions.osiris_rex.sections import (
        assumptions_of,
        calibration_section,
        phase_section,
        range_error_section,
    )
    from giantlike.missions.osiris_rex.setup import mission, user_inputs

    orex, inputs = mission(), user_inputs(settings.data)
    cameras = _SMALL_CAMERAS if settings.small else tuple(orex.cameras)
    sections = [range_error_section(study_range_errors(settings))]
    calibrations = [
        calibrate_camera(
            orex,
            key,
            images=_SMALL_IMAGES if settings.small else orex.cameras[key].calibration_images,
            seed=settings.seed,
            progress=settings.progress,
        )
        for key in cameras
    ]
    sections.append(calibration_section(orex, calibrations))
    cells = orex.body.small_cells if settings.small else orex.body.cells
    truth = true_body(orex.body, inputs.shape, seed=settings.seed, cells=cells)
    calibrated = {each.key: each.camera for each in calibrations}
    stage = PhaseInputs(mission=orex, truth=truth, calibrated=calibrated, settings=settings)
    for phase in (each.with_poor_shape() if settings.change == "poor_shape" else each for each in orex.phases):
        result = stage.run(phase)
        if result is not None:
            sections.append(phase_section(orex, phase, result, inputs.kernels))
    return Replay(
        name=NAME,
        title="OSIRIS-REx at Bennu: independent optical navigation",
        sections=tuple(sections),
        flown="Star images of each camera, calibrated; then each phase: a flight with maneuvers, sunlight and gravity "
        "that the fit does not know, images of Bennu by an independent renderer, processed as campaigns (attitude from "
        "stars, centers by template, limb and center of light, ranges from limbs), and the orbit determined from their "
        "observables alone. Residuals are against that orbit, beside those against the truth.",
        pictures=("Picture, Preliminary Survey, NavCam 1", "Fig. 3", "Fig. 18", "Fig. 24", "Orbit, Orbital A"),
        assumptions=assumptions_of(orex, inputs, settings),
    )
