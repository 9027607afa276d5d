"""Overlays as SVG for web pages: a JPEG of the pixels under vector marks."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

import cv2
import numpy as np

from giantlike.core.arrays import Float
from giantlike.plotting.charts import Axis
from giantlike.plotting.layers import UNITS_PER_POINT, layer_svg
from giantlike.plotting.overlays import PANEL_IN, OverlayPanel, shown_aspect
from giantlike.plotting.style import GRAY, INK

_UNITS_PER_IN = 72.0 * UNITS_PER_POINT
_LEFT, _TOP, _BOTTOM, _RIGHT = 40, 26, 22, 8
"""Margins of a panel, SVG units: for numbers of four digits and a title of one line."""
_JPEG_QUALITY = 82  # of 100: grain of noise stays visible, a picture of 506 x 506 pixels takes about 40 kB
_ENLARGED = 3.0  # units to a pixel from which pixels are shown as squares, not blurred
_TICKS = 5  # most numbers along a side


def overlay_svg(panels: Sequence[OverlayPanel], name: str) -> str:
    """Return panels side by side as SVG to put inside a page."""
    width = PANEL_IN * _UNITS_PER_IN
    height = width * shown_aspect(panels[0])
    step = _LEFT + width + _RIGHT
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="overlay" viewBox="0 0 {step * len(panels):.0f} '
        f'{_TOP + height + _BOTTOM:.0f}" width="{step * len(panels):.0f}" font-family="sans-serif" font-size="10">'
    ]
    for number, panel in enumerate(panels):
        origin = f"translate({number * step + _LEFT:.1f} {_TOP})"
        parts += [f'<g transform="{origin}">', *_panel(panel, f"{name}-{number}", width, height), "</g>"]
    return "".join([*parts, "</svg>"])


def _panel(panel: OverlayPanel, name: str, width: float, height: float) -> list[str]:
    left, right, top, bottom = panel.limits_px
    origin, scale = np.array([left, top]), np.array([width / (right - left), height / (bottom - top)])
    parts = [
        f'<text y="-9" font-weight="bold" font-size="13" fill="{INK}">{html.escape(panel.title)}</text>',
        f'<clipPath id="{name}"><rect width="{width:.1f}" height="{height:.1f}"/></clipPath>',
        f'<rect width="{width:.1f}" height="{height:.1f}" fill="#101418" stroke="{GRAY}"/>',
        f'<g clip-path="url(#{name})">',
    ]
    if panel.gray.size:
        parts.append(_picture(panel, origin, scale))
    for number, layer in enumerate(panel.layers):
        parts.append(layer_svg(layer, f"{name}-{number}", (layer.points - origin) * scale))
    parts.append("</g>")
    for value, text in Axis(label="x, px", low=left, high=right).ticks(_TICKS):
        parts.append(_tick(text, (value - left) * scale[0], height + 12, "middle"))
    for value, text in Axis(label="y, px", low=top, high=bottom).ticks(_TICKS):
        parts.append(_tick(text, -4, (value - top) * scale[1] + 3, "end"))
    return parts


def _tick(text: str, x: float, y: float, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{INK}">{text}</text>'


def _picture(panel: OverlayPanel, origin: Float, scale: Float) -> str:
    left, right, top, bottom = panel.picture_px
    (x, y), (width, height) = (np.array([left, top]) - origin) * scale, np.array([right - left, bottom - top]) * scale
    _, encoded = cv2.imencode(".jpg", panel.gray, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    squares = ' style="image-rendering: pixelated"' if width > _ENLARGED * panel.gray.shape[1] else ""
    return (
        f'<image x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" preserveAspectRatio="none"{squares} '
        f'href="data:image/jpeg;base64,{data}"/>'
    )
