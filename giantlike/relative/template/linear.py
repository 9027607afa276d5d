"""The linear problem of a template fit: columns of geometry and photometry, and its step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.causes import Cause
from giantlike.core.findings import Response
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import BoxPixels
from giantlike.image_model.columns import Block, Columns, Layout, Prior
from giantlike.image_model.field import MarkingModes
from giantlike.image_model.trails import SHARE_SIGMA
from giantlike.relative.template.covariance import Measured, RobustFit, VarianceModel, robust_fit
from giantlike.relative.template.state import TemplateImages, TemplateState

PIXEL_VARIANCE_PX2 = 1.0 / 12.0  # variance, px^2, of a square pixel along one axis

_FIRST_DERIVATIVE = np.array([-1 / 60, 3 / 20, -3 / 4, 0.0, 3 / 4, -3 / 20, 1 / 60])  # central, of sixth order, 1/px
_SECOND_DERIVATIVE = np.array([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90])  # the same, 1/px^2
_AS_IT_IS = np.ones(1)
_TWICE_ALONG_X, _TWICE_ALONG_Y = (_SECOND_DERIVATIVE, _AS_IT_IS), (_AS_IT_IS, _SECOND_DERIVATIVE)
_MIXING_SIGMA = 1.0
"""A priori standard deviation of the fraction of another law; 1 is that law alone. Laws of real bodies lie roughly
between the mixed ones."""
_WING_SIGMA, _WING_WIDTHS = 0.1, (2.0, 6.0)
"""A priori standard deviation of the fractions of light in wings of the point spread function, and their widths
relative to its core; two, as for horizons, span the widths between."""
BEND_SIGMA = 1.0  # A priori standard deviation of the curvature of a response about 0; square-root tables have nearly 1
SMEAR_SIGMA_PX2 = 1.0
"""A priori standard deviation, px^2, of the variances of a smear: a motion by 5 px during the exposure."""
_CUBE_SIGMA = 0.2
"""A priori standard deviation of the cubic term of a response; powers of 0.45 and 0.6 have 0.11 and -0.13."""


def layout_of(*, laws: int, wings: int, trails: int, response: bool, smear: bool) -> Layout:
    """Parameters of a linear step.

    Center in px, logarithm of the range, variance of the point spread function in px^2; then photometry: the light, a
    constant background and its slopes over half the box, shares of other reflectance laws, of wings of the point
    spread function and of trails; then changes of the bend and of the cube of a response, and of the variances of a
    smear.
    """
    return Layout(
        (
            ("center", Cause.NOISE, 2),
            ("range", Cause.NOISE, 1),
            ("blur", Cause.PSF, 1),
            ("gain", Cause.NOISE, 1),
            ("background", Cause.BACKGROUND, 3),
            ("laws", Cause.REFLECTANCE, laws),
            ("wings", Cause.PSF, wings),
            ("trails", Cause.PSF, trails),
            ("bend", Cause.REFLECTANCE, int(response)),
            ("cube", Cause.REFLECTANCE, int(response)),
            ("smear", Cause.PSF, 2 * int(smear)),
        )
    )


class LinearProblem:
    """One linear step: derivatives of the model around a state, and the pixels to explain.

    The model is linear in its photometry: the light, a constant and a slope of the background, and the changes by other
    laws, by wings of the point spread function and, where they are given, by charge-transfer trails.

    ``photometry`` (k,).
    """

    def __init__(
        self,
        pixels: BoxPixels,
        images: TemplateImages,
        state: TemplateState,
        photometry: Float | None,
        response: Response | None = None,
        trailed: Block | None = None,
    ) -> None:
        self.pixels, self.light, self.veiled, self.turned = pixels, images.light, images.veiled, images.turned
        total = float(images.light.sum())
        differences = [_difference(other, images.light) for other in images.others]
        widths = _WING_WIDTHS if images.winged else ()
        differences += [_add_wings(images.light, state.psf_variance_px2, width) - images.light for width in widths]
        differences += [] if trailed is None else [*trailed.matrix]
        self.untried = None if images.untried is None else _difference(images.untried, images.light)
        self.layout = layout_of(
            laws=len(images.others),
            wings=len(widths),
            trails=0 if trailed is None else len(trailed.matrix),
            response=response is not None,
            smear=images.by_smear is not None,
        )
        self.matrix = np.empty((self.layout.count, *images.light.shape))
        seen = np.stack((images.light, *_background(images.light.shape), *differences), out=self["gain", "trails"])
        if photometry is None:
            photometry = fit_unweighted(self["gain", "background"], pixels)
        photometry = np.pad(photometry, (0, len(seen) - len(photometry)))  # of wings, after a render without
        known = self.layout.vector({})
        known[self.layout.span("gain", "trails")] = photometry
        gain, level, laws, wings = (known[self.layout.span(each)] for each in ("gain", "background", "laws", "wings"))
        self.gain_dn = float(gain[0])
        under = np.zeros_like(known)
        under[self.layout.span("background")] = level
        split = np.stack([known - under, under])[:, self.layout.span("gain", "trails")]
        self.signal, background = np.tensordot(split, seen, 1)
        self.model = self.signal + background
        seen_dn, offered = (
            np.where(self.constraint_mask, pixels.values_dn - background, 0.0),
            self.signal[self.constraint_mask],
        )
        self._shown = float(np.vdot(seen_dn, self.signal)) / max(float(offered @ offered), 1e-300)
        self._center = state.center_px - np.array(pixels.corner_px)
        if response is not None:
            np.negative(response.changes_dn(self.model), out=self["bend", "cube"])
        if images.by_smear is not None:
            np.multiply(images.by_smear, self.gain_dn, out=self["smear"])
        x = pixels.corner_px[0] + np.arange(self.model.shape[1]) - state.center_px[0]
        y = pixels.corner_px[1] + np.arange(self.model.shape[0])[:, None] - state.center_px[1]
        spread = state.psf_variance_px2 + PIXEL_VARIANCE_PX2  # the blur does not grow with the body
        self._from_center = x, y, spread
        moved, by_differences = self["center", "blur"], self.signal
        if images.derivatives is not None:
            scales = [total / max(float(other.sum()), 1e-300) for other in images.others]
            weights = np.array([gain[0] - known[self.layout.span("laws", "wings")].sum(), *(laws * scales)])
            np.copyto(moved, images.derivatives(weights))
            by_differences = np.tensordot(wings, self["wings"] + images.light, 1)
        else:
            moved[:] = 0.0
        if images.derivatives is None or wings.any():  # wings are wide enough for differences of pixels
            moved += _differentiate(by_differences, x, y, spread)
        by_x, by_y = self["center"]
        self._slope2 = by_x**2 + by_y**2
        self._slope_moments = _moments(np.where(self.constraint_mask, self._slope2, 0.0), x, y[:, 0])
        self.reach_px = math.sqrt(_moments(images.light, x, y[:, 0])[3] / total)

    def __getitem__(self, effects: str | tuple[str, str]) -> Float:
        """Derivatives (j, h, w) by the parameters of an effect, or of all from one to another."""
        first, last = (effects, effects) if isinstance(effects, str) else effects
        return self.matrix[self.layout.span(first, last)]

    @property
    def mixing_sigma_dn(self) -> float:
        """A priori standard deviation of the parameter of another law."""
        return _MIXING_SIGMA * max(abs(self._shown * self.gain_dn), 1e-12)

    def markings(self, radius_px: float) -> MarkingModes:
        """Modes of undeclared markings, as fractions of the light in the image.

        Relative to the light of a step, a brighter body would make markings more probable.
        """
        return MarkingModes.across(self._shown * self.signal, self._center, radius_px)

    @property
    def constraint_mask(self) -> Mask:
        """Pixels (h, w) that constrain the model: usable ones, and those known to be at least so bright."""
        pixels = self.pixels
        return pixels.usable if pixels.censored is None else pixels.usable | pixels.censored

    @property
    def _short(self) -> Mask:
        """Usable pixels (h, w), and lower limits that exceed the model."""
        pixels = self.pixels
        if pixels.censored is None:
            return pixels.usable
        return np.asarray(pixels.usable | (pixels.censored & (self.model < pixels.values_dn)))

    def motion_px(self, step: Float) -> float:
        """Motion of the image, px, by a step (3,) in x, y and logarithm of the range.

        Root mean square over the pixels, weighted by the squared gradient. Where a body is cut by the frame, a center
        far outside moves more.
        """
        total, by_x, by_y, by_square = self._slope_moments
        x, y, growth = step.tolist()
        squares = (x**2 + y**2) * total - 2.0 * growth * (x * by_x + y * by_y) + growth**2 * by_square
        return math.sqrt(max(float(squares), 0.0) / max(total, 1e-300))

    def d_dstrain(self, state: TemplateState) -> Float:
        """Change of the model (3, h, w) by a strain about its center.

        Shear along rows and along columns, and stretch along rows with shrinking along columns.
        """
        x = self.pixels.corner_px[0] + np.arange(self.model.shape[1]) - state.center_px[0]
        y = self.pixels.corner_px[1] + np.arange(self.model.shape[0])[:, None] - state.center_px[1]
        by_x, by_y = self["center"]
        return np.stack([by_x * y, by_y * x, by_x * x - by_y * y])

    def d_dsmear(self) -> tuple[Float, Float]:
        """Change of the model (h, w) by the two variances of a short smear, without its isotropic part."""
        along, across = (_filter(self.signal, *each) for each in (_TWICE_ALONG_X, _TWICE_ALONG_Y))
        return 0.5 * (along - across), _filter(self.signal, _FIRST_DERIVATIVE, _FIRST_DERIVATIVE)

    def veils(self) -> Float | None:
        """Haze templates (3, h, w) for :func:`~giantlike.relative.template.haze.haze_altitude`, if any."""
        if self.veiled is None:
            return None
        taken, sent, even = self.veiled()
        _, _, by_log_range, _ = _differentiate(even, *self._from_center)
        return np.stack([taken, sent, by_log_range])

    def misfit_dn2(self) -> float:
        """Mean square of image minus model, with the best-fitting brightness."""
        use = self._short
        basis, values = _select_pixels(self["gain", "smear"], use), self.pixels.values_dn[use]
        found = np.linalg.lstsq(basis @ basis.T, basis @ values, rcond=None)[0]
        return float(np.sum((values - found @ basis) ** 2)) / max(int(np.count_nonzero(self.constraint_mask)), 1)

    def objective(self, markings: MarkingModes, sigma_dn: float) -> float:
        """Squared residuals divided by a variance, plus priors, with best-fitting brightness, laws and markings.

        Merit function to compare the first steps.
        """
        first, last = "gain", "trails"
        span, prior = self.layout.span(first, last), self.prior({}, {})
        variance = self.pixels.noise_variance_dn2(self.signal) + sigma_dn**2
        columns = Columns(
            self.layout.part(first, last),
            self.matrix[span],
            Prior(prior.mean[span], prior.information[span]),
            np.where(self.constraint_mask, self.pixels.values_dn, 0.0),
            self._short / variance,
            markings,
            markings.first_variances,
        )
        solution = columns.solve()
        return math.inf if solution is None else solution.penalized_squares

    def plain_step(self, longest_px: float) -> Float:
        """Unweighted step (3,) in x, y and logarithm of the range, brightness free, not longer than ``longest_px``."""
        basis = np.concatenate([self["center", "range"], self["gain", "laws"]])
        step = fit_unweighted(basis, replace(self.pixels, usable=self._short))[self.layout.span("center", "range")]
        x, y, growth = step.tolist()
        length_px = max(float(np.hypot(x, y)), abs(growth) * self.reach_px, 1e-12)
        return np.asarray(step * min(1.0, longest_px / length_px))

    def prior(self, mean: Mapping[str, float | Sequence[float]], sigma: Mapping[str, float]) -> Prior:
        """Prior of all parameters from that of geometry, blur and response; shares and a cube get their own."""
        unit_dn = self.mixing_sigma_dn / _MIXING_SIGMA
        shares = {"laws": self.mixing_sigma_dn, "wings": _WING_SIGMA * unit_dn, "trails": SHARE_SIGMA * unit_dn}
        sigmas = self.layout.vector({**sigma, **shares, "cube": _CUBE_SIGMA}, other=math.inf)
        return Prior.of_sigmas(sigmas, self.layout.vector(mean))

    def solve(
        self,
        prior: Prior,
        clip_sigma: float,
        errors: Float | None,
        *,
        markings: MarkingModes | None = None,
        approach: bool = False,
    ) -> RobustFit | Failure:
        """Weighted least squares, with variances of model errors estimated from the residuals or, at first, given."""
        pixels, signal = self.pixels, self.signal.ravel()
        shapes = np.stack([np.ones(signal.size), self._slope2.ravel(), signal**2])
        offered = self.constraint_mask.ravel()
        measured = Measured(
            np.where(offered, pixels.values_dn.ravel(), 0.0),
            offered,
            np.zeros(signal.size, bool) if pixels.censored is None else pixels.censored.ravel(),
            VarianceModel(pixels.noise_variance_dn2(signal), shapes),
        )
        fit = robust_fit(
            self.layout,
            self.matrix,
            measured,
            prior,
            clip_sigma=clip_sigma,
            start=errors,
            markings=markings,
            approach=approach,
        )
        if fit is None:
            return Failure(
                Reason.DEGENERATE_GEOMETRY, "the pixels do not determine position and brightness of the body"
            )
        return fit


def fit_unweighted(basis: Float, pixels: BoxPixels) -> Float:
    """Plain least squares. ``basis`` (k, h, w); returns (k,)."""
    rows, values = _select_pixels(basis, pixels.usable), pixels.values_dn[pixels.usable]
    normal = rows @ rows.T
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = np.linalg.lstsq(normal / np.outer(scale, scale), rows @ values / scale, rcond=None)[0]
    return np.asarray(scaled / scale, dtype=np.float64)


def _select_pixels(images: Float, use: Mask) -> Float:
    """Values (k, n) of images (k, h, w) where ``use`` (h, w) is True; no copy if it is True everywhere."""
    return images.reshape(len(images), -1) if use.all() else images[:, use]


def _difference(other: Float, light: Float) -> Float:
    """Light (h, w) under another law minus the light under the law of the target, at the same sum."""
    return np.asarray(other * (float(light.sum()) / max(float(other.sum()), 1e-300)) - light)


def _add_wings(light: Float, psf_variance_px2: float, width: float) -> Float:
    """Light (h, w) convolved with the wings of the point spread function; the box is extended by its edge."""
    sigma_px = width * math.sqrt(max(psf_variance_px2, PIXEL_VARIANCE_PX2))
    return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float64)


def _background(shape: tuple[int, ...]) -> tuple[Float, Float, Float]:
    """A constant, and slopes from -1 to 1 along x and y (h, w)."""
    y, x = (np.linspace(-1.0, 1.0, size) for size in shape)
    return np.ones(shape), np.broadcast_to(x, shape), np.broadcast_to(y[:, None], shape)


def _moments(weights: Float, x: Float, y: Float) -> tuple[float, float, float, float]:
    """Sums of weights (h, w) at x (w,) and y (h,), and of these times x, y and ``x^2 + y^2``."""
    by_column, by_row = weights.sum(axis=0), weights.sum(axis=1)
    squares = float(by_column @ x**2 + by_row @ y**2)
    return float(by_row.sum()), float(by_column @ x), float(by_row @ y), squares


def _differentiate(image: Float, x: Float, y: Float, spread: float) -> Float:
    """Derivatives (4, h, w) of an image at x (w,) and y (h, 1) from its center, by center, log range and blur.

    ``spread`` is the variance of the blur, px^2, which does not grow with the body.
    """
    slope_x, slope_y, curvature = _derivatives(image)
    return np.stack([-slope_x, -slope_y, x * slope_x + y * slope_y + spread * curvature, 0.5 * curvature])


def _derivatives(image: Float) -> tuple[Float, Float, Float]:
    """Slopes along x and y and the Laplacian (h, w), by differences of sixth order."""
    curvature: Float = _filter(image, *_TWICE_ALONG_X) + _filter(image, *_TWICE_ALONG_Y)
    return _filter(image, _FIRST_DERIVATIVE, _AS_IT_IS), _filter(image, _AS_IT_IS, _FIRST_DERIVATIVE), curvature


def _filter(image: Float, along_x: Float, along_y: Float) -> Float:
    """Image (h, w) after a filter along x and one along y."""
    filtered = cv2.sepFilter2D(image, cv2.CV_64F, along_x, along_y, borderType=cv2.BORDER_REPLICATE)
    return filtered.astype(np.float64, copy=False)
