"""Camera models estimated from known directions, with their uncertainty; alignment between sensors."""

from __future__ import annotations

from giantlike.calibration.calibrate import calibrate
from giantlike.calibration.fix import CalibrationFix, ImageCalibration, RejectedObservation
from giantlike.calibration.observations import ImageObservations, collimator_directions
from giantlike.calibration.options import CalibrationCriteria, CalibrationOptions
from giantlike.calibration.robust import Loss

__all__ = [
    "CalibrationCriteria",
    "CalibrationFix",
    "CalibrationOptions",
    "ImageCalibration",
    "ImageObservations",
    "Loss",
    "RejectedObservation",
    "calibrate",
    "collimator_directions",
]
