"""Figures: values that describe their content, and functions that draw them as SVG or with matplotlib."""

from giantlike.plotting.calibration import correlation_figure, distortion_figure, residual_trend_figure
from giantlike.plotting.charts import Axis, Chart, ChartSheet, charts_figure, charts_svg
from giantlike.plotting.layers import Layer, Shape
from giantlike.plotting.overlay_svg import overlay_svg
from giantlike.plotting.overlays import (
    CENTERS,
    MARKS,
    BodyMarks,
    CenterMark,
    OverlayPanel,
    StarMarks,
    overlay_figure,
    overlay_panels,
    stretched,
)
from giantlike.plotting.residual_map import residual_map_svg
from giantlike.plotting.residuals import Series, correlation_surface_figure, series_charts, star_residual_charts
from giantlike.plotting.style import svg_text

__all__ = [
    "CENTERS",
    "MARKS",
    "Axis",
    "BodyMarks",
    "CenterMark",
    "Chart",
    "ChartSheet",
    "Layer",
    "OverlayPanel",
    "Series",
    "Shape",
    "StarMarks",
    "charts_figure",
    "charts_svg",
    "correlation_figure",
    "correlation_surface_figure",
    "distortion_figure",
    "overlay_figure",
    "overlay_panels",
    "overlay_svg",
    "residual_map_svg",
    "residual_trend_figure",
    "series_charts",
    "star_residual_charts",
    "stretched",
    "svg_text",
]
