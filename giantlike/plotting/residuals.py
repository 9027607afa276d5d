"""Charts of residuals: of stars over the field, of bodies and attitudes over a campaign."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.statistics import MAD_TO_SIGMA
from giantlike.core.values import Value
from giantlike.plotting.charts import Axis, Chart, ChartSheet
from giantlike.plotting.layers import MANY_POINTS, Layer, MarkShape
from giantlike.plotting.style import BLUE, GRAY, INK, RED, SERIES, drawing, new_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_ARROWS = 400  # for legibility only
_ARROW_SHARE = 1 / 22  # length of the arrow of a typical residual over the width of the field
_SMALLEST_PX = 1e-6  # a logarithmic axis has no zero
_MAGNITUDE_BINS = 24  # a third of a magnitude each over the usual eight
_RESIDUAL_BINS = 48  # over six sigma to each side
_RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))  # of the length of a vector with two unit Gaussian components
_MARKERS = (MarkShape.RING, MarkShape.SQUARE, MarkShape.TRIANGLE, MarkShape.DIAMOND)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series(Value):
    """One quantity of one source over a campaign."""

    label: str
    at: Float  # (n,); time or number of the image
    values: Float  # (n, k); k quantities that get one panel each; NaN where there is none
    sigma: Float  # (n, k); their standard deviations; NaN where unknown
    suspect: Mask  # (n,); drawn hollow


def series_charts(series: Sequence[Series], panels: Sequence[str], at_label: str, title: str) -> ChartSheet:
    """Values with one-sigma bars, one panel per quantity, one color per series."""
    shown = [k for k in range(len(panels)) if any(np.isfinite(part.values[:, k]).any() for part in series)] or [0]
    along = Axis.around(at_label, np.concatenate([part.at for part in series]), margin=0.03)
    charts = list[Chart]()
    for quantity in shown:
        ends = [np.zeros(1)]  # the zero line is always seen
        layers = [
            Layer(points=np.array([[along.low, 0.0], [along.high, 0.0]]), shape=MarkShape.LINE, color=GRAY, width=0.9)
        ]
        for number, part in enumerate(series):
            looks = (SERIES[number % len(SERIES)], _MARKERS[number % len(_MARKERS)])
            layers += _layers_of(part, quantity, *looks, label=part.label if len(series) > 1 else "")
            bars = np.nan_to_num(part.sigma[:, quantity])
            ends += [part.values[:, quantity] - bars, part.values[:, quantity] + bars]
        axis = Axis.around(panels[quantity], np.concatenate(ends))
        charts.append(Chart(title="" if charts else title, x=along, y=axis, layers=layers))
    return ChartSheet(charts=charts, width_in=7.5, height_in=1.6, stacked=True)


def _layers_of(part: Series, quantity: int, color: str, marker: MarkShape, *, label: str) -> list[Layer]:
    """Error bars and markers of a series: full for good values, hollow for suspect ones."""
    known = np.isfinite(part.values[:, quantity])
    sigma = np.nan_to_num(part.sigma[:, quantity])
    at, value = part.at[known], part.values[known, quantity]
    ends = np.stack([value - sigma[known], value + sigma[known]], axis=1)
    bars = np.column_stack([np.repeat(at, 2), ends.ravel()])
    layers = [Layer(points=bars, shape=MarkShape.BARS, color=color)]
    for which, fill, text in ((~part.suspect[known], color, label), (part.suspect[known], "white", "")):
        points = np.column_stack([at[which], value[which]])
        layers.append(Layer(points=points, shape=marker, color=color, size=4.5, fill=fill, label=text))
    return layers


def star_residual_charts(
    points_px: Float, residuals_px: Float, magnitudes: Float, sigma_px: Float, columns: int, rows: int
) -> ChartSheet:
    """Residuals of matched stars: arrows over the field, histogram per axis, size against magnitude.

    Observations without magnitudes, such as corners of a board, are shown against the distance from the image center.

    ``residuals_px`` (n, 2), observed minus predicted, at ``points_px`` (n, 2); ``magnitudes`` (n,), NaN where there are
    none; ``sigma_px`` (n,), standard deviation per axis that weighted each star.
    """
    known, label, title = np.isfinite(magnitudes), "magnitude", "Against magnitude"
    if not known.any():
        known, label, title = np.ones_like(known), "distance from center, px", "Against distance from the center"
        magnitudes = np.linalg.norm(points_px - [(columns - 1) / 2, (rows - 1) / 2], axis=1)
    size = np.maximum(np.linalg.norm(residuals_px[known], axis=1), _SMALLEST_PX)
    charts = (
        _field(points_px, residuals_px, columns, rows),
        _distribution(residuals_px),
        _against(magnitudes[known], size, sigma_px[known], label, title),
    )
    return ChartSheet(charts=charts, width_in=3.0, height_in=2.6)


def _field(points_px: Float, residuals_px: Float, columns: int, rows: int) -> Chart:
    step = max(1, math.ceil(len(points_px) / _MAX_ARROWS))
    points, arrows = points_px[::step], residuals_px[::step]
    typical = max(float(np.median(np.linalg.norm(residuals_px, axis=1))), _SMALLEST_PX)
    ends = np.stack([points, points + arrows * (_ARROW_SHARE * columns / typical)], axis=1).reshape(-1, 2)
    return Chart(
        title=f"Over the field (median {typical:.2g} px)",
        x=Axis(label="x, px", low=-0.5, high=columns - 0.5),
        y=Axis(label="y, px", low=rows - 0.5, high=-0.5),
        layers=[Layer(points=ends, shape=MarkShape.ARROWS, color=BLUE, width=0.8)],
        equal=True,
    )


def _distribution(residuals_px: Float) -> Chart:
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residuals_px - np.median(residuals_px, axis=0))))
    half = max(6 * spread, 1e-6)
    clipped, layers, most = np.clip(residuals_px, -half, half), list[Layer](), 1
    for k, (name, color) in enumerate(zip("xy", SERIES, strict=False)):
        counts, edges = np.histogram(clipped[:, k], bins=_RESIDUAL_BINS, range=(-half, half))
        steps = np.column_stack([np.repeat(edges, 2)[1:-1], np.repeat(counts, 2)])
        label = f"{name}: {float(np.std(residuals_px[:, k])):.3f} px"
        layers.append(Layer(points=steps, shape=MarkShape.LINE, color=color, width=1.2, label=label))
        most = max(most, int(counts.max()))
    return Chart(
        title="Distribution (standard deviation)",
        x=Axis(label="observed - predicted, px", low=-half, high=half),
        y=Axis(label="number", low=0.0, high=1.1 * most),
        layers=layers,
    )


def _against(magnitudes: Float, size: Float, sigma_px: Float, label: str, title: str) -> Chart:
    step = max(1, math.ceil(len(size) / MANY_POINTS))  # the medians are of all
    points = np.column_stack([magnitudes, size])[::step]
    expected = _bin_medians(magnitudes, _RAYLEIGH_MEDIAN * sigma_px)
    layers = [
        Layer(points=points, shape=MarkShape.DOT, color=BLUE, size=3.5),
        Layer(points=expected, shape=MarkShape.LINE, color=RED, width=1.4, label="expected, median"),
        Layer(points=_bin_medians(magnitudes, size), shape=MarkShape.LINE, color=INK, label="residual, median"),
    ]
    y = Axis.around("radial residual, px", size, logarithmic=True)
    return Chart(title=title, x=Axis.around(label, magnitudes), y=y, layers=layers)


def _bin_medians(magnitudes: Float, values: Float) -> Float:
    """Medians (k, 2) of magnitudes and values in bins of magnitude that hold at least three."""
    edges = np.linspace(magnitudes.min(), magnitudes.max() + 1e-9, _MAGNITUDE_BINS + 1)
    number = np.digitize(magnitudes, edges)
    groups = [number == k for k in range(1, _MAGNITUDE_BINS + 1) if np.count_nonzero(number == k) >= 3]
    return np.array([[np.median(magnitudes[group]), np.median(values[group])] for group in groups]).reshape(-1, 2)


def correlation_surface_figure(surface: Float, peak_px: Float | None, title: str) -> Figure:
    """Correlation for shifts around a position, NaN where undefined, and the shift (2,) of its peak."""
    half = (np.array(surface.shape[::-1]) - 1) / 2
    left, top = -half - 0.5
    with drawing():
        figure, (axis,) = new_panels(4.4, 4.0, 1)
        shown = axis.imshow(surface, cmap="viridis", extent=(left, -left, -top, top), aspect="equal")
        axis.grid(visible=False)
        axis.axhline(0.0, color="white", linewidth=0.5)
        axis.axvline(0.0, color="white", linewidth=0.5)
        if peak_px is not None:
            axis.plot(*peak_px, marker="+", color=RED, markersize=12, markeredgewidth=1.5)
            title += f"\npeak at ({peak_px[0]:+.3f}, {peak_px[1]:+.3f}) px"
        axis.set(xlabel="shift along x, px", ylabel="shift along y, px", title=title)
        figure.colorbar(shown, ax=axis, shrink=0.8)
    return figure
