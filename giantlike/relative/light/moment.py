"""Moment: center of brightness of a resolved body, corrected to the center of its figure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import CenterFix, Failure, Reason
from giantlike.core.pixel_box import BoxPixels, PixelBox
from giantlike.core.values import Value
from giantlike.processing.limb.segmentation import (
    Background,
    ExpectedBlob,
    background_of,
    connected_blobs,
    identify_blobs,
    otsu_threshold,
)
from giantlike.ray_tracing import (
    FocalPlane,
    Lambert,
    LommelSeeliger,
    RenderOptions,
    Template,
    disk_photocenter,
    trace_body,
)
from giantlike.relative.estimator import BodyEstimator, EstimatorInputs, apparent_radius_px
from giantlike.relative.light.phase_correction import Correction, phase_correction_px, require_correction
from giantlike.relative.quality import QualityChecks
from giantlike.scene import TargetGeometry

_LIGHT_SIGMAS = 5.0  # of the background: a pixel of noise is so bright once in 3.5 million
_MIN_AREA_PX = 4  # px, of a blob: hits and hot pixels are smaller
_MIN_BACKGROUND_PX = 100  # px: their median is then known to an eighth of the noise
_VISIBLE = 0.02  # of the brightest pixel of a template: its expected blob
_TRACE = 0.002  # the same, for the region that the light of a body is taken from
_REGION_MARGIN, _REGION_MARGIN_PX = 0.05, 3  # of the radius and px, for errors of range and law
_OTSU_MARGIN = 0.25  # of the radius, for enough dark pixels
_LOWER_THRESHOLD = 0.5
"""Factor of the threshold whose effect on the center enters the covariance as one sigma."""
_SAMPLING_PX = 0.02  # px, error by the rays of the template on a large body
_MAX_SATURATED = 0.2  # of the bright pixels: above, the center is not that of the light: see benchmarks/sensitivity.md
_INCONSISTENT_SIGMAS = 4.0  # between predicted and measured size: once in 16,000 by chance
_EDGE_PX = 1.0  # px, error of the edge of the lit area, by the point spread function above all
_MAX_STRAY = 0.05  # of the bright pixels outside the expected area: above, it is not the light of the body alone
_SETTLING, _SETTLED_PX = 4, 2
"""Rounds in which the region follows its light, and motion, px, that ends them: less than the margin of the region."""
_BLOCK = 0.25  # of the radius: markings larger than that are few
_RAYS_ACROSS = 300  # over the body: see _SAMPLING_PX
_OTHER_LAWS = (LommelSeeliger(), Lambert())  # flat and dark at the terminator: those of bodies lie between, about


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentOptions:
    """Options of :class:`Moment`.

    Parameters
    ----------
    search_px : float, px
        Largest distance of the light from its predicted place.
    correction : {'rendered', 'kaasalainen_tanga', 'ellipsoid', 'none'}
        As for ``unresolved``.
    range_sigma : float
        A priori standard deviation of the range as a fraction of it; it scales the correction.

    Raises
    ------
    InputError
        A value is out of its range.

    Notes
    -----
    Half and double of the defaults move no center of ``benchmarks/sensitivity.md`` by more than 0.1 of its sigma.
    """

    search_px: float = 40.0
    correction: str = Correction.RENDERED.value
    range_sigma: float = 0.02

    def __post_init__(self) -> None:
        require(1 <= self.search_px <= 2000, f"search_px must be in [1, 2000], got {self.search_px}")
        require(0 < self.range_sigma < 1, f"range_sigma must be in (0, 1), got {self.range_sigma}")
        require_correction(self.correction)


class Moment(BodyEstimator[MomentOptions, CenterFix]):
    """Center of the light of a body that is all in the frame, and a correction for its phase.

    Bright pixels are joined to blobs; that of the target, distinguished from those of the other targets of the scene by
    place and size, is separated from the dark by Otsu's method, and the brightness above background gives the center of
    light (paper 1 eq. 4). The correction to the center of the figure is by default that of the body rendered at its
    predicted geometry, its light cut at the same level; ``kaasalainen_tanga`` is the one of the paper. It grows with
    the size of the body, predicted (``range_sigma``) and measured by the lit area.

    No limb and no detail of the surface is used, so that nothing can be mistaken for them; in return the reflectance
    law is fully trusted. ``score`` is the lit area over that expected, ``residuals`` are image minus template, shifted
    by whole pixels, over the brightest pixel of the template. The covariance holds the noise, the error of the size,
    and systematic terms, each as one sigma: the effects of the laws of Lommel-Seeliger and Lambert, and of a threshold
    half as high. For ``kaasalainen_tanga`` and ``none`` the difference from the rendered correction stands for the law.
    Markings and rings, which the template lacks, count by the residuals that they leave.

    Failures are ``NO_SIGNAL``, ``AMBIGUOUS``, ``OUT_OF_FRAME`` where light reaches the edge of the image,
    ``SATURATED`` and ``NOT_LIT``.

    Parameters
    ----------
    options : MomentOptions

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Moment Algorithms",
       eqs. 3 and 4.
    """

    name: ClassVar[str] = "moment"
    options_type = MomentOptions

    def _estimate(self, inputs: EstimatorInputs) -> CenterFix | Failure:
        """Find the body of gathered inputs."""
        geometry, search_px = inputs.geometry, self.options.search_px
        templates = _templates(geometry, inputs.focal_plane(), margin_px=math.ceil(search_px))
        if isinstance(templates, Failure):
            return templates
        prediction = _Prediction(
            center_px=inputs.predicted_px,
            radius_px=inputs.radius_px,
            reach_px=inputs.reach_px,
            search_px=search_px,
            template=templates[0],
            others=_other_targets(inputs),
        )
        light = _light_of(inputs.pixels, inputs.masked, prediction)
        return light if isinstance(light, Failure) else _fix(inputs, templates, light, self.options)


def _fix(inputs: EstimatorInputs, templates: list[Template], light: _Light, options: MomentOptions) -> CenterFix:
    """Center of light and the correction, with all that is known of their errors."""
    template, threshold_dn = templates[0], light.threshold_dn
    center_px, noise_px2 = light.centroid(threshold_dn)
    rendered, *by_other_laws = (light.offset_px(one, threshold_dn) for one in templates)
    low_dn = _LOWER_THRESHOLD * threshold_dn
    by_threshold = light.centroid(low_dn)[0] - center_px + light.offset_px(template, low_dn) - rendered
    kind, model = Correction(options.correction), inputs.camera.model
    offset = phase_correction_px(kind, rendered, inputs.geometry, model, radius_px=inputs.radius_px)
    by_correction = [other - rendered for other in (by_other_laws if kind is Correction.RENDERED else [offset])]
    size = _measured_size(light, templates, options.range_sigma)
    terms = [*by_correction, by_threshold, size.sigma * offset]
    covariance = noise_px2 + _SAMPLING_PX**2 * np.eye(2) + sum(np.outer(term, term) for term in terms)
    residuals_dn, peak_dn = light.residuals_dn(template)
    bright = light.bright
    n_used, stray = int(np.count_nonzero(bright)), int(np.count_nonzero(bright & ~light.expected))
    checks = QualityChecks(
        off_px=np.array([np.linalg.norm(center_px + rendered - template.center_px), 0.0]),
        search_px=options.search_px,
        bounded=True,
        residuals=max(size.excess, stray / n_used / _MAX_STRAY),
    )
    return CenterFix(
        **inputs.identity,
        center_px=center_px + size.scale * offset,
        covariance_px2=covariance + light.unexplained_px2(residuals_dn, center_px, inputs.radius_px),
        residuals=residuals_dn[bright] / peak_dn,
        n_used=n_used,
        n_rejected=0,
        score=size.area_ratio,
        flags=inputs.flags_at(bright) | checks.flags,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Prediction(Value):
    """The body as predicted: center, mean and largest radius, px, its light and that of the other targets."""

    center_px: Float
    radius_px: float
    reach_px: float
    search_px: float
    template: Template
    others: list[ExpectedBlob]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Light(Value):
    """The light of one body in the image.

    Parameters
    ----------
    signal_dn : (rows, columns) float64, DN
        Background subtracted, bad pixels filled.
    region : (rows, columns) bool
        Pixels whose light counts as the body's.
    expected : (rows, columns) bool
        Pixels where light of the body is expected, with a margin.
    threshold_dn : float, DN
        Otsu's, above background.
    background : Background
    noise_variance_dn2 : callable
        Variance, DN^2, of the noise of pixels of a given signal.
    shift_px : (2,) int64, px
        From a template at the predicted place to the light.
    """

    signal_dn: Float
    region: Mask
    expected: Mask
    threshold_dn: float
    background: Background
    noise_variance_dn2: Callable[[Float], Float]
    shift_px: NDArray[np.int64]

    @property
    def bright(self) -> Mask:
        """Pixels of the body above threshold."""
        return np.asarray(self.region & (self.signal_dn > self.threshold_dn))

    def centroid(self, threshold_dn: float) -> tuple[Float, Float]:
        """Center of the light above a threshold (2,), px, and its covariance (2, 2) by noise, px^2."""
        rows, columns = np.nonzero(self.region & (self.signal_dn > threshold_dn))
        values = self.signal_dn[rows, columns]
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        center = values @ pixels / values.sum()
        variance = self.noise_variance_dn2(values) - float(self.noise_variance_dn2(np.zeros(1))[0])
        variance = variance + self.background.sigma_dn**2
        arms = (pixels - center) / values.sum()
        return center, (arms * variance[:, None]).T @ arms

    def gain_dn(self, template: Template) -> float:
        """Signal of a surface of relative brightness 1, DN: by all of the light."""
        return float(self.signal_dn[self.region].sum()) / float(template.brightness.sum())

    def offset_px(self, template: Template, threshold_dn: float) -> Float:
        """From the center of a template's light, cut at the same level, to the center of its body (2,), px."""
        brightness = template.brightness
        kept = np.where(brightness * self.gain_dn(template) > threshold_dn, brightness, 0.0)
        if not kept.any():
            kept = brightness
        by_column, by_row = kept.sum(axis=0), kept.sum(axis=1)
        along = np.array([by_column @ np.arange(by_column.size), by_row @ np.arange(by_row.size)])
        center = along / float(by_column.sum())
        return np.asarray(template.center_px - center - template.corner_px)

    def residuals_dn(self, template: Template) -> tuple[Float, float]:
        """Image minus template at the nearest whole pixels (rows, columns), DN, and the template's peak, DN."""
        rows, columns = self.region.shape
        expected = replace(template, corner_px=template.corner_px + self.shift_px).placed(columns, rows)
        gain = self.gain_dn(template)
        return self.signal_dn - gain * expected, gain * float(template.brightness.max())

    def unexplained_px2(self, residuals_dn: Float, center_px: Float, radius_px: float) -> Float:
        """Covariance (2, 2) of the center by markings: residuals of blocks of a quarter radius, each as one sigma."""
        rows, columns = np.nonzero(self.bright)
        left = residuals_dn[rows, columns]
        arms = np.stack([columns, rows], axis=1) - center_px
        block = np.floor(arms / max(_BLOCK * radius_px, 1.0)).astype(np.int64)
        block -= block.min(axis=0)
        number = block[:, 1] * (int(block[:, 0].max()) + 1) + block[:, 0]
        flux = float(self.signal_dn[rows, columns].sum())
        pulls = np.stack([np.bincount(number, left * arms[:, axis]) for axis in range(2)], axis=-1) / flux
        return np.asarray(pulls.T @ pulls)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Size:
    """Size of the body in the image: ``scale`` times its prediction, with a relative ``sigma``.

    ``excess`` is the difference of measured and predicted size over the largest that is consistent.
    """

    scale: float
    sigma: float
    area_ratio: float
    excess: float


def _measured_size(light: _Light, templates: list[Template], range_sigma: float) -> _Size:
    """Size by the lit area, which depends little on the law: predicted and measured size, weighted."""
    level = max(_LIGHT_SIGMAS * light.background.sigma_dn, _TRACE * float(light.signal_dn[light.region].max()))
    measured = float(np.count_nonzero(light.region & (light.signal_dn > level)))
    areas = [float(np.count_nonzero(one.brightness * light.gain_dn(one) > level)) for one in templates]
    own = max(areas[0], 1.0)
    ratio = max(measured, 1.0) / own
    by_law = max(abs(math.log(max(area, 1.0) / own)) for area in areas[1:])
    variance = (0.5 * by_law) ** 2 + 0.25 / own + (0.5 * _EDGE_PX / math.sqrt(own)) ** 2
    log_size = 0.5 * math.log(ratio)
    excess = abs(log_size) / (_INCONSISTENT_SIGMAS * math.sqrt(range_sigma**2 + variance))
    if excess > 1.0:  # halo, or another body
        return _Size(scale=1.0, sigma=range_sigma, area_ratio=ratio, excess=excess)
    weight = range_sigma**2 / (range_sigma**2 + variance)
    sigma = math.sqrt(weight * variance)
    return _Size(scale=math.exp(weight * log_size), sigma=sigma, area_ratio=ratio, excess=excess)


def _templates(geometry: TargetGeometry, plane: FocalPlane, *, margin_px: int) -> list[Template] | Failure:
    """The body at its predicted place under its own law and then others."""
    trace = trace_body(
        geometry.body(),
        plane.model,
        sun_direction_camera=geometry.sun_direction_camera,
        psf=plane.psf,
        columns=plane.columns,
        rows=plane.rows,
        options=RenderOptions(rays_per_pixel_side=1, min_rays_across=_RAYS_ACROSS, margin_px=margin_px),
    )
    if isinstance(trace, Failure):
        return trace
    own = geometry.target.reflectance
    found = []
    for law in (own, *(law for law in _OTHER_LAWS if type(law) is not type(own))):
        template = trace.with_reflectance(law).template()
        if isinstance(template, Failure):
            return template
        found.append(template)
    return found


def _light_of(image: BoxPixels, bad: Mask, prediction: _Prediction) -> _Light | Failure:
    """Find the light of the body and separate it from the dark and from other bodies."""
    template, others, search_px = prediction.template, prediction.others, prediction.search_px
    background = _background(image, prediction)
    if isinstance(background, Failure):
        return background
    signal = _filled(image.values_dn, bad) - background.level_dn
    blobs = connected_blobs(signal, signal > _LIGHT_SIGMAS * background.sigma_dn, min_area_px=_MIN_AREA_PX)
    visible = template.brightness > _VISIBLE * float(template.brightness.max())
    own = ExpectedBlob(
        center_px=(float(template.photocenter_px[0]), float(template.photocenter_px[1])),
        area_px=float(np.count_nonzero(visible)),
    )
    chosen = identify_blobs(blobs, [own, *others], search_px=search_px)
    if isinstance(chosen, Failure) and chosen.reason is Reason.NO_SIGNAL and others:
        chosen = identify_blobs(blobs, [own], search_px=search_px)  # another body may be too faint, or hidden
    if isinstance(chosen, Failure):
        return chosen
    blob = int(chosen[0])
    if bool(blobs.touch_frame[blob]):
        return Failure(
            Reason.OUT_OF_FRAME,
            "the light of the body reaches the edge of the image; use an estimator that matches limb or template",
        )
    foreign = np.isin(blobs.labels, chosen[1:] + 1)
    shift = np.rint(blobs.centroids_px[blob] - template.photocenter_px).astype(np.int64)
    for _ in range(_SETTLING):
        region, expected, around = _regions(template, shift, blobs.labels == blob + 1, prediction.radius_px)
        light = _Light(
            signal_dn=signal,
            region=region & ~foreign,
            expected=expected,
            threshold_dn=otsu_threshold(signal[around & ~foreign]),
            background=background,
            noise_variance_dn2=image.noise_variance_dn2,
            shift_px=shift,
        )
        bright = light.bright
        if not bright.any():
            return Failure(Reason.NO_SIGNAL, f"no pixel is above {light.threshold_dn:.4g} DN over background")
        center = light.centroid(light.threshold_dn)[0] + light.offset_px(template, light.threshold_dn)
        before, shift = shift, np.rint(center - template.center_px).astype(np.int64)
        if np.abs(shift - before).max() <= _SETTLED_PX:
            break
    saturated = float((~image.usable & ~bad)[bright].mean())
    if saturated > _MAX_SATURATED:
        return Failure(
            Reason.SATURATED, f"{saturated:.0%} of the bright pixels are saturated, allowed {_MAX_SATURATED:.0%}"
        )
    return light


def _background(image: BoxPixels, prediction: _Prediction) -> Background | Failure:
    """Level and noise of the sky: of all pixels that the body cannot reach."""
    rows, columns = np.ogrid[: image.usable.shape[0], : image.usable.shape[1]]
    (x, y), search_px = prediction.center_px, prediction.search_px
    away = np.hypot(columns - x, rows - y) > prediction.reach_px + search_px
    values = image.values_dn[away & image.usable]
    if values.size < _MIN_BACKGROUND_PX:
        return Failure(
            Reason.OUT_OF_FRAME,
            f"{values.size} pixels lie more than {search_px:g} px from the body, needed {_MIN_BACKGROUND_PX} for a "
            "background; it fills the image",
        )
    found = background_of(values)
    floor = math.sqrt(float(image.noise_variance_dn2(np.zeros(1))[0]))
    return Background(level_dn=found.level_dn, sigma_dn=max(found.sigma_dn, 0.1 * floor, 1e-9))


def _filled(values_dn: Float, bad: Mask) -> Float:
    """Pixels with bad ones replaced by the mean of the good ones around."""
    if not bad.any():
        return values_dn
    share = cv2.blur((~bad).astype(np.float64), (5, 5))
    near = cv2.blur(np.where(bad, 0.0, values_dn), (5, 5)) / np.maximum(share, 1e-6)
    return np.asarray(np.where(bad, near, values_dn))


def _regions(template: Template, shift_px: NDArray[np.int64], blob: Mask, radius_px: float) -> tuple[Mask, Mask, Mask]:
    """Pixels of the body's light, those where it is expected, and a box with enough dark around for a threshold."""
    rows, columns = blob.shape
    x, y = (template.corner_px + shift_px).tolist()
    trace = template.brightness > _TRACE * float(template.brightness.max())
    expected = PixelBox(x=0, y=0, width=columns, height=rows).cut(trace, (x, y))
    margin = _REGION_MARGIN_PX + math.ceil(_REGION_MARGIN * radius_px)
    down, right = np.ogrid[-margin : margin + 1, -margin : margin + 1]
    disk = (np.hypot(down, right) <= margin).astype(np.uint8)
    region, expected = (
        np.asarray(cv2.dilate(part.astype(np.uint8), disk), dtype=bool) for part in (expected | blob, expected)
    )
    y, x = np.nonzero(region)
    more = math.ceil(_OTSU_MARGIN * radius_px)
    around = np.zeros(region.shape, dtype=bool)
    around[max(y.min() - more, 0) : y.max() + more + 1, max(x.min() - more, 0) : x.max() + more + 1] = True
    return region, expected, around


def _other_targets(inputs: EstimatorInputs) -> list[ExpectedBlob]:
    """Expected light of the other targets in the frame, as spheres."""
    found = []
    for target in inputs.scene.targets:
        if target.name == inputs.target_name:
            continue
        geometry = inputs.scene.geometry(inputs.image, target.name)
        if not isinstance(geometry, Failure):
            found += _expected(geometry, inputs.camera)
    return found


def _expected(geometry: TargetGeometry, camera: Camera) -> list[ExpectedBlob]:
    """Light of a sphere in the place of a body; none where it is not in the frame or only a point."""
    center = camera.model.project(geometry.position_camera_km)
    if not np.isfinite(center).all() or geometry.range_km <= geometry.target.shape.circumscribing_radius_km:
        return []
    radius = apparent_radius_px(camera, center, geometry.target.shape.mean_radius_km, geometry.range_km)
    along = camera.model.project_jacobian(geometry.position_camera_km) @ geometry.sun_direction_camera
    length = float(np.linalg.norm(along))
    phase = geometry.phase_angle_rad
    if length > 0:
        center = center + along / length * radius * float(disk_photocenter(Lambert(), phase))
    area = math.pi * radius**2 * 0.5 * (1.0 + math.cos(phase))
    if area < _MIN_AREA_PX or not bool(camera.contains(center)):
        return []
    return [ExpectedBlob(center_px=(float(center[0]), float(center[1])), area_px=area)]
