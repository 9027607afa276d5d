"""Sources of an image that neither stars nor bodies explain, each with its class and what it looks like.

Nothing is solved here: the attitude is given, and all sources of the image are kept, because a density of false sources
is measured from them. Whether the light came through the optics is judged by its shape alone. A source that is not
seen again may have hit the detector or flown by; what is seen again :func:`~giantlike.search.compare_residuals` tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float, Mask, require, require_number
from giantlike.core.detector import Detector
from giantlike.core.frames import rotate
from giantlike.core.outcomes import AttitudeFix, Failure, Reason
from giantlike.core.statistics import MAD_TO_SIGMA
from giantlike.core.values import Estimate
from giantlike.image import Image
from giantlike.processing.detection.detect import detect_sources
from giantlike.processing.detection.detections import DetectionFlag, Detections
from giantlike.processing.detection.frame_lines import FrameLines
from giantlike.processing.detection.hot_lines import hot_lines
from giantlike.processing.detection.matched_filter import recorded_width_px
from giantlike.processing.detection.options import DetectionOptions
from giantlike.processing.detection.particles import log_odds_of_optics
from giantlike.processing.detection.patches import Patches, cut_patches, draw_stars, pixel_shares
from giantlike.processing.detection.streak import StreakGuesses, fit_lines
from giantlike.scene import Scene, body_mask
from giantlike.stars.field import Sky

GATE = 18.4  # chi-square of two coordinates that one true pair in 10,000 exceeds
_STAR_MARGIN_PX = 3.0  # from a star beyond its gate: proper motion and parallax of a poorly known one
_BLEND_WIDTHS = 3.0  # recorded widths between sources within which the fit of one depends on the other
_RING_WIDTHS = 3.0  # of the pixels whose scatter is the noise at a source, to twice of it
_GHOST_RATIO = 100.0  # of a source to its ghost, at least: coated surfaces reflect a percent each
_GHOST_PX = 3.0  # from the mirror image of the source in the middle of the image
_PARTICLE = math.log(0.01)  # log odds of light through the optics, below which a sharp source is none: one mover in 100
_STREAK_HALF_PX = 24  # half side of patches in which lines are fitted
_STREAK_SIGMAS = 5.0  # of half a length that is one


class SourceClass(StrEnum):
    """Class of a source in an image."""

    STAR = "star"
    CATALOG_STAR_UNMATCHED = "catalog_star_unmatched"
    UNCATALOGED_STAR = "uncataloged_star"
    BODY = "body"
    BODY_DARK_SIDE = "body_dark_side"
    GHOST = "ghost"
    HOT_PIXEL = "hot_pixel"
    HOT_LINE = "hot_line"
    COSMIC_RAY = "cosmic_ray"
    BLEND = "blend"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualOptions:
    """Options of :func:`residual_sources`.

    Parameters
    ----------
    threshold_sigma : float; detection limit, in units of the local noise
    star_limit : float, mag, optional; faintest star of the catalog that explains a source; by default all
    floor_px : float, px
        Error of a predicted star per axis beyond the stated ones: distortion, and pixels that are not Gaussian.
    body_margin_px : float, px; around bodies, whose limb is no source
    max_sigma_px : float, px; sources known worse than this, per axis, make no tracks: a failed fit would suit all
    max_sources : int; most sources of an image; the faintest are left out beyond it

    Raises
    ------
    InputError
        A value is out of range.
    """

    threshold_sigma: float = 5.0
    star_limit: float | None = None
    floor_px: float = 0.1
    body_margin_px: float = 3.0
    max_sigma_px: float = 0.5
    max_sources: int = 2000

    def __post_init__(self) -> None:
        for name in ("threshold_sigma", "max_sigma_px"):
            require_number(getattr(self, name), name, above=0.0)
        for name in ("floor_px", "body_margin_px"):
            require_number(getattr(self, name), name, least=0.0)
        require(1 <= self.max_sources <= 10_000, f"max_sources must be 1 to 10,000, got {self.max_sources}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residuals(Estimate):
    """Classified sources of one image, brightest first.

    Parameters
    ----------
    name : str; of the image
    et : float, TDB seconds past J2000; mid-exposure
    exposure_s : float, s; 0 where it is unknown
    camera : Camera
    camera_from_inertial : Rotation
    attitude_rad2 : (3, 3) float64, rad^2, camera axes; covariance of the attitude, common to all sources
    points_px : (n, 2) float64, px
    covariance_px2 : (n, 2, 2) float64, px^2; of the centroids alone
    directions_inertial : (n, 3) float64, unitless, ICRF axes; apparent directions, aberration included
    flux_dn, snr, magnitude : (n,) float64
        Light, its ratio to the noise, and magnitude in the band of the zero point of the camera (NaN without one).
    kinds : (n,) str; values of :class:`SourceClass`
    optics : (n,) float64; probability that the light came through the optics
    halves_px : (n, 2) float64, px; from the middle of a streak to one end; zeros where there is none
    half_sigma_px : (n,) float64, px
    linkable : (n,) bool; True where a track may go through the source: unknown, and known well enough
    covered : (rows, columns) bool; pixels without sources of tracks: bad ones, bodies and the places of stars
    threshold_sigma : float
    reach_px : float, px; from a star, within which the fit of another source depends on it
    body_position_km : (3,) float64, km, ICRF axes, optional; apparent position of the body from the camera
    body_sigma_km : float, km; standard deviation of it, per axis, in common to all images
    sun_direction_inertial : (3,) float64, unitless, ICRF axes, optional; from the body to the Sun
    """

    name: str
    et: float
    exposure_s: float
    camera: Camera
    camera_from_inertial: Rotation
    attitude_rad2: Float
    points_px: Float
    covariance_px2: Float
    directions_inertial: Float
    flux_dn: Float
    snr: Float
    magnitude: Float
    kinds: NDArray[np.str_]
    optics: Float
    halves_px: Float
    half_sigma_px: Float
    linkable: Mask
    covered: Mask
    threshold_sigma: float
    reach_px: float
    body_position_km: Float | None = None
    body_sigma_km: float = 0.0
    sun_direction_inertial: Float | None = None

    def __len__(self) -> int:
        return len(self.snr)

    def counts(self) -> dict[str, int]:
        """Number of sources of each class that there is."""
        names, counts = np.unique(self.kinds, return_counts=True)
        return dict(zip(names.tolist(), counts.tolist(), strict=True))


def residual_sources(
    image: Image,
    camera: Camera,
    attitude: AttitudeFix | Rotation | None,
    catalog: StarCatalog | None,
    scene: Scene | None,
    options: ResidualOptions = ResidualOptions(),
) -> Residuals | Failure:
    """Detect all sources of an image and say what each is.

    Parameters
    ----------
    image : Image
        With its epoch.
    camera : Camera
    attitude : AttitudeFix or Rotation, optional
        ``camera_from_inertial``; that of the image, with its covariance, by default.
    catalog : StarCatalog, optional
        Without one no source is a star, until :func:`compare_residuals` finds it again.
    scene : Scene, optional
        Bodies in the image; the first one is that of orbits.
    options : ResidualOptions

    Returns
    -------
    Residuals or Failure
        ``no_attitude``; ``no_signal`` and ``saturated`` as :func:`~giantlike.processing.detect_sources`; the failure of
        the geometry of a body.

    Raises
    ------
    InputError
        The image does not suit the camera, or has no epoch.
    """
    camera.require_image(image)
    image = image if attitude is None else image.with_attitude(attitude)
    require(image.et is not None, f"{image.name}: a search needs the epoch of the image")
    if image.camera_from_inertial is None:
        return Failure(Reason.NO_ATTITUDE, f"{image.name}: places on the sky need an attitude")
    on_body = np.zeros(image.pixels.shape, dtype=bool)
    if scene is not None and scene.targets:
        outlines = body_mask(scene, image, camera, margin_px=options.body_margin_px)
        if isinstance(outlines, Failure):
            return outlines
        on_body = outlines
    detector = (image.detector or camera.detector).of_image(image.pixels, image.mask if image.mask.any() else None)
    search = DetectionOptions(threshold_sigma=options.threshold_sigma, max_sources=options.max_sources, searches=2)
    psf = None if camera.psf is None else camera.psf.sigma_px
    found = detect_sources(image.pixels, detector=detector, psf_sigma_px=psf, mask=image.mask, options=search)
    if isinstance(found, Failure):
        return found
    odds = np.zeros(len(found))
    if found.halves_px is None and len(found):  # points
        snr, patches = _weigh(image, found, detector)
        odds = log_odds_of_optics(patches, found.points_px, found.background_dn, found.psf_sigma_px)
        stands_out = snr >= options.threshold_sigma
        found, odds = found.select(stands_out), odds[stands_out]
    found, halves, half_sigma = _fit_streaks(found, image, detector)
    lines = hot_lines(FrameLines.from_frame(image.pixels, detector.bias_dn), noise_dn=found.noise_dn)
    bad = image.mask if lines is None else image.mask | lines
    sources = _Sources(image, camera, found, halves, options)
    kinds = sources.classify(catalog, scene, on_body, bad, odds)
    stars = found.points_px[np.isin(kinds, (SourceClass.STAR, SourceClass.CATALOG_STAR_UNMATCHED))]
    rate = found.flux_dn * detector.gain_e_per_dn / (image.exposure_s or math.nan)
    place = scene.geometry(image, scene.targets[0].name) if scene is not None and scene.targets else None
    body = None if isinstance(place, Failure) else place
    back = image.camera_from_inertial.inv()
    return Residuals(
        name=image.name,
        et=float(image.et or 0.0),
        exposure_s=image.exposure_s or 0.0,
        camera=camera,
        camera_from_inertial=image.camera_from_inertial,
        attitude_rad2=np.zeros((3, 3)) if image.attitude_covariance_rad2 is None else image.attitude_covariance_rad2,
        points_px=found.points_px,
        covariance_px2=found.covariance_px2,
        directions_inertial=rotate(back, camera.model.unproject(found.points_px)),
        flux_dn=found.flux_dn,
        snr=found.snr,
        magnitude=np.full(len(found), np.nan) if camera.photometry is None else camera.photometry.magnitude(rate),
        kinds=kinds,
        optics=expit(odds),
        halves_px=halves,
        half_sigma_px=half_sigma,
        linkable=sources.linkable(kinds),
        covered=on_body | bad | near(on_body.shape, stars, sources.reach_px),
        threshold_sigma=options.threshold_sigma,
        body_position_km=None if body is None else rotate(back, body.position_camera_km),
        body_sigma_km=0.0 if body is None else math.sqrt(float(np.trace(body.covariance_ephemeris_km2)) / 3.0),
        sun_direction_inertial=None if body is None else rotate(back, body.sun_direction_camera),
        reach_px=sources.reach_px,
    )


def near(shape: tuple[int, ...], points_px: Float, reach_px: float) -> Mask:
    """Pixels (rows, columns) within a distance of points (n, 2), px."""
    blank = np.ones(shape, dtype=np.uint8)
    inside = points_px[((points_px > -0.5) & (points_px < np.array(shape[::-1]) - 0.5)).all(axis=1)]
    columns, rows = np.rint(inside).astype(np.int64).T
    blank[rows, columns] = 0
    distance = cv2.distanceTransform(blank, cv2.DIST_L2, 5)
    return np.asarray(distance <= reach_px) if len(inside) else np.zeros(shape, dtype=bool)


def _weigh(image: Image, found: Detections, detector: Detector) -> tuple[Float, Patches]:
    """Ratios (n,) of sources to the noise of a ring around each, and patches with the light of that source alone.

    Wings of bodies and of saturated stars scatter more than the noise: what they seem to add is no source.
    """
    good = found.flags & np.uint16(DetectionFlag.FIT_FAILED) == 0
    flux = np.where(good, found.flux_dn, 0.0)
    left = image.pixels - draw_stars(image.pixels.shape, found.points_px, flux, found.width_px)
    width = recorded_width_px(found.psf_sigma_px)
    bad = image.mask if image.mask.any() else None
    centers = np.rint(found.points_px).astype(np.int64)
    patches = cut_patches(left, bad, centers, math.ceil(2.0 * _RING_WIDTHS * width) + 1, detector=detector)
    dx, dy = patches.offsets_px(found.points_px)
    away = np.hypot(dy[:, :, None], dx[:, None, :])
    ring = (away > _RING_WIDTHS * width) & (away < 2.0 * _RING_WIDTHS * width + 1.0) & patches.valid
    rest = np.where(ring, patches.values_dn, np.nan).reshape(len(found), -1)
    rest[~ring.reshape(rest.shape).any(axis=1)] = 0.0
    scatter = MAD_TO_SIGMA * np.nanmedian(np.abs(rest - np.nanmedian(rest, axis=1)[:, None]), axis=1)
    own = found.flux_dn / found.snr / (2.0 * math.sqrt(math.pi) * width)  # the noise of the detection
    noise = np.maximum(scatter, own)
    across, down = (
        pixel_shares(patches.corner_px[:, k], patches.size_px, found.points_px[:, k], found.width_px)[0] for k in (0, 1)
    )
    light = flux[:, None, None] * down[:, :, None] * across[:, None, :]
    patches = replace(patches, values_dn=np.where(patches.valid, patches.values_dn + light, 0.0), noise_dn=noise)
    return found.snr * own / noise, patches


def _fit_streaks(found: Detections, image: Image, detector: Detector) -> tuple[Detections, Float, Float]:
    """Sources with lines fitted to the long ones; half lines (n, 2) and the error (n,) of half their length, px."""
    halves, sigma = np.zeros((len(found), 2)), np.zeros(len(found))
    if found.halves_px is not None and found.half_sigma_px is not None:
        return found, found.halves_px, found.half_sigma_px
    long = np.flatnonzero(found.flags & np.uint16(DetectionFlag.EXTENDED))
    if not long.size:
        return found, halves, sigma
    bad = image.mask if image.mask.any() else None
    centers, noise = np.rint(found.points_px[long]).astype(np.int64), found.noise_dn
    patches = cut_patches(image.pixels, bad, centers, _STREAK_HALF_PX, detector=detector, noise_dn=noise)
    level = patches.border_level_dn()
    light = np.maximum(patches.values_dn - level[:, None, None] - 3.0 * noise, 0.0)
    x, y, xx, yy, xy = patches.moments(found.points_px[long], np.where(patches.valid, light, 0.0))
    angle, spread = 0.5 * np.arctan2(2.0 * (xy - x * y), xx - x**2 - yy + y**2), xx + yy - x**2 - y**2
    guess = np.sqrt(3.0 * np.maximum(spread, 0.1))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    starts = StreakGuesses(
        centers_px=found.points_px[long] + np.stack([x, y], axis=1),
        halves_px=guess,
        flux_dn=light.sum(axis=(1, 2)),
        background_dn=level,
    )
    lines = fit_lines(patches, starts, found.psf_sigma_px)
    freedom = np.maximum(lines.n_pixels - 8, 1)
    good = lines.converged & (lines.lengths_px > 2.0 * _STREAK_SIGMAS * lines.length_sigma_px)
    good &= lines.chi2 < freedom + 8.0 * np.sqrt(2.0 * freedom)  # of a line on an even background
    which = long[good]
    halves[which], sigma[which] = lines.halves_px[good], lines.length_sigma_px[good] / 2.0
    points, covariance, flags = found.points_px.copy(), found.covariance_px2.copy(), found.flags.copy()
    flux = found.flux_dn.copy()
    points[which], flux[which] = lines.centers_px[good], lines.flux_dn[good]
    covariance[which] = lines.covariance_px2[good][:, :2, :2]
    flags[which] = flags[which] & ~np.uint16(DetectionFlag.EXTENDED) | np.uint16(DetectionFlag.STREAK)
    return replace(found, points_px=points, covariance_px2=covariance, flags=flags, flux_dn=flux), halves, sigma


@dataclass(frozen=True, slots=True)
class _Sources:
    """Sources of an image that are to be classified."""

    image: Image
    camera: Camera
    found: Detections
    halves_px: Float
    options: ResidualOptions

    @property
    def reach_px(self) -> float:
        """Distance within which the fit of a source depends on another."""
        return _BLEND_WIDTHS * recorded_width_px(self.found.psf_sigma_px)

    def has(self, flags: DetectionFlag) -> Mask:
        """Sources (n,) with any of the flags."""
        return np.asarray(self.found.flags & np.uint16(flags) != 0)

    def classify(
        self, catalog: StarCatalog | None, scene: Scene | None, on_body: Mask, bad: Mask, odds: Float
    ) -> NDArray[np.str_]:
        """Classes (n,): the first that holds, from bodies to the unknown.

        ``on_body``, ``bad`` (rows, columns); ``odds`` (n,): log odds of light through the optics.
        """
        points = self.found.points_px
        columns, rows = np.clip(np.rint(points).astype(np.int64), 0, np.array(on_body.shape[::-1]) - 1).T
        inside, (star, unmatched) = on_body[rows, columns], self._stars(catalog)
        sharp, known = self.has(DetectionFlag.SHARP), points[star | unmatched]
        beside = cKDTree(known).query(points)[0] < self.reach_px if len(known) else np.zeros(len(points), dtype=bool)
        cases = {
            SourceClass.BODY_DARK_SIDE: inside & self._unlit(scene),
            SourceClass.BODY: inside,
            SourceClass.HOT_LINE: bad[rows, columns],
            SourceClass.STAR: star,
            SourceClass.CATALOG_STAR_UNMATCHED: unmatched,
            SourceClass.GHOST: self._ghosts(),
            SourceClass.HOT_PIXEL: sharp & ~self.has(DetectionFlag.COSMIC_RAY) & (odds < _PARTICLE),
            SourceClass.COSMIC_RAY: sharp & (odds < _PARTICLE),
            SourceClass.BLEND: beside | self.has(DetectionFlag.EXTENDED),
        }
        return np.select(list(cases.values()), [str(name) for name in cases], default=str(SourceClass.UNKNOWN))

    def linkable(self, kinds: NDArray[np.str_]) -> Mask:
        """Sources (n,) that tracks may go through."""
        turn = self.image.attitude_covariance_rad2
        pointing = 0.0 if turn is None else float(turn[0, 0] + turn[1, 1]) / 2.0 / float(self.camera.ifov_rad()) ** 2
        sigma = np.sqrt(self.found.sigma_px**2 + pointing)
        fine = ~self.has(DetectionFlag.FIT_FAILED) & (sigma <= self.options.max_sigma_px)
        return np.asarray((kinds == SourceClass.UNKNOWN) & fine)

    def _stars(self, catalog: StarCatalog | None) -> tuple[Mask, Mask]:
        """Sources (n,) at stars of the catalog, and others beside a star that none is at."""
        image, camera, none = self.image, self.camera, np.zeros(len(self.found), dtype=bool)
        if catalog is None or image.camera_from_inertial is None or not len(self.found):
            return none, none
        seen = image.observer
        position, velocity = (None, None) if seen is None else (seen.position_km, seen.velocity_km_s)
        sky = Sky(
            catalog=catalog,
            et=image.et,
            observer_position_km=position,
            observer_velocity_km_s=velocity,
            max_magnitude=self.options.star_limit,
        )
        field = sky.field(camera, image.camera_from_inertial)
        predicted = camera.model.project(rotate(image.camera_from_inertial, field.directions_inertial))
        near = np.flatnonzero(np.isfinite(predicted).all(axis=1))
        if not near.size:
            return none, none
        distance, nearest = cKDTree(predicted[near]).query(self.found.points_px)
        stars = near[nearest]
        pixel = float(camera.ifov_rad())
        turn = np.zeros((3, 3)) if image.attitude_covariance_rad2 is None else image.attitude_covariance_rad2
        pointing = float(np.trace(turn[:2, :2])) / 2.0 / pixel**2
        variance = self.found.sigma_px**2 + (field.sigma_rad[stars] / pixel) ** 2 + pointing + self.options.floor_px**2
        at = distance**2 < GATE * variance
        if camera.photometry is not None and image.exposure_s:
            expected = camera.photometry.star_rate_e_s(field.stars.magnitude[stars]) * image.exposure_s
            gain = (image.detector or camera.detector).gain_e_per_dn
            at &= expected > 0.1 * self.found.flux_dn * gain  # a fainter star does not explain the source
        beside = ~at & (distance < _STAR_MARGIN_PX) & ~np.isin(stars, stars[at])
        return at, beside

    def _ghosts(self) -> Mask:
        """Sources (n,) at the mirror image of a far brighter one in the middle of the image."""
        points, flux = self.found.points_px, self.found.flux_dn
        if len(points) < 2:
            return np.zeros(len(points), dtype=bool)
        mirrored = 2.0 * self.camera.center_px - points
        distance, source = cKDTree(mirrored).query(points)
        return np.asarray((distance < _GHOST_PX) & (flux[source] > _GHOST_RATIO * flux))

    def _unlit(self, scene: Scene | None) -> Mask:
        """Sources (n,) before the dark side of a body, taken as a sphere of its mean radius."""
        rays = self.camera.model.unproject(self.found.points_px)
        dark = np.zeros(len(rays), dtype=bool)
        for target in () if scene is None else scene.targets:
            assert scene is not None
            place = scene.geometry(self.image, target.name)
            if isinstance(place, Failure):
                continue
            center, radius = place.position_camera_km, target.shape.mean_radius_km
            along = rays @ center
            depth = radius**2 - (center @ center - along**2)
            hit = rays * (along - np.sqrt(np.maximum(depth, 0.0)))[:, None] - center
            dark |= (depth > 0.0) & (hit @ place.sun_direction_camera < 0.0)
        return dark
