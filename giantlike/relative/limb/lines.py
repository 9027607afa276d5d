"""Where lines are laid across the outline of a body: on the lit limb, in the frame, in even steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, Silhouette, outline_brightness, trace_silhouette
from giantlike.relative.estimator import EstimatorInputs

_OVERVIEW_ANGLES = 360
_MIN_BRIGHTNESS = 0.1  # over the brightest place along it: darker limb tells little beside the rest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbLines(Value):
    """Lines across an outline, by the directions from the body's center in which they meet it.

    Parameters
    ----------
    angles_rad : (k,) float64, rad
        From +x towards +y.
    brightness : (k,) float64
        Just inside the outline, over the brightest place along it.
    spacing_px : float, px
        Between neighbors, along the limb.
    perimeter_px : float, px
        Length of the whole outline.
    cut_by_frame : bool
        Part of the outline lies outside the frame.
    """

    angles_rad: Float
    brightness: Float
    spacing_px: float
    perimeter_px: float
    cut_by_frame: bool

    def thinned(self, count: int) -> LimbLines:
        """About so many of the lines, evenly chosen; all where there are fewer."""
        step = max(self.angles_rad.size // count, 1)
        return replace(
            self,
            angles_rad=self.angles_rad[::step],
            brightness=self.brightness[::step],
            spacing_px=step * self.spacing_px,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedLimb(Value):
    """Points of the limb that are lit and in the frame.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    points_camera_km : (n, 3) float64, km, camera axes
        The same points in space.
    normals_px : (n, 2) float64, unitless
        Outward normals in the image.
    brightness : (n,) float64
        Just inside, over the brightest place along the outline.
    """

    points_px: Float
    points_camera_km: Float
    normals_px: Float
    brightness: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutlineSurvey(Value):
    """The whole outline of a body where it is predicted.

    Parameters
    ----------
    outline : Silhouette
        In even steps of the angle.
    brightness : (k,) float64
        Just inside the outline, over the brightest place along it.
    """

    outline: Silhouette
    brightness: Float

    def between(self, lines: LimbLines) -> PredictedLimb:
        """The limb where ``lines`` meet it, between the points of the survey: good to a pixel or so."""
        points, normals, points_km = (
            np.stack(
                [np.interp(lines.angles_rad, self.outline.angles_rad, v, period=2.0 * np.pi) for v in values.T], -1
            )
            for values in (self.outline.points_px, self.outline.normals_px, self.outline.points_camera_km)
        )
        known = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
        return PredictedLimb(
            points_px=points[known],
            points_camera_km=points_km[known],
            normals_px=normals[known],
            brightness=lines.brightness[known],
        )

    def moved_px(self, center_px: Float, scale: float) -> Float:
        """Points (k, 2) of the outline moved and grown, which is good to a pixel or so."""
        result: Float = center_px + scale * (self.outline.points_px - self.outline.center_px)
        return result


def survey_outline(inputs: EstimatorInputs, body: Body) -> OutlineSurvey:
    """Trace the outline of a body all around and look how bright it is."""
    angles = np.arange(_OVERVIEW_ANGLES) * (2.0 * np.pi / _OVERVIEW_ANGLES)
    sun = inputs.geometry.sun_direction_camera
    outline = trace_silhouette(body, inputs.camera.model, angles, sun_direction_camera=sun)
    brightness = outline_brightness(
        outline.points_px,
        outline.normals_px,
        body,
        inputs.camera.model,
        sun_direction_camera=sun,
        radius_px=inputs.radius_px,
    )
    return OutlineSurvey(outline=outline, brightness=brightness)


def plan_lines(
    inputs: EstimatorInputs, body: Body, *, max_lines: int, spacing_px: float, reach_px: float
) -> LimbLines | Failure:
    """Lay lines across the lit limb of a body: :func:`survey_outline` and :func:`lay_lines`."""
    return lay_lines(
        inputs, survey_outline(inputs, body), max_lines=max_lines, spacing_px=spacing_px, reach_px=reach_px
    )


def lay_lines(
    inputs: EstimatorInputs,
    survey: OutlineSurvey,
    *,
    max_lines: int,
    spacing_px: float,
    reach_px: float,
    center_px: Float | None = None,
    scale: float = 1.0,
) -> LimbLines | Failure:
    """Lay lines across the lit limb.

    Parameters
    ----------
    inputs : EstimatorInputs
    survey : OutlineSurvey
    max_lines : int
    spacing_px : float, px
        Along the limb; longer where ``max_lines`` would not do.
    reach_px : float, px
        How far outside the frame the limb still counts; negative: how far inside it must be.
    center_px : (2,) float64, px, optional
        Where the body is now, and with what ``scale``; None is where it was surveyed.
    scale : float

    Returns
    -------
    LimbLines or Failure
        ``NO_LIMB`` or ``NOT_LIT``, with numbers.
    """
    outline, camera = survey.outline, inputs.camera
    points = survey.moved_px(outline.center_px if center_px is None else center_px, scale)
    chord = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    inside = outline.valid & camera.contains(points, margin_px=-reach_px)
    wanted = inside & (survey.brightness > _MIN_BRIGHTNESS)
    if not wanted.any():
        return _nothing_seen(inputs, outline, inside)
    wanted |= np.roll(wanted, 1) | np.roll(wanted, -1)
    length = np.where(wanted, np.nan_to_num(chord), 0.0)
    total_px = float(length.sum())
    count = int(np.clip(total_px / spacing_px, 8, max_lines))
    along = np.concatenate([[0.0], np.cumsum(length)])
    places = (np.arange(count) + 0.5) * total_px / count
    chosen = np.interp(places, along, np.append(outline.angles_rad, 2.0 * np.pi))
    return LimbLines(
        angles_rad=chosen,
        brightness=np.interp(chosen, outline.angles_rad, survey.brightness, period=2.0 * np.pi),
        spacing_px=total_px / count,
        perimeter_px=float(np.nansum(chord)),
        cut_by_frame=not bool(camera.contains(points).all()),
    )


def trace_lines(inputs: EstimatorInputs, body: Body, lines: LimbLines, *, reach_px: float) -> PredictedLimb | Failure:
    """Trace the limb where the lines meet it.

    Parameters
    ----------
    inputs : EstimatorInputs
    body : Body
    lines : LimbLines
    reach_px : float, px
        As of :func:`plan_lines`.

    Returns
    -------
    PredictedLimb or Failure
        ``NO_LIMB`` when none of the lines meets the limb in the frame.
    """
    silhouette = trace_silhouette(
        body, inputs.camera.model, lines.angles_rad, sun_direction_camera=inputs.geometry.sun_direction_camera
    )
    inside = silhouette.valid & inputs.camera.contains(silhouette.points_px, margin_px=-reach_px)
    seen = inside & np.isfinite(silhouette.normals_px).all(axis=1)
    if not seen.any():
        return _nothing_seen(inputs, silhouette, inside)
    return PredictedLimb(
        points_px=silhouette.points_px[seen],
        points_camera_km=silhouette.points_camera_km[seen],
        normals_px=silhouette.normals_px[seen],
        brightness=lines.brightness[seen],
    )


def _nothing_seen(inputs: EstimatorInputs, overview: Silhouette, inside: Mask) -> Failure:
    """Why there is no lit limb in the frame."""
    total = overview.valid.size
    if not inside.any():
        camera = inputs.camera
        corners = np.array(
            [[0, 0], [camera.columns - 1, 0], [0, camera.rows - 1], [camera.columns - 1, camera.rows - 1]]
        )
        size = np.ptp(overview.points_px[overview.valid], axis=0) if overview.valid.any() else np.full(2, np.nan)
        covered = _encloses(overview.points_px[overview.valid], corners)
        where = "the surface fills the frame" if covered else "the outline passes beside the frame"
        return inputs.fail(
            Reason.NO_LIMB,
            f"none of {total} points of the predicted outline ({size[0]:.0f} x {size[1]:.0f} px) lies in the frame of "
            f"{camera.columns} x {camera.rows}: {where}",
        )
    phase_deg = math.degrees(inputs.geometry.phase_angle_rad)
    return inputs.fail(
        Reason.NOT_LIT,
        f"{int(inside.sum())} of {total} points of the predicted outline lie in the frame, but the body is dark there "
        f"(phase angle {phase_deg:.0f} deg)",
    )


def _encloses(polygon_px: Float, points_px: NDArray[np.int64]) -> bool:
    """Whether the polygon (k, 2) winds around every one of the points (n, 2)."""
    if len(polygon_px) < 3:
        return False
    arms = polygon_px[None] - points_px[:, None]
    angles = np.arctan2(arms[..., 1], arms[..., 0])
    turns = np.diff(np.unwrap(np.concatenate([angles, angles[:, :1]], axis=1), axis=1), axis=1).sum(axis=1)
    return bool(np.all(np.abs(turns) > np.pi))
