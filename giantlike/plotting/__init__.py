"""Figures: values that describe their content, and functions that draw them as SVG or with matplotlib."""

from giantlike.plotting.charts import charts_figure
from giantlike.plotting.overlays import StarMarks, overlay_figure, overlay_panels
from giantlike.plotting.residuals import star_residual_charts

__all__ = [
    "StarMarks",
    "charts_figure",
    "overlay_figure",
    "overlay_panels",
    "star_residual_charts",
]
