"""Style of all figures, and their conversion to parts of a web page."""

from __future__ import annotations

import io
import re
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, PURPLE, SKY, INK, GRAY = (
    "#2166ac", "#d9822b", "#1a936f", "#c0392b", "#8e5ea2", "#4aa8d8", "#1f2933", "#8794a1",
)  # fmt: skip
SERIES = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY)
GRID = "#e4e8ec"
MARKERS = ("o", "s", "^", "D", "v", "P")

_STYLE: Any = MappingProxyType(  # matplotlib's own type for this lists every setting by name
    {
        "font.family": "sans-serif",
        "font.size": 9.0,
        "axes.edgecolor": GRAY,
        "axes.labelcolor": INK,
        "axes.titlesize": 9.5,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titlecolor": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": GRID,
        "grid.linewidth": 0.8,
        "xtick.color": INK,
        "ytick.color": INK,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "svg.fonttype": "none",
    }
)


_DARK = MappingProxyType(
    {
        "#ffffff": "#1b2127", "white": "#1b2127", INK: "#e6eaef", GRAY: "#98a4b1", GRID: "#2c343d", BLUE: "#6ec6ff",
        GREEN: "#3ddc97", RED: "#ff7a6b", PURPLE: "#c79be0",
    }
)  # fmt: skip
"""Colors on a dark page, by those on a white one."""


def dark_svg(text: str) -> str:
    """Return an SVG of this package with the colors of a dark page; pictures in it stay as they are."""
    colors = "|".join(map(re.escape, _DARK))
    return re.sub(rf"(?i)(?<=[:\"\s])({colors})(?=[;\"])", lambda found: _DARK[found[1].lower()], text)


def drawing() -> AbstractContextManager[None]:
    """Draw in the style of all figures: ``with drawing(): ...``, for making and for saving them."""
    import matplotlib  # by whoever draws with it: a report does not

    return matplotlib.rc_context(dict(_STYLE))


_MARGINS_IN = {"left": 0.75, "right": 0.2, "top": 0.35, "bottom": 0.75}
"""Around the panels, inches: tick labels and a label on the left, a title above, labels and a legend below."""
_GAPS_IN = {"wspace": 0.75, "hspace": 0.15}
"""Between panels side by side, with tick labels and a label, and above each other, with one abscissa for all."""


def new_panels(
    width_in: float, height_in: float, rows: int = 1, columns: int = 1, *, shown: bool = False, **settings: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure with empty panels between fixed margins, in half the time of matplotlib's own layout."""
    if shown:
        from matplotlib import pyplot

        figure = pyplot.figure(figsize=(width_in, height_in), facecolor="white")
    else:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width_in, height_in), facecolor="white")
    panel_in = (width_in - _MARGINS_IN["left"] - _MARGINS_IN["right"] - (columns - 1) * _GAPS_IN["wspace"]) / columns
    row_in = (height_in - _MARGINS_IN["top"] - _MARGINS_IN["bottom"] - (rows - 1) * _GAPS_IN["hspace"]) / rows
    places = {
        "left": _MARGINS_IN["left"] / width_in,
        "right": 1.0 - _MARGINS_IN["right"] / width_in,
        "bottom": _MARGINS_IN["bottom"] / height_in,
        "top": 1.0 - _MARGINS_IN["top"] / height_in,
        "wspace": _GAPS_IN["wspace"] / panel_in,
        "hspace": _GAPS_IN["hspace"] / row_in,
    }
    return figure, list(figure.subplots(rows, columns, squeeze=False, gridspec_kw=places, **settings).flat)


def show_field(axis: Axes, columns: int, rows: int) -> None:
    """Make a panel show the frame of an image: pixel (0, 0) at the upper left, equal scales."""
    axis.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal", xlabel="x, px", ylabel="y, px")


def svg_text(figure: Figure, name: str) -> str:
    """Return a figure as SVG to put inside a page."""
    import matplotlib

    buffer = io.StringIO()
    with drawing(), matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
