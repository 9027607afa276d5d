"""Observing the lit limb of a body: lines across the predicted outline, matched with a rendered template.

Shared by the estimators that work on limbs. :func:`locate_limb` finds the outline as a whole and gives the place to
start from; :func:`observe_limb` measures it line by line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value
from giantlike.processing.limb.scan import (
    PIXEL_VARIANCE_PX2,
    SAMPLING_VARIANCE_PX2,
    ProfileMatch,
    Scans,
    edge_width_px,
    line_offsets,
    match_profiles,
    scan_lines,
    step_profile,
)
from giantlike.processing.limb.search import search_limb
from giantlike.ray_tracing import Body, render_near
from giantlike.relative.estimator import EstimatorInputs, position_of_center
from giantlike.relative.limb.lines import LimbLines, lay_lines, plan_lines, survey_outline, trace_lines

_COARSE_LINES = 160
_MIN_CORRELATION, _MIN_CORRELATION_LOOSE = 0.9, 0.8
_MAX_UNEXPLAINED, _MAX_UNEXPLAINED_LOOSE = 0.15, 0.3
_GAIN_RANGE = (0.3, 3.0)  # over the median of the lines
_MAX_NOISE_PX = 0.5
_MIN_WIDTH_PX = 0.3
_BRIGHTNESS_ERROR = 1.0
"""Error of the limb by a wrong reflectance law over the shift that freeing the slope of the brightness makes."""
_MEDIAN_SIGMA = 1.2533  # standard deviation of the median of normal values over theirs, times sqrt(n): sqrt(pi / 2)
_LINES_ALIKE = 3.0  # neighbors that share pixels, and so their errors
_FEW_RAYS_RADIUS_PX, _MAX_RAYS = 50.0, 12  # larger bodies need no more than the options say


class EdgeModel(StrEnum):
    """What the profile across the limb is compared with."""

    TEMPLATE = "template"
    """The body rendered with its reflectance law and the point spread function."""
    STEP = "step"
    """A blurred step: no photometric model is needed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbScanOptions:
    """How the limb is observed.

    Parameters
    ----------
    edges : EdgeModel
    spacing_px : float, px
        Between neighboring lines along the limb.
    max_lines : int
        With longer limbs the lines stand farther apart.
    min_lines : int
        Fewer good lines than this are no limb.
    window_px : float, px
        How far to both sides of the limb profiles are compared.
    local_search_px : float, px
        How far a single line may find its edge from the outline that was located as a whole.
    step_px : float, px
        Between samples on a line.
    rays_per_pixel_side : int
        Of the rendered template where the outline lies; small bodies get more.
    min_contrast : float
        Mean of (inside - outside) / (inside + outside) across the limb below which no limb was located.
    """

    edges: EdgeModel = EdgeModel.TEMPLATE
    spacing_px: float = 1.5
    max_lines: int = 400
    min_lines: int = 12
    window_px: float = 5.0
    local_search_px: float = 4.0
    step_px: float = 0.5
    rays_per_pixel_side: int = 5
    min_contrast: float = 0.35

    def __post_init__(self) -> None:
        known = [str(kind) for kind in EdgeModel]
        require(self.edges in known, f"edges must be one of {', '.join(known)}, got {self.edges!r}")
        object.__setattr__(self, "edges", EdgeModel(self.edges))
        for name in ("spacing_px", "window_px", "local_search_px", "step_px"):
            value = getattr(self, name)
            require(math.isfinite(value) and value > 0, f"{name} must be > 0, got {value}")
        require(self.step_px <= 1.0, f"step_px must be <= 1, got {self.step_px}")
        require(self.min_lines >= 6, f"min_lines must be >= 6, got {self.min_lines}")
        require(
            self.min_lines <= self.max_lines <= 1000, f"max_lines must be in [min_lines, 1000], got {self.max_lines}"
        )
        require(
            1 <= self.rays_per_pixel_side <= 16,
            f"rays_per_pixel_side must be in [1, 16], got {self.rays_per_pixel_side}",
        )
        require(0.0 < self.min_contrast < 1.0, f"min_contrast must be in (0, 1), got {self.min_contrast}")

    @property
    def reach_px(self) -> float:
        """How far outside the frame limb still counts, px: negative, as profiles need their window."""
        return -(self.window_px + 2.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbObservation(Value):
    """The lit limb, measured across a prediction.

    Parameters
    ----------
    predicted_px : (n, 2) float64, px
        Limb points of the body at ``position_camera_km``, those whose lines were good.
    limb_camera_km : (n, 3) float64, km, camera axes
        The same points in space.
    normals_px : (n, 2) float64, unitless
        Outward normals of the outline in the image.
    shift_px : (n,) float64, px
        From the predicted limb outward to the one in the image.
    sigma_px : (n,) float64, px
        Standard deviation by pixel noise.
    brightness_error_px : float, px
        How far the whole limb may be off because its brightness is not as the reflectance law says.
    position_camera_km : (3,) float64, km, camera axes
        Where the body was for the prediction.
    lines : LimbLines
    n_lines : int
        Lines across lit limb in the frame.
    rejected : mapping of str to int
        Lines left out, by reason.
    limb_share : float
        Length of limb measured over the whole outline of the body.
    area : (rows, columns) bool
        Pixels on the lines.
    """

    predicted_px: Float
    limb_camera_km: Float
    normals_px: Float
    shift_px: Float
    sigma_px: Float
    brightness_error_px: float
    position_camera_km: Float
    lines: LimbLines
    n_lines: int
    rejected: Mapping[str, int]
    limb_share: float
    area: Mask

    @property
    def observed_px(self) -> Float:
        """Limb points (n, 2) in the image, px."""
        result: Float = self.predicted_px + self.shift_px[:, None] * self.normals_px
        return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocatedLimb(Value):
    """Where the outline as a whole was found.

    Parameters
    ----------
    position_camera_km : (3,) float64, km, camera axes
        Of the body, good to about a pixel of the limb.
    lines : LimbLines
        Across the lit limb there.
    """

    position_camera_km: Float
    lines: LimbLines


def locate_limb(
    inputs: EstimatorInputs, body: Body, *, search_px: float, search_range: float, options: LimbScanOptions
) -> LocatedLimb | Failure:
    """Find the outline of a body as a whole, about a prediction that may be off.

    Parameters
    ----------
    inputs : EstimatorInputs
    body : Body
        At the predicted position.
    search_px : float, px
        Largest error of the predicted center, in both coordinates.
    search_range : float
        Largest relative error of the predicted range.
    options : LimbScanOptions

    Returns
    -------
    LocatedLimb or Failure
        ``NO_LIMB``, ``NOT_LIT`` or ``OUT_OF_FRAME``, with numbers.
    """
    survey = survey_outline(inputs, body)
    predicted = lay_lines(inputs, survey, max_lines=_COARSE_LINES, spacing_px=1.0, reach_px=search_px)
    if isinstance(predicted, Failure):
        return predicted
    limb = survey.between(predicted)
    model = inputs.camera.model
    center_px = body.center_px(model)
    noise_dn = float(np.sqrt(inputs.camera.detector.variance_dn2(np.zeros(1))[0]))
    coarse = search_limb(
        inputs.pixels_dn,
        inputs.usable,
        limb.points_px,
        limb.normals_px,
        limb.brightness,
        center_px,
        search_px=search_px,
        search_scale=search_range,
        noise_dn=noise_dn,
    )
    if coarse.contrast < options.min_contrast:
        return inputs.fail(
            Reason.NO_LIMB,
            f"no limb within {search_px:g} px of the predicted one: the best contrast across {len(limb.points_px)} lit "
            f"limb points is {coarse.contrast:.2f}, needed {options.min_contrast:g}; the brightest good pixel holds "
            f"{float(inputs.pixels_dn[inputs.usable].max()):.4g} DN over bias, noise in the dark is {noise_dn:.3g}",
        )
    range_km = float(np.linalg.norm(body.position_camera_km)) / coarse.scale
    found_px = center_px + coarse.shift_px
    position, _ = position_of_center(model, found_px, range_km, np.zeros((3, 3)))
    if not np.isfinite(position).all():
        return inputs.fail(Reason.OUT_OF_FRAME, "the limb was found where the camera model images nothing")
    lines = lay_lines(
        inputs,
        survey,
        max_lines=options.max_lines,
        spacing_px=options.spacing_px,
        reach_px=options.reach_px,
        center_px=found_px,
        scale=coarse.scale,
    )
    return lines if isinstance(lines, Failure) else LocatedLimb(position_camera_km=position, lines=lines)


def observe_limb(
    inputs: EstimatorInputs,
    body: Body,
    options: LimbScanOptions,
    *,
    lines: LimbLines | None = None,
    extra_px: float = 0.0,
    relief: bool = False,
) -> LimbObservation | Failure:
    """Measure the lit limb line by line.

    Parameters
    ----------
    inputs : EstimatorInputs
    body : Body
        Where the limb is expected, to a few pixels.
    options : LimbScanOptions
    lines : LimbLines, optional
        Those of an earlier observation, so that the same places on the limb are measured again.
    extra_px : float, px
        How much farther than ``options`` say each line is searched.
    relief : bool
        The body only stands for one with relief: profiles need to be less alike.

    Returns
    -------
    LimbObservation or Failure
        ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME`` or ``SATURATED``, with numbers.
    """
    search_px = options.local_search_px + extra_px
    if lines is None:
        planned = plan_lines(
            inputs, body, max_lines=options.max_lines, spacing_px=options.spacing_px, reach_px=options.reach_px
        )
        if isinstance(planned, Failure):
            return planned
        lines = planned
    limb = trace_lines(inputs, body, lines, reach_px=options.reach_px)
    if isinstance(limb, Failure):
        return limb
    offsets = line_offsets(options.window_px + search_px, options.step_px)
    scans = scan_lines(inputs.pixels_dn, inputs.usable, limb.points_px, limb.normals_px, offsets)
    width = _psf_sigma(inputs, scans, options)
    if isinstance(width, Failure):
        return width
    expected = _expected(inputs, body, scans, width, options)
    if isinstance(expected, Failure):
        return expected
    match = match_profiles(
        scans,
        expected,
        variance_dn2=inputs.camera.detector.variance_dn2,
        window_px=options.window_px,
        search_px=search_px,
    )
    keep, rejected = _judge(match, loose=relief or options.edges is EdgeModel.STEP)
    if keep.sum() < options.min_lines:
        return _too_few(inputs, scans, int(keep.sum()), rejected, options)
    return LimbObservation(
        predicted_px=limb.points_px[keep],
        limb_camera_km=limb.points_camera_km[keep],
        normals_px=limb.normals_px[keep],
        shift_px=match.shift_px[keep],
        sigma_px=match.sigma_px[keep],
        brightness_error_px=_brightness_error_px(match.without_slope_px[keep]),
        position_camera_km=body.position_camera_km,
        lines=lines,
        n_lines=keep.size,
        rejected=rejected,
        limb_share=min(float(keep.sum()) * lines.spacing_px / lines.perimeter_px, 1.0),
        area=_area(scans, inputs.usable.shape),
    )


def _brightness_error_px(without_slope_px: Float) -> float:
    """How far a wrong law may move the whole limb, px, from what freed slopes do to lines (n,), less their scatter."""
    typical = float(np.median(without_slope_px))
    scatter = robust_sigma(without_slope_px, typical)
    chance = _MEDIAN_SIGMA * scatter / math.sqrt(max(without_slope_px.size / _LINES_ALIKE, 1.0))
    return _BRIGHTNESS_ERROR * math.sqrt(max(typical**2 - chance**2, 0.0))


def _psf_sigma(inputs: EstimatorInputs, scans: Scans, options: LimbScanOptions) -> float | Failure:
    """Point spread function: that of the camera, or as wide as the limb is blurred."""
    if inputs.psf_sigma_px is not None:
        return inputs.psf_sigma_px
    usable = scans.usable.all(axis=1)
    if usable.sum() < options.min_lines:
        return inputs.fail(
            Reason.NO_LIMB,
            f"the camera has no psf and only {int(usable.sum())} good lines across the limb to measure it, "
            f"needed {options.min_lines}",
        )
    width = edge_width_px(
        scans,
        variance_dn2=inputs.camera.detector.variance_dn2,
        window_px=options.window_px,
        search_px=options.local_search_px,
    )
    return math.sqrt(max(width**2 - PIXEL_VARIANCE_PX2 - SAMPLING_VARIANCE_PX2, _MIN_WIDTH_PX**2))


def _expected(
    inputs: EstimatorInputs, body: Body, scans: Scans, psf_sigma_px: float, options: LimbScanOptions
) -> Float | Failure:
    """Profiles (n, m) that the lines should show."""
    if options.edges is EdgeModel.STEP:
        width = math.sqrt(psf_sigma_px**2 + PIXEL_VARIANCE_PX2 + SAMPLING_VARIANCE_PX2)
        return np.tile(step_profile(scans.offsets_px, width), (len(scans.points_px), 1))
    compared = np.abs(scans.offsets_px) <= options.window_px + 2.0 * options.step_px
    places = scans.points_px[:, None] + scans.offsets_px[compared, None] * scans.normals_px[:, None]
    brightness = render_near(
        places,
        body,
        inputs.focal_plane(psf_sigma_px),
        sun_direction_camera=inputs.geometry.sun_direction_camera,
        rays_per_pixel_side=_rays_for(inputs.radius_px, options),
    )
    if isinstance(brightness, Failure):
        return inputs.fail(brightness.reason, brightness.detail)
    everywhere = np.ones(brightness.shape, dtype=bool)
    return scan_lines(brightness, everywhere, scans.points_px, scans.normals_px, scans.offsets_px).values_dn


def _rays_for(radius_px: float, options: LimbScanOptions) -> int:
    """Rays along a pixel that a body of some radius should get: few pixels on the limb average few rays."""
    more = max(_FEW_RAYS_RADIUS_PX / radius_px, 1.0)
    return max(min(math.ceil(more * options.rays_per_pixel_side), _MAX_RAYS), options.rays_per_pixel_side)


def _judge(match: ProfileMatch, *, loose: bool) -> tuple[Mask, dict[str, int]]:
    """Which lines are good, and how many are not for which reason (the first that applies)."""
    fits = match.correlation >= (_MIN_CORRELATION_LOOSE if loose else _MIN_CORRELATION)
    fits &= match.unexplained <= (_MAX_UNEXPLAINED_LOOSE if loose else _MAX_UNEXPLAINED)
    gain_ok = match.gain_dn > 0
    typical = match.complete & fits & gain_ok
    if typical.any() and not loose:
        low, high = np.array(_GAIN_RANGE) * float(np.median(match.gain_dn[typical]))
        gain_ok = (match.gain_dn > low) & (match.gain_dn < high)
    checks = (
        ("masked, saturated or outside the frame", match.complete),
        ("too weak", match.sigma_px < _MAX_NOISE_PX),
        ("not like the expected profile", fits),
        ("too bright or too dark", gain_ok),
        ("beyond the search", ~match.at_border),
        ("ambiguous", ~match.rivalled),
    )
    keep = np.ones(match.complete.shape, dtype=bool)
    rejected = {}
    for name, passed in checks:
        rejected[name] = int((keep & ~passed).sum())
        keep &= passed
    return keep, rejected


def _too_few(
    inputs: EstimatorInputs, scans: Scans, kept: int, rejected: Mapping[str, int], options: LimbScanOptions
) -> Failure:
    total = len(scans.points_px)
    area = _area(scans, inputs.usable.shape)
    saturated = float(inputs.saturated[area].mean()) if area.any() else 0.0
    reasons = ", ".join(f"{count} {name}" for name, count in rejected.items() if count)
    return inputs.fail(
        Reason.SATURATED if saturated > 0.2 else Reason.NO_LIMB,
        f"{kept} of {total} lines across the lit limb in the frame are good, needed {options.min_lines}"
        + (f"; {reasons}" if reasons else ""),
    )


def _area(scans: Scans, shape: tuple[int, ...]) -> Mask:
    """Pixels (rows, columns) that the lines cross."""
    area = np.zeros(shape, dtype=bool)
    places = scans.points_px[:, None] + scans.offsets_px[:, None] * scans.normals_px[:, None]
    index = np.rint(places).astype(np.intp).reshape(-1, 2)
    inside = np.all((index >= 0) & (index < [shape[1], shape[0]]), axis=1)
    area[index[inside, 1], index[inside, 0]] = True
    return area
