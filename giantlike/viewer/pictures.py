"""Pictures of the viewer: an image with layers, and how well the image and a fix agree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from giantlike.core.arrays import require
from giantlike.plotting import overlay_figure
from giantlike.plotting.overlays import OverlayPanel, stretch_image
from giantlike.viewer.layers import MarkLayer
from giantlike.viewer.session import Session

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_NAMES = 30  # maximum number of names written in a layer, most important first: more would cover each other
_LONGEST_PX = 2048  # longer sides of images are reduced to this; a page is not wider


def picture_of(
    session: Session, file: str, layers: Sequence[MarkLayer], *, box: tuple[float, float, float, float] | None = None
) -> Figure:
    """Draw an image, or its box (left, top, right, bottom), with layers and names next to stars and landmarks."""
    from matplotlib import patheffects

    pixels = session.pixels(file).pixels
    rows, columns = pixels.shape
    left, top, right, bottom = box or (-0.5, -0.5, columns - 0.5, rows - 0.5)
    first = np.maximum(np.floor([left, top]).astype(int), 0)
    last = np.minimum(np.ceil([right, bottom]).astype(int) + 1, [columns, rows])
    require(bool((last > first).all()) and left < right and top < bottom, f"{file}: nothing of it lies in {box}")
    part = pixels[first[1] : last[1], first[0] : last[0]]
    panel = OverlayPanel(
        title=file,
        gray=stretch_image(part, longest_px=_LONGEST_PX),
        picture_px=np.array([first[0], last[0], first[1], last[1]]) - 0.5,
        limits_px=np.array([left, right, top, bottom]),
        layers=[each.layer for each in layers],
    )
    figure = overlay_figure([panel])
    rim = patheffects.withStroke(linewidth=1.2, foreground="black")
    for each in layers:
        inside = ((each.layer.points >= [left, top]) & (each.layer.points <= [right, bottom])).all(axis=1)
        for place in np.flatnonzero(inside)[: MOST_NAMES if each.names else 0]:
            figure.axes[0].annotate(
                each.names[place],
                each.layer.points[place],
                xytext=(5.0, -2.0),
                textcoords="offset points",
                color=each.layer.color,
                fontsize=5.0,
                path_effects=[rim],
            )
    return figure
