"""Center of a body of a few pixels or less: centroid of its light and correction to its figure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import ClassVar

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, require, unit
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, Failure, Quality, Reason
from giantlike.core.statistics import robust_sigma
from giantlike.image import Image
from giantlike.processing.detection.detect import detect_sources
from giantlike.processing.detection.detections import DetectionFlag, Detections
from giantlike.processing.detection.windowed import WindowedCentroid, windowed_centroid
from giantlike.ray_tracing import Template
from giantlike.relative.estimator import EstimatorInputs, gather
from giantlike.relative.light.photocenter import ellipsoid_photocenter_km
from giantlike.relative.template.fit import TemplateFit, TemplateFitOptions, fit_template
from giantlike.relative.template.rendering import (
    KNOWN_BLUR_SIGMA_PX2,
    UNKNOWN_BLUR_SIGMA_PX2,
    FitBox,
    TemplateRenderer,
)
from giantlike.scene import Scene

_BACKGROUND_PX = 12  # ring around the search region, for the background and its noise
_CORE_SIGMAS = 2.5  # of the window: saturated or bad pixels here spoil the centroid
_WINDOW_REACH_SIGMAS = 5.0
_RIVAL_FLUX = 0.3  # of the brightest source: a second one as bright is a rival
_CLIP_SIGMA, _CLIP_ROUNDS = 3.0, 5
_FIT_MARGIN_PX = 4
_RAYS_PER_PIXEL, _RAYS_ACROSS = 20, (96, 240)  # finer is lost in noise
_STRAIGHT = 1e-9  # of the sunlight across the line of sight: less than that has no direction but of rounding
_MAX_DISAGREEMENT = 1.0  # of the width of the light, between windowed centroid and fit


class Correction(StrEnum):
    """How the centroid of the light is taken to the center of the figure."""

    RENDERED = "rendered"
    """By the same centroid of the body rendered at its predicted geometry."""
    KAASALAINEN_TANGA = "kaasalainen_tanga"
    """By paper 1 eq. 3, meant for bodies that are not resolved."""
    ELLIPSOID = "ellipsoid"
    """By the center of light of its best-fitting ellipsoid under the law of Lommel and Seeliger, in closed form."""
    NONE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class UnresolvedOptions:
    """Options of :class:`Unresolved`.

    Parameters
    ----------
    max_diameter_px : float, px
        Larger bodies (diameter of the sphere around them) are refused: other estimators see their shape.
    search_px : float, px
        Radius around the predicted photocenter in which the body is looked for.
    min_snr : float
        Weaker detections are none.
    correction : {'rendered', 'kaasalainen_tanga', 'ellipsoid', 'none'}
    range_sigma : float
        A priori standard deviation of the range as a fraction of it; it scales the correction.

    Raises
    ------
    InputError
        A value is out of its range.
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
        known = [str(kind) for kind in Correction]
        require(self.correction in known, f"correction must be one of {', '.join(known)}, got {self.correction!r}")


class Unresolved:
    """Brightest source near the prediction, a fit of the rendered body to its light, and a phase correction.

    A Gaussian has its center elsewhere than the light of a body that is a few pixels wide, so what is fitted is the
    body itself, rendered through the point spread function. The fit gives the center of the figure directly (correction
    ``rendered``, the default) or, less its offset, the center of the light, to which ``kaasalainen_tanga``, that of the
    best-fitting ``ellipsoid`` or no correction is applied. Rendered is the default because it knows the shape: on
    made-up bodies of 2 to 12 px it is right to 0.01-0.02 px per axis, while the published correction, meant for spheres
    that are not resolved, leaves 0.1 px at 2 px and 60 degrees and 0.5 px at 12 px.

    ``score`` is the signal to noise of the source, ``residuals`` are image minus model over the brightest pixel of the
    model. The covariance holds noise, errors of the model as the residuals show them, an error ``range_sigma`` of the
    range, and of the correction: for ``rendered`` what another reflectance law would do, as far as the image leaves
    that open; for ``kaasalainen_tanga`` and ``ellipsoid`` their difference from the rendered correction, as one sigma.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Unresolved Optical
       Navigation", eq. 3.
    """

    name: ClassVar[str] = "unresolved"

    def __init__(self, options: UnresolvedOptions | None = None) -> None:
        self.options = UnresolvedOptions() if options is None else options

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> CenterFix | Failure:
        """Find a small target of ``scene`` in ``image``; ``target`` may be left out when there is only one.

        Raises
        ------
        InputError
            The image has another size than the camera, or there is no such target.
        DataError
            SPICE kernels do not cover the epoch.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        diameter = 2 * inputs.reach_px
        if diameter > self.options.max_diameter_px:
            return inputs.fail(
                Reason.NOT_UNRESOLVED,
                f"the body is {diameter:.1f} px wide, at most {self.options.max_diameter_px:g} px are meant; "
                "take an estimator for resolved bodies",
            )
        rays_across = int(np.clip(_RAYS_PER_PIXEL * diameter, *_RAYS_ACROSS))
        renderer = TemplateRenderer(inputs=inputs, rays_across=rays_across)
        template = renderer.render(renderer.start, margin_px=math.ceil(self.options.search_px))
        if isinstance(template, Failure):
            return inputs.fail(template.reason, template.detail)
        found = self._brightest(inputs, template)
        if isinstance(found, Failure):
            return found
        start_px, rivals = found
        return self._fix(inputs, renderer, template, start_px, rivals)

    def _brightest(self, inputs: EstimatorInputs, template: Template) -> tuple[Float, bool] | Failure:
        """Position of the brightest source in the search region, and whether another comes near it."""
        box = _box_around(template.photocenter_px, self.options.search_px + _BACKGROUND_PX, inputs)
        if box.width < 2 * _BACKGROUND_PX or box.height < 2 * _BACKGROUND_PX:
            return inputs.fail(Reason.OUT_OF_FRAME, f"predicted at {_text(inputs.predicted_px)} px, outside the image")
        sources = detect_sources(
            box.cut(inputs.pixels_dn),
            detector=inputs.camera.detector,
            psf_sigma_px=_width_px(template),
            mask=box.cut(inputs.masked),
        )
        if isinstance(sources, Failure):
            return inputs.fail(sources.reason, sources.detail)
        points = sources.points_px + box.corner_px
        near = np.linalg.norm(points - template.photocenter_px, axis=1) <= self.options.search_px
        near &= (sources.snr >= self.options.min_snr) & ~_sharp(sources)
        if not near.any():
            return inputs.fail(
                Reason.NO_SIGNAL,
                f"no source of a signal to noise of {self.options.min_snr:g} within {self.options.search_px:g} px of "
                f"the prediction {_text(template.photocenter_px)} px",
            )
        flux = sources.flux_dn[near]
        order = np.argsort(-flux)
        rivals = order.size > 1 and float(flux[order[1]]) > _RIVAL_FLUX * float(flux[order[0]])
        return points[near][order[0]], bool(rivals)

    def _fix(
        self, inputs: EstimatorInputs, renderer: TemplateRenderer, template: Template, start_px: Float, rivals: bool
    ) -> CenterFix | Failure:
        window = _width_px(template)
        measured = _measure(inputs, start_px, window)
        if isinstance(measured, Failure):
            return measured
        offset = _offset(inputs, template, window)
        if isinstance(offset, Failure):
            return offset
        fit = self._fit(inputs, renderer, template, measured.point_px + offset)
        if isinstance(fit, Failure):
            return inputs.fail(fit.reason, fit.detail)
        shift, systematic = self._correction(inputs, template)
        flags = inputs.flags_at(_disk(inputs, measured.point_px, _CORE_SIGMAS * window))
        if rivals:
            flags |= Quality.AMBIGUOUS
        if np.linalg.norm(measured.point_px - template.photocenter_px) > 0.95 * self.options.search_px:
            flags |= Quality.FAR_FROM_PREDICTION
        if np.linalg.norm(fit.state.center_px - measured.point_px - offset) > _MAX_DISAGREEMENT * window:
            flags |= Quality.LARGE_RESIDUALS
        return CenterFix(
            estimator=self.name,
            target=inputs.target_name,
            center_px=fit.state.center_px + shift,
            covariance_px2=fit.covariance[:2, :2] + systematic,
            predicted_px=inputs.predicted_px,
            residuals=fit.residuals_dn[fit.used] / float(fit.model_dn.max() - fit.offset_dn),
            n_used=int(fit.used.sum()),
            n_rejected=fit.n_rejected,
            score=measured.snr,
            flags=flags,
            provenance=inputs.provenance,
        )

    def _fit(
        self, inputs: EstimatorInputs, renderer: TemplateRenderer, template: Template, center_px: Float
    ) -> TemplateFit | Failure:
        """The rendered body fitted to the image; another law is let in where its offset goes into the result."""
        shift = np.rint(center_px - template.center_px).astype(np.int64)
        box = FitBox.around(template, shift, _FIT_MARGIN_PX, inputs)
        return fit_template(
            box.cut(inputs.pixels_dn),
            box.cut(inputs.usable),
            box.corner_px,
            renderer.synthesis(box, other_law=Correction(self.options.correction) is Correction.RENDERED),
            replace(renderer.start, center_px=center_px),
            noise_variance_dn2=inputs.camera.detector.variance_dn2,
            options=TemplateFitOptions(
                log_range_sigma=self.options.range_sigma,
                blur_sigma_px2=KNOWN_BLUR_SIGMA_PX2 if inputs.camera.psf is not None else UNKNOWN_BLUR_SIGMA_PX2,
            ),
        )

    def _correction(self, inputs: EstimatorInputs, template: Template) -> tuple[Float, Float]:
        """From the fitted center to the corrected one (2,), px, and the covariance (2, 2), px^2, that this adds."""
        kind = Correction(self.options.correction)
        if kind is Correction.RENDERED:
            return np.zeros(2), np.zeros((2, 2))
        to_light = template.photocenter_px - template.center_px
        if kind is Correction.NONE:
            return to_light, np.outer(to_light, to_light)
        published = modeled_correction_px(inputs, kind)
        difference, scaled = published + to_light, self.options.range_sigma * published
        return difference, np.outer(difference, difference) + np.outer(scaled, scaled)


def kaasalainen_tanga(sunlight: Float, *, radius_px: float, phase_angle_rad: float) -> Float:
    """Phase correction (2,), px, to add to a center of brightness.

    Parameters
    ----------
    sunlight : (2,) float64, unitless, image axes
        Unit vector along which the light travels in the image, away from the Sun.
    radius_px : float, px
        Apparent radius of the body.
    phase_angle_rad : float, rad

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eq. 3.

    >>> kaasalainen_tanga(np.array([1.0, 0.0]), radius_px=1.0, phase_angle_rad=np.radians(50.0)).round(9).tolist()
    [0.31, 0.0]
    """
    phase_deg = math.degrees(phase_angle_rad)
    return sunlight * (0.0062 if phase_deg < 80 else 0.0065) * radius_px * phase_deg


def modeled_correction_px(inputs: EstimatorInputs, kind: Correction) -> Float:
    """From the center of light to that of the figure (2,), px, by a formula: ``KAASALAINEN_TANGA`` or ``ELLIPSOID``."""
    geometry = inputs.geometry
    shape = geometry.target.shape
    if kind is Correction.KAASALAINEN_TANGA or shape.circumscribing_radius_km == 0.0:
        return kaasalainen_tanga(
            sunlight_px(inputs), radius_px=inputs.radius_px, phase_angle_rad=geometry.phase_angle_rad
        )
    body_from_camera = geometry.camera_from_body.inv()
    light_body_km = ellipsoid_photocenter_km(
        shape.best_fit_ellipsoid,
        sun_direction_body=rotate(body_from_camera, geometry.sun_direction_camera),
        observer_direction_body=-rotate(body_from_camera, unit(geometry.position_camera_km)),
    )
    light_camera_km = rotate(geometry.camera_from_body, light_body_km)
    result: Float = -inputs.camera.model.project_jacobian(geometry.position_camera_km) @ light_camera_km
    return result


def sunlight_px(inputs: EstimatorInputs) -> Float:
    """Unit vector (2,) along which sunlight travels in the image at the predicted center; zero at zero phase."""
    position = inputs.geometry.position_camera_km
    along = inputs.camera.model.project_jacobian(position) @ inputs.geometry.sun_direction_camera
    length = float(np.linalg.norm(along))
    straight = _STRAIGHT * inputs.camera.model.focal_length_px / inputs.geometry.range_km
    return -along / length if length > straight else np.zeros(2)


def _measure(inputs: EstimatorInputs, start_px: Float, window_px: float) -> WindowedCentroid | Failure:
    """Centroid in the image, background and its noise from a ring around the source."""
    reach = _WINDOW_REACH_SIGMAS * window_px
    box = _box_around(start_px, reach + _BACKGROUND_PX, inputs)
    values, usable = box.cut(inputs.pixels_dn), box.cut(inputs.usable, outside=False)
    corner = np.array(box.corner_px)
    rows, columns = np.indices(values.shape)
    distance = np.hypot(columns + corner[0] - start_px[0], rows + corner[1] - start_px[1])
    core = distance <= _CORE_SIGMAS * window_px
    if not usable[core].all():
        saturated = box.cut(inputs.saturated)[core].any()
        return inputs.fail(
            Reason.SATURATED if saturated else Reason.NO_SIGNAL,
            f"{int((~usable[core]).sum())} of {int(core.sum())} pixels on the source at {_text(start_px)} px are "
            f"{'saturated' if saturated else 'bad or outside the image'}",
        )
    level, noise = _background(values[(distance > reach) & usable])
    signal = values - level
    variance = inputs.camera.detector.variance_dn2(signal) - inputs.camera.detector.variance_dn2(np.zeros(1)) + noise**2
    measured = windowed_centroid(
        signal, variance, usable & (distance <= reach), start_px - corner, window_sigma_px=window_px
    )
    if measured is None:
        return inputs.fail(Reason.NOT_CONVERGED, f"the centroid does not settle near {_text(start_px)} px")
    return WindowedCentroid(
        point_px=measured.point_px + corner, covariance_px2=measured.covariance_px2, snr=measured.snr
    )


def _offset(inputs: EstimatorInputs, template: Template, window_px: float) -> Float | Failure:
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
        return inputs.fail(Reason.NOT_CONVERGED, "the centroid of the rendered body does not settle")
    return template.center_px - (found.point_px + template.corner_px)


def _background(values: Float) -> tuple[float, float]:
    """Median and robust standard deviation of ring pixels, stars clipped."""
    for _ in range(_CLIP_ROUNDS):
        level = float(np.median(values))
        noise = robust_sigma(values, level)
        kept = np.abs(values - level) <= _CLIP_SIGMA * max(noise, 1e-12)
        if kept.all():
            break
        values = values[kept]
    return float(np.mean(values)), max(noise, float(np.std(values)))


def _width_px(template: Template) -> float:
    """Standard deviation, px, of the recorded light along one axis, mean of both axes."""
    light = template.brightness
    rows, columns = np.indices(light.shape)
    total = light.sum()
    x, y = (columns * light).sum() / total, (rows * light).sum() / total
    return math.sqrt(float((((columns - x) ** 2 + (rows - y) ** 2) * light).sum() / total) / 2)


def _box_around(center_px: Float, half_px: float, inputs: EstimatorInputs) -> FitBox:
    """Box of the image within ``half_px`` of a point, cut at the frame."""
    frame = np.array([inputs.camera.columns, inputs.camera.rows])
    low = np.clip(np.floor(center_px - half_px), 0, frame).astype(int)
    high = np.clip(np.ceil(center_px + half_px) + 1, low, frame).astype(int)
    return FitBox(x=int(low[0]), y=int(low[1]), width=int(high[0] - low[0]), height=int(high[1] - low[1]))


def _disk(inputs: EstimatorInputs, center_px: Float, radius_px: float) -> Mask:
    rows, columns = np.ogrid[: inputs.camera.rows, : inputs.camera.columns]
    return np.asarray((columns - center_px[0]) ** 2 + (rows - center_px[1]) ** 2 <= radius_px**2)


def _sharp(sources: Detections) -> Mask:
    return np.asarray((sources.flags & np.uint16(DetectionFlag.SHARP)) != 0)


def _text(point_px: Float) -> str:
    return f"({point_px[0]:.1f}, {point_px[1]:.1f})"
