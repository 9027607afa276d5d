"""Camera models estimated from known directions, with their uncertainty; alignment between sensors."""

from giantlike.calibration.calibrate import calibrate
from giantlike.calibration.field_map import FieldMap, map_difference
from giantlike.calibration.observations import ImageObservations
from giantlike.calibration.options import CalibrationOptions
from giantlike.calibration.result import CalibrationResult
from giantlike.calibration.star_images import calibrate_stars, identify_first
from giantlike.core.deprecation import forward_names

__all__ = [
    "CalibrationOptions",
    "CalibrationResult",
    "FieldMap",
    "ImageObservations",
    "calibrate",
    "calibrate_stars",
    "identify_first",
    "map_difference",
]

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.calibration": "CalibrationFix:CalibrationResult",
        "giantlike.calibration.alignment": "AlignmentFix:AlignmentResult AlignmentResult align interlock",
        "giantlike.calibration.boards": "board_observations",
        "giantlike.calibration.criteria": "CalibrationCriteria",
        "giantlike.calibration.observations": "collimator_directions",
        "giantlike.calibration.star_images": "observations_of_fix",
    },
    until="0.4",
)
