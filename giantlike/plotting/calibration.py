"""Figures of a camera calibration: distortion and its uncertainty over the field, correlations, residual trends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.plotting.style import BLUE, GRAY, INK, ORANGE, RED, drawing, new_panels, show_field

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

_ARROWS = 13  # along an axis; for legibility only
_DIVERGING = (BLUE, "white", RED)
_SEQUENTIAL = ("#f5f7f9", "#9fc2de", BLUE, "#0b2f5c")
_LABEL_SHARE = 0.995  # correlations above it would be rounded to 1.00, and get three digits


def distortion_figure(
    points_px: Float, distortion_px: Float, sigma_points_px: Float, sigma_px: Float, columns: int, rows: int
) -> Figure:
    """Distortion from a pinhole over the field (arrows on its size), and the uncertainty of the camera map."""
    with drawing():
        figure, (left, right) = new_panels(10.0, 3.9, columns=2)
        size = np.linalg.norm(distortion_px, axis=1)
        _fill_map(figure, left, points_px, size, columns, rows)
        chosen = _pick_on_grid(points_px)
        left.quiver(*points_px[chosen].T, *distortion_px[chosen].T, angles="xy", color=ORANGE, width=0.004)
        left.set_title(f"Distortion, px (at most {size.max():.3g})")
        _fill_map(figure, right, sigma_points_px, sigma_px, columns, rows)
        right.set_title(f"One sigma of the map, px (at most {sigma_px.max():.2g})")
    return figure


def _colors(names: Sequence[str]) -> LinearSegmentedColormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("giantlike", list(names))


def _fill_map(figure: Figure, axis: Axes, points_px: Float, values: Float, columns: int, rows: int) -> None:
    levels = np.linspace(0.0, max(float(values.max()), 1e-9), 13).tolist()
    drawn = axis.tricontourf(points_px[:, 0], points_px[:, 1], values, levels=levels, cmap=_colors(_SEQUENTIAL))
    figure.colorbar(drawn, ax=axis, shrink=0.9, format="%.3g")
    axis.grid(visible=False)
    show_field(axis, columns, rows)


def _pick_on_grid(points_px: Float) -> NDArray[np.intp]:
    """Indices of points nearest to a coarse grid."""
    low, high = points_px.min(axis=0), points_px.max(axis=0)
    places = (points_px - low) / np.maximum(high - low, 1e-9) * (_ARROWS - 1)
    cells = np.rint(places)
    order = np.argsort(np.linalg.norm(places - cells, axis=1), kind="stable")
    _, first = np.unique(cells[order], axis=0, return_index=True)
    return np.asarray(order[first])


def correlation_figure(names: Sequence[str], correlation: Float) -> Figure:
    """Correlation matrix of estimated parameters, with its numbers. ``correlation`` (k, k)."""
    with drawing():
        side = 1.6 + 0.52 * len(names)
        figure, (axis,) = new_panels(side + 0.9, side)
        drawn = axis.imshow(correlation, cmap=_colors(_DIVERGING), vmin=-1.0, vmax=1.0)
        figure.colorbar(drawn, ax=axis, shrink=0.85)
        places = range(len(names))
        axis.set_xticks(places, names, rotation=45, ha="right")
        axis.set_yticks(places, names)
        axis.grid(visible=False)
        for (row, column), value in np.ndenumerate(correlation):
            text = f"{value:.2f}" if abs(value) < _LABEL_SHARE else f"{value:.3f}"
            color = "white" if abs(value) > 0.6 else INK
            axis.text(column, row, text, ha="center", va="center", fontsize=7.0, color=color)
        axis.set_title("Correlation of the parameters")
    return figure


def residual_trend_figure(trends: Mapping[str, tuple[Float, Float, Float]]) -> Figure:
    """Residual rms against quantities it might depend on, one panel each (three arrays), with the expected rms."""
    with drawing():
        figure, panels = new_panels(2.2 + 2.6 * len(trends), 2.9, columns=max(len(trends), 1), sharey=True)
        for axis, (label, (at, rms, noise)) in zip(panels, trends.items(), strict=False):
            axis.plot(at, noise, "-", color=GRAY, linewidth=1.2, label="noise promised")
            axis.plot(at, rms, "o", color=BLUE, markersize=4.0, label="residual")
            axis.set_xlabel(label)
        panels[0].set_ylabel("radial rms, px")
        panels[0].set_ylim(bottom=0.0)
        panels[0].legend(loc="lower left")
    return figure
