"""Expected brightness profiles along lines across a limb, and their match with the image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from giantlike.core.arrays import Float, Mask, require_number
from giantlike.core.causes import Cause
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.image_model.columns import Layout, Prior, when_seen
from giantlike.image_model.optics import ovality
from giantlike.image_model.trails import SHARE_SIGMA, trails_of_lines
from giantlike.processing.limb.measurement import judge_points
from giantlike.processing.limb.scan import (
    PIXEL_VARIANCE_PX2,
    SAMPLING_VARIANCE_PX2,
    ProfileMatch,
    Scans,
    match_profiles,
    step_profile,
    values_on_lines,
)
from giantlike.processing.limb.shared import SharedEstimate, estimate_shared, smooth_places
from giantlike.processing.limb.view import LimbView
from giantlike.ray_tracing import Body
from giantlike.ray_tracing.air import Black
from giantlike.ray_tracing.near_outline import NearRender, render_near
from giantlike.ray_tracing.reflectance import Lambert, LommelSeeliger, Minnaert, Reflectance
from giantlike.relative.limb.clipped import (
    EXTRAPOLATION_ERROR,
    LOG_GAIN_SIGMA,
    clipped_profiles,
    clipping_level_dn,
)
from giantlike.relative.limb.fix import EdgeModel, ScanOptions

OTHER_LAWS: tuple[Reflectance, ...] = (Lambert(), LommelSeeliger(), Minnaert(k=0.7))
"""Laws mixed into the assumed one: strong, no and medium limb darkening.

At one phase angle the mixtures of the first two include all of McEwen's and lunar-Lambert laws and nearly Hapke's law
of dark surfaces, but not the third.
"""
LAW_SIGMA = 1.0  # A priori standard deviation of the fraction of each of the other laws: as likely as the assumed law
_DEPTH_STEP_PX = 0.05  # step of the integral over depth that blurs the disk of a sphere
_DISK_DN = 3000.0  # brightness of that disk, DN: a usual exposure, where noise does not matter
_UNKNOWN_PSF_SIGMA_PX2 = 2.0
"""Standard deviation, px^2, of the variance of an unknown point spread function: widths up to 2 px are usual."""
_LEAST_VARIANCE_PX2 = 0.1
"""Minimum variance of the point spread function, px^2, to which ``psf_error`` is applied: about that of a pixel."""
_WING_SIGMA, _WING_WIDTH = 0.1, 5.0
"""A priori standard deviation of the fraction of light in the wings of the point spread function, and their width
relative to its core: real cameras scatter some percent over some pixels."""
_ROUNDS, _SETTLED_PX = 6, 0.002
"""Maximum number of fits, each about the last shared parameters; and shift, px, by their change at convergence.

The fractions of laws multiply the gain of each line, so that one linear step between laws leaves a few percent.
"""
_FIRST_RAYS = 2  # rays along a pixel for the first measurement, whose error may be up to the width of a profile
_SKY_PX = 4.0
"""Length, px, by which lines are rendered less far outward than inward. Outside is sky, except in a concave outline,
which is still rendered out to at least 5 px."""
_FEW_RAYS_RADIUS_PX, _MAX_RAYS = 50.0, 12
"""Radius below which bodies get more rays per pixel, as few pixels average few rays; and maximum number."""
_MIN_CORRELATION, _MIN_CORRELATION_LOOSE = 0.9, 0.8
"""Minimum correlation of good lines with the expected profile; loose where the profile is not of the body itself."""
_MAX_UNEXPLAINED, _MAX_UNEXPLAINED_LOOSE = 0.15, 0.3
"""Maximum residuals of good lines relative to the height of the profile."""
_MAX_NOISE_PX = 0.5  # maximum standard deviation of a line by noise, px: half the width of a usual profile


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbScanOptions(ScanOptions):
    """Options of the lines across a limb.

    spacing_px: between neighboring lines along the limb.
    max_lines: on longer limbs the lines are farther apart.
    min_lines: fewer good lines than this are no limb.
    window_px: largest distance of compared profiles, to both sides of the limb.
    local_search_px: largest distance of the edge on a line from the outline that was located as a whole.
    step_px: between samples on a line.
    rays_per_pixel_side: of the rendered template where the outline lies; small bodies get more.
    min_contrast: mean of (inside - outside) / (inside + outside) across the limb below which no limb was located.
    psf_error: relative standard deviation of the width of the camera's point spread function.
    """

    spacing_px: float = 1.5
    max_lines: int = 400
    min_lines: int = 12
    local_search_px: float = 4.0
    step_px: float = 0.5
    rays_per_pixel_side: int = 5

    def __post_init__(self) -> None:
        ScanOptions.__post_init__(self)
        require_number(self.spacing_px, "spacing_px", above=0.0)
        require_number(self.local_search_px, "local_search_px", above=0.0)
        require_number(self.step_px, "step_px", above=0.0, most=1.0)
        require_number(self.min_lines, "min_lines", least=6)
        require_number(self.max_lines, "max_lines", least=self.min_lines, most=1000)
        require_number(self.rays_per_pixel_side, "rays_per_pixel_side", least=1, most=16)

    @property
    def margin_px(self) -> float:
        """Distance from the edge of the frame that points of the limb need for their profiles, px."""
        return self.window_px + 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedProfiles(Value):
    """Expected profiles of lines, and their derivatives by parameters that all lines share.

    layout: of the parameters: shares of other laws, of wings and of trails, logarithm of a brightness that is clipped,
        and, px^2, the variance of the point spread function, half the excess of that along columns over that along
        rows, and the covariance of both.
    beyond: (n,); logarithm of the ratio of the brightness of each line to its clipping level; 0 where it is not
        clipped.
    """

    values: Float  # (n, m); any unit
    changes: Float  # (n, m, c); derivative by each of c parameters
    layout: Layout
    prior: Prior  # of the changes of the parameters from those of the profiles
    beyond: Float

    def apply_step(self, step: Float) -> ExpectedProfiles:
        """Return the profiles with parameters (c,) changed by a step."""
        prior = replace(self.prior, mean=self.prior.mean - step)
        return replace(self, values=self.values + self.changes @ step, prior=prior)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedLines(Value):
    """Lines of an image matched with the profiles expected there.

    common_px: dict of Cause to (n, c); shift of the lines by one standard deviation of each of the shared parameters.
    extrapolated_px: standard deviation of the limb by the extrapolation of its brightness above the clipping level.
    """

    match: ProfileMatch  # with the shared parameters as found
    good: Mask  # (n,)
    rejected: dict[str, int]  # number of the others by reason
    common_px: dict[Cause, Float]
    psf_px2: float  # change of the variance of the point spread function that was found
    extrapolated_px: float


def expected_profiles(
    view: LimbView,
    body: Body,
    scans: Scans,
    psf_px2: float,
    options: LimbScanOptions,
    other_laws: Sequence[Reflectance] = OTHER_LAWS,
    *,
    first: bool,
) -> ExpectedProfiles | Failure:
    """Compute the profiles expected along lines. Fails as :func:`~giantlike.ray_tracing.near_outline.render_near`."""
    if options.edges is EdgeModel.STEP:
        return _without_shared(np.tile(_step_profile(scans, psf_px2), (len(scans.points_px), 1)))
    others = () if first else tuple(law for law in other_laws if law != body.reflectance)
    if others and body.air is not None:
        others = (*others, Black())
    rays = _FIRST_RAYS if first else options.rays_per_pixel_side
    rendered = _render_images(view, body, scans, psf_px2, options, others, rays=rays)
    if isinstance(rendered, Failure):
        return rendered
    images, there = rendered.images, replace(scans, points_px=scans.points_px - rendered.corner_px)
    beyond = np.zeros(len(scans.points_px))
    values, *laws = values_on_lines(images, there.points_px, there.normals_px, there.offsets_px)
    height = np.ptp(values, axis=1)
    scales = [float(np.median(height / np.maximum(np.ptp(law, axis=1), 1e-300))) for law in laws]
    nominal, psf_sigma = _nominal_psf(view, psf_px2, options.psf_error)
    level_dn = clipping_level_dn(view, scans)
    if level_dn is None:
        second = np.zeros_like(values)
        second[:, 1:-1] = (values[:, 2:] - 2.0 * values[:, 1:-1] + values[:, :-2]) / scans.step_px**2
        whole = _extend(values, scans, options.window_px)
        changes = [
            *(scale * law - values for scale, law in zip(scales, laws, strict=True)),
            _wings(whole, scans, psf_px2),
            *trails_of_lines(whole, scans.normals_px, scans.step_px),
        ]
        blur = 0.5 * second
    else:
        scaled = [images[0], *(scale * image for scale, image in zip(scales, images[1:], strict=True))]
        reach_px = scans.offsets_px[-1] - options.window_px
        clipped = clipped_profiles(scaled, there, level_dn, view, window_px=options.window_px, search_px=reach_px)
        values, beyond = clipped.values, clipped.beyond
        changes, blur = [*np.moveaxis(clipped.laws, -1, 0), clipped.brightness], clipped.blur
    if first:
        return _without_shared(values)
    oval = [] if view.in_air else [blur * part[:, None] for part in ovality(scans.normals_px)]
    changes += [blur, *oval]
    layout = _layout(laws=len(laws), whole=level_dn is None, clipped=level_dn is not None, oval=len(oval))
    sigmas = {"laws": LAW_SIGMA, "wings": _WING_SIGMA, "trails": SHARE_SIGMA, "brightness": LOG_GAIN_SIGMA}
    sigmas |= {"blur": psf_sigma, "ovality": psf_sigma}
    return ExpectedProfiles(
        values=values,
        changes=np.stack(changes, axis=-1),
        layout=layout,
        prior=Prior.of_sigmas(layout.vector(sigmas), layout.vector({"blur": nominal - psf_px2})),
        beyond=beyond,
    )


def _layout(*, laws: int = 0, whole: int = 0, clipped: int = 0, oval: int = 0) -> Layout:
    """Layout of the parameters that all lines share, of whole or of clipped profiles."""
    return Layout(
        (
            ("laws", Cause.REFLECTANCE, laws),
            ("wings", Cause.PSF, whole),
            ("trails", Cause.PSF, 2 * whole),
            ("brightness", Cause.EDGE, clipped),
            ("blur", Cause.PSF, whole + clipped),
            ("ovality", Cause.PSF, oval),
        )
    )


def _extend(values: Float, scans: Scans, window_px: float) -> Float:
    """Profiles (n, m) whose values beyond the window are those at its inner end, and dark sky."""
    far = np.abs(scans.offsets_px) > window_px
    inner = values[:, np.flatnonzero(~far)[0], None]
    return np.where(far, np.where(scans.offsets_px < 0.0, inner, 0.0), values)


def _wings(whole: Float, scans: Scans, psf_px2: float) -> Float:
    """Change of profiles (n, m) if all light goes into the wide wings of the point spread function."""
    width = _WING_WIDTH * math.sqrt(max(psf_px2, _LEAST_VARIANCE_PX2)) / scans.step_px
    result: Float = gaussian_filter1d(whole, width, axis=1, mode="nearest") - whole
    return result


def _without_shared(values: Float) -> ExpectedProfiles:
    """Profiles (n, m) without shared parameters."""
    return ExpectedProfiles(
        values=values,
        changes=np.zeros((*values.shape, 0)),
        layout=_layout(),
        prior=Prior.of_sigmas([]),
        beyond=np.zeros(len(values)),
    )


def step_shortfall(scans: Scans, psf_px2: float, view: LimbView, options: LimbScanOptions) -> float:
    """Ratio of the error of a step with a slope at the limb of a darkened disk to the change by that slope."""
    width = math.sqrt(psf_px2 + PIXEL_VARIANCE_PX2 + SAMPLING_VARIANCE_PX2)
    depth = np.arange(0.5 * _DEPTH_STEP_PX, scans.offsets_px[-1] + 6.0 * width, _DEPTH_STEP_PX)
    cosine = np.sqrt(np.maximum(1.0 - np.maximum(1.0 - depth / view.radius_px, 0.0) ** 2, 0.0))
    spread = np.exp(-0.5 * ((scans.offsets_px[:, None] + depth) / width) ** 2)
    disk = _DISK_DN * (spread @ cosine) / float((spread @ np.ones_like(cosine)).max())
    one = Scans(scans.points_px[:1], scans.normals_px[:1], scans.offsets_px, disk[None], scans.usable[:1])
    match = match_profiles(
        one,
        _step_profile(scans, psf_px2)[None],
        variance_dn2=view.detector.variance_dn2,
        window_px=options.window_px,
        search_px=options.local_search_px,
    )
    missed, changed = float(match.shift_px[0]), float(match.without_slope_px[0])
    return math.hypot(missed, changed) / max(abs(changed), 1e-9)


def match_lines(
    view: LimbView, scans: Scans, profiles: ExpectedProfiles, *, window_px: float, search_px: float, loose: bool
) -> MatchedLines:
    """Match the lines of an image with the profiles expected there, and estimate the shared parameters.

    ``window_px``, ``search_px`` as for :func:`giantlike.processing.limb.scan.match_profiles`.
    """
    variance = view.detector.variance_dn2
    layout, found = profiles.layout, np.zeros(profiles.layout.count)
    of_blur = layout.vector({"blur": 1.0}) > 0.0
    about_px = None
    none = SharedEstimate(values=found, covariance=np.zeros((found.size, found.size)))
    for number in range(_ROUNDS):
        match = match_profiles(
            scans,
            profiles.values,
            variance_dn2=variance,
            window_px=window_px,
            search_px=search_px,
            shared=profiles.changes,
            about_px=about_px,
        )
        good, rejected = _judge_lines(match, loose=loose)
        estimate = none
        if found.size == 0 or not good.any():
            break
        mean, information = profiles.prior.parts
        free = estimate_shared(match, good, prior=information, expected=mean, open_above=of_blur)
        values, covariance = free.values, free.covariance
        for effect in ("ovality", "trails"):
            values, covariance = when_seen(values, covariance, layout.span(effect), profiles.prior)
        estimate = SharedEstimate(values=values, covariance=covariance)
        last = number > 0 and float(np.median(np.abs(match.shared_px[good] @ estimate.values))) < _SETTLED_PX
        if last or number == _ROUNDS - 1:
            break
        about_px = smooth_places(match, good) - match.shared_px @ estimate.values
        profiles, found = profiles.apply_step(estimate.values), found + estimate.values
    match = replace(match, shift_px=match.shift_px - match.shared_px @ estimate.values)
    by_sigma = match.shared_px @ _root(estimate.covariance)
    return MatchedLines(
        match=match,
        good=good,
        rejected=rejected,
        common_px={cause: by_sigma[:, layout.of_cause(cause)] for cause in layout.causes},
        extrapolated_px=_extrapolated_px(match, good, profiles),
        psf_px2=float((found + estimate.values)[layout.span("blur")].sum()),
    )


def _extrapolated_px(match: ProfileMatch, good: Mask, profiles: ExpectedProfiles) -> float:
    """Mean shift of good lines by one standard deviation of the clipped brightness; 0 where none is clipped."""
    by_brightness = match.shared_px[good, profiles.layout.span("brightness")].ravel()
    if not by_brightness.size:
        return 0.0
    return EXTRAPOLATION_ERROR * float(np.mean(np.abs(by_brightness) * profiles.beyond[good] ** 2))


def _root(covariance: Float) -> Float:
    """Lower triangular root (c, c) of a covariance."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    correlation = covariance / np.outer(scale, scale)
    return scale[:, None] * np.linalg.cholesky(correlation + 1e-9 * np.eye(scale.size))


def _nominal_psf(view: LimbView, psf_px2: float, psf_error: float) -> tuple[float, float]:
    """A priori variance of the point spread function, px^2, and its standard deviation."""
    if view.psf_sigma_px is None:
        return psf_px2, _UNKNOWN_PSF_SIGMA_PX2
    nominal = view.psf_sigma_px**2
    return nominal, 2.0 * psf_error * max(nominal, _LEAST_VARIANCE_PX2)


def _step_profile(scans: Scans, psf_px2: float) -> Float:
    """Profile (m,) of a step."""
    return step_profile(scans.offsets_px, math.sqrt(psf_px2 + PIXEL_VARIANCE_PX2 + SAMPLING_VARIANCE_PX2))


def _render_images(
    view: LimbView,
    body: Body,
    scans: Scans,
    psf_px2: float,
    options: LimbScanOptions,
    others: Sequence[Reflectance],
    *,
    rays: int,
) -> NearRender | Failure:
    """Images of the body under its law and under others, where lines are compared."""
    reach_px = options.window_px + 4.0 * scans.step_px
    compared = (scans.offsets_px >= -reach_px) & (scans.offsets_px <= reach_px - _SKY_PX)
    per_side = _rays_for(view.radius_px, rays)
    return render_near(
        scans.points_px[:, None] + scans.offsets_px[compared, None] * scans.normals_px[:, None],
        body,
        replace(view.plane, psf=GaussianPsf(sigma_px=math.sqrt(psf_px2))),
        sun_direction_camera=view.sun_direction_camera,
        rays_per_pixel_side=per_side,
        edges_px=scans.points_px,
        other_laws=others,
    )


def _rays_for(radius_px: float, rays: int) -> int:
    """Rays along a pixel for a body of some radius: few pixels on the limb average few rays."""
    more = max(_FEW_RAYS_RADIUS_PX / radius_px, 1.0)
    return max(min(math.ceil(more * rays), _MAX_RAYS), rays)


def _judge_lines(match: ProfileMatch, *, loose: bool) -> tuple[Mask, dict[str, int]]:
    """Good lines and the number of others by reason; loose where the expected profile is not of the body."""
    alike: Mask = match.correlation >= (_MIN_CORRELATION_LOOSE if loose else _MIN_CORRELATION)
    alike &= match.unexplained <= (_MAX_UNEXPLAINED_LOOSE if loose else _MAX_UNEXPLAINED)
    return judge_points(
        complete=match.complete,
        strong=match.sigma_px < _MAX_NOISE_PX,
        alike=alike,
        gain_dn=match.gain_dn,
        even=not loose,
        also={"beyond the search": ~match.at_border, "ambiguous": ~match.rivalled},
    )
