"""Images with stars, outlines and centers drawn on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.plotting.style import drawing

MARKS = MappingProxyType(
    {
        "matched star": "#3ddc97",
        "detected, not used": "#ffb347",
        "where the solution puts catalog stars": "#6ec6ff",
        "match thrown out": "#ff4d4d",
        "a priori outline and center": "#b9a7ff",
        "limb points used": "#ffe066",
    }
)
"""Colors by meaning, for a legend beside the figures."""

CENTERS = ("#ff5c7a", "#37c8ff", "#8dff6a", "#ff9de2", "#ffffff", "#ffa042")
"""Colors for the centers that estimators found."""

_OUTLINE, _LIMB = MARKS["a priori outline and center"], MARKS["limb points used"]
_PANEL_IN = 4.6
"""Width of a panel, inches: 506 px at the 110 dpi of the report, whose narrowest card is 480 px wide."""
_MAX_ELONGATION = 2.0
"""Largest ratio of the sides of a panel; narrower images are stretched."""
_MIN_ZOOM_PX, _ZOOM_MARGIN = 24.0, 1.25
"""Half width of a close-up at the least, px, and its margin around the body."""
_SOFTENING = 8.0
"""Level, in units of the noise, up to which the gray scale is linear; above it is logarithmic."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarMarks(Value):
    """Stars of an image, px.

    Parameters
    ----------
    detected_px : (n, 2)
        All detections.
    matched_px, predicted_px : (m, 2)
        Identified stars as measured, and as the solution predicts them.
    rejected_px : (k, 2)
        Matches rejected as outliers.
    """

    detected_px: Float
    matched_px: Float
    predicted_px: Float
    rejected_px: Float = field(default_factory=lambda: np.zeros((0, 2)))

    @classmethod
    def of_detections(cls, detected_px: Float) -> StarMarks:
        """Marks of an image whose stars were not identified.

        Parameters
        ----------
        detected_px : (n, 2)

        Returns
        -------
        StarMarks
        """
        return cls(detected_px=detected_px, matched_px=np.zeros((0, 2)), predicted_px=np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CenterMark(Value):
    """Result of one estimator.

    Parameters
    ----------
    color : str
    center_px : (2,)
    covariance_px2 : (2, 2)
    limb_px : (n, 2)
        Limb points used.
    """

    color: str
    center_px: Float
    covariance_px2: Float
    limb_px: Float = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyMarks(Value):
    """A body in an image, px.

    Parameters
    ----------
    name : str
    predicted_px : (2,)
        A priori center.
    radius_px : float
        Apparent radius of the sphere around it.
    outline_px : (n, 2)
        A priori outline; empty for a body too small to have one.
    lit : (n,) bool
        True for outline points in sunlight.
    centers : sequence of CenterMark
    """

    name: str
    predicted_px: Float
    radius_px: float
    outline_px: Float
    lit: Mask
    centers: Sequence[CenterMark] = ()


def stretched(pixels: NDArray[np.generic], *, longest_px: int = 640) -> NDArray[np.uint8]:
    """Return an image for viewing: noise dark gray, faint stars visible, the shading of bodies kept.

    Parameters
    ----------
    pixels : (rows, columns), DN
    longest_px : int
        Larger images are reduced to about this many pixels along the longer side; single bright pixels survive.

    Returns
    -------
    gray : (rows, columns) uint8
    """
    image = np.ascontiguousarray(pixels, dtype=np.float32)
    factor = int(np.ceil(max(image.shape) / longest_px))
    if factor > 1:
        image = np.asarray(cv2.dilate(image, np.ones((factor, factor), np.uint8)), dtype=np.float32)[::factor, ::factor]
    steps = np.abs(np.diff(image, axis=1)) if image.shape[1] > 1 else np.zeros((1, 1), np.float32)
    noise = 1.05 * float(np.median(steps))  # of neighbors, so that a body that fills the view does not count
    dark, bright, top = (float(value) for value in np.percentile(image, [10.0, 90.0, 100.0]))
    unit = max(_SOFTENING * noise, 0.5 * (bright - dark), 1e-3 * (top - dark), 1e-9)
    low, high = np.arcsinh(-2 * noise / unit), np.arcsinh(max((top - dark) / unit, 1e-6))
    levels = (np.arcsinh((image - dark) / unit) - low) / (high - low)
    result: NDArray[np.uint8] = np.rint(255.0 * np.clip(levels, 0.0, 1.0)).astype(np.uint8)
    return result


def overlay_figure(
    pixels: NDArray[np.generic], title: str, *, stars: StarMarks | None = None, bodies: Sequence[BodyMarks] = ()
) -> Figure:
    """An image with its stars and bodies, and a close-up of every body that the image shows.

    Parameters
    ----------
    pixels : (rows, columns), DN
    title : str
    stars : StarMarks, optional
    bodies : sequence of BodyMarks

    Returns
    -------
    Figure
    """
    rows, columns = pixels.shape
    close = [(body, view) for body in bodies if (view := _zoom(body, columns, rows)) is not None]
    aspect = float(np.clip(rows / columns, 1 / _MAX_ELONGATION, _MAX_ELONGATION))
    with drawing():
        figure, panels = _panels(1 + len(close), _PANEL_IN, _PANEL_IN * aspect)
        frame = panels[0]
        frame.imshow(
            stretched(pixels), cmap="gray", vmin=0, vmax=255, extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
            aspect="auto",
        )  # fmt: skip
        frame.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), title=title)
        if stars is not None:
            _draw_stars(frame, stars)
        for body in bodies:
            _draw_outline(frame, body)
        for axis, (body, view) in zip(panels[1:], close, strict=True):
            _draw_close_up(axis, pixels, body, view)
    return figure


def _panels(count: int, width_in: float, height_in: float) -> tuple[Figure, list[Axes]]:
    """Panels of equal size side by side; placed here, which is many times faster than matplotlib's own layout."""
    left, bottom, top = 0.42, 0.25, 0.28
    total_width, total_height = count * (left + width_in) + 0.08, bottom + height_in + top
    figure = Figure(figsize=(total_width, total_height), facecolor="white")
    panels = []
    for number in range(count):
        start = left + number * (left + width_in)
        box = (start / total_width, bottom / total_height, width_in / total_width, height_in / total_height)
        axis = figure.add_axes(box)
        axis.grid(visible=False)
        axis.tick_params(labelsize=7)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.yaxis.set_major_locator(MaxNLocator(5))
        panels.append(axis)
    return figure, panels


def _draw_stars(axis: Axes, stars: StarMarks) -> None:
    matched_color, other_color, predicted_color, rejected_color = list(MARKS.values())[:4]
    used = set(map(tuple, stars.matched_px.tolist()))
    other = stars.detected_px[[tuple(point) not in used for point in stars.detected_px.tolist()]]
    size = float(np.clip(80.0 / np.sqrt(max(len(used), 1)), 3.5, 9.0))
    ring: Any = {"linestyle": "none", "marker": "o", "markerfacecolor": "none", "markeredgewidth": 0.7}
    axis.plot(*other.T, **ring, color=other_color, markersize=0.6 * size)
    axis.plot(*stars.matched_px.T, **ring, color=matched_color, markersize=size)
    axis.plot(*stars.rejected_px.T, "x", color=rejected_color, markersize=0.8 * size, markeredgewidth=0.9)
    axis.plot(*stars.predicted_px.T, "+", color=predicted_color, markersize=0.5 * size, markeredgewidth=0.6)


def _draw_outline(axis: Axes, body: BodyMarks) -> None:
    if len(body.outline_px):
        axis.plot(*_closed(body.outline_px).T, "--", color=_OUTLINE, linewidth=0.9)
    axis.plot(*body.predicted_px, "+", color=_OUTLINE, markersize=9, markeredgewidth=1.2)


def _zoom(body: BodyMarks, columns: int, rows: int) -> tuple[Float, float] | None:
    """Middle (2,) and half width of a close-up, px; None if the body is outside of the image."""
    points = np.vstack([body.predicted_px, *(mark.center_px for mark in body.centers), body.outline_px])
    low = np.maximum(points.min(axis=0), -0.5)
    high = np.minimum(points.max(axis=0), [columns - 0.5, rows - 0.5])
    if bool(np.any(high < low)):
        return None
    half = max(_ZOOM_MARGIN * float(np.max(high - low)) / 2, _ZOOM_MARGIN * body.radius_px, _MIN_ZOOM_PX)
    return (low + high) / 2, min(half, max(columns, rows) / 2)


def _draw_close_up(axis: Axes, pixels: NDArray[np.generic], body: BodyMarks, view: tuple[Float, float]) -> None:
    (x, y), half = view
    rows, columns = pixels.shape
    left, right = int(max(x - half, 0)), int(min(x + half, columns - 1)) + 1
    top, bottom = int(max(y - half, 0)), int(min(y + half, rows - 1)) + 1
    cut = pixels[top:bottom, left:right]
    if cut.size:
        axis.imshow(
            stretched(cut), cmap="gray", vmin=0, vmax=255, extent=(left - 0.5, right - 0.5, bottom - 0.5, top - 0.5)
        )
    axis.set(xlim=(x - half, x + half), ylim=(y + half, y - half), title=body.name, facecolor="#101418")
    _draw_outline(axis, body)
    for mark in body.centers:
        if len(mark.limb_px):
            axis.plot(*mark.limb_px.T, ".", color=_LIMB, markersize=2.2)
        elif len(body.outline_px):
            found = body.outline_px + (mark.center_px - body.predicted_px)
            axis.plot(*_closed(found).T, "-", color=mark.color, linewidth=0.7, alpha=0.8)
        axis.plot(*mark.center_px, "x", color=mark.color, markersize=8, markeredgewidth=1.6)
        if np.isfinite(mark.covariance_px2).all():
            axis.add_patch(_three_sigma(mark))


def _closed(points: Float) -> Float:
    """Points (n, 2) of an outline, and the first of them once more."""
    return np.concatenate([points, points[:1]])


def _three_sigma(mark: CenterMark) -> Ellipse:
    values, vectors = np.linalg.eigh(mark.covariance_px2)
    width, height = 6 * np.sqrt(np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    x, y = mark.center_px.tolist()
    return Ellipse((x, y), float(width), float(height), angle=angle, fill=False, edgecolor=mark.color, linewidth=1.0)
