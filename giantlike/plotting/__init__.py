"""Figures: values that describe their content, and functions that draw them as SVG or with matplotlib."""

from giantlike.core.deprecation import forward_names
from giantlike.plotting.charts import charts_figure
from giantlike.plotting.overlays import StarMarks, overlay_figure, overlay_panels
from giantlike.plotting.residuals import star_residual_charts

__all__ = ["StarMarks", "charts_figure", "overlay_figure", "overlay_panels", "star_residual_charts"]

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.plotting.calibration": "correlation_figure distortion_figure residual_trend_figure",
        "giantlike.plotting.charts": "Axis Chart ChartSheet charts_svg",
        "giantlike.plotting.layers": "Layer Shape:MarkShape",
        "giantlike.plotting.svg_overlay": "overlay_svg",
        "giantlike.plotting.overlays": "BodyMarks CENTERS CenterMark MARKS OverlayPanel stretched:stretch_image",
        "giantlike.plotting.residual_map": "residual_map_svg",
        "giantlike.plotting.residuals": "Series correlation_surface_figure series_charts",
        "giantlike.plotting.style": "svg_text",
    },
    until="0.4",
)
