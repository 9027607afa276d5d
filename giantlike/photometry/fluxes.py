"""Fluxes of point sources at known places, with the covariance that they have in common.

Every flux is a weighted sum of pixels, whether or not the source stands out: the pixels of a circle minus the level of
a ring around it, or the pixels of the point spread function by least squares, all sources at once. So faint fluxes are
right on average, and the covariance follows from the weights: sources whose rings or cores overlap share pixels. What
a circle or a Gaussian leaves out is taken from the growth curve of the bright sources; its error is common to all.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog, StarTable, apparent_directions
from giantlike.catalogs.blends import blended
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float, Mask, as_floats, require
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import MAD_TO_SIGMA
from giantlike.core.time import et_from_time, utc_text
from giantlike.core.values import Estimate
from giantlike.image import Image
from giantlike.processing.detection.detections import DetectionFlag
from giantlike.processing.detection.frame import saturation_of
from giantlike.processing.detection.patches import MIN_PSF_SIGMA_PX, Patches, cut_patches, pixel_shares
from giantlike.stars.field import EPOCH_WHEN_UNKNOWN, Sky

_CLIP = 3.0  # robust sigmas from the median of a ring beyond which its pixels are other sources
_LEAST_RING = 20  # good pixels of a ring: the level is then known to a fifth of the noise of a pixel
_CENTERED_SNR = 20.0  # of sources that are centered: their flux gains 1 / SNR^2 by it, a quarter of a percent
_CENTERING_ROUNDS = 4
_WIDTH_SNR = 5.0  # of sources that tell the common width
_WIDTH_SIGMA = 0.3  # of its logarithm, before the image
_LONGEST_SHIFT_PX = 1.0  # from the given place: beyond it another source was found
_MERGED_PX = 1.0  # stars nearer than this are one
_MOST_BRIGHT = 200  # brightest sources of the width and of the growth curve
_OWN_LIGHT = 1.5  # spread over noise above which a ring shows the light of its own source
_CLIPPED = 0.973  # variance of a normal distribution cut at three sigma
_CORE_WIDTHS = 4.0  # half size of the core: 99.99 % of a Gaussian
_WINGS = 0.05  # prior of the light beyond a Gaussian and of its error, where no source is bright enough to tell
_GROWTH_RINGS = 4
_GROWTH_SCATTER = 0.01  # of a single bright source: pixel phase, field
_ALONE = 0.05  # light of others within the inner ring radius, relative: sources of the growth curve have less
_BLENDED = 0.1  # light of the others relative to the own light in the aperture
USELESS = DetectionFlag.SATURATED | DetectionFlag.MASKED | DetectionFlag.CUT_BY_FRAME | DetectionFlag.BLENDED
"""Flags of fluxes that are not used for a zero point."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FluxOptions:
    """Options of :func:`measure_fluxes`.

    Parameters
    ----------
    aperture_px : float, px; radius of the circle, whose pixels also decide the flags of the source
    annulus_px : (float, float), px; radii of the ring; fluxes refer to all light within the inner one
    method : {"psf", "aperture"}
        Least squares with the point spread function, or the sum of the circle. Where pixels are large (a sigma below
        0.5 px) or the point spread function varies over the field, the circle is the safer one.
    growth : bool; correct for light beyond circle or function by the growth curve of the bright sources
    max_stars : int; most stars that :func:`measure_stars` measures, the brightest of the catalog: bounds the time

    Raises
    ------
    InputError
        The radii are not positive and increasing, or the method is unknown.
    """

    aperture_px: float = 3.0
    annulus_px: tuple[float, float] = (9.0, 14.0)
    method: Literal["psf", "aperture"] = "psf"
    growth: bool = True
    max_stars: int = 500

    def __post_init__(self) -> None:
        radii = (self.aperture_px, *self.annulus_px)
        ordered = len(radii) == 3 and 0.0 < radii[0] <= radii[1] < radii[2] <= 200.0
        require(self.max_stars >= 1, f"max_stars must be >= 1, got {self.max_stars}")
        require(ordered, f"aperture_px <= annulus_px must be increasing radii up to 200 px, got {radii}")
        require(self.method in ("psf", "aperture"), f"method must be 'psf' or 'aperture', got {self.method!r}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fluxes(Estimate):
    """Fluxes of n point sources in one image.

    Parameters
    ----------
    points_px : (n, 2) float64, px; where they were measured: the given places, bright sources centered
    flux_dn : (n,) float64, DN; light above the level; negative by noise where there is none
    noise_covariance_dn2 : (n, n) float64, DN^2; of the noise of the pixels, those in common included
    shot_dn : (n,) float64, DN; variance by the shot noise of the source itself, over its flux
    level_dn : (n,) float64, DN; level of the ring
    flags : (n,) uint16; combinations of ``DetectionFlag``: saturated, masked, cut, blended
    angle_rad : (n,) float64, rad; from the optical axis
    width_px : float, px; standard deviation of the point spread function
    growth, growth_sigma : float; factor of the growth curve in ``flux_dn``, and its common relative error
    exposure_s : float, s
    gain_e_per_dn : float, electron/DN; of the camera file
    half_diagonal_deg : float, degrees; angle from the axis to the corner of the frame
    name, epoch : str; of the image; UTC
    """

    points_px: Float
    flux_dn: Float
    noise_covariance_dn2: Float
    shot_dn: Float
    level_dn: Float
    flags: NDArray[np.uint16]
    angle_rad: Float
    width_px: float
    growth: float
    growth_sigma: float
    exposure_s: float
    gain_e_per_dn: float
    half_diagonal_deg: float
    name: str = ""
    epoch: str = ""

    @property
    def covariance_dn2(self) -> Float:
        """Covariance (n, n), DN^2, with the error of the growth curve."""
        return self.noise_covariance_dn2 + self.growth_sigma**2 * np.outer(self.flux_dn, self.flux_dn)

    @property
    def sigma_dn(self) -> Float:
        """Standard deviations (n,), DN."""
        return np.sqrt(np.diag(self.covariance_dn2))

    @property
    def rate_e_s(self) -> Float:
        """Electrons per second (n,)."""
        return self.flux_dn * self.gain_e_per_dn / self.exposure_s

    @property
    def useful(self) -> Mask:
        """True (n,) without a flag of :data:`USELESS`."""
        return np.asarray((self.flags & np.uint16(USELESS)) == 0)


def measure_fluxes(
    image: Image, camera: Camera, points_px: ArrayLike, options: FluxOptions = FluxOptions()
) -> Fluxes | Failure:
    """Measure the light of point sources at given places, whether they are detected or not.

    Parameters
    ----------
    image : Image; with its exposure time
    camera : Camera; its ``psf`` is the first guess of the width, 1 px without one
    points_px : (n, 2) array_like, px; in the frame; neighbors are separated only where both are given
    options : FluxOptions

    Returns
    -------
    Fluxes or Failure
        ``no_signal``: all pixels are masked or equal.

    Raises
    ------
    InputError
        There are no points, one is not finite or outside of the frame, or the image has no exposure time.

    Examples
    --------
    >>> import giantlike as gl
    >>> pixels = np.random.default_rng(1).normal(100.0, 2.0, (64, 64))
    >>> pixels[28:33, 38:43] += np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) * 10.0
    >>> image = gl.Image(pixels=pixels, exposure_s=1.0)
    >>> found = measure_fluxes(image, gl.Camera.from_fov(5.0, 64, 64), [[40.0, 30.0]])
    >>> bool(abs(found.flux_dn[0] - 2560.0) < 3.0 * found.sigma_dn[0])
    True
    """
    camera.require_image(image)
    require(
        image.exposure_s is not None and image.exposure_s > 0.0,
        f"{image.name}: fluxes need an exposure time above 0 s (header, or exposure_s of the geometry table), "
        f"got {image.exposure_s}",
    )
    require(np.size(points_px) > 0, "points_px: there are no points to measure")
    points = as_floats(points_px, (2,), "points_px").reshape(-1, 2)
    outside = np.flatnonzero(~camera.contains(points))
    require(
        outside.size == 0,
        f"points_px: {outside.size} points lie outside of the image, the first at "
        f"{points[outside[:1]].tolist()}: leave them out (Camera.contains)",
    )
    good = image.pixels[~image.mask]
    if not good.size or float(good.min()) == float(good.max()):
        return Failure(Reason.NO_SIGNAL, f"{image.name}: all pixels are masked or equal")
    known = image.detector or camera.detector
    bad = image.mask if image.mask.any() else None
    detector = known.of_image(image.pixels, bad)
    width = 1.0 if camera.psf is None else max(camera.psf.sigma_px, MIN_PSF_SIGMA_PX)
    limit = saturation_of(image.pixels.dtype, detector.saturation_dn)
    half = math.ceil(options.annulus_px[1]) + 1
    detector = replace(detector, saturation_dn=limit)
    patches = cut_patches(image.pixels, bad, np.rint(points).astype(np.int64), half, detector=detector)
    work = _Work(patches, image.pixels.shape, options)
    points, width = work.center(points, width)
    assert image.exposure_s is not None
    return Fluxes(
        points_px=points,
        **work.fluxes(points, width),
        angle_rad=np.arccos(np.clip(camera.model.unproject(points)[:, 2], -1.0, 1.0)),
        width_px=width,
        exposure_s=image.exposure_s,
        gain_e_per_dn=known.gain_e_per_dn,
        half_diagonal_deg=math.degrees(camera.half_diagonal_rad),
        name=image.name,
        epoch="" if image.epoch is None else utc_text(image.epoch),
    )


def measure_stars(
    image: Image, camera: Camera, catalog: StarCatalog, options: FluxOptions = FluxOptions()
) -> tuple[Fluxes, StarTable] | Failure:
    """Measure all stars of a catalog in the frame of an image, at the places that its attitude gives.

    Parameters
    ----------
    image : Image; with its attitude, solved from stars, and its exposure time
    camera : Camera
    catalog : StarCatalog
    options : FluxOptions

    Returns
    -------
    (Fluxes, StarTable) or Failure
        Fluxes and stars in the same order. Stars nearer to each other than the point spread function is wide are merged
        and marked as double. ``no_attitude``: the image has none; ``no_catalog_stars``: none is in the frame.

    Raises
    ------
    InputError
        As :func:`measure_fluxes`.
    """
    if image.camera_from_inertial is None:
        return Failure(Reason.NO_ATTITUDE, f"{image.name}: the places of stars need an attitude")
    known = image.observer
    et = et_of_julian_year(EPOCH_WHEN_UNKNOWN) if image.epoch is None else et_from_time(image.epoch)
    position, velocity = (None, None) if known is None else (known.position_km, known.velocity_km_s)
    sky = Sky(catalog=catalog, et=et, observer_position_km=position, observer_velocity_km_s=velocity)
    stars = sky.field(camera, image.camera_from_inertial).stars
    stars = blended(stars, _MERGED_PX * float(camera.ifov_rad()), et=et)
    directions = apparent_directions(stars, et, observer_position_km=position, observer_velocity_km_s=velocity)
    points = camera.model.project(rotate(image.camera_from_inertial, directions))
    inside = np.flatnonzero(camera.contains(points))[: options.max_stars]
    if not inside.size:
        return Failure(Reason.NO_CATALOG_STARS, f"{image.name}: no star of the catalog lies in the frame")
    fluxes = measure_fluxes(image, camera, points[inside], options)
    return fluxes if isinstance(fluxes, Failure) else (fluxes, stars.select(inside))


class _Work:
    """Patches of n sources with the levels of their rings; ``weights`` of sources are sparse (n, pixels of image)."""

    def __init__(self, patches: Patches, shape: tuple[int, ...], options: FluxOptions) -> None:
        self.patches, self.options, self.shape, self.width_sigma = patches, options, shape, _WIDTH_SIGMA
        steps = np.arange(patches.size_px) - patches.half_px
        away = np.hypot(steps, steps[:, None])
        self.away = away.ravel()
        self.ring = self.between(*options.annulus_px)
        self.kept, self.level, self.variance = self.clip_ring(self.ring)
        self.count = np.maximum(self.kept.sum(axis=1), 1)
        rows, columns = np.divmod(np.arange(patches.size_px**2), patches.size_px)
        corner = patches.corner_px.astype(np.int64)
        self.pixel = (corner[:, 1, None] + rows) * shape[1] + corner[:, 0, None] + columns

    def between(self, inner_px: float, outer_px: float) -> NDArray[np.int64]:
        """Pixels of a patch in a ring about its middle."""
        return np.flatnonzero((self.away >= inner_px) & (self.away < outer_px))

    def clip_ring(self, ring: NDArray[np.int64], noise: Float | None = None) -> tuple[Mask, Float, Float]:
        """Pixels (n, m) of a ring without other sources, by their noise (n,), and their mean and variance (n,)."""
        values, valid = (each.reshape(len(each), -1)[:, ring] for each in (self.patches.values_dn, self.patches.valid))
        if not valid.all():
            values = np.where(valid, values, np.nan)
            values[~valid.any(axis=1)] = 0.0
        middle = np.nanmedian(values, axis=1, keepdims=True)
        spread = MAD_TO_SIGMA * np.nanmedian(np.abs(values - middle), axis=1, keepdims=True)
        if noise is not None:
            spread = np.where(spread < _OWN_LIGHT * noise[:, None], noise[:, None], spread)
        kept = valid & (np.abs(values - middle) <= np.maximum(_CLIP * spread, 1.0 * (spread == 0.0)))
        count, values = np.maximum(kept.sum(axis=1), 1), np.where(kept, values, 0.0)
        mean = values.sum(axis=1) / count
        variance = np.sum(np.where(kept, values - mean[:, None], 0.0) ** 2, axis=1) / count / _CLIPPED
        return kept, mean, variance

    def matrix(self, values: Float, half: int) -> csr_array:
        """Sparse (n, pixels of the image) of values (n, w, w) on the middle of the patches; bad pixels count 0."""
        middle = self.middle(half)
        good = self.patches.valid[middle] & (values != 0.0)
        source = np.broadcast_to(np.arange(len(values))[:, None, None], values.shape)
        pixel = self.pixel.reshape(self.patches.valid.shape)[middle]
        size = (len(values), self.shape[0] * self.shape[1])
        return csr_array((values[good], (source[good], pixel[good])), shape=size)

    def middle(self, half: int) -> tuple[slice, slice, slice]:
        inner = slice(self.patches.half_px - half, self.patches.half_px + half + 1)
        return slice(None), inner, inner

    def profile(self, points: Float, width: float) -> tuple[Float, list[Float]]:
        """Shares (n, w, w) of sources in the pixels of their cores, and derivatives by x, y and ln width."""
        half = min(math.ceil(_CORE_WIDTHS * math.hypot(width, 0.3)) + 1, self.patches.half_px)
        first, wide = self.patches.corner_px + self.patches.half_px - half, np.full(len(points), width)
        (x, x_c, x_w), (y, y_c, y_w) = (pixel_shares(first[:, k], 2 * half + 1, points[:, k], wide) for k in (0, 1))
        outer = [(y, x), (y, x_c), (y_c, x), (y, x_w), (y_w, x)]
        star, by_x, by_y, one, two = (down[:, :, None] * across[:, None, :] for down, across in outer)
        return star, [by_x, by_y, one + two]

    def circle(self, points: Float, radius: float) -> csr_array:
        """Sparse (n, pixels of the image): the part of each pixel that lies in a circle."""
        half = min(math.ceil(radius) + 1, self.patches.half_px)
        start = (self.patches.corner_px + self.patches.half_px - half - points - 0.5) / radius
        edges = np.arange(2 * half + 2) / radius
        below = _circle_below((start[:, 0, None] + edges)[:, None, :], (start[:, 1, None] + edges)[:, :, None])
        part = np.diff(np.diff(below, axis=1), axis=2) * radius**2
        return self.matrix(np.where(part > 1e-12, part, 0.0), half)

    def above_level(self, weights: csr_array) -> csr_array:
        """Weights whose sums are above the level of the ring."""
        pixel = self.pixel[:, self.ring][self.kept]
        source = np.nonzero(self.kept)[0]
        share = (weights.sum(axis=1) / self.count)[source]
        return weights - csr_array((share, (source, pixel)), shape=weights.shape)

    def solve(self, points: Float, width: float) -> tuple[csr_array, csr_array, Float]:
        """Profiles (n, pixels), inverse normal matrix (n, n) of the least squares of all sources, and fluxes (n,)."""
        star, _ = self.profile(points, width)
        profiles = self.matrix(star, star.shape[1] // 2)
        inverse = _inverse((profiles @ profiles.T).toarray())
        return profiles, inverse, inverse @ (profiles @ self.image - profiles.sum(axis=1) * self.level)

    @cached_property
    def image(self) -> Float:
        """Pixels (rows * columns) that lie in a patch; 0 elsewhere."""
        flat = np.zeros(self.shape[0] * self.shape[1])
        good = self.patches.valid.reshape(self.pixel.shape)
        flat[self.pixel[good]] = self.patches.values_dn.reshape(self.pixel.shape)[good]
        return flat

    def select(self, which: NDArray[np.int64]) -> Self:
        """Some of the sources."""
        some = copy(self)
        some.patches = self.patches.select(which)
        some.kept, some.count, some.pixel = self.kept[which], self.count[which], self.pixel[which]
        some.level, some.variance = self.level[which], self.variance[which]
        return some

    def noise(self, weights: csr_array, light: Float) -> csr_array:
        """Weights times the noise of the pixels (rows * columns) with this light: their products are covariances."""
        source = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
        here = light[weights.indices]
        shot = here / self.patches.gain_e_per_dn + (self.patches.relative_noise * here) ** 2
        scaled = weights.data * np.sqrt(self.variance[source] + shot)
        return csr_array((scaled, weights.indices, weights.indptr), shape=weights.shape)

    def hit(self, points: Float) -> tuple[Mask, Mask, Mask]:
        """Sources (n,) with saturated, bad or missing pixels in their circles, or without a ring."""
        dx, dy = self.patches.offsets_px(points)
        inside = dx[:, None, :] ** 2 + dy[:, :, None] ** 2 <= (self.options.aperture_px + 0.5) ** 2
        corner, steps = self.patches.corner_px, np.arange(self.patches.size_px)
        row, column = (((at := corner[:, k, None] + steps) >= 0) & (at < self.shape[1 - k]) for k in (1, 0))
        in_frame = row[:, :, None] & column[:, None, :]
        saturated, bad, cut = (
            np.asarray((inside & each).any(axis=(1, 2)))
            for each in (self.patches.saturated, in_frame & ~self.patches.valid, ~in_frame)
        )
        return saturated, bad | (self.count < _LEAST_RING), cut

    def center(self, points: Float, width: float) -> tuple[Float, float]:
        """Places of the bright sources, and the common width, by least squares of place, flux and width."""
        given, guess, usable = points, width, ~np.any(self.hit(points), axis=0)
        for _ in range(_CENTERING_ROUNDS):
            profiles, inverse, flux = self.solve(points, width)
            shot = np.maximum(flux, 0.0) / self.patches.gain_e_per_dn
            snr = flux / np.sqrt(np.maximum(self.variance * inverse.diagonal() + shot, 1e-300))
            bright = np.flatnonzero(usable & (snr > _WIDTH_SNR))
            if not bright.size:
                break
            some = self.select(bright)
            star, slopes = some.profile(points[bright], width)
            middle = some.middle(star.shape[1] // 2)
            pixel = some.pixel.reshape(some.patches.valid.shape)[middle]
            valid = some.patches.valid[middle]
            model = flux @ profiles
            others = np.where(valid, model[np.where(valid, pixel, 0)], 0.0) - flux[bright, None, None] * star
            left = some.patches.values_dn[middle] - some.level[:, None, None] - others
            rows = np.stack([star, *slopes]).reshape(4, len(bright), -1).swapaxes(0, 1) * valid.reshape(
                len(bright), 1, -1
            )
            normal = rows @ rows.swapaxes(1, 2) + 1e-12 * np.eye(4)
            found = np.linalg.solve(normal, rows @ left.reshape(len(bright), -1, 1))[:, :, 0]
            step = found[:, 1:] / np.maximum(found[:, :1], 1e-300)
            across = rows[:, 3] - np.einsum(
                "nip,ni->np", rows[:, :3], np.linalg.solve(normal[:, :3, :3], normal[:, :3, 3:])[:, :, 0]
            )
            weight = found[:, 0] ** 2 * np.sum(across**2, axis=1) / (self.variance[bright] + shot[bright])
            information = float(weight.sum()) + _WIDTH_SIGMA**-2
            change = (float(weight @ step[:, 2]) + math.log(guess / width) * _WIDTH_SIGMA**-2) / information
            width = max(width * math.exp(min(max(change, -0.3), 0.3)), MIN_PSF_SIGMA_PX)
            self.width_sigma = information**-0.5
            moved = points.copy()
            centered = snr[bright] > _CENTERED_SNR
            moved[bright[centered]] += np.clip(step[centered, :2], -0.5, 0.5)
            near = np.linalg.norm(moved - given, axis=1) <= _LONGEST_SHIFT_PX
            points = np.where(near[:, None], moved, given)
        return points, width

    def fluxes(self, points: Float, width: float) -> dict[str, Any]:
        """Fields of :class:`Fluxes` that pixels give."""
        profiles, inverse, flux = self.solve(points, width)
        weights = inverse @ self.above_level(profiles)
        light = np.maximum(flux, 0.0) @ profiles
        circle = self.circle(points, self.options.aperture_px)
        overlap = circle @ profiles.T
        others = overlap - diags_array(overlap.diagonal())
        by_others = others @ np.maximum(flux, 0.0)
        if self.options.method == "aperture":
            used, weights = circle, self.above_level(circle) - others @ weights
        else:
            used = diags_array(1.0 / (profiles @ profiles.T).diagonal()) @ profiles
        core_flux, flux = flux, weights @ self.image
        spread = self.noise(weights, light)
        covariance = (spread @ spread.T).toarray()
        sigma = np.sqrt(covariance.diagonal())
        usable = ~np.any(self.hit(points), axis=0)
        growth, growth_sigma = 1.0, 0.0
        if self.options.growth:
            growth, growth_sigma = self.growth(
                points, width, profiles, core_flux, flux, usable & (flux > _CENTERED_SNR * sigma)
            )
        near = by_others * growth > np.maximum(_BLENDED * flux, _CLIP * sigma)
        hits = (*self.hit(points), near)
        kinds = (DetectionFlag.SATURATED, DetectionFlag.MASKED, DetectionFlag.CUT_BY_FRAME, DetectionFlag.BLENDED)
        flags = sum(np.where(hit, np.uint16(kind), np.uint16(0)) for hit, kind in zip(hits, kinds, strict=True))
        return {
            "flux_dn": growth * flux,
            "noise_covariance_dn2": growth**2 * covariance,
            "shot_dn": growth * used.multiply(used).multiply(profiles).sum(axis=1) / self.patches.gain_e_per_dn,
            "level_dn": self.level,
            "flags": np.asarray(flags, np.uint16),
            "growth": growth,
            "growth_sigma": growth_sigma,
        }

    def growth(
        self, points: Float, width: float, profiles: csr_array, core_flux: Float, flux: Float, bright: Mask
    ) -> tuple[float, float]:
        """Light within the inner radius of the ring over the measured flux, and the relative error."""
        shape, unsure = 1.0 + _WINGS, math.hypot(_WINGS, self.width_sigma)
        if self.options.method == "aperture":
            missed = math.exp(-0.5 * (self.options.aperture_px / math.hypot(width, 0.3)) ** 2)
            shape, unsure = shape / (1.0 - missed), math.hypot(_WINGS, missed)
        which = np.flatnonzero(bright)
        which = which[np.argsort(-flux[which])[:_MOST_BRIGHT]]
        if not which.size:
            return shape, unsure
        some = self.select(which)
        last = self.options.annulus_px[0]
        radii = np.linspace(
            min(max(self.options.aperture_px, _CORE_WIDTHS * width + 1.0), last), last, _GROWTH_RINGS + 1
        )
        circle = some.circle(points[which], radii[0])
        own = (circle.multiply(profiles[which])).sum(axis=1) * core_flux[which]
        by_others = circle @ (np.maximum(core_flux, 0.0) @ profiles) - own
        alone = by_others < _ALONE * flux[which]
        inside = (some.above_level(circle) @ self.image - by_others) / flux[which]
        outside, variance = np.zeros(len(which)), np.zeros(len(which))
        for inner, outer in pairwise(radii):
            kept, mean, _ = some.clip_ring(some.between(inner, outer), np.sqrt(some.variance))
            area = math.pi * (outer**2 - inner**2)
            outside += area * (mean - some.level) / flux[which]
            variance += (area / flux[which]) ** 2 * some.variance / np.maximum(kept.sum(axis=1), 1)
        variance += (math.pi * (radii[-1] ** 2 - radii[0] ** 2) / flux[which]) ** 2 * some.variance / some.count
        core, core_sigma = _robust_mean(inside[alone], np.full(alone.sum(), _GROWTH_SCATTER))
        wings, wings_sigma = _robust_mean(outside[alone], np.hypot(np.sqrt(variance[alone]), _GROWTH_SCATTER))
        weight, prior = (core_sigma**2 + wings_sigma**2) ** -1, (unsure * shape) ** -2
        growth = (weight * (core + wings) + prior * shape) / (weight + prior)
        return growth, math.sqrt(1.0 / (weight + prior)) / growth


def _robust_mean(values: Float, sigma: Float) -> tuple[float, float]:
    """Weighted mean without outliers and its error, larger where the values scatter more; infinite without values."""
    mean, error = 0.0, math.inf
    for _ in range(4):
        if not values.size:
            break
        mean = float(np.median(values)) if math.isinf(error) else float(np.sum(values / sigma**2) / np.sum(sigma**-2.0))
        away = np.abs(values - mean) / sigma
        error = max(1.0, MAD_TO_SIGMA * float(np.median(away))) / math.sqrt(float(np.sum(sigma**-2.0)))
        good = away < _CLIP * max(1.0, MAD_TO_SIGMA * float(np.median(away)))
        values, sigma = values[good], sigma[good]
    return mean, error


def _circle_below(x: Float, y: Float) -> Float:
    """Area of the unit circle at places left of x and above y, its closed form; x and y broadcast."""
    u, v = np.clip(x, -1.0, 1.0), np.clip(y, -1.0, 1.0)
    chord = np.sqrt(1.0 - v**2)
    middle = np.clip(u, -chord, chord)
    part = v * (middle + chord) + _under_arc(middle) - _under_arc(-chord)
    sides = _under_arc(np.minimum(u, -chord)) - _under_arc(-1.0) + _under_arc(np.maximum(u, chord)) - _under_arc(chord)
    return np.asarray(part + np.where(v > 0.0, 2.0 * sides, 0.0))


def _under_arc(t: ArrayLike) -> Float:
    """Integral of ``sqrt(1 - t^2)``."""
    t = np.asarray(t, dtype=np.float64)
    return np.asarray(0.5 * (t * np.sqrt(1.0 - t**2) + np.arcsin(t)))


def _inverse(normal: Float) -> csr_array:
    """Inverse (n, n) of a symmetric matrix that falls into small parts, of sources that overlap."""
    count, part = connected_components(csr_array(normal), directed=False)
    order, size = np.argsort(part, kind="stable"), np.bincount(part, minlength=count)
    start = np.cumsum(size) - size
    values, rows, columns = [], [], []
    for side in np.unique(size):
        members = order[start[size == side][:, None] + np.arange(side)]
        values.append(np.linalg.pinv(normal[members[:, :, None], members[:, None, :]], hermitian=True).ravel())
        rows.append(np.repeat(members, side, axis=1).ravel())
        columns.append(np.tile(members, side).ravel())
    return csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=normal.shape)
