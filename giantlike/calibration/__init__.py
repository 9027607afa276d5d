"""Camera models estimated from known directions, with their uncertainty; alignment between sensors."""

from __future__ import annotations

from giantlike.calibration.alignment import AlignmentResult, align, interlock
from giantlike.calibration.boards import board_observations
from giantlike.calibration.calibrate import calibrate
from giantlike.calibration.criteria import CalibrationCriteria
from giantlike.calibration.field_map import FieldMap, map_difference
from giantlike.calibration.observations import ImageObservations, collimator_directions
from giantlike.calibration.options import CalibrationOptions
from giantlike.calibration.result import CalibrationResult
from giantlike.calibration.star_images import calibrate_stars, identify_first, observations_of_fix
from giantlike.core.deprecation import renamed

__all__ = [
    "AlignmentResult",
    "CalibrationCriteria",
    "CalibrationResult",
    "CalibrationOptions",
    "FieldMap",
    "ImageObservations",
    "align",
    "board_observations",
    "calibrate",
    "calibrate_stars",
    "collimator_directions",
    "identify_first",
    "interlock",
    "map_difference",
    "observations_of_fix",
]

__getattr__ = renamed(__name__, {"AlignmentFix": "AlignmentResult", "CalibrationFix": "CalibrationResult"}, until="0.4")
