"""Charts as values, in the units of their axes; :func:`charts_svg` and :func:`charts_figure` draw them."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.plotting.layers import UNITS_PER_POINT, Layer, MarkShape, layer_svg
from giantlike.plotting.style import GRAY, GRID, INK, drawing, new_panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_UNITS_PER_IN = 72.0 * UNITS_PER_POINT
_LEFT, _RIGHT, _TOP, _BOTTOM = 68.0, 14.0, 30.0, 42.0
"""Room around a chart, SVG units: labels of the ordinate, nothing, a title, numbers and label of the abscissa."""
_GAP = 10.0  # between charts above each other, which have one abscissa
_LEGEND = 20.0  # height of a line of a legend
_LETTER = 6.4  # mean width of a letter of 12 units
_TICKS_PER_UNIT = 1 / 70.0  # most numbers along an axis, a unit
_EXACT = 6  # digits from which numbers are written with an exponent


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """An axis of a chart."""

    label: str  # quantity and unit
    low: float  # low, high: its ends, left or at the bottom first; ``low > high`` for an axis that runs down
    high: float
    logarithmic: bool = False

    @classmethod
    def around(cls, label: str, values: Float, *, margin: float = 0.05, logarithmic: bool = False) -> Axis:
        """Axis that contains the finite ones of values (n,); of a single one, as wide as it is large."""
        known = values[np.isfinite(values)]
        known = np.log10(known) if logarithmic else known
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        width = high - low if high > low else abs(high) or 1.0
        half = max(width, 1e-9 * abs(high), 1e-12) * (0.5 + margin)
        ends = ((low + high) / 2 - half, (low + high) / 2 + half)
        low, high = (10.0**end for end in ends) if logarithmic else ends
        return cls(label=label, low=low, high=high, logarithmic=logarithmic)

    def shares(self, values: Float) -> Float:
        """Places (n,) of values on the axis: 0 at its low end, 1 at its high end."""
        if self.logarithmic:
            shares: Float = np.log(np.maximum(values, 1e-300) / self.low) / math.log(self.high / self.low)
        else:
            shares = (values - self.low) / (self.high - self.low)
        return shares

    def ticks(self, most: int) -> list[tuple[float, str]]:
        """Round values on the axis, at most so many and two more, with their texts."""
        low, high = sorted((self.low, self.high))
        if self.logarithmic:
            first, last = math.ceil(math.log10(low)), math.floor(math.log10(high))
            stride = max(1, math.ceil((last - first + 1) / most))
            return [(10.0**power, f"{10.0**power:g}") for power in range(first, last + 1, stride)]
        rough = (high - low) / max(most, 1)
        power = math.floor(math.log10(rough))
        step = next(size for k in (1, 2, 5, 10) if (size := k * 10.0**power) >= 0.999 * rough)
        digits, largest = max(0, -math.floor(math.log10(step) + 1e-9)), max(abs(low), abs(high))
        plain = digits < _EXACT and largest < 10.0**_EXACT
        numbers = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step
        return [(value, f"{value:.{digits}f}" if plain else f"{value:.4g}") for value in numbers.tolist()]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart(Value):
    """Layers between two axes."""

    title: str
    x: Axis
    y: Axis
    layers: Sequence[Layer]  # those with a label are in the legend
    equal: bool = False  # one unit is as long on both axes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChartSheet(Value):
    """Charts side by side, each with its legend below, or above each other with one abscissa and one legend below."""

    charts: Sequence[Chart]
    width_in: float  # width_in, height_in: of a chart, without labels
    height_in: float
    stacked: bool = False  # above each other


def charts_svg(sheet: ChartSheet, name: str) -> str:
    """Return charts as SVG, to put inside a page or to write to a file."""
    width, height = sheet.width_in * _UNITS_PER_IN, sheet.height_in * _UNITS_PER_IN
    name = "".join(letter if letter.isalnum() else "-" for letter in name)
    count, stacked = len(sheet.charts), sheet.stacked
    step = (0.0, height + _GAP) if stacked else (width + _LEFT + _RIGHT, 0.0)
    total = np.array([_LEFT + width + _RIGHT, _TOP + height + _BOTTOM]) + (count - 1) * np.array(step)
    legends = [_rows(_select_labeled(chart), width) for chart in sheet.charts[: 1 if stacked else count]]
    below = _LEGEND * max(map(len, legends)) * (not stacked or len(_select_labeled(sheet.charts[0])) > 1)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total[0]:.0f} {total[1] + below:.0f}" '
        f'width="{total[0]:.0f}" font-family="sans-serif" font-size="12">'
    ]
    for number, chart in enumerate(sheet.charts):
        left, top = _LEFT + number * step[0], _TOP + number * step[1]
        last = not stacked or number == count - 1
        parts.append(f'<g transform="translate({left:.0f} {top:.0f})" fill="{INK}">')
        parts += _chart(chart, f"{name}-{number}", width, height, numbered=last)
        parts.append("</g>")
    for number, rows in enumerate(legends if below else ()):
        parts.append(f'<g transform="translate({_LEFT + number * step[0]:.0f} {total[1]:.0f})" fill="{INK}">')
        parts += _legend(rows, f"{name}-{number}", width)
        parts.append("</g>")
    return "".join([*parts, "</svg>"])


def _select_labeled(chart: Chart) -> list[Layer]:
    return [layer for layer in chart.layers if layer.label]


def _chart(chart: Chart, name: str, width: float, height: float, *, numbered: bool) -> list[str]:
    """A chart whose upper left corner is the origin."""
    parts = [f'<text y="-10" font-size="13" font-weight="bold">{html.escape(chart.title)}</text>'] * bool(chart.title)
    if chart.equal:
        scale = min(width / abs(chart.x.high - chart.x.low), height / abs(chart.y.high - chart.y.low))
        width, height = (scale * abs(axis.high - axis.low) for axis in (chart.x, chart.y))
    lines, texts = "", list[str]()
    for value, text in chart.x.ticks(max(int(width * _TICKS_PER_UNIT), 2)):
        x = width * float(chart.x.shares(np.array(value)))
        lines += f"M{x:.1f} 0V{height:.1f}"
        texts.append(
            f'<text x="{x:.1f}" y="{height + 15:.1f}" text-anchor="middle">{_format_signed(text)}</text>' * numbered
        )
    for value, text in chart.y.ticks(max(int(height * 1.6 * _TICKS_PER_UNIT), 2)):
        y = height * (1.0 - float(chart.y.shares(np.array(value))))
        lines += f"M0 {y:.1f}H{width:.1f}"
        texts.append(f'<text x="-6" y="{y + 4:.1f}" text-anchor="end">{_format_signed(text)}</text>')
    parts += [
        f'<path d="{lines}" stroke="{GRID}" stroke-width="1.2"/>',
        f'<path d="M0 0V{height:.1f}H{width:.1f}" fill="none" stroke="{GRAY}" stroke-width="1.2"/>',
        *texts,
        f'<text transform="translate(-50 {height / 2:.1f}) rotate(-90)" text-anchor="middle">'
        f"{html.escape(chart.y.label)}</text>",
    ]
    if numbered:
        parts.append(
            f'<text x="{width / 2:.1f}" y="{height + 33:.1f}" text-anchor="middle">{html.escape(chart.x.label)}</text>'
        )
    parts.append(f'<clipPath id="{name}"><rect width="{width:.1f}" height="{height:.1f}"/></clipPath>')
    parts.append(f'<g clip-path="url(#{name})">')
    for number, layer in enumerate(chart.layers):
        if len(layer.points):
            shares = np.column_stack([chart.x.shares(layer.points[:, 0]), 1.0 - chart.y.shares(layer.points[:, 1])])
            # far outside, numbers grow long and browsers lose precision
            places = np.clip(shares, -2.0, 3.0) * [width, height]
            parts.append(layer_svg(layer, f"{name}-{number}", places))
    parts.append("</g>")
    return parts


def _format_signed(number: str) -> str:
    return number.replace("-", "\N{MINUS SIGN}")


def _rows(layers: Sequence[Layer], width: float) -> list[list[Layer]]:
    """Entries of a legend in lines that are not wider than a chart."""
    rows = list[list[Layer]]()
    for layer in layers:
        if rows and sum(map(_entry_width, [*rows[-1], layer])) <= width:
            rows[-1].append(layer)
        else:
            rows.append([layer])
    return rows


def _legend(rows: Sequence[Sequence[Layer]], name: str, width: float) -> list[str]:
    """Lines of entries, each in the middle below a chart."""
    parts = list[str]()
    for line, row in enumerate(rows):
        at = (width - sum(map(_entry_width, row))) / 2
        for number, layer in enumerate(row):
            parts += _entry(layer, f"{name}-legend-{line}-{number}", at, 6.0 + _LEGEND * line)
            at += _entry_width(layer)
    return parts


def _entry_width(layer: Layer) -> float:
    return 44.0 + _LETTER * len(layer.label)


def _entry(layer: Layer, name: str, left: float, y: float) -> list[str]:
    """A sample of a layer and its label."""
    ends = (
        [[left + 4.0, y], [left + 24.0, y]] if layer.shape in (MarkShape.LINE, MarkShape.DASHES) else [[left + 14.0, y]]
    )
    text = f'<text x="{left + 30:.1f}" y="{y + 4:.1f}">{html.escape(layer.label)}</text>'
    return [layer_svg(layer, name, np.array(ends)), text]


def charts_figure(sheet: ChartSheet) -> Figure:
    """Draw charts side by side or above each other with matplotlib; :func:`charts_svg` is faster, for pages."""
    count, stacked = len(sheet.charts), sheet.stacked
    columns, rows = (1, count) if stacked else (count, 1)
    with drawing():
        size_in = (columns * (sheet.width_in + 0.75) + 0.2, rows * (sheet.height_in + 0.15) + 1.1)
        figure, panels = new_panels(*size_in, rows=rows, columns=columns, sharex=stacked)
        for number, (axis, chart) in enumerate(zip(panels, sheet.charts, strict=True)):
            last = not stacked or number == count - 1
            axis.set(xlabel=chart.x.label if last else "", ylabel=chart.y.label, title=chart.title)
            axis.set_xscale("log" if chart.x.logarithmic else "linear")
            axis.set_yscale("log" if chart.y.logarithmic else "linear")
            axis.set(xlim=(chart.x.low, chart.x.high), ylim=(chart.y.low, chart.y.high))
            axis.set_aspect("equal" if chart.equal else "auto")
            for layer in chart.layers:
                _draw(axis, layer)
            labels = len(_select_labeled(chart)) - stacked  # of a stack, one alone says nothing
            if last and labels > 0:
                places = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.36 / sheet.height_in), "ncols": labels + 1}
                axis.legend(**places)
    return figure


def _draw(axis: Axes, layer: Layer) -> None:
    x, y = layer.points.T
    if layer.shape is MarkShape.BARS:
        axis.vlines(x[::2], y[::2], y[1::2], color=layer.color, linewidth=layer.width)
    elif layer.shape is MarkShape.ARROWS:
        shifts = layer.points[1::2] - layer.points[::2]
        axis.quiver(x[::2], y[::2], *shifts.T, angles="xy", scale_units="xy", scale=1.0, color=layer.color, width=0.003)
    else:
        draw_layer(axis, layer)


def draw_layer(axis: Axes, layer: Layer) -> None:
    """Draw a layer of markers or lines with matplotlib."""
    markers = {
        MarkShape.RING: "o", MarkShape.CROSS: "x", MarkShape.PLUS: "+", MarkShape.DOT: ".", MarkShape.SQUARE: "s",
        MarkShape.TRIANGLE: "^", MarkShape.DIAMOND: "D",
    }  # fmt: skip
    line = {MarkShape.LINE: "-", MarkShape.DASHES: "--"}.get(layer.shape, "none")
    axis.plot(
        *layer.points.T, marker=markers.get(layer.shape), linestyle=line, color=layer.color, markersize=layer.size,
        markeredgewidth=layer.width, linewidth=layer.width, markerfacecolor=layer.fill, label=layer.label or None,
    )  # fmt: skip
