"""Unresolved: the center of a body of a few pixels or less, by a fit of the rendered body to its light."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.outcomes import CenterFix, Failure, Reason
from giantlike.core.pixel_box import BoxPixels, PixelBox
from giantlike.processing.detection.detect import detect_sources
from giantlike.processing.detection.detections import DetectionFlag
from giantlike.processing.detection.windowed import WindowedCentroid, windowed_centroid
from giantlike.processing.limb.segmentation import background_of
from giantlike.ray_tracing import Template
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import Facts
from giantlike.relative.light.phase_correction import Correction, phase_correction_px, require_correction
from giantlike.relative.template.fit import TemplateFit, TemplateFitOptions, fit_template
from giantlike.relative.template.moved_body import MovedBody
from giantlike.relative.template.rendering import KNOWN_BLUR_SIGMA_PX2, UNKNOWN_BLUR_SIGMA_PX2, TemplateRenderer

_BACKGROUND_PX = 12  # px, width of the ring around the search region for the background and its noise
_CORE_SIGMAS = 2.5  # of the window: saturated or bad pixels here spoil the centroid
_WINDOW_REACH_SIGMAS = 5.0  # of the window: less than 4e-6 of a Gaussian lies beyond
_HOT_PSF, _HOT_LIGHT = 0.7, 0.3
"""Maximum width of a hot pixel relative to the point spread function, which may be declared 30 % too wide, and relative
to the expected light, of which at least a quarter is fitted."""
_RIVAL_FLUX = 0.3  # of the brightest source, from which a second one is a competing solution: benchmarks/sensitivity.md
_FIT_MARGIN_PX = 4  # px around the template: derivatives take so many, and the background is fitted
_RAYS_PER_PIXEL, _RAYS_ACROSS = 10, (96, 240)
"""Rays over a fully lit body, per pixel and in all: centers of 2, 5 and 10 px are right to 0.001-0.003 px up to 120
deg."""
_LEAST_LIT, _MOST_RAYS = 0.05, 720
"""Minimum lit fraction down to which the number of lit rays is kept as on a full disk, and maximum rays across."""
_RAYS_THROUGH_PER_PIXEL, _RAYS_THROUGH = 12, 48
"""Rays through the lit part of a disk: per pixel of the diameter, and maximum. At 150 degrees a crescent of 4 px is
0.3 px thick; errors of its center with 96, 372 and 720 rays across are 0.02, 0.005 and 0.003 px."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnresolvedOptions:
    """Options of :class:`Unresolved`.

    Parameters
    ----------
    max_diameter_px : float, px
        Larger bodies (diameter of the sphere around them) are refused: other estimators see their shape.
    search_px : float, px; largest distance of the light from the predicted photocenter
    min_snr : float; minimum signal to noise of a detection
    correction : {'rendered', 'kaasalainen_tanga', 'ellipsoid', 'none'}
    range_sigma : float; a priori standard deviation of the range as a fraction of it; it scales the correction

    Raises
    ------
    InputError
        A value is out of its range.

    Notes
    -----
    Half and double of the defaults move no center of ``benchmarks/sensitivity.md`` by more than 0.4 of its sigma.
    """

    max_diameter_px: float = 12.0
    search_px: float = 40.0
    min_snr: float = 6.0
    correction: str = Correction.RENDERED.value
    range_sigma: float = 0.02

    def __post_init__(self) -> None:
        require(0 < self.max_diameter_px <= 100, f"max_diameter_px must be in (0, 100], got {self.max_diameter_px}")
        require(1 <= self.search_px <= 2000, f"search_px must be in [1, 2000], got {self.search_px}")
        require(self.min_snr >= 3, f"min_snr must be >= 3, got {self.min_snr}")
        require(0 < self.range_sigma < 1, f"range_sigma must be in (0, 1), got {self.range_sigma}")
        require_correction(self.correction)


class Unresolved(BodyEstimator[UnresolvedOptions, CenterFix]):
    """Brightest source near the prediction, a fit of the rendered body to its light, and a phase correction.

    The center of a Gaussian is biased for a body that is a few pixels wide, so the body itself is fitted, rendered
    through the point spread function. The fit gives the center of the figure directly (correction ``rendered``, the
    default) or, minus its offset, the center of the light, to which ``kaasalainen_tanga``, that of the best-fitting
    ``ellipsoid`` or no correction is applied. Rendered is the default because it uses the shape: on synthetic bodies of
    2 to 12 px its errors are 0.01-0.02 px per axis, those of the published correction, meant for unresolved spheres,
    0.1 px at 2 px and 60 degrees and 0.5 px at 12 px.

    ``score`` is the signal to noise of the source, ``residuals`` are image minus model divided by the brightest pixel
    of the model. The covariance holds, as parts, ``noise`` and ``reflectance``: errors of the model scaled to the
    residuals, an error ``range_sigma`` of the range, and of the correction: for ``rendered`` the effect of another
    reflectance law, as far as the image does not exclude it; for ``kaasalainen_tanga`` and ``ellipsoid`` their
    difference from the rendered correction, as one sigma.

    Failures are ``NOT_UNRESOLVED`` for larger bodies, ``NO_SIGNAL``, ``MASKED``, ``OUT_OF_FRAME``, ``NOT_LIT``,
    ``SATURATED``, ``NOT_CONVERGED`` and ``DEGENERATE_GEOMETRY``.

    Parameters
    ----------
    options : UnresolvedOptions

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Unresolved Optical
       Navigation", eq. 3.
    """

    name: ClassVar[str] = "unresolved"
    options_type = UnresolvedOptions

    def _estimate(self, inputs: EstimatorInputs) -> CenterFix | Failure:
        """Find the body of gathered inputs."""
        options, diameter = self.options, 2 * inputs.reach_px
        if diameter > options.max_diameter_px:
            return Failure(
                Reason.NOT_UNRESOLVED,
                f"the sphere around the body is {diameter:.1f} px wide, max_diameter_px is "
                f"{options.max_diameter_px:g}; use an estimator for resolved bodies",
                not_applicable=True,
            )
        renderer = TemplateRenderer(
            target=inputs.geometry.body(),
            plane=inputs.focal_plane(),
            sun_direction_camera=inputs.geometry.sun_direction_camera,
            rays_across=rays_across(diameter, inputs.geometry.phase_angle_rad),
        )
        trace = renderer.trace(renderer.start, renderer.sampling(math.ceil(options.search_px)))
        if isinstance(trace, Failure):
            return trace
        template = trace.template()
        if isinstance(template, Failure):
            return template
        image = inputs.pixels
        width_px = _width_px(template)
        found = _brightest(inputs, template, width_px, options)
        if isinstance(found, Failure):
            return found
        start_px, rivals = found
        measured = _centroid(image, inputs.saturated, start_px, width_px)
        if isinstance(measured, Failure):
            return measured
        offset = _offset(template, width_px)
        if isinstance(offset, Failure):
            return offset
        start_px = measured.point_px + offset
        fit = _fit_traced_body(
            inputs, renderer, MovedBody(trace=trace, state=renderer.start), template, start_px, options
        )
        if isinstance(fit, Failure):
            return fit
        rendered_px = template.center_px - template.photocenter_px
        kind, model = Correction(options.correction), inputs.camera.model
        correction_px = phase_correction_px(kind, rendered_px, inputs.geometry, model, radius_px=inputs.radius_px)
        shift_px = correction_px - rendered_px
        scaled_px = options.range_sigma * correction_px * float(kind is not Correction.RENDERED)  # else in the fit
        systematic = np.outer(shift_px, shift_px) + np.outer(scaled_px, scaled_px)
        noise_px2 = fit.noise_covariance[:2, :2]
        parts = {Cause.NOISE: noise_px2, Cause.REFLECTANCE: _excess(fit.covariance[:2, :2], noise_px2) + systematic}
        checks = Facts(
            off_px=np.array([np.linalg.norm(measured.point_px - template.photocenter_px), 0.0]),
            search_px=options.search_px,
            bounded=True,
            ambiguous=rivals,
        )
        core, corner_px = _disk(image, measured.point_px, _CORE_SIGMAS * width_px)
        return CenterFix(
            **inputs.identity,
            center_px=fit.state.center_px + shift_px,
            covariance_px2=sum_parts(parts),
            parts=parts,
            residuals=fit.residuals_dn[fit.used] / float(fit.signal_dn.max()),
            residuals_at_px=fit.used_at_px(),
            n_used=int(fit.used.sum()),
            n_rejected=fit.n_rejected,
            score=measured.snr,
            flags=inputs.flags_at(core, corner_px) | checks.flags,
        )


def _excess(total: Float, part: Float) -> Float:
    """Covariance (2, 2) minus a part of it, with negative eigenvalues set to zero."""
    values, axes = np.linalg.eigh(0.5 * (total + total.T) - 0.5 * (part + part.T))
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)


def rays_across(diameter_px: float, phase_rad: float) -> int:
    """Rays over a body: as many on the lit part of its disk at any phase, and enough through it."""
    lit = max(0.5 * (1.0 + math.cos(phase_rad)), _LEAST_LIT)
    across = float(np.clip(_RAYS_PER_PIXEL * diameter_px, *_RAYS_ACROSS)) / math.sqrt(lit)
    through = min(_RAYS_THROUGH_PER_PIXEL * diameter_px, _RAYS_THROUGH) / lit
    return min(round(max(across, through)), _MOST_RAYS)


def _brightest(
    inputs: EstimatorInputs, template: Template, width_px: float, options: UnresolvedOptions
) -> tuple[Float, bool] | Failure:
    """Position of the brightest source in the search region, and True if another is nearly as bright."""
    image, bad, detector = inputs.pixels, inputs.masked, inputs.camera.detector
    optics_px = UNKNOWN_PSF_SIGMA_PX if inputs.psf_sigma_px is None else inputs.psf_sigma_px
    expected_px, search_px = template.photocenter_px, options.search_px
    box = _box_around(expected_px, search_px + _BACKGROUND_PX, image)
    if box.width < 2 * _BACKGROUND_PX or box.height < 2 * _BACKGROUND_PX:
        return Failure(
            Reason.OUT_OF_FRAME, f"the predicted center of light {_text(expected_px)} px is outside the image"
        )
    sources = detect_sources(box.cut(image.values_dn), detector=detector, psf_sigma_px=width_px, mask=box.cut(bad))
    if isinstance(sources, Failure):
        return sources
    points = sources.points_px + box.corner_px
    near = np.linalg.norm(points - expected_px, axis=1) <= search_px
    hot = (sources.flags & np.uint16(DetectionFlag.SHARP)) > 0
    hot &= sources.width_px < max(_HOT_PSF * optics_px, _HOT_LIGHT * width_px)  # a thin crescent is sharp too
    near &= (sources.snr >= options.min_snr) & ~hot
    if not near.any():
        return Failure(
            Reason.NO_SIGNAL,
            f"no source with a signal-to-noise ratio of at least {options.min_snr:g} within "
            f"{search_px:g} px of the prediction {_text(expected_px)} px",
        )
    flux = sources.flux_dn[near]
    order = np.argsort(-flux)
    rivals = order.size > 1 and float(flux[order[1]]) > _RIVAL_FLUX * float(flux[order[0]])
    return points[near][order[0]], bool(rivals)


def _fit_traced_body(
    inputs: EstimatorInputs,
    renderer: TemplateRenderer,
    traced: MovedBody,
    template: Template,
    center_px: Float,
    options: UnresolvedOptions,
) -> TemplateFit | Failure:
    """Fit the traced body to the image; another law is mixed in where its offset enters the result."""
    low = (template.corner_px + np.rint(center_px - template.center_px).astype(np.int64)).astype(np.float64)
    box = renderer.box(low, low + template.brightness.shape[::-1], _FIT_MARGIN_PX)
    other_law = Correction(options.correction) is Correction.RENDERED
    return fit_template(
        inputs.pixels.cut(box),
        renderer.synthesis(box, other_law=other_law, traced=traced),
        replace(renderer.start, center_px=center_px),
        options=TemplateFitOptions(
            log_range_sigma=options.range_sigma,
            blur_sigma_px2=UNKNOWN_BLUR_SIGMA_PX2 if inputs.psf_sigma_px is None else KNOWN_BLUR_SIGMA_PX2,
            fine_at_once=True,
        ),
    )


def _centroid(image: BoxPixels, saturated: Mask, start_px: Float, window_px: float) -> WindowedCentroid | Failure:
    """Centroid in the image, background and its noise from a ring around the source."""
    reach = _WINDOW_REACH_SIGMAS * window_px
    box = _box_around(start_px, reach + _BACKGROUND_PX, image)
    values, usable = box.cut(image.values_dn), box.cut(image.usable)
    corner = np.array(box.corner_px)
    rows, columns = np.indices(values.shape)
    distance = np.hypot(columns + corner[0] - start_px[0], rows + corner[1] - start_px[1])
    core = distance <= _CORE_SIGMAS * window_px
    if not usable[core].all():
        clipped = bool(box.cut(saturated)[core].any())
        return Failure(
            Reason.SATURATED if clipped else Reason.MASKED,
            f"{int((~usable[core]).sum())} of {int(core.sum())} pixels on the source at {_text(start_px)} px are "
            f"{'saturated' if clipped else 'bad or outside the image'}",
        )
    ring = (distance > reach) & usable
    if not ring.any():
        return Failure(Reason.MASKED, f"no good pixel around the source at {_text(start_px)} px for a background")
    sky = background_of(values[ring])
    signal, variance_dn2 = values - sky.level_dn, image.noise_variance_dn2
    measured = windowed_centroid(
        signal,
        variance_dn2(signal) - variance_dn2(np.zeros(1)) + sky.sigma_dn**2,
        usable & (distance <= reach),
        start_px - corner,
        window_sigma_px=window_px,
    )
    if measured is None:
        return Failure(Reason.NOT_CONVERGED, f"the centroid does not converge near {_text(start_px)} px")
    return replace(measured, point_px=measured.point_px + corner)


def _offset(template: Template, window_px: float) -> Float | Failure:
    """From the windowed centroid of a template to the center of the body (2,), px."""
    light = template.brightness
    found = windowed_centroid(
        light,
        np.ones_like(light),
        np.ones(light.shape, dtype=bool),
        template.photocenter_px - template.corner_px,
        window_sigma_px=window_px,
    )
    if found is None:
        return Failure(Reason.NOT_CONVERGED, "the centroid of the rendered body does not converge")
    return template.center_px - (found.point_px + template.corner_px)


def _width_px(template: Template) -> float:
    """Standard deviation, px, of the recorded light along one axis, mean of both axes."""
    variance_px2 = 0.0
    for light in (template.brightness.sum(axis=0), template.brightness.sum(axis=1)):
        places, share = np.arange(light.size), light / light.sum()
        variance_px2 += float(share @ (places - share @ places) ** 2)
    return math.sqrt(variance_px2 / 2)


def _box_around(center_px: Float, half_px: float, image: BoxPixels) -> PixelBox:
    """Box of the image within ``half_px`` of a point, cut at the frame."""
    box = PixelBox.spanning(center_px - half_px, center_px + half_px + 1.0)
    rows, columns = image.usable.shape
    return box.clip(columns, rows)


def _disk(image: BoxPixels, center_px: Float, radius_px: float) -> tuple[Mask, tuple[int, int]]:
    """Pixels (h, w) within a radius of a point, in a box of the image, and its first column and row."""
    box = _box_around(center_px, radius_px, image)
    rows, columns = np.ogrid[: box.height, : box.width]
    x, y = center_px - np.array(box.corner_px)
    return np.asarray((columns - x) ** 2 + (rows - y) ** 2 <= radius_px**2), box.corner_px


def _text(point_px: Float) -> str:
    return f"({point_px[0]:.1f}, {point_px[1]:.1f})"
