"""Images with stars, outlines and centers drawn on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.plotting.charts import draw_layer
from giantlike.plotting.layers import Layer, MarkShape
from giantlike.plotting.style import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKS = MappingProxyType(
    {
        "matched star": "#3ddc97",
        "detected, not used": "#ffb347",
        "where the solution puts catalog stars": "#6ec6ff",
        "match thrown out": "#ff4d4d",
        "a priori outline and center": "#b9a7ff",
        "limb points used": "#ffe066",
        "limb points rejected": "#ff4d4d",
    }
)
"""Colors by meaning, for a legend next to the figures."""

CENTERS = ("#ff5c7a", "#37c8ff", "#8dff6a", "#ff9de2", "#ffffff", "#ffa042")
"""Colors for the centers that estimators found."""

_OUTLINE, _LIMB = MARKS["a priori outline and center"], MARKS["limb points used"]
_LIMB_REJECTED = MARKS["limb points rejected"]
PANEL_IN = 4.6  # width of a panel, inches: 506 px at the 110 dpi of the report, whose narrowest card is 480 px wide
_MAX_ELONGATION = 2.0  # largest ratio of the sides of a panel; narrower images are stretched
_MIN_ZOOM_PX, _ZOOM_MARGIN = 24.0, 1.25  # half width of a close-up at the least, px, and its margin around the body
_ELLIPSE_RAD = np.linspace(0.0, 2.0 * np.pi, 49)  # of the points of an ellipse: no corners are seen
_CUT = 10.0  # distance of neighbors on an outline, over the median one, beyond which the frame lies between them
_SAMPLED_ROWS = 64  # rows that a gray scale is taken from: 30,000 pixels give percentiles well enough
_SOFTENING = 8.0  # level, in units of the noise, up to which the gray scale is linear; above it is logarithmic


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarMarks(Value):
    """Stars of an image, px."""

    detected_px: Float  # (n, 2); all detections
    matched_px: Float  # matched_px, predicted_px: (m, 2); identified stars as measured, and as predicted
    predicted_px: Float
    rejected_px: Float = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2); matches rejected as outliers

    @classmethod
    def of_detections(cls, detected_px: Float) -> StarMarks:
        """Marks of an image whose stars were not identified. ``detected_px`` (n, 2)."""
        return cls(detected_px=detected_px, matched_px=np.zeros((0, 2)), predicted_px=np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CenterMark(Value):
    """Result of one estimator."""

    color: str
    center_px: Float
    covariance_px2: Float
    limb_px: Float = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2); limb_rejected_px: lit limb not used
    limb_rejected_px: Float = field(default_factory=lambda: np.zeros((0, 2)))
    outline_px: Float = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2); at the result, where it is known


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyMarks(Value):
    """A body in an image, px."""

    name: str
    predicted_px: Float  # a priori center
    radius_px: float  # apparent radius of the sphere around it
    outline_px: Float  # (n, 2); a priori outline; empty for a body too small to have one
    lit: Mask  # (n,); True for outline points in sunlight
    centers: Sequence[CenterMark] = ()


def stretch_image(pixels: NDArray[np.generic], *, longest_px: int = 640) -> NDArray[np.uint8]:
    """Return a gray image (rows, columns) for viewing: noise dark, faint stars visible, the shading of bodies kept."""
    image = np.ascontiguousarray(pixels, dtype=np.float32)
    factor = int(np.ceil(max(image.shape) / longest_px))
    if factor > 1:
        image = np.asarray(cv2.dilate(image, np.ones((factor, factor), np.uint8)), dtype=np.float32)[::factor, ::factor]
    some = image[:: max(image.shape[0] // _SAMPLED_ROWS, 1)]
    steps = np.abs(np.diff(some, axis=1)) if image.shape[1] > 1 else np.zeros((1, 1), np.float32)
    noise = 1.05 * float(np.median(steps))  # of neighbors, so that a body that fills the view does not count
    dark, bright, top = (float(value) for value in (*np.percentile(some, [10.0, 90.0]), image.max()))
    unit = max(_SOFTENING * noise, 0.5 * (bright - dark), 1e-3 * (top - dark), 1e-9)
    low, high = np.arcsinh(-2 * noise / unit), np.arcsinh(max((top - dark) / unit, 1e-6))
    levels = (np.arcsinh((image - dark) / unit) - low) / (high - low)
    result: NDArray[np.uint8] = np.rint(255.0 * np.clip(levels, 0.0, 1.0)).astype(np.uint8)
    return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OverlayPanel(Value):
    """An image or a part of it, and the layers drawn over it."""

    title: str
    gray: NDArray[np.uint8]  # (rows, columns); picture, stretched for viewing; empty where the panel shows no pixel
    picture_px: Float  # (4,); left, right, top and bottom edges of the picture in the image
    limits_px: Float  # (4,); left, right, top and bottom of the panel
    layers: Sequence[Layer] = ()


def overlay_panels(
    pixels: NDArray[np.generic], title: str, *, stars: StarMarks | None = None, bodies: Sequence[BodyMarks] = ()
) -> list[OverlayPanel]:
    """An image with its stars and bodies, and a close-up of every body that the image shows."""
    rows, columns = pixels.shape
    frame = np.array([-0.5, columns - 0.5, -0.5, rows - 0.5])
    layers = [] if stars is None else _star_layers(stars)
    layers += [layer for body in bodies for layer in _outline_layers(body)]
    panels = [OverlayPanel(title=title, gray=stretch_image(pixels), picture_px=frame, limits_px=frame, layers=layers)]
    for body in bodies:
        view = _zoom(body, columns, rows)
        if view is not None:
            panels.append(_close_up(pixels, body, *view))
    return panels


def overlay_figure(panels: Sequence[OverlayPanel]) -> Figure:
    """Draw panels side by side with matplotlib; :mod:`giantlike.plotting.svg_overlay` is faster, for pages."""
    height_in = PANEL_IN * shown_aspect(panels[0])
    with drawing():
        figure, axes = _axes(len(panels), PANEL_IN, height_in)
        for axis, panel in zip(axes, panels, strict=True):
            left, right, top, bottom = panel.picture_px
            if panel.gray.size:
                axis.imshow(panel.gray, cmap="gray", vmin=0, vmax=255, extent=(left, right, bottom, top), aspect="auto")
            left, right, top, bottom = panel.limits_px
            axis.set(xlim=(left, right), ylim=(bottom, top), title=panel.title, facecolor="#101418")
            for layer in panel.layers:
                draw_layer(axis, layer)
    return figure


def shown_aspect(panel: OverlayPanel) -> float:
    """Height of a panel over its width; very long images are stretched."""
    left, right, top, bottom = panel.limits_px
    return float(np.clip((bottom - top) / (right - left), 1 / _MAX_ELONGATION, _MAX_ELONGATION))


def _axes(count: int, width_in: float, height_in: float) -> tuple[Figure, list[Axes]]:
    """Panels of equal size side by side; placed here, in half the time of matplotlib's own layout."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

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


def _star_layers(stars: StarMarks) -> list[Layer]:
    matched_color, other_color, predicted_color, rejected_color = list(MARKS.values())[:4]
    used = set(map(tuple, stars.matched_px.tolist()))
    other = stars.detected_px[[tuple(point) not in used for point in stars.detected_px.tolist()]]
    size = float(np.clip(80.0 / np.sqrt(max(len(used), 1)), 3.5, 9.0))
    layers = [
        Layer(points=other, shape=MarkShape.RING, color=other_color, size=0.6 * size, width=0.7),
        Layer(points=stars.matched_px, shape=MarkShape.RING, color=matched_color, size=size, width=0.7),
        Layer(points=stars.rejected_px, shape=MarkShape.CROSS, color=rejected_color, size=0.8 * size, width=0.9),
        Layer(points=stars.predicted_px, shape=MarkShape.PLUS, color=predicted_color, size=0.5 * size, width=0.6),
    ]
    return [layer for layer in layers if len(layer.points)]


def _outline_layers(body: BodyMarks) -> list[Layer]:
    outline = [Layer(points=one, shape=MarkShape.DASHES, color=_OUTLINE, width=0.9) for one in _arcs(body.outline_px)]
    return [*outline, Layer(points=body.predicted_px[None], shape=MarkShape.PLUS, color=_OUTLINE, size=9.0, width=1.2)]


def _close_up(pixels: NDArray[np.generic], body: BodyMarks, middle_px: Float, half_px: float) -> OverlayPanel:
    rows, columns = pixels.shape
    (x, y), half = middle_px, half_px
    left, right = int(max(x - half, 0)), int(min(x + half, columns - 1)) + 1
    top, bottom = int(max(y - half, 0)), int(min(y + half, rows - 1)) + 1
    cut = pixels[top:bottom, left:right]
    layers = _outline_layers(body)
    for mark in body.centers:
        if len(mark.limb_px):
            layers.append(Layer(points=mark.limb_rejected_px, shape=MarkShape.DOT, color=_LIMB_REJECTED, size=2.2))
            layers.append(Layer(points=mark.limb_px, shape=MarkShape.DOT, color=_LIMB, size=2.2))
        elif len(mark.outline_px) or len(body.outline_px):
            moved = body.outline_px + (mark.center_px - body.predicted_px)
            found = mark.outline_px if len(mark.outline_px) else moved
            layers += [Layer(points=one, shape=MarkShape.LINE, color=mark.color, width=0.7) for one in _arcs(found)]
        layers.append(Layer(points=mark.center_px[None], shape=MarkShape.CROSS, color=mark.color, size=8.0, width=1.6))
        if np.isfinite(mark.covariance_px2).all():
            ellipse = three_sigma_ellipse(mark.center_px, mark.covariance_px2)
            layers.append(Layer(points=ellipse, shape=MarkShape.LINE, color=mark.color))
    return OverlayPanel(
        title=f"{body.name}, close-up",
        gray=stretch_image(cut) if cut.size else np.zeros((0, 0), np.uint8),
        picture_px=np.array([left, right, top, bottom]) - 0.5,
        limits_px=np.array([x - half, x + half, y - half, y + half]),
        layers=[layer for layer in layers if len(layer.points)],
    )


def _zoom(body: BodyMarks, columns: int, rows: int) -> tuple[Float, float] | None:
    """Middle (2,) and half width of a close-up, px; None if the body is outside of the image."""
    points = np.vstack([body.predicted_px, *(mark.center_px for mark in body.centers), body.outline_px])
    low = np.maximum(points.min(axis=0), -0.5)
    high = np.minimum(points.max(axis=0), [columns - 0.5, rows - 0.5])
    if bool(np.any(high < low)):
        return None
    half = max(_ZOOM_MARGIN * float(np.max(high - low)) / 2, _ZOOM_MARGIN * body.radius_px, _MIN_ZOOM_PX)
    return (low + high) / 2, min(half, max(columns, rows) / 2)


def _arcs(outline_px: Float) -> list[Float]:
    """Arcs (k, 2) of an outline (n, 2): the frame cuts it where neighbors are far apart; else one that is closed."""
    if not len(outline_px):
        return []
    steps = np.linalg.norm(np.roll(outline_px, -1, axis=0) - outline_px, axis=1)
    cuts = np.flatnonzero(steps > _CUT * float(np.median(steps)))
    if not len(cuts):
        return [np.concatenate([outline_px, outline_px[:1]])]
    return np.split(np.roll(outline_px, -cuts[-1] - 1, axis=0), cuts[:-1] + len(outline_px) - cuts[-1])


def three_sigma_ellipse(center_px: Float, covariance_px2: Float) -> Float:
    """Points (n, 2), px, of the ellipse of three standard deviations."""
    values, vectors = np.linalg.eigh(covariance_px2)
    circle = np.stack([np.cos(_ELLIPSE_RAD), np.sin(_ELLIPSE_RAD)])
    points: Float = center_px + (3.0 * (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle).T
    return points
