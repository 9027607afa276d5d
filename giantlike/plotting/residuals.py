"""Figures of residuals: of stars over the field, of bodies and attitudes over a campaign."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from giantlike.core.arrays import Float, Mask
from giantlike.core.statistics import MAD_TO_SIGMA
from giantlike.core.values import Value
from giantlike.plotting.style import BLUE, GRAY, INK, MANY_POINTS, MARKERS, RED, SERIES, drawing, new_panels, show_field

_MAX_ARROWS = 400  # for legibility only
_SMALLEST_PX = 1e-6  # a logarithmic axis has no zero
_MAGNITUDE_BINS = 24  # a third of a magnitude each over the usual eight
_RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))  # of the length of a vector with two unit Gaussian components

_MARKS_PER_BAR = 4
"""Marks of a point with an error bar: itself, the bar, two caps."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series(Value):
    """One quantity of one source over a campaign.

    Parameters
    ----------
    label : str
    at : (n,) float64
        Time or number of the image.
    values : (n, k) float64
        k quantities that get one panel each; NaN where there is none.
    sigma : (n, k) float64
        Their standard deviations; NaN where unknown.
    suspect : (n,) bool
        Drawn hollow.
    """

    label: str
    at: Float
    values: Float
    sigma: Float
    suspect: Mask


def series_figure(series: Sequence[Series], panels: Sequence[str], at_label: str, title: str) -> Figure:
    """Values with one-sigma bars, one panel per quantity, one color per series.

    Parameters
    ----------
    series : sequence of Series
    panels : sequence of str
        Labels of the k quantities, with units; a quantity that no series has gets no panel.
    at_label, title : str

    Returns
    -------
    Figure
    """
    shown = [k for k in range(len(panels)) if any(np.isfinite(part.values[:, k]).any() for part in series)]
    bars = sum(int(np.isfinite(part.values[:, shown]).sum()) for part in series)
    many = bars * _MARKS_PER_BAR > MANY_POINTS
    with drawing():
        rows = max(len(shown), 1)
        figure, axes = new_panels(8.4, 1.1 + 1.7 * rows, rows, sharex=True)
        for axis, quantity in zip(axes, shown, strict=False):
            axis.axhline(0.0, color=GRAY, linewidth=0.9)
            for number, part in enumerate(series):
                looks = (SERIES[number % len(SERIES)], MARKERS[number % len(MARKERS)])
                _draw_series(axis, part, quantity, looks, rasterized=many)
            axis.set_ylabel(panels[quantity])
        axes[0].set_title(title)
        axes[-1].set_xlabel(at_label)
        if len(series) > 1:
            figure.legend(*axes[0].get_legend_handles_labels(), loc="lower center", ncols=min(len(series), 5))
    return figure


def _draw_series(axis: Axes, part: Series, quantity: int, looks: tuple[str, str], *, rasterized: bool) -> None:
    known, (color, marker) = np.isfinite(part.values[:, quantity]), looks
    for which, fill, label in ((known & ~part.suspect, color, part.label), (known & part.suspect, "white", None)):
        sigma = part.sigma[which, quantity]
        axis.errorbar(
            part.at[which],
            part.values[which, quantity],
            yerr=np.where(np.isfinite(sigma), sigma, 0.0),
            fmt=marker,
            color=color,
            markerfacecolor=fill,
            markersize=4.5,
            elinewidth=1.0,
            capsize=2.0,
            label=label,
            rasterized=rasterized,
        )


def star_residual_figure(
    points_px: Float, residuals_px: Float, magnitudes: Float, sigma_px: Float, columns: int, rows: int
) -> Figure:
    """Residuals of matched stars: arrows over the field, histogram per axis, size against magnitude.

    Observations without magnitudes, such as corners of a board, are shown against the distance from the image center.

    Parameters
    ----------
    points_px : (n, 2), px
        Measured places of the stars.
    residuals_px : (n, 2), px
        Observed minus predicted.
    magnitudes, sigma_px : (n,)
        Catalog magnitudes, NaN where there are none; standard deviation per axis that weighted each star, px.
    columns, rows : int
        Size of the detector.

    Returns
    -------
    Figure
    """
    with drawing():
        figure, (field, histogram, brightness) = new_panels(11.0, 3.6, columns=3, width_ratios=(1.25, 1.0, 1.0))
        _draw_arrows(field, points_px, residuals_px, columns, rows)
        _draw_histogram(histogram, residuals_px)
        size = np.maximum(np.linalg.norm(residuals_px, axis=1), _SMALLEST_PX)
        many = size.size > MANY_POINTS
        known = np.isfinite(magnitudes)
        label, title = "magnitude", "Against magnitude"
        if not known.any():
            known, label, title = np.ones_like(known), "distance from center, px", "Against distance from the center"
            magnitudes = np.linalg.norm(points_px - [(columns - 1) / 2, (rows - 1) / 2], axis=1)
        magnitudes, size, sigma_px = magnitudes[known], size[known], sigma_px[known]
        brightness.plot(magnitudes, size, ".", color=BLUE, markersize=3.5, alpha=0.4, rasterized=many)
        brightness.plot(*_binned(magnitudes, _RAYLEIGH_MEDIAN * sigma_px), "-", color=RED, label="expected, median")
        brightness.plot(*_binned(magnitudes, size), "-", color=INK, linewidth=1.0, label="residual, median")
        brightness.set_yscale("log")
        brightness.set(xlabel=label, ylabel="radial residual, px", title=title)
        brightness.legend(loc="lower right", frameon=True, framealpha=0.85, edgecolor="none")
    return figure


def _binned(magnitudes: Float, values: Float) -> tuple[Float, Float]:
    """Medians of values in bins of magnitude that hold at least three."""
    edges = np.linspace(magnitudes.min(), magnitudes.max() + 1e-9, _MAGNITUDE_BINS + 1)
    number = np.digitize(magnitudes, edges)
    groups = [number == k for k in range(1, _MAGNITUDE_BINS + 1) if np.count_nonzero(number == k) >= 3]
    middles = np.array([np.median(magnitudes[group]) for group in groups])
    return middles, np.array([np.median(values[group]) for group in groups])


def _draw_arrows(axis: Axes, points_px: Float, residuals_px: Float, columns: int, rows: int) -> None:
    step = max(1, math.ceil(len(points_px) / _MAX_ARROWS))
    points, arrows = points_px[::step], residuals_px[::step]
    typical = max(float(np.median(np.linalg.norm(residuals_px, axis=1))), _SMALLEST_PX)
    quiver = axis.quiver(
        points[:, 0], points[:, 1], arrows[:, 0], arrows[:, 1],
        angles="xy", color=BLUE, width=0.0028, scale=typical * 22, rasterized=len(points) > MANY_POINTS,
    )  # fmt: skip
    key = float(f"{2 * typical:.1g}")
    axis.quiverkey(quiver, 0.88, 1.05, key, f"{key:g} px", labelpos="W", color=INK)
    show_field(axis, columns, rows)
    axis.set_title("Over the field")


def _draw_histogram(axis: Axes, residuals_px: Float) -> None:
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residuals_px - np.median(residuals_px, axis=0))))
    half = max(6 * spread, 1e-6)
    bins = np.linspace(-half, half, 49).tolist()
    clipped = np.clip(residuals_px, -half, half)
    for k, (name, color) in enumerate(zip("xy", SERIES, strict=False)):
        sigma = float(np.std(residuals_px[:, k]))
        label = f"{name}: {sigma:.3f} px"
        axis.hist(clipped[:, k], bins=bins, histtype="step", linewidth=1.4, color=color, label=label)
    axis.set(xlabel="observed - predicted, px", ylabel="number", title="Distribution (standard deviation)")
    axis.legend(loc="upper right")
