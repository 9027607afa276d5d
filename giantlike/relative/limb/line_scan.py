"""Measure the lit limb of a body of any shape: lines across the predicted outline, matched with a rendered template."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value, select_rows
from giantlike.processing.limb.measurement import (
    MIN_BRIGHTNESS,
    UNSEEN,
    LimbMeasurement,
    SmoothError,
    limb_design,
    no_lit_limb,
    pixels_near,
    too_few,
)
from giantlike.processing.limb.scan import (
    PIXEL_VARIANCE_PX2,
    SAMPLING_VARIANCE_PX2,
    Scans,
    edge_width_px,
    line_offsets,
    scan_lines,
)
from giantlike.processing.limb.search import find_limb
from giantlike.processing.limb.view import LimbView, PredictedLimb
from giantlike.ray_tracing import Body, Reflectance, Silhouette, trace_silhouette
from giantlike.ray_tracing.near_outline import outline_brightness
from giantlike.relative.limb.fix import (
    LEAST_PSF_PX2,
    PATIENCE,
    EdgeModel,
    IteratedSearch,
    LimbState,
    LimbStep,
    agreeing_step,
    next_motion_px,
    settle_limb,
)
from giantlike.relative.limb.profiles import (
    OTHER_LAWS,
    ExpectedProfiles,
    LimbScanOptions,
    expected_profiles,
    match_lines,
    step_shortfall,
)

_OVERVIEW_RAD = np.arange(360) * (2.0 * np.pi / 360)  # of an outline all around: a degree is 2 px at a radius of 100
_COARSE_LINES, _COARSE_SPACING_PX = 160, 1.0
"""Maximum number, and minimum spacing, of lines for the search of the outline as a whole."""
_LEAST_LINES = 8  # lines laid on the shortest limb: below the minimum of the options, which then reject it
_FIRST_SEARCH_PX = 3.0  # additional search along lines in the first measurement, px, for the error of the coarse search
_FIRST_LINES = 100  # lines of the first measurement, whose error may be up to the width of a profile
_FIRST_MATCHES = 3
"""Maximum number of matches of the first measurement. Its lines are offset from the compared positions, so that relief
of the outline moves the body by a tenth of that. Errors of nine rocks of 300 px fell from 0.0054 to 0.0042 px by it."""
_FIRST_TOLERANCE_PX = 0.1  # motion of the limb, px, below which the first measurement has converged
_RELIEF_TOLERANCE, _RELIEF_SEARCH = 0.1, 3.0
"""Tolerance of the motion of a limb, and additional search along lines, in units of the relief."""
_STEP_SHADOW_PX = 0.1
"""Maximum width of the shadow along a limb, px, up to which a step takes the edge of the light as the limb."""
_UNSURE = 0.5  # final tolerance of the motion of a limb, in standard deviations by the shared parameters
_PSF_STEP = 0.25  # relative change of the variance of the point spread function above which the limb is measured again
_MIN_WIDTH_PX = 0.3  # minimum width of a point spread function measured on a limb, px, that pixels sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbLines(Value):
    """Lines across an outline, by the directions of their intersections from the body's center."""

    angles_rad: Float  # (k,); from +x towards +y
    brightness: Float  # (k,); just inside the outline, over the brightest place along it
    spacing_px: float  # between neighbors, along the limb
    perimeter_px: float  # length of the whole outline
    cut_by_frame: bool  # part of the outline lies outside the frame

    def thin(self, count: int) -> LimbLines:
        """Return about ``count`` of the lines, evenly chosen; all where there are fewer."""
        step = max(self.angles_rad.size // count, 1)
        angles, brightness = self.angles_rad[::step], self.brightness[::step]
        return replace(self, angles_rad=angles, brightness=brightness, spacing_px=step * self.spacing_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outline(Value):
    """Whole outline of a body where it is predicted."""

    silhouette: Silhouette  # in even steps of the angle
    brightness: Float  # (k,); just inside the outline, over the brightest place along it

    @classmethod
    def from_body(cls, view: LimbView, body: Body) -> Outline:
        """Trace the outline of a body all around and the light just inside it."""
        model, sun = view.model, view.sun_direction_camera
        silhouette = trace_silhouette(body, model, _OVERVIEW_RAD, sun_direction_camera=sun)
        brightness = outline_brightness(
            silhouette.points_px,
            silhouette.normals_px,
            body,
            model,
            sun_direction_camera=sun,
            radius_px=view.radius_px,
        )
        return cls(silhouette=silhouette, brightness=brightness)

    def at(self, lines: LimbLines) -> PredictedLimb:
        """Interpolate the limb where ``lines`` meet it, to about a pixel."""
        outline = self.silhouette
        points, normals, points_km = (
            np.stack([np.interp(lines.angles_rad, outline.angles_rad, v, period=2.0 * np.pi) for v in values.T], -1)
            for values in (outline.points_px, outline.normals_px, outline.points_camera_km)
        )
        known = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
        return PredictedLimb(
            points_px=points[known],
            points_camera_km=points_km[known],
            normals_px=normals[known],
            brightness=lines.brightness[known],
        )

    def move(self, center_px: Float, scale: float) -> Outline:
        """Return the outline moved to another center (2,), px, and scaled, to about a pixel."""
        old = self.silhouette
        points = center_px + scale * (old.points_px - old.center_px)
        return replace(self, silhouette=replace(old, points_px=points, center_px=center_px))

    def intersect(self, view: LimbView, lines: LimbLines, margin_px: float) -> PredictedLimb:
        """Interpolate the limb where ``lines`` meet it in the frame, ``margin_px`` from its edge."""
        limb = self.at(lines)
        return select_rows(limb, view.contains(limb.points_px, margin_px=margin_px))


def lay_lines(
    view: LimbView, outline: Outline, *, spacing_px: float, max_lines: int, margin_px: float
) -> LimbLines | None:
    """Lay lines across the lit limb in even steps.

    ``margin_px``: distance of the limb from the edge of the frame (negative for limb outside); returns None where no
    lit limb lies in the frame.
    """
    points, angles = outline.silhouette.points_px, outline.silhouette.angles_rad
    chord = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    inside = outline.silhouette.valid & view.contains(points, margin_px=margin_px)
    wanted = inside & (outline.brightness > MIN_BRIGHTNESS)
    if not wanted.any():
        return None
    wanted |= np.roll(wanted, 1) | np.roll(wanted, -1)
    length = np.where(wanted, np.nan_to_num(chord), 0.0)
    total_px = float(length.sum())
    count = int(np.clip(total_px / spacing_px, _LEAST_LINES, max_lines))
    along = np.concatenate([[0.0], np.cumsum(length)])
    places = (np.arange(count) + 0.5) * total_px / count
    chosen = np.interp(places, along, np.append(angles, 2.0 * np.pi))
    return LimbLines(
        angles_rad=chosen,
        brightness=np.interp(chosen, angles, outline.brightness, period=2.0 * np.pi),
        spacing_px=total_px / count,
        perimeter_px=float(np.nansum(chord)),
        cut_by_frame=not bool(view.contains(points).all()),
    )


def measure_by_lines(
    view: LimbView,
    body: Body,
    search: IteratedSearch,
    options: LimbScanOptions,
    *,
    relief: SmoothError | None = None,
    other_laws: tuple[Reflectance, ...] = OTHER_LAWS,
) -> LineMeasurement | Failure:
    """Find the limb of a body and measure it line by line until convergence."""
    outline = Outline.from_body(view, body)
    lines = lay_lines(
        view, outline, spacing_px=_COARSE_SPACING_PX, max_lines=_COARSE_LINES, margin_px=-search.search_px
    )
    if lines is None:
        return _not_seen(view, outline.silhouette, body, -search.search_px)
    found = find_limb(
        view,
        outline.at(lines),
        body.position_camera_km,
        search_px=search.search_px,
        search_range=search.search_range,
        min_contrast=options.min_contrast,
    )
    if isinstance(found, Failure):
        return found
    position, coarse = found
    moved = outline.move(outline.silhouette.center_px + coarse.shift_px, coarse.scale)
    lines = lay_lines(
        view, moved, spacing_px=options.spacing_px, max_lines=options.max_lines, margin_px=options.margin_px
    )
    if lines is None:
        return _not_seen(view, moved.silhouette, body, options.margin_px)
    scan = LineScan(
        view=view,
        body=body,
        lines=lines,
        search=search,
        options=options,
        relief=relief,
        outline=moved,
        other_laws=other_laws,
    )
    closest_km = body.shape.circumscribing_radius_km
    start = LimbState(position_camera_km=position, psf_px2=(view.psf_sigma_px or UNKNOWN_PSF_SIGMA_PX) ** 2)
    return settle_limb(scan, start, search, min_points=options.min_lines, closest_km=closest_km)


def measure_once(
    view: LimbView, body: Body, search: IteratedSearch, options: LimbScanOptions, *, psf_px2: float
) -> LineMeasurement | Failure:
    """Measure the limb of a body line by line at its given position."""
    outline = Outline.from_body(view, body)
    lines = lay_lines(
        view, outline, spacing_px=options.spacing_px, max_lines=options.max_lines, margin_px=options.margin_px
    )
    if lines is None:
        return _not_seen(view, outline.silhouette, body, options.margin_px)
    scan = LineScan(view=view, body=body, lines=lines, search=search, options=options)
    return scan.measure_at(body.position_camera_km, psf_px2=max(psf_px2, LEAST_PSF_PX2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineMeasurement(LimbMeasurement):
    """Limb measured line by line."""

    psf_px2: float  # variance of the point spread function estimated from the lines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineScan(Value):
    """Measures a limb line by line: a :class:`~giantlike.relative.limb.fix.LimbScan`.

    relief: departure of the true outline from the modeled one; with it the limits on profiles are looser.
    """

    view: LimbView
    body: Body  # anywhere
    lines: LimbLines
    search: IteratedSearch
    options: LimbScanOptions
    relief: SmoothError | None = None
    outline: Outline | None = None  # outline as located, the start of the first measurement; None to trace it
    other_laws: tuple[Reflectance, ...] = OTHER_LAWS  # laws mixed into the law of the body

    @property
    def relief_px(self) -> float:
        """Root mean square of the relief, px."""
        return 0.0 if self.relief is None else self.relief.sigma_px

    def measure(self, state: LimbState) -> LineMeasurement | Failure:
        """Measure the limb across the body in a state, roughly at first."""
        if state.iteration > 0:
            return self.measure_at(state.position_camera_km, psf_px2=state.psf_px2)
        scan = replace(self, lines=self.lines.thin(_FIRST_LINES))
        return scan.measure_at(state.position_camera_km, extra_px=_FIRST_SEARCH_PX)

    def step(self, measured: LineMeasurement, state: LimbState) -> LimbStep:
        """Robust least-squares step, and the width of the point spread function estimated from the lines."""
        step = agreeing_step(measured, self.search.outlier_mad)
        return replace(step, psf_px2=measured.psf_px2 - state.psf_px2)

    def has_converged(self, measured: LineMeasurement, step: LimbStep, moved_px: float, state: LimbState) -> bool:
        """Return True if the next step would be small, or in the end if noise explains this one."""
        if state.iteration == 0 or abs(step.psf_px2) > _PSF_STEP * state.psf_px2:
            return False
        tolerance_px = self.search.tolerance_px + _RELIEF_TOLERANCE * self.relief_px
        kept = self.finish(measured, step)
        unsure_px = max(kept.motion_sigma_px(step.position_km), _UNSURE * kept.common_sigma_px)
        by_noise = state.iteration >= PATIENCE and moved_px < unsure_px
        return next_motion_px(state.moved_px, moved_px) < tolerance_px or by_noise

    def finish(self, measured: LineMeasurement, step: LimbStep) -> LineMeasurement:
        """Return the measurement with the points that agree."""
        return replace(measured, keep=step.keep)

    def measure_at(
        self, position_camera_km: Float, *, psf_px2: float | None = None, extra_px: float = 0.0
    ) -> LineMeasurement | Failure:
        """Measure the limb across the body at a position."""
        view, options, body = self.view, self.options, self.body.at(position_camera_km)
        limb = self._limb(body, first=psf_px2 is None)
        if isinstance(limb, Failure):
            return limb
        scans = self._scans(limb, self._offsets(extra_px))
        width = _psf_sigma(view, scans, options) if psf_px2 is None else math.sqrt(psf_px2)
        if isinstance(width, Failure):
            return width
        first = psf_px2 is None
        profiles = expected_profiles(view, body, scans, width**2, options, self.other_laws, first=first)
        if isinstance(profiles, Failure):
            return profiles
        found = self._match(position_camera_km, limb, scans, profiles, width)
        if isinstance(found, Failure) or psf_px2 is not None:
            return found
        return self._rematch(found, limb, profiles, width, offsets_px=scans.offsets_px)

    def _rematch(
        self,
        found: LineMeasurement,
        limb: PredictedLimb,
        profiles: ExpectedProfiles,
        width: float,
        *,
        offsets_px: Float,
    ) -> LineMeasurement:
        """Match profiles again at the new position of the body, moved along with it, until convergence.

        The first match is kept where the next step is more than half as long.
        """
        model, outlier_mad, first = self.view.model, self.search.outlier_mad, found
        step_km = agreeing_step(found, outlier_mad).position_km
        before_px = float(np.max(np.abs(found.design @ step_km)))
        for _ in range(_FIRST_MATCHES - 1):
            points_km = limb.points_camera_km + step_km
            moved_px = model.project(points_km) - model.project(limb.points_camera_km)
            moved = replace(limb, points_px=limb.points_px + moved_px, points_camera_km=points_km)
            again = self._match(found.position_camera_km, moved, self._scans(moved, offsets_px), profiles, width)
            if isinstance(again, Failure):
                return first
            found = replace(again, shift_px=again.shift_px + again.design @ step_km)
            next_km = agreeing_step(found, outlier_mad).position_km
            further_px, step_km = float(np.max(np.abs(found.design @ (next_km - step_km)))), next_km
            if further_px < _FIRST_TOLERANCE_PX:
                return found
            if further_px > 0.5 * before_px:
                return first
            before_px = further_px
        return found

    def _offsets(self, extra_px: float = 0.0) -> Float:
        """Offsets (m,) along lines from the limb, px; ``extra_px`` farther than in ``options``."""
        search_px = self.options.local_search_px + _RELIEF_SEARCH * self.relief_px + extra_px
        return line_offsets(self.options.window_px + search_px, self.options.step_px)

    def _scans(self, limb: PredictedLimb, offsets_px: Float) -> Scans:
        """The image along the lines across a limb."""
        view = self.view
        usable = view.with_clipped if self.options.edges is EdgeModel.TEMPLATE else view.usable
        return scan_lines(view.pixels_dn, usable, limb.points_px, limb.normals_px, offsets_px)

    def _match(
        self, position_camera_km: Float, limb: PredictedLimb, scans: Scans, profiles: ExpectedProfiles, width: float
    ) -> LineMeasurement | Failure:
        """Match lines with their profiles, which were made with a point spread function of some ``width``, px."""
        view, options, offsets = self.view, self.options, scans.offsets_px
        known = view.psf_sigma_px if profiles.layout.count else None
        loose = self.relief_px > 0.0 or options.edges is EdgeModel.STEP
        search_px = offsets[-1] - options.window_px
        found = match_lines(view, scans, profiles, window_px=options.window_px, search_px=search_px, loose=loose)
        match, good, rejected = found.match, found.good, found.rejected
        area = pixels_near(limb.points_px, limb.normals_px, offsets, view.usable.shape)
        if good.sum() < options.min_lines:
            return too_few(view, area, good, rejected, needed=options.min_lines)
        brightness_px = match.brightness_error_px(good)
        if options.edges is EdgeModel.STEP:
            brightness_px *= step_shortfall(scans, width**2, view, options)
        errors = [SmoothError(cause=Cause.REFLECTANCE, sigma_px=brightness_px, length_px=view.radius_px)]
        if found.extrapolated_px > 0.0:
            extrapolated = SmoothError(cause=Cause.EDGE, sigma_px=found.extrapolated_px, length_px=view.radius_px)
            errors.append(extrapolated)
        unseen = rejected.pop(UNSEEN) if options.edges is EdgeModel.TEMPLATE else 0  # clipped pixels are seen there
        design = limb_design(limb.normals_px[good], view.model.project_jacobian(limb.points_camera_km[good]))
        return LineMeasurement(
            predicted_px=limb.points_px[good],
            normals_px=limb.normals_px[good],
            design=design,
            shift_px=match.shift_px[good],
            sigma_px=match.sigma_px[good],
            keep=np.ones(int(good.sum()), dtype=bool),
            common_px={cause: shared[good] for cause, shared in found.common_px.items()},
            smooth_errors=tuple(errors),
            position_camera_km=position_camera_km,
            spacing_px=self.lines.spacing_px,
            perimeter_px=self.lines.perimeter_px,
            cut_by_frame=self.lines.cut_by_frame,
            rejected=rejected,
            n_elsewhere=unseen,
            area=area,
            relief=self.relief,
            psf_px2=width**2 + found.psf_px2,
            wider_px2=None if known is None else width**2 + found.psf_px2 - known**2,
            unmeasured_px=limb.points_px[~good],
            rotation_design=np.cross(limb.points_camera_km[good] - position_camera_km, design),
        )

    def _limb(self, body: Body, *, first: bool) -> PredictedLimb | Failure:
        """The limb where lines meet it in the frame; at first as located, which is accurate enough."""
        if first and self.outline is not None and self.options.edges is EdgeModel.TEMPLATE:
            limb = self.outline.intersect(self.view, self.lines, self.options.margin_px)
            if limb.points_px.size:
                return limb
        return _trace_limb(self.view, body, self.lines, self.options)


def _trace_limb(view: LimbView, body: Body, lines: LimbLines, options: LimbScanOptions) -> PredictedLimb | Failure:
    """The limb of a body where lines meet it in the frame; for steps only where no shadow lies along it."""
    margin_px = options.margin_px
    outline = trace_silhouette(body, view.model, lines.angles_rad, sun_direction_camera=view.sun_direction_camera)
    seen = outline.valid & view.contains(outline.points_px, margin_px=margin_px)
    seen &= np.isfinite(outline.normals_px).all(axis=1)
    if options.edges is EdgeModel.STEP:
        shadow_px = 0.5 * view.radius_px * np.minimum(np.nan_to_num(outline.cos_incidence), 0.0) ** 2
        seen &= shadow_px < _STEP_SHADOW_PX
    if not seen.any():
        return _not_seen(view, outline, body, margin_px)
    return PredictedLimb(
        points_px=outline.points_px[seen],
        points_camera_km=outline.points_camera_km[seen],
        normals_px=outline.normals_px[seen],
        brightness=lines.brightness[seen],
    )


def _not_seen(view: LimbView, outline: Silhouette, body: Body, margin_px: float) -> Failure:
    inside = outline.valid & view.contains(outline.points_px, margin_px=margin_px)
    return no_lit_limb(view, outline.points_px[outline.valid], inside, body.position_camera_km)


def _psf_sigma(view: LimbView, scans: Scans, options: LimbScanOptions) -> float | Failure:
    """Width of the point spread function, px: declared by the camera, or measured on the limb."""
    if view.psf_sigma_px is not None:
        return view.psf_sigma_px
    usable = int(scans.usable.all(axis=1).sum())
    if usable < options.min_lines:
        return Failure(
            Reason.NO_LIMB,
            f"the camera has no psf, and {usable} good lines across the limb are too few to measure it, needed "
            f"{options.min_lines}",
        )
    variance, window_px, search_px = view.detector.variance_dn2, options.window_px, options.local_search_px
    width = edge_width_px(scans, variance_dn2=variance, window_px=window_px, search_px=search_px)
    return math.sqrt(max(width**2 - PIXEL_VARIANCE_PX2 - SAMPLING_VARIANCE_PX2, _MIN_WIDTH_PX**2))
