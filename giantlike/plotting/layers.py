"""Layers of a picture or a chart: points, with a shape and a color; and their SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value

UNITS_PER_POINT = 110.0 / 72.0
"""SVG units per point: 110 per inch, so that a panel of 4.6 inches is 506 wide; cards of the report have 480 px."""
MANY_POINTS = 3000  # points of a chart from which those that fall on one place are drawn once, to keep a page small
_HEAD, _HEAD_SLOPE = 4.0, 0.5  # length of the head of an arrow, SVG units, and its half width over the length


class MarkShape(StrEnum):
    """Style of the points of a layer."""

    RING = "ring"
    CROSS = "cross"
    PLUS = "plus"
    DOT = "dot"
    SQUARE = "square"
    TRIANGLE = "triangle"
    DIAMOND = "diamond"
    LINE = "line"
    DASHES = "dashes"
    BARS = "bars"  # vertical strokes, each between two points
    ARROWS = "arrows"  # each from a point to the next


_MARKERS = {
    MarkShape.RING: '<circle cx="5" cy="5" r="4"/>',
    MarkShape.DOT: '<circle cx="5" cy="5" r="2" fill="{color}" stroke="none"/>',
    MarkShape.CROSS: '<path d="M1 1L9 9M9 1L1 9"/>',
    MarkShape.PLUS: '<path d="M5 1V9M1 5H9"/>',
    MarkShape.SQUARE: '<path d="M1.5 1.5H8.5V8.5H1.5z"/>',
    MarkShape.TRIANGLE: '<path d="M5 1L9 8.5H1z"/>',
    MarkShape.DIAMOND: '<path d="M5 .5L9.5 5L5 9.5L.5 5z"/>',
}
"""Markers in a box of 10 x 10, the shape itself 8 wide."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer(Value):
    """Points of one meaning over an image or in a chart."""

    points: Float  # (n, 2); px, or in units of the axes of a chart; of ``BARS`` and ``ARROWS`` two for each
    shape: MarkShape
    color: str
    size: float = 0.0  # points; diameter of a marker; of lines unused
    width: float = 1.0  # points; of strokes
    fill: str = "none"  # color inside of a marker
    label: str = ""  # for a legend; empty for none


def layer_svg(layer: Layer, name: str, points: Float) -> str:
    """One path for all points of a layer: strokes, or invisible with a marker at each vertex."""
    width = layer.width * UNITS_PER_POINT
    if layer.shape in (MarkShape.LINE, MarkShape.DASHES, MarkShape.BARS, MarkShape.ARROWS):
        dashes = ' stroke-dasharray="5 3"' if layer.shape is MarkShape.DASHES else ""
        path = {MarkShape.BARS: _bars, MarkShape.ARROWS: _arrows}.get(layer.shape, _line)(points)
        return f'<path d="{path}" fill="none" stroke="{layer.color}" stroke-width="{width:.1f}"{dashes}/>'
    if len(points) > MANY_POINTS:
        points = np.unique(np.rint(points), axis=0)
    size = layer.size * UNITS_PER_POINT * 10 / 8
    box = f'viewBox="0 0 10 10" refX="5" refY="5" markerWidth="{size:.1f}" markerHeight="{size:.1f}"'
    drawn = _MARKERS[layer.shape].format(color=layer.color)
    # a path of one point shows no marker: the last point is there twice, and a marker at the end would be drawn twice.
    return (
        f'<marker id="{name}" {box} markerUnits="userSpaceOnUse"><g fill="{layer.fill}" stroke="{layer.color}" '
        f'stroke-width="{10 * width / size:.2f}">{drawn}</g></marker>'
        f'<path d="{_line(points)}h0" fill="none" stroke="none" marker-start="url(#{name})" '
        f'marker-mid="url(#{name})"/>'
    )


def _line(points: Float) -> str:
    return "M" + "L".join(_places(points))


def _places(points: Float) -> Sequence[str]:
    return [f"{x:.1f} {y:.1f}".replace(".0", "") for x, y in points.tolist()]


def _bars(points: Float) -> str:
    """Strokes; of many, those that stand in one column of units are joined."""
    ends = np.concatenate([points[::2], points[1::2, 1:]], axis=1)
    if len(ends) > MANY_POINTS:
        columns, which = np.unique(np.rint(ends[:, 0]), return_inverse=True)
        low, high = np.full(len(columns), np.inf), np.full(len(columns), -np.inf)
        np.minimum.at(low, which, ends[:, 1:].min(axis=1))
        np.maximum.at(high, which, ends[:, 1:].max(axis=1))
        ends = np.column_stack([columns, low, high])
    return "".join(f"M{x:.1f} {low:.1f}V{high:.1f}" for x, low, high in ends.tolist())


def _arrows(points: Float) -> str:
    start, end = points[::2], points[1::2]
    length = np.linalg.norm(end - start, axis=1, keepdims=True)
    back = (start - end) / np.maximum(length, 1e-9) * np.minimum(_HEAD, 0.5 * length)
    side = _HEAD_SLOPE * back[:, ::-1] * [-1.0, 1.0]
    parts = zip(*map(_places, (start, end, end + back + side, end + back - side)), strict=True)
    return "".join(f"M{tail}L{tip}M{one}L{tip}L{other}" for tail, tip, one, other in parts)
