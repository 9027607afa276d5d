"""Arrays in, arrays out: what is done to pixels before anybody asks what they show."""

from giantlike.processing.detection.detect import detect_sources
from giantlike.processing.detection.detections import NOT_A_STAR, DetectionFlag, Detections
from giantlike.processing.detection.options import DetectionOptions

__all__ = ["NOT_A_STAR", "DetectionFlag", "DetectionOptions", "Detections", "detect_sources"]
