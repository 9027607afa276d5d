"""Processing of pixel arrays without knowledge of bodies or stars: sources, point spread functions, limbs, geometry."""

from giantlike.processing.detection.detect import detect_sources
from giantlike.processing.detection.detections import NOT_A_STAR, DetectionFlag, Detections
from giantlike.processing.detection.options import DetectionOptions

__all__ = ["NOT_A_STAR", "DetectionFlag", "DetectionOptions", "Detections", "detect_sources"]
