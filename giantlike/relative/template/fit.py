"""Photometric fit of a rendered template to an image: center, range, and a covariance that includes model errors.

The image is modeled as ``gain * light + background + sum(mixing_i * difference_i)``: ``light`` is the template rendered
at the current geometry, the background a plane, and the differences are the changes by other reflectance laws and by
wings of the point spread function.
Gauss-Newton steps in center, logarithm of the range and width of the point spread function alternate with new renders,
so that the solution does not depend on the way derivatives are taken.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.findings import Response, Smear, Trails, Turn
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import BoxPixels
from giantlike.core.statistics import excess
from giantlike.core.values import Value
from giantlike.image_model.columns import Block, Columns, Prior, Use, split_noise
from giantlike.image_model.trails import trails_of_image
from giantlike.image_model.turn import TURN_SIGMA_RAD, turn_block
from giantlike.processing.limb.altitude import lift_points
from giantlike.relative.template.covariance import LinearFit, RobustFit
from giantlike.relative.template.haze import haze_altitude, haze_block
from giantlike.relative.template.linear import BEND_SIGMA, PIXEL_VARIANCE_PX2, SMEAR_SIGMA_PX2, LinearProblem
from giantlike.relative.template.relief import relief_covariance
from giantlike.relative.template.smear import smeared_renders
from giantlike.relative.template.state import Synthesis, TemplateState
from giantlike.relative.template.undeclared import IndependentParts, Undeclared, undeclared_effects

_LOG = logging.getLogger("giantlike.relative")

_MAX_STEP_PX, _MAX_STEP_LOG_RANGE = 4.0, 0.1
"""Largest motion of the image, px, and step of the logarithm of the range: linear over a few pixels only."""
_MAX_STEP_BLUR_PX2 = 3.0  # px^2: blur hides errors of the center, as long as these are large
_MAX_PSF_VARIANCE_PX2 = 25.0  # px^2: a point spread function of 5 px, beyond any camera in focus
_BLUR_MOVES = 0.1
"""Motion of the center, px, taken as equivalent to a change of the blur by 1 px^2. Blur is even where shifts are odd,
and hardly moves a body."""
_RETREAT = 0.3  # fraction of a step that increased the residuals to try next
_DAMPED_AFTER = 5  # renders, after which steps are halved: they come from the sampling of the renders
_FLICKER_PX = 0.6
"""Last step, px, up to which a fit at the end of its renders counts as converged; the step enters the covariance."""
_ROUGH_ERROR = 0.03  # of the brightest light: error of the model in rough renders, from which only steps follow
_ROUGH_STEP_PX = 0.5  # px: from so near, one linear step ends where the next hardly moves
_WRONG_EDGE_PX = 0.015
"""Error of the model at edges, px, above which haze and relief are tested for: 0.02 to 0.3 with haze of a scale height
of 0.2 to 0.6 px around 120 px, at most 0.017 without haze and with correct models."""
_STRAIN_SIGMA = 0.01
"""A priori standard deviation of an undeclared strain: relief of 1 % of the radius, the root mean square of relief with
a median of 0.4 % and a geometric standard deviation of 2.5."""
_BLOCK = 0.35
"""Side of the blocks of the jackknife over the rms radius of the light. Half and double: benchmarks/sensitivity.md."""
_OF_NOISE = (Cause.NOISE, Cause.BACKGROUND, Cause.REFLECTANCE, Cause.PSF)
_MAX_BLOCK_PX = 32  # px: enough blocks remain on large bodies


@dataclass(frozen=True, slots=True, kw_only=True)
class TemplateFitOptions:
    """Options of :func:`fit_template`.

    tolerance_px: the fit has converged when a step from a fine render moves neither the center nor the limb by more.
    clip_sigma: pixels whose residual is larger than so many standard deviations (noise and model error) are rejected.
    log_range_sigma: A priori standard deviation of the logarithm of the range; infinite lets the image alone decide.
    blur_sigma_px2: A priori standard deviation of the variance of the point spread function around that of the start.
    relief_sigma: standard deviation of the errors of the shape along its radii, as a fraction of the radius.
    relief_length_px: their correlation length: the correlation at a distance d is ``exp(-d^2 / (2
        relief_length_px^2))``.
    sun_direction: unit vector from body to Sun, along columns, rows and the line of sight.
    trails: trails whose shares are estimated along with the rest; of these their directions count.
    fine_at_once: render finely from the first: for bodies so small that rough renders save nothing, which then take one
        render where the start is within ``tolerance_px``.
    response: response by which the pixels were linearized; its curvature is estimated along with the rest.
    turn: rotation of the rendered body from its declared orientation; further rotation is in the covariance then.
    """

    max_iterations: int = 8  # renders at most
    tolerance_px: float = 0.05
    clip_sigma: float = 5.0
    log_range_sigma: float = math.inf
    blur_sigma_px2: float = 0.15
    relief_sigma: float = 0.0
    relief_length_px: float = 10.0
    altitude_sigma: float = 0.0  # standard deviation of the altitude of the limb by haze, as a fraction of the radius
    sun_direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    radius_px: float = math.inf  # radius of the body
    block_px: int = 1  # side of a pixel of the box, pixels of the detector
    trails: Trails | None = None
    fine_at_once: bool = False
    response: Response | None = None
    smear_sigma_px2: float = SMEAR_SIGMA_PX2  # a priori standard deviation of the variances of a smear
    turn: Turn | None = None
    turn_sigma_rad: float = TURN_SIGMA_RAD  # a priori standard deviation of the rotation about each axis
    complete: bool = True  # the model is complete: undeclared effects are not tested for in the residuals

    def __post_init__(self) -> None:
        require(self.max_iterations >= 1, f"max_iterations must be >= 1, got {self.max_iterations}")
        require(self.tolerance_px > 0, f"tolerance_px must be > 0, got {self.tolerance_px}")
        require(self.clip_sigma >= 2, f"clip_sigma must be >= 2, got {self.clip_sigma}")
        require(self.log_range_sigma > 0, f"log_range_sigma must be > 0, got {self.log_range_sigma}")
        require(self.blur_sigma_px2 > 0, f"blur_sigma_px2 must be > 0, got {self.blur_sigma_px2}")
        require(0 <= self.relief_sigma < 0.2, f"relief_sigma must be in [0, 0.2), got {self.relief_sigma}")
        require(self.relief_length_px > 0, f"relief_length_px must be > 0, got {self.relief_length_px}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateFit(Value):
    """A fitted template.

    parts: mapping of Cause to (3, 3); covariance of x and y in px and of the logarithm of the range, by cause.
    log_variance: mean logarithm of the variances of the pixels that were offered, with squared residuals of those
        rejected.
    altitude_sigma: standard deviation of the altitude of the limb relative to the radius, declared or by haze in the
        residuals.
    """

    state: TemplateState
    parts: Mapping[Cause, Float]
    gain_dn: float  # signal of a surface of relative brightness 1
    offset_dn: float  # background in the middle of the box
    signal_dn: Float  # (h, w); the model without its background
    score: float  # correlation coefficient of template and image over the pixels used
    residuals_dn: Float  # (h, w); image minus model, also where pixels were not used
    model_dn: Float  # (h, w)
    used: Mask  # (h, w)
    n_rejected: int  # usable pixels that were clipped
    chi: float  # root mean square over the used pixels of residual over noise
    iterations: int
    columns: Columns  # of the last step
    trails: Trails  # charge-transfer trails, as fitted or as the residuals show them
    log_variance: float
    response: Response  # response, smear: estimated in the model or, where it has none, linearly from the residuals
    smear: Smear
    undeclared: Mapping[str, Undeclared]  # undeclared effects that the model leaves out, by name
    independent: IndependentParts
    altitude_sigma: float = 0.0
    corner_px: tuple[int, int] = (0, 0)  # column and row of the first element of the box

    def used_at_px(self, block_px: int = 1) -> Float:
        """Return the image positions of the pixels used.

        Returns (n, 2), pixel centers, in the order of ``residuals_dn[used]``.
        """
        rows, columns = np.nonzero(self.used)
        places = np.column_stack([columns, rows]) + np.array(self.corner_px)
        return np.asarray(block_px * places + 0.5 * (block_px - 1), dtype=np.float64)

    def chance(self, effect: str) -> float:
        """Return the probability of an effect that the model leaves out; 0 where it was not tested for."""
        return self.undeclared[effect].chance if effect in self.undeclared else 0.0

    def log_evidence(self, parts: float) -> float:
        """Return the logarithm of the likelihood of the pixels."""
        n_used = np.count_nonzero(self.columns.weights)
        share = n_used / (n_used + self.n_rejected)
        return self.columns.log_evidence(share * parts) - 0.5 * parts * self.log_variance

    @property
    def place(self) -> Float:
        """Center, px, and logarithm of the range, (3,)."""
        return np.append(self.state.center_px, self.state.log_range)

    @property
    def covariance(self) -> Float:
        """Covariance (3, 3) of x and y in px and of the logarithm of the range, from all causes."""
        return sum_parts(self.parts)

    @property
    def noise_covariance(self) -> Float:
        """Part of the covariance by detector noise, with all parameters estimated along with the geometry."""
        return sum_parts(self.parts, _OF_NOISE)


def fit_template(
    pixels: BoxPixels,
    synthesize: Synthesis,
    start: TemplateState,
    *,
    options: TemplateFitOptions = TemplateFitOptions(),
) -> TemplateFit | Failure:
    r"""Fit a rendered template to the pixels of a box.

    Pixels are weighted by ``1 / (noise + v0 + v1 |grad M|^2 + v2 S^2)``: the noise variance of the model image ``M``
    (with its signal ``S``), and three variances of the model error - everywhere, at edges, and proportional to the
    signal - that maximize the likelihood of the residuals. The covariance of the weighted fit is then widened to that
    of a jackknife over blocks of pixels, which includes residuals that are correlated over the size of a block.

    Unmodeled relief ``h`` (relative to the radius) moves each point of the image by ``h`` times its distance from the
    center, along that direction: it changes the image by ``-h dM/dlog(range)``. The covariance is nowhere below the
    covariance by random relief with the given standard deviation and correlation length nor, where edges are wrong,
    below that of relief with the spectrum of the residuals, see
    :func:`~giantlike.relative.template.relief.relief_covariance`. Other effects of relief on the shading are left to
    the residuals.
    """
    synthesize = smeared_renders(synthesize)
    trial, fine = start, options.fine_at_once
    last: _SolvedStep | None = None
    for iteration in range(1, options.max_iterations + 1):
        images = synthesize(trial, fine)
        if isinstance(images, Failure):
            return images
        photometry = None if last is None else last["gain", "trails"]
        trailed = None if options.trails is None else trails_of_image(images.light, options.block_px, options.trails)
        problem = LinearProblem(pixels, images, trial, photometry, options.response, trailed)
        markings = problem.markings(options.radius_px) if math.isfinite(options.radius_px) else None
        approach = markings is not None and not fine
        errors = None if last is None or last.approach > approach else last.solution.errors
        objective = -math.inf
        if markings is None:
            objective = problem.misfit_dn2()
        elif approach:
            sigma_dn = (
                _ROUGH_ERROR * (float(np.abs(markings.light).max()) or float(problem.light.max()))
                if errors is None
                else math.sqrt(errors[0])
            )
            errors, objective = np.array([sigma_dn**2, 0.0, 0.0]), problem.objective(markings, sigma_dn)
        if last is not None and last.motion_px > _ROUGH_STEP_PX and objective > last.objective:
            last = last.shorten(_RETREAT)
            trial = last.take_step()
            continue
        prior = _prior(trial, start, problem, options)
        last_render = iteration == options.max_iterations
        solution = problem.solve(prior, options.clip_sigma, errors, markings=markings, approach=approach)
        if isinstance(solution, Failure):
            return solution
        solved = _SolvedStep(problem, trial, prior, solution, objective, approach)
        moved_px = solved.length_px
        _LOG.debug("template moved by %.3g px in render %d", moved_px, iteration)
        settled = fine and moved_px < options.tolerance_px
        if settled or (last_render and moved_px < _FLICKER_PX):
            flicker = solved["center", "range"] * (0.0 if settled else 1.0)
            return solved.result(flicker, iteration, options)
        if iteration > _DAMPED_AFTER or (last is not None and solved.returns(last)):
            solved = solved.shorten(0.5)
        trial, fine, last = solved.take_step(), fine or solved.motion_px < _ROUGH_STEP_PX, solved
    return Failure(Reason.NOT_CONVERGED, f"still moving by {moved_px:.2f} px after {options.max_iterations} renders")


def _prior(state: TemplateState, start: TemplateState, problem: LinearProblem, options: TemplateFitOptions) -> Prior:
    """Return the prior of the step from ``state``; center and background have none."""
    mean: dict[str, float | Sequence[float]] = {
        "range": -state.log_range,
        "blur": start.psf_variance_px2 - state.psf_variance_px2,
    }
    sigma = {"range": options.log_range_sigma, "blur": options.blur_sigma_px2}
    if options.response is not None:
        mean, sigma = mean | {"bend": -options.response.bend}, sigma | {"bend": BEND_SIGMA}
    if state.smear is not None:
        mean = mean | {"smear": (-state.smear.straight_px2, -state.smear.oblique_px2)}
        sigma = sigma | {"smear": options.smear_sigma_px2}
    return problem.prior(mean, sigma)


@dataclass(frozen=True, slots=True)
class _SolvedStep:
    """A linear problem at a state with its prior and solution, and the fraction of the solution to step."""

    problem: LinearProblem
    state: TemplateState
    prior: Prior
    solution: RobustFit
    objective: float
    approach: bool
    share: float = 1.0

    def __getitem__(self, effects: tuple[str, str]) -> Float:
        """Parameters (j,) from one effect to another."""
        return self.solution.parameters[self.problem.layout.span(*effects)]

    @property
    def _place(self) -> Float:
        """Step (3,) of center and logarithm of the range."""
        return self.share * self["center", "range"]

    @property
    def _blur_step_px2(self) -> float:
        """Step of the variance of the point spread function, px^2."""
        return self.share * float(self["blur", "blur"][0])

    @property
    def length_px(self) -> float:
        """Motion of center or limb, px, by the step."""
        x, y, growth = self._place
        return max(float(np.hypot(x, y)), abs(float(growth)) * self.problem.reach_px, _BLUR_MOVES * self._blurred_px2)

    @property
    def _next_smear(self) -> Smear | None:
        """Smear after the step, which adds a limited variance or at most doubles its width."""
        known = self.state.smear
        if known is None:
            return None
        straight, oblique = (self.share * self["smear", "smear"]).tolist()
        step = Smear(straight_px2=straight, oblique_px2=oblique)
        share = min(max(_MAX_STEP_BLUR_PX2, known.size_px2) / max(step.size_px2, 1e-12), 1.0)
        return Smear(
            straight_px2=known.straight_px2 + share * straight, oblique_px2=known.oblique_px2 + share * oblique
        )

    @property
    def motion_px(self) -> float:
        """Motion of the image, px, by the step: smaller than the motion of the center where the frame cuts the body."""
        return max(self.problem.motion_px(self._place), _BLUR_MOVES * self._blurred_px2)

    @property
    def _blurred_px2(self) -> float:
        """Change of the variance of the point spread function or of a smear, px^2."""
        known, smear, smeared = self.state.psf_variance_px2, self.state.smear, self._next_smear
        blurred_px2 = abs(float(np.clip(known + self._blur_step_px2, 0.0, _MAX_PSF_VARIANCE_PX2)) - known)
        return blurred_px2 if smear is None or smeared is None else max(blurred_px2, smeared.subtract(smear).size_px2)

    def returns(self, last: _SolvedStep) -> bool:
        """Return True if the step reverses most of the last one: renders flicker, or the step was too long."""
        scale = np.array([1.0, 1.0, self.problem.reach_px])
        one, two = scale * self._place, scale * last._place
        return float(one @ two) < -0.5 * float(two @ two)

    def shorten(self, share: float) -> _SolvedStep:
        """Return the problem with a shorter step."""
        return replace(self, share=share * self.share)

    def take_step(self) -> TemplateState:
        """State after the step, limited by the motion of the image, with center and range scaled alike."""
        state, step = self.state, self._place
        longest = min(
            _MAX_STEP_PX / max(self.problem.motion_px(step), 1e-12),
            _MAX_STEP_LOG_RANGE / max(abs(float(step[-1])), 1e-12),
        )
        x, y, growth = (min(longest, 1.0) * step).tolist()
        blur = float(np.clip(self._blur_step_px2, -_MAX_STEP_BLUR_PX2, _MAX_STEP_BLUR_PX2))
        return TemplateState(
            center_px=state.center_px + np.array([x, y]),
            log_range=state.log_range + growth,
            psf_variance_px2=float(np.clip(state.psf_variance_px2 + blur, 0.0, _MAX_PSF_VARIANCE_PX2)),
            smear=self._next_smear,
        )

    def result(self, last_step: Float, iterations: int, options: TemplateFitOptions) -> TemplateFit:
        """The fit after its last step (3,)."""
        problem, solution, state = self.problem, self.solution, self.take_step()
        used = problem.constraint_mask & solution.kept
        fit = LinearFit(solution.solution.columns, solution.parameters)
        columns, values, noise, error = fit.columns, fit.columns.data, solution.noise, solution.error
        signal = fit.model - np.tensordot(fit["background"], columns["background"], 1)
        independent = IndependentParts.from_size(int(np.count_nonzero(used)), options.radius_px, self._blur_px)
        response = self._response(fit, options.response)
        left_out = undeclared_effects(fit, self._left_out(fit, response, independent, options))
        if options.turn is not None and "turn" in left_out:
            left_out["turn"] = replace(left_out["turn"], chance=1.0)
        smear = state.smear
        if smear is None:
            straight_px2, oblique_px2 = self._estimates(left_out, "smear") or (0.0, 0.0)
            smear = Smear(straight_px2=straight_px2, oblique_px2=oblique_px2)
        if options.response is None:
            response = replace(response, bend=sum(self._estimates(left_out, "bend")))
        altitude_sigma = options.altitude_sigma or self._undeclared_altitude(fit, left_out, options)
        options = replace(options, altitude_sigma=altitude_sigma)
        parts = self._parts(fit, (noise, error), left_out, options)
        parts[Cause.NOISE] = parts[Cause.NOISE] + np.outer(last_step, last_step)
        n_rejected = int(np.count_nonzero(problem.constraint_mask & ~solution.kept))
        clipped = n_rejected / max(int(np.count_nonzero(problem.constraint_mask)), 1)
        log_variance = (
            float(np.mean(np.log((noise + error)[problem.constraint_mask]))) + options.clip_sigma**2 * clipped
        )
        if options.response is not None:
            slopes = options.response.slope_at(fit.model[problem.constraint_mask])
            log_variance -= 2.0 * float(np.mean(np.log(np.maximum(slopes, 1e-9))))
        return TemplateFit(
            state=state,
            parts=parts,
            gain_dn=float(fit["gain"][0]),
            offset_dn=float(fit["background"][0]),
            signal_dn=signal,
            score=float(np.corrcoef(problem.light[used], values[used])[0, 1]),
            residuals_dn=fit.residuals,
            model_dn=fit.model,
            used=used,
            n_rejected=n_rejected,
            chi=float(np.sqrt(np.mean(fit.residuals[used] ** 2 / noise[used]))),
            iterations=iterations,
            columns=columns,
            trails=self._trails(fit, left_out, options.trails),
            log_variance=log_variance,
            response=response,
            smear=smear,
            undeclared=left_out,
            independent=independent,
            altitude_sigma=altitude_sigma,
            corner_px=problem.pixels.corner_px,
        )

    def _response(self, fit: LinearFit, known: Response | None) -> Response:
        """Response with the estimated curvature, or a linear one."""
        if known is not None:
            return replace(known, bend=known.bend + float(fit["bend"][0]))
        dark_dn = float(fit["background"][0])
        return Response(bend=0.0, dark_dn=dark_dn, bright_dn=max(float(fit.model.max()), dark_dn + 1e-12))

    def _left_out(
        self, fit: LinearFit, response: Response, independent: IndependentParts, options: TemplateFitOptions
    ) -> dict[Block, float]:
        """Undeclared effects that the model leaves out, and the number of independent values in the pixels."""
        problem, blocks = self.problem, dict[Block, float]()
        surface, edges = independent.of_surface, independent.of_edges
        if problem.untried is not None:
            law = _block("untried law", Cause.REFLECTANCE, problem.untried[None], [problem.mixing_sigma_dn])
            blocks[law] = surface
        if options.complete:
            return blocks
        blocks[_block("strain", Cause.RELIEF, problem.d_dstrain(self.state), 3 * [_STRAIN_SIGMA])] = surface
        if self.state.smear is None:
            blocks[_block("smear", Cause.PSF, np.stack(problem.d_dsmear()), 2 * [options.smear_sigma_px2])] = edges
        if options.trails is None:
            blocks[trails_of_image(problem.signal, options.block_px)] = edges
        if options.response is None:
            bend = -response.changes_dn(fit.model)[:1]
            blocks[_block("bend", Cause.REFLECTANCE, bend, [BEND_SIGMA])] = surface
        if problem.turned is not None and (options.turn is not None or self._wrong_edges):
            blocks[turn_block(problem.gain_dn * problem.turned(), options.turn, options.turn_sigma_rad)] = surface
        veils = self.problem.veils() if self._wrong_edges and not options.altitude_sigma else None
        if veils is not None:
            blocks[haze_block(problem.gain_dn * veils)] = edges
        return blocks

    def _trails(self, fit: LinearFit, left_out: Mapping[str, Undeclared], known: Trails | None) -> Trails:
        """Trails as fitted, or as the residuals show them."""
        if known is None:
            along_rows, along_columns = self._estimates(left_out, "trails") or (0.0, 0.0)
        else:
            shares = fit["trails"].reshape(2, -1).sum(axis=1) / float(fit["gain"][0])
            along_rows, along_columns = (np.sign([known.along_rows, known.along_columns]) * shares).tolist()
        return Trails(along_rows=along_rows, along_columns=along_columns)

    def _estimates(self, left_out: Mapping[str, Undeclared], effect: str) -> list[float]:
        """Linear estimates of the unknowns of an effect; none where it was not tested for."""
        return left_out[effect].score.values.tolist() if effect in left_out else []

    def _undeclared_altitude(
        self, fit: LinearFit, left_out: Mapping[str, Undeclared], options: TemplateFitOptions
    ) -> float:
        """Standard deviation of the altitude of the limb relative to the radius, by haze in the residuals."""
        if "haze" not in left_out:
            return 0.0
        place = self.problem.layout.span("center", "range")
        lifted_by = fit.columns.consider(self._altitude(options, 1.0))[place, place]
        wider_px2 = float(fit["blur"][0] - self.prior.mean[self.problem.layout.span("blur")][0])
        blur, haze = math.sqrt(max(wider_px2, 0.0)) / options.radius_px, left_out["haze"]
        return math.sqrt(haze.chance) * haze_altitude(haze.score.step[place], lifted_by, blur=blur)

    def _altitude(self, options: TemplateFitOptions, sigma: float) -> Block:
        """Altitudes of the limb along two axes, relative to the radius, extrapolated linearly to the whole radius."""
        (growth,) = self.problem["range"]
        rows, columns = np.indices(growth.shape)
        x, y = self.state.center_px - self.problem.pixels.corner_px
        sights = np.stack([columns - x, rows - y, np.ones_like(growth)], axis=-1).reshape(-1, 3)
        lifts = lift_points(growth.ravel(), sights, np.array([0.0, 0.0, 1.0]), np.array(options.sun_direction))
        return Block(
            effect="altitude",
            cause=Cause.ALTITUDE,
            matrix=lifts.T.reshape(2, *growth.shape),
            prior=Prior.of_sigmas([sigma, sigma]),
            use=Use.CONSIDERED,
        )

    @property
    def _wrong_edges(self) -> bool:
        """True if edges of the image disagree with the model by more than with correct models."""
        return math.sqrt(self.solution.errors[1]) >= _WRONG_EDGE_PX

    @property
    def _blur_px(self) -> float:
        """Standard deviation of the point spread function with the pixel."""
        return math.sqrt(self.state.psf_variance_px2 + PIXEL_VARIANCE_PX2)

    @property
    def _block_px(self) -> int:
        """Side of the blocks of the jackknife."""
        return int(np.clip(round(_BLOCK * self.problem.reach_px), 3, _MAX_BLOCK_PX))

    def _relief(self, fit: LinearFit, options: TemplateFitOptions) -> Float:
        """Covariance (k, k) of the parameters by relief, where edges are wrong."""
        if not self._wrong_edges:
            return np.zeros_like(fit.columns.information)
        center_px, sun = self.state.center_px - self.problem.pixels.corner_px, np.array(options.sun_direction)
        return relief_covariance(fit, center_px, sun[:2], radius_px=self.problem.reach_px)

    def _parts(
        self,
        fit: LinearFit,
        variances: tuple[Float, Float],
        left_out: Mapping[str, Undeclared],
        options: TemplateFitOptions,
    ) -> dict[Cause, Float]:
        """Covariance (3, 3) of center and range by cause: noise, and residuals beyond noise as markings."""
        noise, error = variances
        of_noise, of_relief = fit.noise_covariance(noise), self._relief(fit, options)
        whole = fit.full_covariance(
            error, of_noise=of_noise + of_relief, blur_px=self._blur_px, block_px=self._block_px
        )
        parts = split_noise(of_noise, self.problem.layout, (Cause.REFLECTANCE, Cause.BACKGROUND, Cause.PSF))
        known = sum(parts.values(), np.zeros_like(whole))
        parts[Cause.RELIEF], with_relief = of_relief, known + of_relief
        if options.relief_sigma > 0.0:
            (growth,) = self.problem["range"]
            relief = options.relief_sigma * growth
            declared = fit.error_covariance(relief, length_px=options.relief_length_px)
            parts[Cause.RELIEF] = declared + excess(known + declared, with_relief)
        known = known + parts[Cause.RELIEF]
        if options.altitude_sigma > 0.0:
            parts[Cause.ALTITUDE] = fit.columns.consider(self._altitude(options, options.altitude_sigma))
            known = known + parts[Cause.ALTITUDE]
        parts[Cause.ALBEDO] = excess(known, whole)
        for name, effect in left_out.items():
            if name != "haze":  # its altitude is a part already
                cause = effect.block.cause
                parts[cause] = parts.get(cause, 0.0) + effect.covariance
        place = self.problem.layout.span("center", "range")
        return {cause: 0.5 * (part + part.T)[place, place] for cause, part in parts.items()}


def _block(effect: str, cause: Cause, matrix: Float, sigmas: list[float]) -> Block:
    """Block of unknowns that the fit leaves out."""
    return Block(effect=effect, cause=cause, matrix=matrix, prior=Prior.of_sigmas(sigmas), use=Use.WHEN_SEEN)
