"""What moves near a body or before the stars: sources that nothing explains, and what becomes of them."""

from giantlike.search.compare import compare_residuals
from giantlike.search.link import LinkOptions, Track, link
from giantlike.search.motion import MotionFix, MotionOptions, Orbit, fit_motion
from giantlike.search.residuals import ResidualOptions, Residuals, SourceClass, residual_sources

__all__ = [
    "LinkOptions",
    "MotionFix",
    "MotionOptions",
    "Orbit",
    "ResidualOptions",
    "Residuals",
    "SourceClass",
    "Track",
    "compare_residuals",
    "fit_motion",
    "link",
    "residual_sources",
]
