"""Figures for people: functions that take values and return a matplotlib ``Figure``, or SVG for a page."""

from giantlike.plotting.calibration import correlation_figure, distortion_figure, residual_trend_figure
from giantlike.plotting.overlay_svg import overlay_svg
from giantlike.plotting.overlays import (
    CENTERS,
    MARKS,
    BodyMarks,
    CenterMark,
    Layer,
    OverlayPanel,
    Shape,
    StarMarks,
    overlay_figure,
    overlay_panels,
    stretched,
)
from giantlike.plotting.residuals import Series, series_figure, star_residual_figure
from giantlike.plotting.style import svg_text

__all__ = [
    "CENTERS",
    "MARKS",
    "BodyMarks",
    "CenterMark",
    "Layer",
    "OverlayPanel",
    "Series",
    "Shape",
    "StarMarks",
    "correlation_figure",
    "distortion_figure",
    "overlay_figure",
    "overlay_panels",
    "overlay_svg",
    "residual_trend_figure",
    "series_figure",
    "star_residual_figure",
    "stretched",
    "svg_text",
]
