"""Plots of residuals that the paper has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from giantlike.core.arrays import Float
from giantlike.core.values import Value

BLUE, RED, GRAY = "#1f5fa8", "#b5342c", "#555555"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dots(Value):
    """Points of a plot."""

    x: Float  # (n,)
    y: Float  # (n,)
    color: str = BLUE
    label: str = ""


def panel_figure(
    panels: Sequence[tuple[str, Sequence[Dots], tuple[Float, Float] | float | None]], x_label: str
) -> Figure:
    """Draw panels one above the other: label of y, points, and bounds about zero, a number or curves (x, y)."""
    figure = Figure(figsize=(7.0, 0.6 + 2.1 * len(panels)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    for axis, (label, series, bound) in zip(axes, panels, strict=True):
        for dots in series:
            axis.plot(dots.x, dots.y, ".", markersize=3.5, color=dots.color, label=dots.label or None)
        if isinstance(bound, float):
            for sign in (-1.0, 1.0):
                axis.axhline(sign * bound, color="black", linestyle="--", linewidth=0.9)
        elif bound is not None:
            for sign in (-1.0, 1.0):
                axis.plot(bound[0], sign * bound[1], "--", color="black", linewidth=0.9)
        axis.axhline(0.0, color=GRAY, linewidth=0.5)
        axis.set_ylabel(label)
        axis.grid(alpha=0.25)
        if any(dots.label for dots in series):
            axis.legend(fontsize=8, loc="best")
    axes[-1].set_xlabel(x_label)
    return figure
