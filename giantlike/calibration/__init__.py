"""Camera models estimated from known directions, with their uncertainty; alignment between sensors."""

from __future__ import annotations

from giantlike.calibration.alignment import AlignmentFix, align, interlock
from giantlike.calibration.calibrate import calibrate
from giantlike.calibration.fix import CalibrationFix
from giantlike.calibration.observations import ImageObservations, collimator_directions
from giantlike.calibration.options import CalibrationCriteria, CalibrationOptions
from giantlike.calibration.star_images import calibrate_stars, identify_first, observations_of_fix

__all__ = [
    "AlignmentFix",
    "CalibrationCriteria",
    "CalibrationFix",
    "CalibrationOptions",
    "ImageObservations",
    "align",
    "calibrate",
    "calibrate_stars",
    "collimator_directions",
    "identify_first",
    "interlock",
    "observations_of_fix",
]
