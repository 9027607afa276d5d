"""Figures for people: functions that take values and return a matplotlib ``Figure``."""

from giantlike.plotting.calibration import correlation_figure, distortion_figure, residual_trend_figure
from giantlike.plotting.overlays import CENTERS, MARKS, BodyMarks, CenterMark, StarMarks, overlay_figure, stretched
from giantlike.plotting.residuals import Series, series_figure, star_residual_figure
from giantlike.plotting.style import jpeg_data_uri, svg_text

__all__ = [
    "CENTERS",
    "MARKS",
    "BodyMarks",
    "CenterMark",
    "Series",
    "StarMarks",
    "correlation_figure",
    "distortion_figure",
    "jpeg_data_uri",
    "overlay_figure",
    "residual_trend_figure",
    "series_figure",
    "star_residual_figure",
    "stretched",
    "svg_text",
]
