"""Cross-correlation: a template rendered from shape and light, found in the image and then fitted to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.image import Image
from giantlike.processing.correlate import CorrelationOptions, CorrelationPeak, locate_template
from giantlike.ray_tracing import Template, trace_silhouette
from giantlike.relative.estimator import EstimatorInputs, gather, position_of_center
from giantlike.relative.template.fit import (
    TemplateFit,
    TemplateFitOptions,
    align_template,
    fit_template,
)
from giantlike.relative.template.rendering import (
    KNOWN_BLUR_SIGMA_PX2,
    UNKNOWN_BLUR_SIGMA_PX2,
    FitBox,
    TemplateRenderer,
)
from giantlike.scene import Scene

_ALIGN_RADIUS_PX = 12.0  # below, the peak of the correlation is close enough to start the fit from
_BOX_MARGIN = 0.08  # of the radius of the body: room for an error of the range ...
_ALIGNED_MARGIN = 0.02  # ... and what is left of it after the alignment
_BOX_MARGIN_PX = 6
_EDGE_LIGHT = 1e-3  # of the brightest pixel: where a box may end
_LIT = 0.02  # of the brightest pixel: what counts as the light of the body
_MAX_UNUSABLE_LIGHT = 0.5
_LOW_SCORE = 0.7
_NEAR_SEARCH_LIMIT = 0.9
_LARGE_CHI, _LARGE_RESIDUAL = 5.0, 0.3
_OUTLINE_RAD = np.arange(360) * (2.0 * np.pi / 360)


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossCorrelationOptions:
    """How to look for a body and how to fit it.

    Parameters
    ----------
    search_px : int, px
        How far from the prediction to look, along each axis.
    min_score : float
        Correlation below which nothing counts as found.
    estimate_scale : bool, optional
        Whether to estimate the range too. By default where the body is at least ``min_scale_diameter_px`` wide.
    min_scale_diameter_px : float, px
    range_sigma : float
        Where the range is not estimated: its a priori standard deviation as a fraction of it, which enters the
        covariance of the center.
    free_reflectance : bool
        Let the image mix another reflectance law into that of the target, so that a wrong law does not pull the center.
    clip_sigma : float
        Pixels with larger residuals, in standard deviations, are rejected.
    max_iterations : int
        Renders at most.
    relief_sigma : float
        How wrong the shape is: standard deviation of its errors along its radii, as a fraction of the radius. The
        residuals show most of it; what hangs together over a good part of the limb they do not, and it is stated here.
    relief_length_rad : float, rad
        How far these errors hang together on the body: an angle, seen from its center.
    """

    search_px: int = 40
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
        require(self.min_scale_diameter_px > 0, f"min_scale_diameter_px must be > 0, got {self.min_scale_diameter_px}")
        TemplateFitOptions(
            max_iterations=self.max_iterations,
            clip_sigma=self.clip_sigma,
            log_range_sigma=self.range_sigma,
            relief_sigma=self.relief_sigma,
        )
        require(0 < self.relief_length_rad < 3, f"relief_length_rad must be in (0, 3), got {self.relief_length_rad}")


class CrossCorrelation:
    r"""Finds a body by normalized cross-correlation with a rendered template, then fits the template to the pixels.

    The steps: 1. render the body at the predicted geometry, reaching over the frame by the search range; 2. correlate
    within the search range, peak by a paraboloid; 3. move and scale the template onto the image, from blurred to sharp;
    4. fit brightness, center, range and blur, rendering again at each new geometry.

    The result is a :class:`~giantlike.core.outcomes.PositionFix` where the range was estimated and a
    :class:`~giantlike.core.outcomes.CenterFix` elsewhere. Its ``score`` is the correlation of image and template at the
    solution, its ``residuals`` are image minus model over the brightest pixel of the model, and ``limb_px`` is the
    outline of the template. The covariance is that of :func:`~giantlike.relative.template.fit.fit_template`.

    Notes
    -----
    An error of the position moves the body in the image without turning it, an error of the attitude does both. The
    attitude is trusted: what the image asks for is taken as a change of the position.

    Where a body is predicted outside the field, the paper renders it at the boresight (step 1a). Here the template
    reaches over the frame instead, so that it keeps its aspect; beyond the search range the body cannot be found.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Template Matching".
    """

    name: ClassVar[str] = "cross_correlation"

    def __init__(self, options: CrossCorrelationOptions = CrossCorrelationOptions()) -> None:
        self._options = options

    @property
    def options(self) -> CrossCorrelationOptions:
        """The options it was made with."""
        return self._options

    def estimate(
        self, image: Image, camera: Camera, scene: Scene, target: str | None = None
    ) -> CenterFix | PositionFix | Failure:
        """Find a target of ``scene`` in ``image``.

        Parameters
        ----------
        image : Image
        camera : Camera
        scene : Scene
        target : str, optional
            May be left out when there is only one.

        Returns
        -------
        PositionFix, CenterFix or Failure

        Raises
        ------
        InputError
            The image has another size than the camera, or there is no such target.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        renderer = TemplateRenderer(inputs=inputs)
        template = renderer.render(renderer.start, margin_px=self.options.search_px, rough=True)
        if isinstance(template, Failure):
            return inputs.fail(template.reason, template.detail)
        peak = self._locate(inputs, template)
        if isinstance(peak, Failure):
            return inputs.fail(peak.reason, peak.detail)
        fit = self._fit(inputs, renderer, template, peak)
        if isinstance(fit, Failure):
            return inputs.fail(fit.reason, fit.detail)
        return self._fix(inputs, renderer, *fit)

    def _locate(self, inputs: EstimatorInputs, template: Template) -> CorrelationPeak | Failure:
        """The peak of the correlation; saturated pixels still say where it is bright."""
        return locate_template(
            inputs.pixels_dn,
            ~inputs.masked,
            template.brightness,
            (int(template.corner_px[0]), int(template.corner_px[1])),
            options=CorrelationOptions(search_px=self.options.search_px, min_score=self.options.min_score),
        )

    def _fit(
        self, inputs: EstimatorInputs, renderer: TemplateRenderer, template: Template, peak: CorrelationPeak
    ) -> tuple[TemplateFit, FitBox] | Failure:
        """Align the first template with the image and fit new ones in a box around its light."""
        shift = np.rint(peak.offset_px).astype(np.int64)
        low, high = _lit_part(template)
        box = FitBox.spanning(
            low + shift, high + shift, _BOX_MARGIN_PX + math.ceil(_BOX_MARGIN * inputs.radius_px), inputs
        )
        pixels, usable = box.cut(inputs.pixels_dn), box.cut(inputs.usable)
        light = box.place(template.brightness, template.corner_px + shift)
        within = box.cut(np.ones_like(inputs.usable))
        if not float(light[within].sum()) > 0.0:
            return Failure(Reason.OUT_OF_FRAME, "what correlates best lies outside the frame")
        if float(light[usable].sum()) < (1.0 - _MAX_UNUSABLE_LIGHT) * float(light[within].sum()):
            return Failure(Reason.SATURATED, "most of the body's light falls on saturated or bad pixels")
        state = replace(renderer.start, center_px=inputs.predicted_px + peak.offset_px)
        if inputs.radius_px >= _ALIGN_RADIUS_PX:
            rendered = replace(state, center_px=template.center_px + shift)
            state = align_template(pixels, usable, box.corner_px, light, rendered, state, radius_px=inputs.radius_px)
            scale = math.exp(-state.log_range)
            low, high = (state.center_px + scale * (end - template.center_px) for end in (low, high))
            box = FitBox.spanning(low, high, _BOX_MARGIN_PX + math.ceil(_ALIGNED_MARGIN * inputs.radius_px), inputs)
            pixels, usable = box.cut(inputs.pixels_dn), box.cut(inputs.usable)
        fit = fit_template(
            pixels,
            usable,
            box.corner_px,
            renderer.synthesis(box, other_law=self.options.free_reflectance),
            state,
            noise_variance_dn2=inputs.camera.detector.variance_dn2,
            options=self._fit_options(inputs),
        )
        if isinstance(fit, Failure):
            return fit
        problem = self._problem(inputs, fit)
        return (fit, box) if problem is None else problem

    def _problem(self, inputs: EstimatorInputs, fit: TemplateFit) -> Failure | None:
        """Why a fit is not the body, if so."""
        shift = fit.state.center_px - inputs.predicted_px
        if fit.gain_dn <= 0.0 or not fit.score >= self.options.min_score:
            detail = f"the fitted template has a correlation of {fit.score:.2f}, needed {self.options.min_score:g}"
            return Failure(Reason.LOW_CORRELATION, detail)
        if float(np.abs(shift).max()) > self.options.search_px:
            detail = f"the fit left the search region of {self.options.search_px} px; widen search_px"
            return Failure(Reason.PEAK_AT_EDGE, detail)
        return None

    def _fit_options(self, inputs: EstimatorInputs) -> TemplateFitOptions:
        known_psf = inputs.psf_sigma_px is not None
        return TemplateFitOptions(
            max_iterations=self.options.max_iterations,
            clip_sigma=self.options.clip_sigma,
            log_range_sigma=math.inf if self._scaled(inputs) else self.options.range_sigma,
            blur_sigma_px2=KNOWN_BLUR_SIGMA_PX2 if known_psf else UNKNOWN_BLUR_SIGMA_PX2,
            relief_sigma=self.options.relief_sigma,
            relief_length_px=self.options.relief_length_rad * inputs.radius_px,
        )

    def _scaled(self, inputs: EstimatorInputs) -> bool:
        """Whether the range is estimated."""
        wide = 2.0 * inputs.radius_px >= self.options.min_scale_diameter_px
        return wide if self.options.estimate_scale is None else self.options.estimate_scale

    def _fix(
        self, inputs: EstimatorInputs, renderer: TemplateRenderer, fit: TemplateFit, box: FitBox
    ) -> CenterFix | PositionFix:
        """The fix of a fit, with its flags."""
        signal = fit.model_dn - fit.offset_dn
        lit = signal >= _LIT * float(signal.max())
        center = CenterFix(
            estimator=self.name,
            target=inputs.target_name,
            center_px=fit.state.center_px,
            covariance_px2=fit.covariance[:2, :2],
            predicted_px=inputs.predicted_px,
            residuals=fit.residuals_dn[fit.used] / float(signal.max()),
            n_used=int(fit.used.sum()),
            n_rejected=fit.n_rejected,
            score=fit.score,
            flags=self._flags(inputs, fit, box, lit),
            provenance=inputs.provenance,
        )
        if not self._scaled(inputs):
            return center
        body = renderer.body(fit.state)
        model = inputs.camera.model
        range_km = inputs.geometry.range_km * math.exp(fit.state.log_range)
        position, covariance = position_of_center(model, fit.state.center_px, range_km, fit.covariance)
        sun = inputs.geometry.sun_direction_camera
        outline = trace_silhouette(body, model, _OUTLINE_RAD, sun_direction_camera=sun)
        return PositionFix(
            **{field.name: getattr(center, field.name) for field in fields(center)},
            position_camera_km=position,
            covariance_camera_km2=covariance,
            limb_px=_inside(outline.points_px[outline.valid], inputs.camera),
        )

    def _flags(self, inputs: EstimatorInputs, fit: TemplateFit, box: FitBox, lit: Mask) -> Quality:
        area = np.zeros_like(inputs.usable)
        within = box.cut(np.ones_like(inputs.usable))
        rows, columns = np.nonzero(lit & within)
        area[rows + box.y, columns + box.x] = True
        flags = inputs.flags_at(area)
        if bool((lit & ~within).any()):
            flags |= Quality.CUT_BY_FRAME
        if fit.score < _LOW_SCORE:
            flags |= Quality.LOW_SCORE
        if fit.n_rejected > int(fit.used.sum()):
            flags |= Quality.MANY_REJECTED
        shift = float(np.abs(fit.state.center_px - inputs.predicted_px).max())
        if shift > _NEAR_SEARCH_LIMIT * self.options.search_px:
            flags |= Quality.FAR_FROM_PREDICTION
        seen = lit & fit.used
        signal = fit.model_dn[seen] - fit.offset_dn
        unexplained = float(np.linalg.norm(fit.residuals_dn[seen]) / np.linalg.norm(signal))
        if fit.chi > _LARGE_CHI and unexplained > _LARGE_RESIDUAL:
            flags |= Quality.LARGE_RESIDUALS
        return flags


def _lit_part(template: Template) -> tuple[Float, Float]:
    """First pixel (2,) of the lit part of a template, and the one after the last."""
    lit = template.brightness > _EDGE_LIGHT * float(template.brightness.max())
    ends = [np.flatnonzero(lit.any(axis=axis))[[0, -1]] for axis in (0, 1)]
    low = np.add(template.corner_px, [end[0] for end in ends])
    high = np.add(template.corner_px, [end[1] + 1 for end in ends])
    return low.astype(np.float64), high.astype(np.float64)


def _inside(points_px: Float, camera: Camera) -> Float:
    """Those of points (n, 2) that lie on the detector."""
    limits = np.array([camera.columns, camera.rows]) - 0.5
    result: Float = points_px[np.all((points_px >= -0.5) & (points_px <= limits), axis=1)]
    return result
