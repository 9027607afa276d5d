"""Charts of one image, as SVG: residuals of its stars, residuals along a limb, correlation around a fix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import map_coordinates

from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.plotting import star_residual_charts
from giantlike.plotting.charts import Axis, Chart, ChartSheet, charts_svg
from giantlike.plotting.layers import Layer, MarkShape
from giantlike.plotting.residual_map import residual_map_svg
from giantlike.plotting.residuals import correlation_surface_figure
from giantlike.plotting.style import GRAY, SERIES, svg_text
from giantlike.processing.correlate import find_peak
from giantlike.viewer.comparison import limb_residuals, match_of
from giantlike.viewer.session import Session


def star_chart(session: Session, file: str) -> str:
    """Residuals of the stars of an image."""
    seen = session.seen(file)
    stars = seen.points.get(seen.record.subject, {}).get("stars")
    if stars is None or not len(stars["observed_px"]):
        raise InputError(f"{file}: no star of it was identified")
    observed, predicted = (np.asarray(stars[name], dtype=float) for name in ("observed_px", "predicted_px"))
    sheet = star_residual_charts(
        observed,
        observed - predicted,
        np.asarray(stars["magnitudes"], dtype=float),
        np.asarray(stars["sigma_px"], dtype=float),
        seen.record.columns,
        seen.record.rows,
    )
    return charts_svg(sheet, "stars")


def limb_chart(session: Session, file: str, target: str) -> str:
    """Distances of the limb points of a target from the outlines at their fixes, by angle."""
    seen = session.seen(file)
    layers, crosses, values = list[Layer](), list[Layer](), [np.zeros(1)]
    for fix in seen.observations:
        if fix.target != target or not len(seen.points.get(fix.subject, {}).get("limb_px", ())):
            continue
        found = limb_residuals(session, file, fix)
        points = np.column_stack([found.angle_deg, found.distance_px])
        color = SERIES[len(layers) % len(SERIES)]
        layers.append(Layer(points=points, shape=MarkShape.DOT, color=color, size=4.5, label=fix.estimator))
        values.append(found.distance_px)
        if len(seen.points[fix.subject].get("limb_rejected_px", ())):
            others = limb_residuals(session, file, fix, rejected=True)
            points = np.column_stack([others.angle_deg, others.distance_px])
            crosses.append(Layer(points=points, shape=MarkShape.CROSS, color=color, size=4.0, label=""))
            values.append(others.distance_px)
    if not layers:
        raise InputError(f"{file}: no fix of {target} has limb points")
    zero = Layer(points=np.array([[-180.0, 0.0], [180.0, 0.0]]), shape=MarkShape.LINE, color=GRAY, width=0.9)
    chart = Chart(
        title=f"{target}: limb points off the outline; crosses: rejected",
        x=Axis(label="angle from +x towards +y, deg", low=-180.0, high=180.0),
        y=Axis.around("outward, px", np.concatenate(values)),
        layers=[zero, *crosses, *layers],
    )
    return charts_svg(ChartSheet(charts=[chart], width_in=3.6, height_in=2.2), f"limb-{target}")


def profile_chart(session: Session, file: str, line_px: Sequence[float]) -> str:
    """Values of an image along a line from (x, y) to (x, y), px, between pixels linearly."""
    require(len(line_px) == 4, f"a line is x,y,x,y, got {len(line_px)} numbers")
    pixels = session.pixels(file).pixels
    (begin, end), size = np.reshape(line_px, (2, 2)), np.array(pixels.shape[::-1])
    require(
        bool(((begin >= 0) & (end >= 0) & (begin < size) & (end < size)).all()), f"{file}: the line leaves the image"
    )
    length_px = float(np.hypot(*(end - begin)))
    along = np.linspace(0.0, length_px, 2 + int(2 * length_px))
    at = begin + (end - begin) * (along / max(length_px, 1e-9))[:, None]
    values = map_coordinates(pixels.astype(np.float64), at.T[::-1], order=1, mode="nearest")
    layer = Layer(points=np.column_stack([along, values]), shape=MarkShape.LINE, color=SERIES[0], width=1.0)
    chart = Chart(
        title=f"from ({begin[0]:.1f}, {begin[1]:.1f}) to ({end[0]:.1f}, {end[1]:.1f})",
        x=Axis(label="along the line, px", low=0.0, high=max(length_px, 1.0)),
        y=Axis.around("DN", values),
        layers=[layer],
    )
    return charts_svg(ChartSheet(charts=[chart], width_in=3.6, height_in=2.2), "profile")


def residual_chart(session: Session, file: str, target: str, estimator: str) -> str:
    """Image minus template of a fix, as the estimator left it: means over cells."""
    residuals = session.seen(file).points.get((target, estimator), {}).get("residuals")
    if residuals is None or not residuals["cell_px"]:
        raise InputError(f"{file}: {estimator} left no map of residuals of {target}")
    return residual_map_svg(
        np.asarray(residuals["at_px"], dtype=float).reshape(-1, 2),
        100.0 * np.asarray(residuals["values"], dtype=float),
        residuals["cell_px"],
        f"{target}, {estimator}: image - template",
        unit="% of its peak",
    )


def correlation_chart(session: Session, file: str, target: str, estimator: str | None = None) -> str:
    """Correlation of the image with the template at a fix, for shifts around it, and its peak."""
    match = match_of(session, file, target, estimator)
    surface = match.correlation()
    peak = find_peak(surface)
    where = None if peak is None else peak.offset_px - (np.array(surface.shape[::-1]) - 1) / 2
    title = f"{target}, {match.estimator or 'prediction'}: correlation by shift"
    return svg_text(correlation_surface_figure(surface, where, title), f"correlation-{target}")
