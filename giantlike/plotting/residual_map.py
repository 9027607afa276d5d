"""Residuals over the place where they are in the image, as SVG: a map of cells, blue below zero and red above."""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.plotting.charts import Axis
from giantlike.plotting.style import GRAY, INK

_SIDE = 200.0  # longer side of a map, SVG units
_LEFT, _TOP, _BOTTOM, _RIGHT = 40.0, 22.0, 52.0, 12.0
"""Room for numbers, a title, numbers with a scale of colors, and nothing, SVG units."""
_LETTER = 6.8  # mean width of a letter of the title, SVG units
_BAR, _BAR_WIDTH = 8.0, 110.0  # height and width of the scale of colors, SVG units
_TICKS = 5  # most numbers along a side
_FULL_SHARE = 0.98  # fraction of the cells inside the limits of the color scale: single outliers do not stretch it
_ENDS_BGR = np.array([[150.0, 70.0, 20.0], [245.0, 245.0, 245.0], [30.0, 30.0, 180.0]])
"""Colors of the lower end, of zero and of the upper end."""
_SCALE = np.linspace(-1.0, 1.0, 64)


def residual_map_svg(at_px: Float, values: Float, cell_px: float, title: str, *, unit: str) -> str:
    """Draw a map of residuals. ``at_px`` (n, 2); ``values`` (n,)."""
    low = at_px.min(axis=0)
    cells = np.rint((at_px - low) / cell_px).astype(np.int64)
    columns, rows = (cells.max(axis=0) + 1).tolist()
    most = max(float(np.quantile(np.abs(values), _FULL_SHARE)), 1e-12)
    picture = np.zeros((rows, columns, 4), dtype=np.uint8)
    picture[cells[:, 1], cells[:, 0], :3] = _colors(values / most)
    picture[cells[:, 1], cells[:, 0], 3] = 255
    scale = _SIDE / max(columns, rows)
    width, height = scale * columns, scale * rows
    total = (_LEFT + max(width, _BAR_WIDTH, _LETTER * len(title)) + _RIGHT, _TOP + height + _BOTTOM)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="map" viewBox="0 0 {total[0]:.0f} {total[1]:.0f}" '
        f'width="{total[0]:.0f}" font-family="sans-serif" font-size="10" fill="{INK}">',
        f'<g transform="translate({_LEFT:.0f} {_TOP:.0f})">',
        f'<text y="-8" font-weight="bold" font-size="12">{html.escape(title)}</text>',
        _picture(picture, 0.0, width, height),
        f'<path d="M0 0V{height:.1f}H{width:.1f}" fill="none" stroke="{GRAY}"/>',
    ]
    edge = low - 0.5 * cell_px
    for value, text in Axis(label="x", low=edge[0], high=edge[0] + columns * cell_px).ticks(_TICKS):
        at = (value - edge[0]) / cell_px * scale
        parts.append(f'<text x="{at:.1f}" y="{height + 12:.1f}" text-anchor="middle">{text}</text>')
    for value, text in Axis(label="y", low=edge[1], high=edge[1] + rows * cell_px).ticks(_TICKS):
        at = (value - edge[1]) / cell_px * scale
        parts.append(f'<text x="-4" y="{at + 3:.1f}" text-anchor="end">{text}</text>')
    bar = np.dstack([_colors(_SCALE)[None], np.full((1, len(_SCALE)), 255)]).astype(np.uint8)
    parts.append(_picture(bar, height + 22.0, _BAR_WIDTH, _BAR))
    for share, text in ((0.0, f"\N{MINUS SIGN}{most:.2g}"), (0.5, "0"), (1.0, f"{most:.2g} {unit}")):
        at = _BAR_WIDTH * share
        parts.append(f'<text x="{at:.0f}" y="{height + 41:.1f}" text-anchor="middle">{html.escape(text)}</text>')
    return "".join([*parts, "</g></svg>"])


def _colors(values: Float) -> NDArray[np.uint8]:
    """Colors (n, 3), blue, green, red, of values between -1 and 1."""
    inside = np.clip(values, -1.0, 1.0)
    return np.stack([np.interp(inside, [-1.0, 0.0, 1.0], each) for each in _ENDS_BGR.T], axis=-1).astype(np.uint8)


def _picture(picture: NDArray[np.uint8], y: float, width: float, height: float) -> str:
    _, encoded = cv2.imencode(".png", picture)
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    return (
        f'<image y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" preserveAspectRatio="none" '
        f'style="image-rendering: pixelated" href="data:image/png;base64,{data}"/>'
    )
