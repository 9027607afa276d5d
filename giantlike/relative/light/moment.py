"""Moment: center of brightness of a resolved body, corrected to the center of its figure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require, unit
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.findings import Corrections
from giantlike.core.outcomes import CenterFix, Failure
from giantlike.processing.limb.segmentation import ExpectedBlob
from giantlike.ray_tracing import Lambert, LommelSeeliger, RenderOptions, Template
from giantlike.ray_tracing.block_templates import BlockedPlane, block_templates
from giantlike.ray_tracing.disk import disk_photocenter
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import Facts
from giantlike.relative.light.averaging import average_blocks, on_pixels
from giantlike.relative.light.law_mixture import LawMixture, fit_law
from giantlike.relative.light.lit_size import first_scale, measured_size
from giantlike.relative.light.phase_correction import Correction, phase_correction_px, require_correction
from giantlike.relative.light.separation import MIN_AREA_PX, TRACE, Prediction, SeparatedLight, separate_light
from giantlike.relative.light.wings import WING_UNKNOWN, wing_share, with_wings
from giantlike.relative.place import apparent_radius_px
from giantlike.scene import TargetGeometry

_LOWER_THRESHOLD = 0.5  # factor of the threshold; its effect on the center enters the covariance as one sigma
_SAMPLING_PX = 0.02  # px, error by the rays of the template on a large body
_FILL_UNKNOWN = 0.25
"""One sigma as a fraction of the effect of filled pixels on the center. The template used for it is right to half a
pixel and some percent of the range."""
_LEAST_LIT = 0.05  # of the disk, as for ``unresolved``
_RAYS_ACROSS, _RAYS_SIZE_PX = (96, 300), 40.0
"""Minimum and maximum number of rays across a full disk, and its size up to which the minimum is used. The sampling
error grows with the size and falls with the power 3/2 of the number of rays. A crescent gets as many. See
``_SAMPLING_PX``."""
_MOST_RAYS = 24  # along the side of a pixel: bounds the cost of small bodies
_SIZES, _SETTLED_SIZE = 3, 1e-3
"""Maximum number of iterations of law and size, and relative change of the size at convergence. Such a change moves the
center of a body of 300 px by 0.02 px and the law by 0.003 of the difference of two laws."""
_LEAST_SINE = 1e-3  # sine of the phase angle below which it grows in all directions from the center
_BLOCKS_ACROSS = 150
"""Blocks of pixels across a disk, each with one ray where light is uniform; 2 px wide on small disks."""
_CELL_SIGMAS, _LEAST_PSF_PX = math.sqrt(2.0 / 12.0), 0.14
"""Side of the cell of a ray in widths of the point spread function, so that the cell adds at most half of its variance;
and width, px, below which the pixel (0.29 px) is used instead. Centers of ellipsoids of 1,000 px on means of 3 x 3
pixels have errors of 0.28 px, and 1.7 px with rays as far apart as pixels; at 600 px on means of 2 x 2 pixels 0.11 px,
and 0.22 px with cells as wide as the point spread function."""
_AVERAGED_PX, _LEAST_BLOCK_PX = 62.5, 3
"""Diameter divided by the square of the side of an averaged block, px, as for ``cross_correlation``: the cost grows
with the limb; and minimum side, used from 563 px on. Ellipsoids of 600 and 1,000 px have errors of 0.15 and 0.13 px in
blocks of 3 and 4 px, and 0.12 and 0.32 px in pixels, where edges of templates are coarser. Blocks of 2 px at 300 px are
as accurate, with smaller sigmas: see "Means over blocks" of ``benchmarks/README.md``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentOptions:
    """Options of :class:`Moment`.

    Parameters
    ----------
    search_px : float, px; largest distance of the light from its predicted place
    correction : {'rendered', 'kaasalainen_tanga', 'ellipsoid', 'none'}; as for ``unresolved``
    range_sigma : float; a priori standard deviation of the range as a fraction of it; it scales the correction

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
    """Center of the light of a body that lies wholly in the frame, and a correction for its phase.

    Bright pixels are joined to blobs. The blob of the target, distinguished from those of other targets of the scene by
    position and size, is separated from the sky background by Otsu's method, and the brightness above the plane through
    the sky gives the center of light (Liounis et al. eq. 4). The correction to the center of the figure is by default
    that of the body rendered at its predicted geometry, its light cut at the same level; ``kaasalainen_tanga`` is their
    eq. 3. It scales with the size of the body: the predicted one (``range_sigma``) combined with the size measured by
    the lit area above several levels, which is estimated together with the width of the point spread function.

    No limb and no detail of the surface is used, so that none can be mismatched. The result depends on the reflectance
    law: its deviation from the law of the target toward Lommel-Seeliger or Lambert, and its change with the phase angle
    across the body, are estimated from the brightness of blocks of a quarter of the radius.

    ``score`` is the ratio of lit area to expected lit area, ``seen_size`` of its corrections the ratio of measured to
    predicted size, ``residuals`` are image minus template divided by the brightest pixel of the template.

    The covariance is the sum of ``parts``: ``noise``; ``background``, the plane and, as one sigma, the curvature of the
    sky; ``reflectance``, the uncertainty of the law and, for saturated bodies, the error of their brightness;
    ``albedo``, markings and rings, by the residuals of the blocks; ``psf``, the error of the size, including its effect
    on the law, half of the effect of the wings estimated from the light next to the body and, as one sigma, the effect
    of a threshold half as high; ``relief``, an error of the shape indicated by limb, terminator and strain in the
    checks of every fix. For ``kaasalainen_tanga``, ``ellipsoid`` and ``none`` the difference from the rendered
    correction is an error of the reflectance.

    Failures are ``NO_SIGNAL``, ``AMBIGUOUS``, ``OUT_OF_FRAME`` where light reaches the edge of the image,
    ``SATURATED`` where hardly any unsaturated pixel is left, and ``NOT_LIT``.

    Parameters
    ----------
    options : MomentOptions

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Moment Algorithms",
       eqs. 3 and 4.
    """

    name: ClassVar[str] = "moment"
    by_light: ClassVar[bool] = True
    options_type = MomentOptions

    def _estimate(self, inputs: EstimatorInputs) -> CenterFix | Failure:
        """Find the body of gathered inputs: a wide one on means over blocks of pixels, unless that fails."""
        size = int(math.sqrt(2.0 * inputs.radius_px / _AVERAGED_PX))
        if size >= _LEAST_BLOCK_PX:
            options = replace(self.options, search_px=max(self.options.search_px / size, 1.0))
            fix = _find_body(average_blocks(inputs, size), options)
            if not isinstance(fix, Failure):
                return on_pixels(fix, inputs, size)
        return _find_body(inputs, self.options)


def _find_body(inputs: EstimatorInputs, options: MomentOptions) -> CenterFix | Failure:
    """Find the body in unaveraged pixels."""
    search_px = options.search_px
    laws = _laws(inputs, math.ceil(search_px))
    if isinstance(laws, Failure):
        return laws
    prediction = Prediction(
        center_px=inputs.predicted_px,
        radius_px=inputs.radius_px,
        reach_px=inputs.reach_px,
        search_px=search_px,
        template=laws.own,
        others=_other_targets(inputs),
    )
    light = separate_light(inputs.pixels, inputs.masked, inputs.saturated, prediction)
    return light if isinstance(light, Failure) else _fix(inputs, laws, light, options)


def _fix(inputs: EstimatorInputs, laws: LawMixture, light: SeparatedLight, options: MomentOptions) -> CenterFix:
    """Center of light and the correction, with their error budget."""
    psf_sigma_px = UNKNOWN_PSF_SIGMA_PX if inputs.psf_sigma_px is None else inputs.psf_sigma_px
    laws = laws.seen_from(light.corner_px)
    share = wing_share(light, laws.own, psf_sigma_px=psf_sigma_px, radius_px=inputs.radius_px)
    threshold_dn, without = light.threshold_dn, laws.own
    laws = with_wings(laws, share, psf_sigma_px) if share > 0.0 else laws
    by_wings = light.offset_px(laws.own, threshold_dn) - light.offset_px(without, threshold_dn)
    ranged = partial(measured_size, range_sigma=options.range_sigma, trace=max(TRACE, share))
    first = first_scale(light, laws, range_sigma=options.range_sigma, trace=max(TRACE, share))
    for _ in range(_SIZES):
        law = fit_law(light, laws.resize(first), radius_px=first * inputs.radius_px)
        size = ranged(light, laws, law, psf_sigma_px=psf_sigma_px, radius_px=inputs.radius_px)
        rest = size.scale / first
        if abs(math.log(rest)) < _SETTLED_SIZE:
            break
        first = size.scale
    template = law.template
    center_px, noise_px2, background_px2 = light.centroid(threshold_dn)
    cut = light.offset_px(template, threshold_dn)
    low_dn = _LOWER_THRESHOLD * threshold_dn
    by_threshold = light.center_px(low_dn) + light.offset_px(template, low_dn) - center_px - cut
    brighter = 1.0 + _gain_error(light, template, math.hypot(math.log(rest), size.sigma))
    by_gain = light.offset_px(template, threshold_dn, brighter=brighter) - cut
    by_fill = _FILL_UNKNOWN * (cut - light.offset_px(template, threshold_dn, filled=False))
    rendered = cut + math.log(rest) * law.by_size_px
    kind, model = Correction(options.correction), inputs.camera.model
    offset, by_law, by_size = rendered, law.covariance_px2, law.by_size_px
    if kind is not Correction.RENDERED:
        offset = size.scale * phase_correction_px(kind, rendered, inputs.geometry, model, radius_px=inputs.radius_px)
        by_law, by_size = np.outer(offset - rendered, offset - rendered), offset
    parts = {
        Cause.NOISE: noise_px2 + _SAMPLING_PX**2 * np.eye(2),
        Cause.BACKGROUND: background_px2,
        Cause.REFLECTANCE: by_law + np.outer(by_gain, by_gain),
        Cause.ALBEDO: law.unexplained_px2 + np.outer(by_fill, by_fill),
        Cause.PSF: np.outer(by_threshold, by_threshold)
        + size.sigma**2 * np.outer(by_size, by_size)
        + WING_UNKNOWN**2 * np.outer(by_wings, by_wings),
    }
    bright = light.bright
    n_used = int(np.count_nonzero(bright))
    checks = Facts(
        off_px=np.array([np.linalg.norm(center_px + rendered - template.center_px), 0.0]),
        search_px=options.search_px,
        bounded=True,
    )
    identity = inputs.identity
    identity["corrections"] |= Corrections(seen_size=size.scale)
    return CenterFix(
        **identity,
        center_px=light.corner_px + center_px + offset,
        covariance_px2=sum_parts(parts),
        parts=parts,
        residuals=law.residuals,
        residuals_at_px=(np.argwhere(bright)[:, ::-1] + light.corner_px).astype(np.float64),
        n_used=n_used,
        n_rejected=0,
        score=size.area_ratio,
        flags=inputs.flags_at(bright, (int(light.corner_px[0]), int(light.corner_px[1]))) | checks.flags,
    )


def _gain_error(light: SeparatedLight, template: Template, size_sigma: float) -> float:
    """Relative error of the brightness of a clipped body by the error of its size."""
    if math.isinf(light.ceiling_dn):
        return 0.0
    expected = light.expected_dn(template.brightness)
    free = float(expected[expected < light.ceiling_dn].sum()) / float(expected.sum())
    return min(2.0 * size_sigma / max(free, 1e-6), 1.0)


def _laws(inputs: EstimatorInputs, margin_px: int) -> LawMixture | Failure:
    """Mixture of the body at its predicted position under its own law, a flat one and Lambert's."""
    geometry, camera, diameter_px = inputs.geometry, inputs.camera, 2.0 * inputs.radius_px
    lit = max(0.5 * (1.0 + math.cos(geometry.phase_angle_rad)), _LEAST_LIT)
    rays_across = _RAYS_ACROSS[0] * max(diameter_px / _RAYS_SIZE_PX, 1.0) ** (2.0 / 3.0) / math.sqrt(lit)
    plane = inputs.focal_plane()
    across = min(max(round(min(rays_across, _RAYS_ACROSS[1]) / diameter_px), 1), _MOST_RAYS)
    finer = -(-max(across, math.ceil(_CELL_SIGMAS / max(plane.psf_sigma_px, _LEAST_PSF_PX))) // across)
    rays, size = finer * across, finer * max(round(diameter_px / _BLOCKS_ACROSS), 2)
    templates = block_templates(
        geometry.body(),
        BlockedPlane(plane=plane, model=camera.binned(size, detector=camera.detector).model, size_px=size),
        (geometry.target.reflectance, LommelSeeliger(), Lambert()),
        sun_direction_camera=geometry.sun_direction_camera,
        options=RenderOptions(rays_per_pixel_side=rays, margin_px=margin_px),
    )
    if isinstance(templates, Failure):
        return templates
    own, flat, dark = templates
    per_px = _phase_per_px(geometry, camera)
    return LawMixture.from_template(own, flat=flat.brightness, dark=dark.brightness, phase_per_px=per_px)


def _phase_per_px(geometry: TargetGeometry, camera: Camera) -> Float:
    """Change (2,) of the phase angle from pixel to pixel at the center of a body, rad."""
    sight, sine = unit(geometry.position_camera_km), math.sin(geometry.phase_angle_rad)
    if sine < _LEAST_SINE:
        return np.zeros(2)
    per_px = camera.model.unproject_jacobian(camera.model.project(sight))
    return np.asarray(geometry.sun_direction_camera @ per_px / sine)


def _other_targets(inputs: EstimatorInputs) -> list[ExpectedBlob]:
    """Expected light of the other targets in the frame, as spheres."""
    found = []
    for target in inputs.scene.targets:
        if target.name == inputs.target_name:
            continue
        geometry = inputs.scene.geometry(inputs.image, target.name)
        if not isinstance(geometry, Failure):
            found += _predict_blobs(geometry, inputs.camera)
    return found


def _predict_blobs(geometry: TargetGeometry, camera: Camera) -> list[ExpectedBlob]:
    """Light of a sphere at the position of a body; none where it is not in the frame or only a point."""
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
    if area < MIN_AREA_PX or not bool(camera.contains(center)):
        return []
    return [ExpectedBlob(center_px=(float(center[0]), float(center[1])), area_px=area)]
