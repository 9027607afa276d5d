"""Display of images, cameras and fixes in notebooks: one drawing on axes for each kind of value."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from giantlike.calibration import CalibrationResult
from giantlike.camera import Camera
from giantlike.camera_models.convert import frame_grid
from giantlike.core.arrays import Float
from giantlike.core.display import paints
from giantlike.core.outcomes import AttitudeFix, CenterFix, Failure, PositionFix
from giantlike.image import Image
from giantlike.plotting.overlays import MARKS, stretch_image
from giantlike.plotting.style import BLUE, INK, RED, drawing, new_panels
from giantlike.ray_tracing import trace_silhouette
from giantlike.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIDE_IN = 5.2
_NODES = 41  # points along the longer side of the frame between which lines of equal angle are drawn
_MARGIN_PX = 12.0  # around a body, px
_MOST_ARROWS = 500  # more hide one another in a figure of :data:`_SIDE_IN`
_ARROW_SHARE = 1 / 22  # length of the arrow of a typical residual over the width of the field


@paints(Image)
def draw_image(image: Image, axes: Axes | None = None, *, longest_px: int = 1024) -> Axes:
    """Draw an image: noise dark gray, faint stars visible, the shading of bodies kept."""
    axes = _axes(axes, image.rows / image.columns)
    extent = (-0.5, image.columns - 0.5, image.rows - 0.5, -0.5)
    axes.imshow(stretch_image(image.pixels, longest_px=longest_px), cmap="gray", vmin=0, vmax=255, extent=extent)
    axes.grid(visible=False)
    axes.set(title=image.name, xlabel="x, px", ylabel="y, px")
    return axes


@paints(Camera)
def draw_camera(camera: Camera, axes: Axes | None = None) -> Axes:
    """Draw the field of a camera: lines of equal angle from the boresight, in degrees."""
    axes = _axes(axes, camera.rows / camera.columns)
    points = frame_grid(camera.columns, camera.rows, nodes=_NODES)
    directions = camera.model.unproject(points)
    angle = np.degrees(np.arctan2(np.hypot(directions[..., 0], directions[..., 1]), directions[..., 2]))
    lines = axes.contour(points[..., 0], points[..., 1], angle, levels=8, colors=BLUE, linewidths=1.0)
    axes.clabel(lines, fmt="%.3g deg", fontsize=8)
    axes.plot(*camera.model.project(np.array([0.0, 0.0, 1.0])), "+", color=RED, markersize=12)
    axes.set(xlim=(-0.5, camera.columns - 0.5), ylim=(camera.rows - 0.5, -0.5), aspect="equal", title=camera.name)
    axes.set(xlabel="x, px", ylabel="y, px")
    return axes


@paints(Scene)
def draw_scene(
    scene: Scene, axes: Axes | None = None, *, image: Image | None = None, camera: Camera | None = None
) -> Axes:
    """Draw the predicted outlines of the targets of a scene over an image; without one, their names and radii."""
    if image is None or camera is None:
        axes = _axes(axes, 0.6)
        names = [target.name for target in scene.targets]
        axes.barh(names, [target.shape.circumscribing_radius_km for target in scene.targets], color=BLUE)
        axes.set(xlabel="radius, km", title="Targets", xscale="log")
        return axes
    axes = draw_image(image, axes)
    angles = np.linspace(0.0, 2.0 * np.pi, 361)
    for target in scene.targets:
        geometry = scene.geometry(image, target.name)
        if isinstance(geometry, Failure):
            continue
        sun = geometry.sun_direction_camera
        outline = trace_silhouette(geometry.body(), camera.model, angles, sun_direction_camera=sun)
        axes.plot(*outline.points_px[outline.valid].T, "--", color=MARKS["a priori outline and center"], linewidth=1.0)
        center = camera.model.project(geometry.position_camera_km)
        axes.annotate(target.name, (center[0], center[1]), color="white", fontsize=9)
    return axes


@paints(AttitudeFix)
def draw_attitude(fix: AttitudeFix, axes: Axes | None = None) -> Axes:
    """Draw the residuals of the stars of an attitude as arrows over the field."""
    axes = _axes(axes, 1.0)
    median_px = _arrows(axes, fix.observed_px, fix.residuals_px, fix.rejected_px)
    axes.set_title(f"Residuals of {fix.n_used} stars, median {median_px:.3g} px")
    return axes


@paints(CalibrationResult)
def draw_calibration(result: CalibrationResult, axes: Axes | None = None) -> Axes:
    """Draw the residuals of all images of a calibration as arrows over the field."""
    axes = _axes(axes, 1.0)
    used = result.used
    median_px = _arrows(axes, result.observed_px[used], result.residuals_px[used], result.observed_px[~used])
    axes.set_title(f"Residuals of {result.n_used} observations, median {median_px:.3g} px")
    return axes


def _arrows(axes: Axes, observed_px: Float, residuals_px: Float, rejected_px: Float) -> float:
    """Arrows of residuals over the field (some, if they are many), crosses where one was rejected; the median, px."""
    typical = max(float(np.median(np.linalg.norm(residuals_px, axis=1))), 1e-9) if len(residuals_px) else 1.0
    width = float(np.ptp(observed_px, axis=0).max()) if len(residuals_px) else 1.0
    arrows = residuals_px * (_ARROW_SHARE * width / typical)
    some = np.linspace(0, len(arrows) - 1, min(len(arrows), _MOST_ARROWS)).astype(int)
    at, drawn = observed_px[some], arrows[some]
    axes.quiver(*at.T, *drawn.T, angles="xy", scale_units="xy", scale=1.0, color=BLUE, width=0.003)
    axes.plot(*rejected_px.T, "x", color=RED)
    axes.invert_yaxis()
    axes.set(xlabel="x, px", ylabel="y, px", aspect="equal")
    return typical


@paints(CenterFix)
def draw_fix(fix: CenterFix, axes: Axes | None = None, *, image: Image | None = None) -> Axes:
    """Draw the center of a body with its ellipse of three sigma, and limb points used and rejected, or the outline."""
    from matplotlib.patches import Ellipse

    axes = _axes(axes, 1.0) if image is None else draw_image(image, axes)
    limb = fix.limb_px if isinstance(fix, PositionFix) else np.zeros((0, 2))
    if isinstance(fix, PositionFix) and len(fix.measured_limb_px):
        axes.plot(*fix.limb_rejected_px.T, ".", color=MARKS["limb points rejected"], markersize=3)
        axes.plot(*limb.T, ".", color=MARKS["limb points used"], markersize=3)
    else:  # the outline of a template, or landmarks
        axes.plot(*limb.T, ".", color=BLUE, markersize=2)
    values, vectors = np.linalg.eigh(fix.covariance_px2)
    width, height = 6.0 * np.sqrt(np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(Ellipse(tuple(fix.center_px), width, height, angle=angle, fill=False, color=RED))
    axes.plot(*fix.center_px, "x", color=RED if image is None else "#8dff6a")
    points = np.vstack([limb, fix.center_px])
    half = max(float(np.abs(points - fix.center_px).max()) + _MARGIN_PX, 3.0 * float(height))
    x, y = fix.center_px.tolist()
    axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half), xlabel="x, px", ylabel="y, px", aspect="equal")
    axes.set_title(f"{fix.target} by {fix.estimator}", color=INK)
    return axes


def _axes(axes: Axes | None, aspect: float) -> Axes:
    """The given axes, or the axes of a new figure with this ratio of height to width."""
    if axes is not None:
        return axes
    with drawing():
        _, panels = new_panels(_SIDE_IN, min(max(_SIDE_IN * aspect + 0.6, 2.0), 8.0), shown=True)
    return panels[0]
