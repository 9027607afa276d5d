"""Cross-correlation: a template rendered from shape and light, found in the image and then fitted to it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Mask, require, require_number
from giantlike.core.causes import Cause
from giantlike.core.findings import Corrections, Response, Smear, Trails, Turn
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.core.pixel_box import BoxPixels, PixelBox
from giantlike.core.values import Value
from giantlike.image_model.columns import chance_of_odds
from giantlike.image_model.turn import TURN_SIGMA_RAD
from giantlike.processing.correlate import CorrelationOptions, CorrelationPeak, locate_template
from giantlike.ray_tracing import Template, trace_silhouette
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.ray_tracing.silhouette import outline_points_px
from giantlike.relative.estimator import BodyEstimator, Solved
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import SHORT_ARC_SHARE, Facts
from giantlike.relative.place import limb_in_frame, position_of_center
from giantlike.relative.response import MOST_BEND
from giantlike.relative.template.align import align_template
from giantlike.relative.template.binning import Blocks, make_blocks
from giantlike.relative.template.fit import TemplateFit, TemplateFitOptions, fit_template
from giantlike.relative.template.moved_body import MovedBody
from giantlike.relative.template.rendering import (
    KNOWN_BLUR_SIGMA_PX2,
    ROUGH,
    UNKNOWN_BLUR_SIGMA_PX2,
    TemplateRenderer,
    contrasting_laws,
    place_template,
)
from giantlike.relative.template.state import Synthesis, TemplateState
from giantlike.scene import TargetGeometry
from giantlike.shapes import Ellipsoid

_ALIGN_RADIUS_PX = 12.0  # px, below which the peak of the correlation is close enough to start the fit from
_BOX_MARGIN = 0.08  # of the radius of the body: margin for an error of the range ...
_ALIGNED_MARGIN = 0.02  # ... and for the error that remains after the alignment
_BOX_MARGIN_PX = 6  # px, for the derivatives, the point spread function and some sky
_EDGE_LIGHT = 1e-3  # of the brightest pixel, below which a box may end
_LIT = 0.02  # of the brightest pixel: fainter ones are not counted as the light of the body
_MAX_UNUSABLE_LIGHT = 0.5
"""Maximum fraction of light on saturated or bad pixels. Half and double: benchmarks/sensitivity.md."""
_SEARCHED_WIDER = (Reason.LOW_CORRELATION, Reason.PEAK_AT_EDGE)  # failures that a body outside the search explains
_WIDER, _WIDEST_PX = 2.5, 400  # factor of the declared search, and maximum, px: cost grows with the square
_WIDER_LOG_RANGES = (0.0, -0.08, 0.08)
"""Offsets of the logarithm of the range in the wider search: the alignment converges from 5 % around each."""
_MOST_OVEREXPOSED = 2.0
"""Ratio of signal to saturation above which a limb is lost: a sharp limb is at half of the signal, so that all of it is
saturated and only the wings of the point spread function are left, which are not Gaussian."""
_LEAST_LIMB_PX = 60.0
"""Minimum length of lit limb in the frame, px, to locate an ellipsoid without markings, as in ``auto``. Flat fields,
laws and templates are right to some 1e-3; squared errors by the brightness gradient alone were then 6 per degree of
freedom (484 px, six draws of noise)."""
_ROUNDS, _SETTLED_BEND = 3, 0.02
"""Maximum number of fits with a response, and change of its curvature at convergence; the rest is estimated
linearly."""
_TURN_ROUNDS, _SETTLED_TURN_PX = 6, 0.5
"""Maximum number of fits with a rotated body, and motion of its surface by the last rotation, px, at convergence."""
_LINEAR_PX = 1.0
"""Motion of the surface, in pixels of the fit, up to which its position follows linearly: the width of an edge."""
_OUTLINE_RAD = np.arange(360) * (2.0 * np.pi / 360)  # rad, directions of the outline points of a fix


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossCorrelationOptions:
    """Options of :class:`CrossCorrelation`.

    Parameters
    ----------
    search_px : int, px; largest error of the predicted center, along each axis
    search_range : float
        Largest relative error of the predicted range. As wide as for ``ellipse_fit``: the estimated range of a small
        body is uncertain by some percent. Where the body is not found within both, a wider region is searched; a fix
        there is ``FAR_FROM_PREDICTION``, and so suspect.
    min_score : float; minimum correlation of a body that counts as found
    estimate_scale : bool, optional
        True estimates the range too. By default where the body is at least ``min_scale_diameter_px`` wide.
    min_scale_diameter_px : float, px; smaller bodies hardly constrain their range
    range_sigma : float
        Where the range is not estimated: its a priori standard deviation as a fraction of it, which enters the
        covariance of the center.
    free_reflectance : bool
        Mix another reflectance law into the law of the target, so that a wrong law does not bias the center.
    clip_sigma : float; pixels with larger residuals, in standard deviations, are rejected
    max_iterations : int; maximum number of renders
    relief_sigma : float
        Standard deviation of the errors of the shape along its radii, as a fraction of the radius. Needed for errors
        correlated over a good part of the limb, which residuals do not show.
    relief_length_rad : float, rad; correlation length of these errors on the body: an angle, seen from its center

    Raises
    ------
    InputError
        A value is out of its range.

    Notes
    -----
    Half and double of the defaults move no center of ``benchmarks/sensitivity.md`` by more than 0.7 of its sigma.
    """

    search_px: int = 40
    search_range: float = 0.05
    min_score: float = 0.5
    estimate_scale: bool | None = None
    min_scale_diameter_px: float = 15.0
    range_sigma: float = 0.02
    free_reflectance: bool = True
    clip_sigma: float = 5.0
    max_iterations: int = 8
    relief_sigma: float = 0.0
    relief_length_rad: float = 0.15

    def __post_init__(self) -> None:
        CorrelationOptions(search_px=self.search_px, min_score=self.min_score)
        require_number(self.search_range, "search_range", least=0.0, most=0.3)
        require(self.min_scale_diameter_px > 0, f"min_scale_diameter_px must be > 0, got {self.min_scale_diameter_px}")
        TemplateFitOptions(
            max_iterations=self.max_iterations,
            clip_sigma=self.clip_sigma,
            log_range_sigma=self.range_sigma,
            relief_sigma=self.relief_sigma,
        )
        require(0 < self.relief_length_rad < 3, f"relief_length_rad must be in (0, 3), got {self.relief_length_rad}")


class CrossCorrelation(BodyEstimator[CrossCorrelationOptions, CenterFix]):
    r"""Finds a body by normalized cross-correlation with a rendered template, then fits the template to the pixels.

    The steps: 1. render the body at the predicted geometry, reaching over the frame by the search range; 2. correlate
    within the search range, peak by a paraboloid; 3. move and scale the template onto the image, from blurred to sharp;
    4. fit brightness, center, range and blur, rendering again at each new geometry.

    The result is a :class:`~giantlike.core.outcomes.PositionFix` where the range was estimated and a
    :class:`~giantlike.core.outcomes.CenterFix` elsewhere. ``LOW_CORRELATION``,
    ``PEAK_AT_EDGE``, ``OUT_OF_FRAME``, ``NO_LIMB``, ``NOT_LIT``, ``MASKED``, ``SATURATED``, ``NOT_CONVERGED`` and
    ``DEGENERATE_GEOMETRY`` are its failures. Its ``score`` is the correlation of image and template at the
    solution, its ``residuals`` are image minus model over the brightest pixel of the model, and ``limb_px`` is the
    outline of the template. The covariance is that of :func:`~giantlike.relative.template.fit.fit_template`.

    Parameters
    ----------
    options : CrossCorrelationOptions

    Notes
    -----
    An error of the position moves the body in the image without turning it, an error of the attitude does both. The
    attitude is trusted: the fitted change is taken as one of the position.

    Where a body is predicted outside the field, the paper renders it at the boresight (step 1a). Here the template
    reaches over the frame instead, so that it keeps its aspect; beyond the search range the body cannot be found.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Template Matching".
    """

    name: ClassVar[str] = "cross_correlation"
    finds_response: ClassVar[bool] = True
    options_type = CrossCorrelationOptions

    def _estimate(self, inputs: EstimatorInputs) -> CenterFix | PositionFix | Failure:
        """Find the body of gathered inputs."""
        solved = self._solve(inputs)
        return solved if isinstance(solved, Failure) else solved.fix

    def _solve(self, inputs: EstimatorInputs) -> Solved[CenterFix] | Failure:
        """Find the body of gathered inputs: :func:`match_template`, the flags of its result, and its response."""
        altitude_km = inputs.geometry.limb_altitude_km[0]
        if altitude_km:
            inputs = replace(inputs, corrections=inputs.corrections | Corrections(limb_altitude_km=altitude_km))
        response = inputs.corrections.response
        inputs = inputs if response is None else inputs.linearize(response)
        blocks, match = self._match_template(inputs, response)
        if isinstance(match, Failure):
            return match
        if not inputs.place_alone:
            inputs, blocks, match = self._add_effects(inputs, blocks, match)
        declared = inputs.geometry.limb_altitude_km[1] > 0.0
        if declared or match.fit.chance("haze") > 0.5:
            sigma_km = match.fit.altitude_sigma * inputs.geometry.seen_body().shape.mean_radius_km
            inputs = replace(inputs, corrections=inputs.corrections | Corrections(altitude_sigma_km=sigma_km))
        fix = _fix(inputs, blocks, replace(match, fit=blocks.unbin(match.fit)), self.options)
        return fix if isinstance(fix, Failure) else Solved(fix, _response_of(inputs, blocks, match, fix))

    def _add_effects(
        self, inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch
    ) -> tuple[EstimatorInputs, Blocks, TemplateMatch]:
        """Add effects that are more probable than not to the model, as long as the likelihood increases.

        The shift of the position by an effect, times the probability of the rejected model, is an error.
        """
        independent = match.fit.independent
        tries = (
            (self._fit_linearized, independent.of_surface),
            (self._fit_smeared, independent.of_edges),
            (self._fit_trailed, independent.of_edges),
            (self._fit_turned, independent.of_surface),
        )
        for with_effect, parts in tries:
            again = with_effect(inputs, blocks, match)
            if again is None:
                continue
            chance = chance_of_odds(again[2].log_evidence(parts) - match.log_evidence(parts))
            moved = again[2].fit.place - match.fit.place
            if chance > 0.5:
                inputs, blocks, match = again
            error = min(chance, 1.0 - chance) * np.outer(moved, moved)
            total = match.fit.parts.get(Cause.REFLECTANCE, 0.0) + error
            match = replace(match, fit=replace(match.fit, parts={**match.fit.parts, Cause.REFLECTANCE: total}))
        return inputs, blocks, match

    def _match_template(
        self, inputs: EstimatorInputs, response: Response | None
    ) -> tuple[Blocks, TemplateMatch | Failure]:
        """Match the template to the image of some inputs, averaged over blocks."""
        blocks, smear = make_blocks(inputs), inputs.corrections.smear
        body = inputs.seen_geometry.seen_body()
        renderer = TemplateRenderer(
            target=body,
            plane=blocks.plane,
            sun_direction_camera=inputs.geometry.sun_direction_camera,
            airless=inputs.geometry.target.airless,
        )
        match = match_template(
            blocks.pixels if response is None else _linearize_pixels(blocks.pixels, response),
            blocks.good,
            renderer,
            psf_known=inputs.psf_sigma_px is not None,
            options=replace(self.options, search_px=math.ceil(self.options.search_px / blocks.size)),
            block_px=blocks.size,
            response=response,
            smear=None if smear is None else smear.on_blocks(blocks.size),
            trails=inputs.corrections.trails,
            turn_sigma_rad=max(inputs.turn_rad, TURN_SIGMA_RAD),
            altitude_sigma=inputs.geometry.limb_altitude_km[1] / body.shape.mean_radius_km,
        )
        return blocks, match

    def _fit_linearized(
        self, inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch
    ) -> tuple[EstimatorInputs, Blocks, TemplateMatch] | None:
        """Fit linearized values; None where a nonlinear response is improbable."""
        straight = inputs
        if match.fit.chance("bend") < 0.5:
            return None
        for _ in range(_ROUNDS):
            response = match.fit.response
            response = replace(response, bend=min(max(response.bend, 0.0), MOST_BEND))
            straight = inputs.linearize(response)
            blocks = make_blocks(straight)
            again = match.refit(_linearize_pixels(blocks.pixels, response), response=response)
            if isinstance(again, Failure):
                return None
            match = again
            if abs(match.fit.response.bend - response.bend) < _SETTLED_BEND:
                break
        return straight, blocks, match

    def _fit_smeared(
        self, inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch
    ) -> tuple[EstimatorInputs, Blocks, TemplateMatch] | None:
        """Fit with a smeared template; None where a smear is improbable."""
        if match.fit.chance("smear") < 0.5:
            return None
        again = match.refit(blocks.pixels, smear=match.fit.smear)
        if isinstance(again, Failure):
            return None
        moved = Corrections(smear=again.fit.smear.on_blocks(1.0 / blocks.size))
        return replace(inputs, corrections=inputs.corrections | moved), blocks, again

    def _fit_trailed(
        self, inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch
    ) -> tuple[EstimatorInputs, Blocks, TemplateMatch] | None:
        """Fit with charge-transfer trails; None where they are improbable."""
        if match.fit.chance("trails") < 0.5:
            return None
        again = match.refit(blocks.pixels, trails=match.fit.trails)
        if isinstance(again, Failure):
            return None
        found = Corrections(trails=again.fit.trails)
        return replace(inputs, corrections=inputs.corrections | found), blocks, again

    def _fit_turned(
        self, inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch
    ) -> tuple[EstimatorInputs, Blocks, TemplateMatch] | None:
        """Fit with a rotated body; None where residuals show no errors at edges, or the rotation does not converge."""
        if "turn" not in match.fit.undeclared:
            return None
        for _ in range(_TURN_ROUNDS):
            step = Rotation.from_rotvec(match.fit.undeclared["turn"].score.values)
            again = match.rotate_body(blocks.pixels, step)
            if isinstance(again, Failure):
                return None
            match = again
            if step.magnitude() * match.renderer.radius_px < _SETTLED_TURN_PX:
                break
        found = Corrections(turn=match.options.turn)
        return replace(inputs, corrections=inputs.corrections | found), blocks, match


def _linearize_pixels(pixels: BoxPixels, response: Response) -> BoxPixels:
    """Linearized pixels, their noise variance scaled by the squared slope of the response."""
    noise = pixels.noise_variance_dn2

    def of_light(signal: Float) -> Float:
        return noise(signal) * response.slope_at(response.dark_dn + signal) ** 2

    return replace(pixels, noise_variance_dn2=of_light)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateMatch(Value):
    """A template found in an image and fitted to it."""

    fit: TemplateFit
    box: PixelBox  # pixels that were fitted; it may reach over the frame
    synthesis: Synthesis  # renders the template into the box
    options: TemplateFitOptions
    start: TemplateState  # start of the fits, without blur beyond that of the camera
    renderer: TemplateRenderer
    free_reflectance: bool  # other reflectance laws are mixed in
    most_laws: int | None  # at most so many of them

    def log_evidence(self, parts: float) -> float:
        """Return the logarithm of the likelihood of the pixels, further rotations of a rotated body integrated out."""
        fit = self.fit
        free = 0.0 if self.options.turn is None else fit.columns.odds_of([fit.undeclared["turn"].block], parts)
        return fit.log_evidence(parts) + free

    def rotate_body(self, image: BoxPixels, step: Rotation) -> TemplateMatch | Failure:
        """Return the match with the body rotated further, in camera axes."""
        target, known = self.renderer.target, self.options.turn
        body = replace(target, camera_from_body=step * target.camera_from_body)
        renderer = replace(self.renderer, target=body)
        synthesis = renderer.synthesis(self.box, other_law=self.free_reflectance, most_laws=self.most_laws)
        options = replace(self.options, turn=Turn.of_rotation(step if known is None else step * known.rotation))
        start = replace(self.start, smear=self.fit.state.smear)
        fit = fit_template(image.cut(self.box), synthesis, start, options=options)
        if isinstance(fit, Failure):
            return fit
        return replace(self, fit=fit, synthesis=synthesis, options=options, renderer=renderer)

    def motion(self, light: Float, other: Float) -> Float:
        """Linear motion (3,) of center and logarithm of the range for another light (h, w) of the body."""
        fit = self.fit
        change_dn = float(fit.signal_dn.sum()) / max(float(light.sum()), 1e-300) * (other - light)
        return np.asarray(-np.tensordot(fit.columns.gain("center", "range"), change_dn, 2))

    def refit(
        self,
        image: BoxPixels,
        *,
        response: Response | None = None,
        smear: Smear | None = None,
        trails: Trails | None = None,
    ) -> TemplateMatch | Failure:
        """Return the match with a response, a smear or trails estimated in addition."""
        known = self.options
        options = replace(known, response=response or known.response, trails=trails or known.trails)
        start = replace(self.start, smear=smear or self.fit.state.smear)
        fit = fit_template(image.cut(self.box), self.synthesis, start, options=options)
        return fit if isinstance(fit, Failure) else replace(self, fit=fit, options=options)


def match_template(
    image: BoxPixels,
    good: Mask,
    renderer: TemplateRenderer,
    *,
    psf_known: bool,
    options: CrossCorrelationOptions,
    block_px: int = 1,
    response: Response | None = None,
    smear: Smear | None = None,
    trails: Trails | None = None,
    turn_sigma_rad: float = TURN_SIGMA_RAD,
    altitude_sigma: float = 0.0,
) -> TemplateMatch | Failure:
    """Find a body in an image by correlation with its template, and fit the template to the pixels."""
    radius_px = renderer.radius_px
    located = _locate(image, good, renderer, options)
    if isinstance(located, Failure):
        return located
    start, template, peak = located.traced.state, located.template, located.peak
    shift = np.rint(peak.offset_px).astype(np.int64)
    low, high = _lit_part(template)
    box = renderer.box(low + shift, high + shift, _BOX_MARGIN_PX + math.ceil(_BOX_MARGIN * radius_px))
    pixels, light = image.cut(box), place_template(template, box, shift)
    within = box.cut(np.ones_like(good))
    if not float(light[within].sum()) > 0.0:
        return Failure(Reason.OUT_OF_FRAME, "the best correlation lies outside the frame")
    known = pixels.usable if pixels.censored is None else pixels.usable | pixels.censored
    if float(light[known].sum()) < (1.0 - _MAX_UNUSABLE_LIGHT) * float(light[within].sum()):
        detail = "most of the light of the body falls on bad pixels: check the mask"
        return Failure(Reason.MASKED, detail)
    state = replace(start, center_px=start.center_px + peak.offset_px, smear=smear)
    if radius_px >= _ALIGN_RADIUS_PX:
        rendered = replace(state, center_px=template.center_px + shift)
        other = located.trace.with_reflectance(contrasting_laws(renderer.target.reflectance)[0]).template()
        lights = [light] if isinstance(other, Failure) else [light, place_template(other, box, shift)]
        state = align_template(pixels, lights, rendered, state, radius_px=radius_px)
        scale = math.exp(rendered.log_range - state.log_range)
        low, high = (state.center_px + scale * (end - template.center_px) for end in (low, high))
        box = renderer.box(low, high, _BOX_MARGIN_PX + math.ceil(_ALIGNED_MARGIN * radius_px))
        pixels = image.cut(box)
    of_body = _fit_options(options, radius_px, psf_known=psf_known, block_px=block_px)
    fit_options = replace(
        of_body,
        response=response,
        trails=trails,
        turn_sigma_rad=turn_sigma_rad,
        smear_sigma_px2=of_body.smear_sigma_px2 / block_px**2,
        altitude_sigma=altitude_sigma,
        sun_direction=renderer.sun_across(state),
        complete=False,
    )
    fit: TemplateFit | Failure = Failure(Reason.NOT_CONVERGED, "")
    for most_laws in (None, 1, 0) if options.free_reflectance else (0,):
        if isinstance(fit, Failure) and fit.reason is Reason.NOT_CONVERGED:
            # Real images may not separate all laws; the change by those left out is in the covariance.
            synthesis = renderer.synthesis(
                box, other_law=options.free_reflectance, most_laws=most_laws, traced=located.traced
            )
            fit = fit_template(pixels, synthesis, state, options=fit_options)
    if isinstance(fit, Failure):
        return fit
    if fit.gain_dn <= 0.0 or not fit.score >= options.min_score:
        detail = f"the fitted template has a correlation of {fit.score:.3g}, needed {options.min_score:g}"
        return Failure(Reason.LOW_CORRELATION, detail)
    return TemplateMatch(
        fit=fit,
        box=box,
        synthesis=synthesis,
        options=fit_options,
        start=state,
        renderer=renderer,
        free_reflectance=options.free_reflectance,
        most_laws=most_laws,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Located(Value):
    """A template rendered from a traced body, and its position in the image."""

    trace: Trace
    traced: MovedBody
    template: Template
    peak: CorrelationPeak


def _locate(
    image: BoxPixels, good: Mask, renderer: TemplateRenderer, options: CrossCorrelationOptions
) -> _Located | Failure:
    """Find the template within the declared search or, failing that, the best match in a wider region."""
    found = _correlate(image, good, renderer, renderer.start, options.search_px, options.min_score)
    if not isinstance(found, Failure) or found.reason not in _SEARCHED_WIDER:
        return found
    wider_px = min(round(_WIDER * options.search_px), _WIDEST_PX)
    tried = [
        _correlate(image, good, renderer, replace(renderer.start, log_range=log_range), wider_px, options.min_score)
        for log_range in _WIDER_LOG_RANGES
    ]
    wide = [one for one in tried if not isinstance(one, Failure)]
    return max(wide, key=lambda one: one.peak.score) if wide else found


def _correlate(
    image: BoxPixels, good: Mask, renderer: TemplateRenderer, state: TemplateState, search_px: int, min_score: float
) -> _Located | Failure:
    """Find the template of a state by correlation, clipped like the image."""
    trace = renderer.trace(state, renderer.sampling(search_px, spacing=ROUGH))
    if isinstance(trace, Failure):
        return trace
    template = trace.template()
    if isinstance(template, Failure):
        return template
    light = template.brightness
    clipped = 0 if image.censored is None else int(np.count_nonzero(image.censored))
    if 0 < clipped < light.size:
        light = np.minimum(light, np.partition(light, -clipped, axis=None)[-clipped])
    corner = (int(template.corner_px[0]), int(template.corner_px[1]))
    peak = locate_template(
        image.values_dn, good, light, corner, options=CorrelationOptions(search_px=search_px, min_score=min_score)
    )
    return (
        peak
        if isinstance(peak, Failure)
        else _Located(trace=trace, traced=MovedBody(trace=trace, state=state), template=template, peak=peak)
    )


def _fit_options(
    options: CrossCorrelationOptions, radius_px: float, *, psf_known: bool, block_px: int
) -> TemplateFitOptions:
    return TemplateFitOptions(
        max_iterations=options.max_iterations,
        clip_sigma=options.clip_sigma,
        log_range_sigma=math.inf if _is_range_estimated(options, radius_px) else options.range_sigma,
        blur_sigma_px2=(KNOWN_BLUR_SIGMA_PX2 if psf_known else UNKNOWN_BLUR_SIGMA_PX2) / block_px**2,
        relief_sigma=options.relief_sigma,
        relief_length_px=options.relief_length_rad * radius_px,
        radius_px=radius_px,
        block_px=block_px,
    )


def _is_range_estimated(options: CrossCorrelationOptions, radius_px: float) -> bool:
    """Return True if the range is estimated."""
    wide = 2.0 * radius_px >= options.min_scale_diameter_px
    return wide if options.estimate_scale is None else options.estimate_scale


def _fix(
    inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch, options: CrossCorrelationOptions
) -> CenterFix | PositionFix | Failure:
    """Return the fix of a match, with its flags; ``NO_LIMB`` where only the brightness gradient locates a body."""
    fit, model = match.fit, inputs.camera.model
    signal = fit.signal_dn
    lit = signal >= _LIT * float(signal.max())
    center = CenterFix(
        **inputs.identity,
        center_px=fit.state.center_px,
        covariance_px2=fit.covariance[:2, :2],
        residuals=fit.residuals_dn[fit.used] / float(signal.max()),
        residuals_at_px=fit.used_at_px(blocks.size),
        n_used=int(fit.used.sum()),
        n_rejected=fit.n_rejected,
        score=fit.score,
        flags=_flags(inputs, blocks, match, lit, options),
        parts={cause: part[:2, :2] for cause, part in fit.parts.items()},
    )
    if not _is_range_estimated(options, inputs.radius_px):
        return center
    range_km = inputs.geometry.range_km * math.exp(fit.state.log_range)
    position, covariance = position_of_center(model, fit.state.center_px, range_km, fit.covariance)
    body = inputs.seen_geometry.seen_body(position)
    if _smooth(inputs):
        sun = inputs.geometry.sun_direction_camera
        outline = trace_silhouette(body, model, _OUTLINE_RAD, sun_direction_camera=sun)
        share, length_px = limb_in_frame(outline, inputs.focal_plane())
        if share < SHORT_ARC_SHARE and length_px < _LEAST_LIMB_PX:
            return Failure(
                Reason.NO_LIMB,
                f"{length_px:.3g} px of lit limb in the frame, needed {_LEAST_LIMB_PX:g}: how its light falls off does "
                "not place a smooth body",
            )
        limb_px = outline.points_px
    else:
        limb_px = outline_points_px(body, model, _OUTLINE_RAD)
    return PositionFix(
        **{each.name: getattr(center, each.name) for each in fields(center)} | {"parts": fit.parts},
        position_camera_km=position,
        covariance_camera_km2=covariance,
        limb_px=limb_px[inputs.camera.contains(limb_px)],
    )


def _response_of(
    inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch, fix: CenterFix
) -> Callable[[TargetGeometry], Float | None]:
    """Response of the position of a match to the geometry of the body; None where the surface moves too far."""
    geometry, state, scale = inputs.geometry, match.fit.state, np.array([blocks.size, blocks.size, 1.0])

    @cache
    def light() -> Float | Failure:
        return match.renderer.light(match.box, state)

    def motion(moved: TargetGeometry) -> Float | None:
        turn = (moved.camera_from_body * geometry.camera_from_body.inv()).magnitude()
        growth = abs(math.log(moved.range_km / geometry.range_km))
        if (turn + growth) * match.renderer.radius_px > _LINEAR_PX:
            return None
        target = replace(inputs, geometry=moved).seen_geometry.seen_body()
        sun = moved.sun_direction_camera
        other = replace(match.renderer, target=target, sun_direction_camera=sun).light(match.box, state)
        before = light()
        if isinstance(before, Failure) or isinstance(other, Failure):
            return None
        return (scale * match.motion(before, other))[: 3 if isinstance(fix, PositionFix) else 2]

    return motion


def _smooth(inputs: EstimatorInputs) -> bool:
    """Return True for a body without relief and without markings."""
    shape = inputs.geometry.target.shape
    return isinstance(shape, Ellipsoid) and shape.albedo is None


def _flags(
    inputs: EstimatorInputs, blocks: Blocks, match: TemplateMatch, lit: Mask, options: CrossCorrelationOptions
) -> Quality:
    """Flags of a match whose light falls on the blocks ``lit`` (h, w) of its box."""
    fit, box = match.fit, match.box
    area = np.zeros_like(blocks.good)
    within = box.cut(np.ones_like(blocks.good))
    rows, columns = np.nonzero(lit & within)
    area[rows + box.y, columns + box.x] = True
    n_used = int(fit.used.sum())
    checks = Facts(
        off_px=fit.state.center_px - inputs.predicted_px,
        search_px=options.search_px,
        range_ratio=math.exp(-fit.state.log_range),
        search_range=options.search_range,
        bounded=True,
        n_used=n_used,
        n_offered=n_used + fit.n_rejected,
        cut_by_frame=bool((lit & ~within).any()),
        overexposed=_overexposure(blocks, match, lit & within) > _MOST_OVEREXPOSED,
    )
    return inputs.flags_at(blocks.area(area, inputs.usable.shape)) | checks.flags


def _overexposure(blocks: Blocks, match: TemplateMatch, lit: Mask) -> float:
    """Largest ratio of the signal of the model to the saturation level; 0 where no pixel saturates."""
    pixels = blocks.pixels.cut(match.box)
    clipped = None if pixels.censored is None else lit & pixels.censored
    if clipped is None or not clipped.any():
        return 0.0
    limit_dn = float(pixels.values_dn[clipped].min()) - match.fit.offset_dn
    return float(match.fit.signal_dn.max()) / max(limit_dn, 1e-12)


def _lit_part(template: Template) -> tuple[Float, Float]:
    """First pixel (2,) of the lit part of a template, and the one after the last."""
    lit = template.brightness > _EDGE_LIGHT * float(template.brightness.max())
    ends = [np.flatnonzero(lit.any(axis=axis))[[0, -1]] for axis in (0, 1)]
    low = np.add(template.corner_px, [end[0] for end in ends])
    high = np.add(template.corner_px, [end[1] + 1 for end in ends])
    return low.astype(np.float64), high.astype(np.float64)
