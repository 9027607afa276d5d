"""Photometric fit of a rendered template to an image: center, range, and a covariance that counts model errors.

The image is modeled as ``gain * light + offset + sum(mixing_i * difference_i)``, with ``light`` the template rendered
at the current geometry and the differences those that other reflectance laws make. Gauss-Newton steps in center,
logarithm of the range and width of the point spread function alternate with new renders, so that the solution does not
depend on the way derivatives are taken.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import BoxPixels
from giantlike.core.values import Value
from giantlike.relative.template.covariance import LinearFit, Prior, RobustFit, VarianceModel, larger, robust_fit

_LOG = logging.getLogger("giantlike.relative")

FIT_BORDER_PX = 4
"""Pixels over the frame that a fitted box should reach: derivatives take that many neighbors."""

_FIRST_DERIVATIVE = np.array([-1 / 60, 3 / 20, -3 / 4, 0.0, 3 / 4, -3 / 20, 1 / 60])  # central, of sixth order, 1/px
_SECOND_DERIVATIVE = np.array([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90])  # the same, 1/px^2
_PIXEL_VARIANCE_PX2 = 1.0 / 12.0  # px^2, of a square pixel along one axis
_X, _Y, _RANGE, _BLUR, _GAIN, _OFFSET = range(6)  # parameters; after them the other laws
_MIXING_SIGMA = 1.0
"""A priori standard deviation of the share of another law in the light; 1 is that law alone: laws of real bodies lie
about between those that are mixed."""
_MAX_STEP_PX, _MAX_STEP_LOG_RANGE = 4.0, 0.1
"""Largest step of center, px, and logarithm of the range: an image is linear in them over a few pixels only."""
_MAX_STEP_BLUR_PX2 = 3.0  # px^2: blur hides errors of the center, as long as these are large
_MAX_PSF_VARIANCE_PX2 = 25.0  # px^2: a point spread function of 5 px, beyond any camera in focus
_BLUR_MOVES = 0.1
"""Motion of the center, px, that counts for a change of the blur by 1 px^2: blur is even where shifts are odd, and
hardly moves a body."""
_DAMPED_AFTER = 5  # renders: steps that have not settled by then come from the sampling of the renders, and are halved
_FLICKER_PX = 0.3
"""Last step, px, up to which a fit at the end of its renders counts as converged; the step enters the covariance."""
_ROUGH_STEP_PX = 0.5  # px: from so near, one linear step ends where the next hardly moves
_ALIGN_RADII_PX = (
    12.0,
    40.0,
)  # px, of the body in the reduced images: errors of half of it are still found, then refined
_ALIGN_STEPS = 5  # of an alignment in each reduced image; the best state on the way is taken
_ALIGN_STEP_PX = 2.0  # px of the reduced image: the reach of its slopes after _ALIGN_BLUR_PX
_ALIGN_BLUR_PX = 0.6  # px of the reduced image: block means alias without it
_WARPED_OVER = 4  # pixels averaged after an image was moved: the errors of the interpolation average with them
_BLOCK = 0.35
"""Side of the blocks of the jackknife over the rms radius of the light. Half and double: benchmarks/sensitivity.md."""
_MAX_BLOCK_PX = 32  # px: enough blocks remain on large bodies


@dataclass(frozen=True, slots=True, kw_only=True)
class TemplateFitOptions:
    """Options of :func:`fit_template`.

    Parameters
    ----------
    max_iterations : int
        Renders at most.
    tolerance_px : float, px
        The fit has converged when a step from a fine render moves neither the center nor the limb by more.
    clip_sigma : float
        Pixels whose residual is larger than so many standard deviations (noise and model error) are rejected.
    log_range_sigma : float
        A priori standard deviation of the logarithm of the range; infinite lets the image alone decide.
    blur_sigma_px2 : float, px^2
        A priori standard deviation of the variance of the point spread function around that of the start.
    relief_sigma : float
        Standard deviation of the errors of the shape along its radii, as a fraction of the radius.
    relief_length_px : float, px
        Their correlation length: at a distance d they have the correlation ``exp(-d^2 / (2 relief_length_px^2))``.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    max_iterations: int = 8
    tolerance_px: float = 0.05
    clip_sigma: float = 5.0
    log_range_sigma: float = math.inf
    blur_sigma_px2: float = 0.15
    relief_sigma: float = 0.0
    relief_length_px: float = 10.0

    def __post_init__(self) -> None:
        require(self.max_iterations >= 1, f"max_iterations must be >= 1, got {self.max_iterations}")
        require(self.tolerance_px > 0, f"tolerance_px must be > 0, got {self.tolerance_px}")
        require(self.clip_sigma >= 2, f"clip_sigma must be >= 2, got {self.clip_sigma}")
        require(self.log_range_sigma > 0, f"log_range_sigma must be > 0, got {self.log_range_sigma}")
        require(self.blur_sigma_px2 > 0, f"blur_sigma_px2 must be > 0, got {self.blur_sigma_px2}")
        require(0 <= self.relief_sigma < 0.2, f"relief_sigma must be in [0, 0.2), got {self.relief_sigma}")
        require(self.relief_length_px > 0, f"relief_length_px must be > 0, got {self.relief_length_px}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateState(Value):
    """Geometry and blur that a template is rendered for.

    Parameters
    ----------
    center_px : (2,) float64, px
        Center of the body in the image.
    log_range : float
        Natural logarithm of the range over the a priori range.
    psf_variance_px2 : float, px^2
    """

    center_px: Float
    log_range: float = 0.0
    psf_variance_px2: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateImages(Value):
    """A body rendered into the box that is fitted.

    Parameters
    ----------
    light : (h, w) float64
        Brightness under the reflectance law of the target.
    others : (k, h, w) float64
        Brightness under k other laws, which the fit may mix in; none by default.
    derivatives : (4, h, w) float64, optional
        Of ``light``, by x and y of the center in px, the logarithm of the range and the variance of the point spread
        function in px^2; None takes them from differences of pixels. Those are off by a tenth where an image is as
        sharp as a point spread function, which does not matter on wide bodies. On small ones, shift, range, blur and
        law nearly do the same to the image, and with such errors they seem to be distinguishable.
    """

    light: Float
    others: Sequence[Float] = ()
    derivatives: Float | None = None


Synthesis = Callable[[TemplateState, bool], TemplateImages | Failure]
"""Renders the body for a state into the fitted box; finely (True) at the end of the fit, roughly on the way."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateFit(Value):
    """A fitted template.

    Parameters
    ----------
    state : TemplateState
    covariance : (3, 3) float64
        Of x and y in px and of the logarithm of the range: noise and model error.
    noise_covariance : (3, 3) float64
        The part of it from the noise of the detector alone.
    gain_dn : float, DN
        Signal of a surface of relative brightness 1.
    offset_dn : float, DN
    score : float
        Correlation coefficient of template and image over the pixels used.
    residuals_dn : (h, w) float64, DN
        Image minus model, also where pixels were not used.
    model_dn : (h, w) float64, DN
    used : (h, w) bool
    n_rejected : int
        Usable pixels that were clipped.
    chi : float
        Root mean square over the used pixels of residual over noise.
    iterations : int
    """

    state: TemplateState
    covariance: Float
    noise_covariance: Float
    gain_dn: float
    offset_dn: float
    score: float
    residuals_dn: Float
    model_dn: Float
    used: Mask
    n_rejected: int
    chi: float
    iterations: int


def fit_template(
    pixels: BoxPixels,
    synthesize: Synthesis,
    start: TemplateState,
    *,
    options: TemplateFitOptions = TemplateFitOptions(),
) -> TemplateFit | Failure:
    r"""Fit a rendered template to the pixels of a box.

    Parameters
    ----------
    pixels : BoxPixels
    synthesize : callable
        Renders a :class:`TemplateState` into the box, finely where its second argument is True.
    start : TemplateState
        Within a pixel or two, in center and limb.
    options : TemplateFitOptions

    Returns
    -------
    TemplateFit or Failure
        ``DEGENERATE_GEOMETRY`` when the pixels do not fix the parameters, ``NOT_CONVERGED``, or what ``synthesize``
        failed with.

    Notes
    -----
    Pixels are weighted by ``1 / (noise + v0 + v1 |grad M|^2 + v2 S^2)``: the noise variance of the model image ``M``
    (with its signal ``S``), and three variances of the model error - everywhere, at edges, and in proportion to the
    light - that maximize the likelihood of the residuals. The covariance of the weighted fit is then widened to that
    of a jackknife over blocks of pixels, which includes residuals that are correlated over the size of a block.

    Relief ``h`` (over the radius) that the shape lacks moves each point of the image by ``h`` times its distance from
    the center, along that direction: it changes the image by ``-h dM/dlog(range)``. The covariance is nowhere below
    that of a field of such relief with the given standard deviation and correlation length. The effect of relief on the
    shading is left to the residuals.
    """
    state, fine = start, False
    photometry: Float | None = None
    errors: Float | None = None
    for iteration in range(1, options.max_iterations + 1):
        images = synthesize(state, fine)
        if isinstance(images, Failure):
            return images
        problem = _Problem(pixels, images, state, photometry)
        prior = _prior(state, start, problem, options)
        solution = problem.solve(prior, options.clip_sigma, errors)
        if isinstance(solution, Failure):
            return solution
        photometry, errors = solution.parameters[_GAIN:], solution.errors
        damping = 1.0 if iteration <= _DAMPED_AFTER else 0.5
        stepped, moved_px = _stepped(state, solution.parameters * damping, problem.reach_px, options)
        _LOG.debug("template moved by %.3g px in render %d", moved_px, iteration)
        settled = fine and moved_px < options.tolerance_px
        if settled or (iteration == options.max_iterations and moved_px < _FLICKER_PX):
            flicker = solution.parameters[: _RANGE + 1] * (0.0 if settled else 1.0)
            return problem.result(solution, prior, stepped, flicker, iteration, options)
        state, fine = stepped, fine or moved_px < _ROUGH_STEP_PX
    return Failure(Reason.NOT_CONVERGED, f"still moving by {moved_px:.2f} px after {options.max_iterations} renders")


def align_template(
    pixels: BoxPixels, light: Float, rendered: TemplateState, start: TemplateState, *, radius_px: float
) -> TemplateState:
    """Improve a rough start from one render by moving and scaling it, on images reduced in size and then less so.

    Parameters
    ----------
    pixels : BoxPixels
    light : (h, w) float64
        A template rendered for the state ``rendered``.
    rendered, start : TemplateState
    radius_px : float, px
        Of the body; the first reduction leaves 12 px of it, the last 40.

    Returns
    -------
    TemplateState
        The best state on the way, which may be the start.
    """
    state = start
    for radius in _ALIGN_RADII_PX:
        factor = max(round(radius_px / radius), 1)
        last = min(factor, _WARPED_OVER)  # part of the reduction comes before the light is moved, part hides that
        first = round(factor / last)
        factor = first * last
        share = _mean_over(pixels.usable.astype(np.float64), factor)
        known = _mean_over(np.where(pixels.usable, pixels.values_dn, 0.0), factor)
        small = BoxPixels(
            values_dn=_softened(known) / np.maximum(_softened(share), 1e-6),
            usable=share > 0.5,
            corner_px=(0, 0),
            noise_variance_dn2=pixels.noise_variance_dn2,
        )
        part = _mean_over(light, first)
        tried: list[tuple[float, TemplateState]] = []
        for _ in range(_ALIGN_STEPS):
            moved = warped(
                part, (0, 0), _reduced(rendered, pixels.corner_px, first), _reduced(state, pixels.corner_px, first)
            )
            moved = _softened(_mean_over(moved, last))
            moved = moved[: small.usable.shape[0], : small.usable.shape[1]]
            if not float(moved.sum()) > 0.0:
                break
            problem = _Problem(small, TemplateImages(light=moved), _reduced(state, pixels.corner_px, factor), None)
            tried.append((problem.misfit_dn2(), state))
            step = problem.plain_step()
            state = replace(
                state, center_px=state.center_px + factor * step[[_X, _Y]], log_range=state.log_range + step[_RANGE]
            )
        if not tried:
            return start
        state = min(tried, key=lambda entry: entry[0])[1]
    return state


def _reduced(state: TemplateState, corner_px: tuple[int, int], factor: int) -> TemplateState:
    """Return a state in the pixels of a box that was reduced in size."""
    center = (state.center_px - corner_px + 0.5) / factor - 0.5
    return replace(state, center_px=center, psf_variance_px2=_ALIGN_BLUR_PX**2)


def _prior(state: TemplateState, start: TemplateState, problem: _Problem, options: TemplateFitOptions) -> Prior:
    """Return the prior of the step from ``state``: none of gain, offset and center."""
    mean, sigma = np.zeros(problem.n_parameters), np.full(problem.n_parameters, np.inf)
    mean[_RANGE], sigma[_RANGE] = -state.log_range, options.log_range_sigma
    mean[_BLUR], sigma[_BLUR] = start.psf_variance_px2 - state.psf_variance_px2, options.blur_sigma_px2
    sigma[_OFFSET + 1 :] = _MIXING_SIGMA * max(abs(problem.gain_dn), 1e-12)
    return Prior(mean, sigma**-2)


class _Problem:
    """One linear step: derivatives of the model around a state, and the pixels to explain.

    The model is linear in its photometry: the light, a constant, and the differences that other laws make.
    """

    def __init__(
        self, pixels: BoxPixels, images: TemplateImages, state: TemplateState, photometry: Float | None
    ) -> None:
        self._pixels, self._light = pixels, images.light
        total = float(images.light.sum())
        differences = [other * (total / float(other.sum())) - images.light for other in images.others]
        basis = np.stack([images.light, np.ones_like(images.light), *differences])
        if photometry is None:
            first = _unweighted(basis[:2], pixels)
            photometry = np.concatenate([first, np.zeros(len(differences))])
        self.gain_dn, offset = float(photometry[0]), float(photometry[1])
        self._model = model = np.tensordot(photometry, basis, 1)
        self._signal = model - offset
        x = pixels.corner_px[0] + np.arange(model.shape[1]) - state.center_px[0]
        y = pixels.corner_px[1] + np.arange(model.shape[0])[:, None] - state.center_px[1]
        spread = state.psf_variance_px2 + _PIXEL_VARIANCE_PX2  # the blur does not grow with the body
        rendered = images.derivatives
        by_pixels = model if rendered is None else np.tensordot(photometry[2:], basis[2:], 1)
        slope_x, slope_y, curvature = _derivatives(by_pixels)
        radial = x * slope_x + y * slope_y + spread * curvature
        moved = np.stack([-slope_x, -slope_y, radial, 0.5 * curvature])
        if rendered is not None:
            moved += self.gain_dn * rendered
        self._slope2 = moved[_X] ** 2 + moved[_Y] ** 2
        self._columns = np.concatenate([moved, basis])
        self.n_parameters = len(self._columns)
        self.reach_px = math.sqrt(float((images.light * (x**2 + y**2)).sum() / total))

    def misfit_dn2(self) -> float:
        """Mean square of image minus model, before any step."""
        use = self._pixels.usable
        return float(np.mean((self._pixels.values_dn[use] - self._model[use]) ** 2))

    def plain_step(self) -> Float:
        """Unweighted step (3,) in x, y and logarithm of the range, brightness free, kept short."""
        names = [_X, _Y, _RANGE, _GAIN, _OFFSET]
        step = _unweighted(self._columns[names], self._pixels)[: _RANGE + 1]
        longest = max(float(np.hypot(step[_X], step[_Y])), abs(float(step[_RANGE])) * self.reach_px, 1e-12)
        return np.asarray(step * min(1.0, _ALIGN_STEP_PX / longest))

    def solve(self, prior: Prior, clip_sigma: float, errors: Float | None) -> RobustFit | Failure:
        """Weighted least squares with the model-error variances that the residuals ask for."""
        use = self._pixels.usable
        signal = self._signal[use]
        shapes = np.stack([np.ones(signal.size), self._slope2[use], signal**2])
        variances = VarianceModel(self._pixels.noise_variance_dn2(signal), shapes)
        design, values = self._columns[:, use].T, self._pixels.values_dn[use]
        fit = robust_fit(design, values, variances, prior, clip_sigma=clip_sigma, start=errors)
        if fit is None:
            return Failure(
                Reason.DEGENERATE_GEOMETRY, "the pixels do not determine position and brightness of the body"
            )
        return fit

    def result(
        self,
        solution: RobustFit,
        prior: Prior,
        state: TemplateState,
        last_step: Float,
        iterations: int,
        options: TemplateFitOptions,
    ) -> TemplateFit:
        """The fit after its last step (3,)."""
        use = self._pixels.usable
        used = np.zeros(use.shape, bool)
        used[use] = solution.kept
        noise, error = np.ones(use.shape), np.zeros(use.shape)
        noise[use], error[use] = solution.noise, solution.error
        model = np.tensordot(solution.parameters, self._columns, 1)
        residuals = self._pixels.values_dn - model
        fit = LinearFit(self._columns, np.where(used, 1.0 / (noise + error), 0.0), prior)
        covariance = fit.full_covariance(
            residuals,
            noise,
            error,
            blur_px=math.sqrt(state.psf_variance_px2 + _PIXEL_VARIANCE_PX2),
            block_px=int(np.clip(round(_BLOCK * self.reach_px), 3, _MAX_BLOCK_PX)),
        )
        of_noise = fit.noise_covariance(noise)
        if options.relief_sigma > 0.0:
            relief = options.relief_sigma * self._columns[_RANGE]
            of_relief = fit.error_covariance(relief, length_px=options.relief_length_px)
            covariance = larger(of_noise + of_relief, covariance)
        return TemplateFit(
            state=state,
            covariance=covariance[:3, :3] + np.outer(last_step, last_step),
            noise_covariance=of_noise[:3, :3],
            gain_dn=float(solution.parameters[_GAIN]),
            offset_dn=float(solution.parameters[_OFFSET]),
            score=float(np.corrcoef(self._light[used], self._pixels.values_dn[used])[0, 1]),
            residuals_dn=residuals,
            model_dn=model,
            used=used,
            n_rejected=int(np.count_nonzero(~solution.kept)),
            chi=float(np.sqrt(np.mean(residuals[used] ** 2 / noise[used]))),
            iterations=iterations,
        )


def _unweighted(basis: Float, pixels: BoxPixels) -> Float:
    """Least-squares brightness (k,) of images (k, h, w)."""
    brightness = np.linalg.lstsq(basis[:, pixels.usable].T, pixels.values_dn[pixels.usable], rcond=None)[0]
    return brightness.astype(np.float64, copy=False)


def _stepped(
    state: TemplateState, parameters: Float, reach_px: float, options: TemplateFitOptions
) -> tuple[TemplateState, float]:
    """State after a step, which is limited, and the motion of center or limb, px, by the whole step."""
    shift_px = parameters[[_X, _Y]]
    length_px = float(np.hypot(*shift_px))
    shift_px = shift_px * min(1.0, _MAX_STEP_PX / max(length_px, 1e-12))
    log_range = float(np.clip(parameters[_RANGE], -_MAX_STEP_LOG_RANGE, _MAX_STEP_LOG_RANGE))
    blur = float(np.clip(parameters[_BLUR], -_MAX_STEP_BLUR_PX2, _MAX_STEP_BLUR_PX2))
    psf_variance_px2 = float(np.clip(state.psf_variance_px2 + blur, 0.0, _MAX_PSF_VARIANCE_PX2))
    blurred = abs(psf_variance_px2 - state.psf_variance_px2)
    moved_px = max(length_px, abs(log_range) * reach_px, _BLUR_MOVES * blurred)
    stepped = TemplateState(
        center_px=state.center_px + shift_px,
        log_range=state.log_range + log_range,
        psf_variance_px2=psf_variance_px2,
    )
    return stepped, moved_px


def _derivatives(image: Float) -> tuple[Float, Float, Float]:
    """Slopes along x and y and the Laplacian (h, w), by differences of sixth order."""
    keep = np.ones(1)

    def slope(along_x: Float, along_y: Float) -> Float:
        filtered = cv2.sepFilter2D(image, cv2.CV_64F, along_x, along_y, borderType=cv2.BORDER_REPLICATE)
        return filtered.astype(np.float64, copy=False)

    curvature: Float = slope(_SECOND_DERIVATIVE, keep) + slope(keep, _SECOND_DERIVATIVE)
    return slope(_FIRST_DERIVATIVE, keep), slope(keep, _FIRST_DERIVATIVE), curvature


def _mean_over(image: Float, factor: int) -> Float:
    """Mean over squares of ``factor`` pixels; what does not fill a square at the end is left out."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if height == 0 or width == 0:
        return np.zeros((1, 1))
    squares = image[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return np.asarray(squares.mean(axis=(1, 3)))


def _softened(image: Float) -> Float:
    """An image blurred a little, so that its slopes can be taken."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _ALIGN_BLUR_PX, borderType=cv2.BORDER_REPLICATE), np.float64)


def warped(light: Float, corner_px: tuple[int, int], rendered: TemplateState, to: TemplateState) -> Float:
    """Move and scale a template to another state within the same box.

    Parameters
    ----------
    light : (h, w) float64
        Rendered for the state ``rendered``.
    corner_px : (int, int), px
        Column and row of its first element.
    rendered, to : TemplateState

    Returns
    -------
    (h, w) float64
    """
    scale = math.exp(to.log_range - rendered.log_range)
    corner = np.asarray(corner_px, dtype=np.float64)
    shift = rendered.center_px - corner - scale * (to.center_px - corner)
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = (light.shape[1], light.shape[0])
    return np.asarray(cv2.warpAffine(light, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.float64)
