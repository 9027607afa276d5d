"""Stars that an image will show: their expected number, and the attitude that they will give."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr, spence

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.processing.detection.matched_filter import recorded_width_px
from giantlike.processing.detection.options import DetectionOptions
from giantlike.stars.attitude import fit_attitude
from giantlike.stars.consider import attitude_parts, response_to_camera
from giantlike.stars.field import StarField
from giantlike.stars.matching import predicted_in_frame
from giantlike.stars.navigation import sky_of
from giantlike.stars.options import StarOptions

_BLEND_WIDTHS = 2.5  # distance, in widths of a star, within which the fainter is lost: equal peaks merge at 2
_BACKGROUND_LOSS = 0.97  # of the signal to noise ratio, kept by ``matched_filter``, which removes background
_TWO_SIGMA = 2.0  # half width of the stated interval, standard deviations: 95 %
_INFORMATION = 0.96  # part of the information in the stars used; a run measures the brightest (``StarOptions``)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarForecast(Value):
    """Stars that an image will show.

    Parameters
    ----------
    in_field : int; stars of the catalog in the field of view, down to its limit
    expected : float; expected number of detections; equal to ``in_field`` where no zero point is known
    low, high : float; interval of 95 % of that number: chance, and the error of the zero point
    covariance_rad2 : (3, 3) float64, rad^2, camera axes, optional; of the attitude, as in ``AttitudeFix``
    parts : mapping of Cause to (3, 3) float64, rad^2; that covariance by cause
    failure : Failure, optional; reason for which there is no attitude
    """

    in_field: int
    expected: float
    low: float
    high: float
    covariance_rad2: Float | None = None
    parts: Mapping[Cause, Float] = field(default_factory=dict)
    failure: Failure | None = None


def expect_stars(
    image: Image,
    camera: Camera,
    catalog: StarCatalog,
    *,
    blur_px: tuple[float, float] = (0.0, 0.0),
    body: tuple[Float, float] | None = None,
    options: StarOptions | None = None,
    detection: DetectionOptions | None = None,
    seed: int = 0,
) -> StarForecast:
    r"""Predict the stars of an image and the covariance of the attitude from them.

    Parameters
    ----------
    image : Image; epoch, exposure, attitude and observer; pixels are not used
    camera : Camera
        Its photometry has the zero point in the band of the catalog. Without that, or with an unknown detector, every
        star of the catalog counts, and no attitude follows.
    catalog : StarCatalog
    blur_px : (float, float), px; motion (x, y) of the stars over the image during the exposure
    body : ((2,) float64, float), px, optional; center and radius of a disk that hides stars
    options : StarOptions, optional
    detection : DetectionOptions, optional; threshold and largest number
    seed : int; of the errors of the stars that the attitude is fitted to

    Returns
    -------
    StarForecast
        Its failure: no_attitude, no_catalog_stars, too_few_detections, or that of the fit.

    Notes
    -----
    A star of ``F`` electrons has, after the matched filter of a Gaussian of width ``s``, a ratio to the noise ``n`` of
    a pixel of ``F s / (n sqrt(pi (a^2 + s^2) (b^2 + s^2)))``, with the widths ``a`` and ``b`` of its trail; it is found
    with the probability that this and a normal error exceed the threshold. It lies off the middle of its brightest
    pixel by an even error, of variance 1/12 px^2 an axis. Its centroid has the Fisher information of a Gaussian on the
    noise of its own photons and of the detector, ``F / a^2 (1 + Li2(-q) / q)`` with the ratio ``q`` of both variances
    at its peak. The attitude is the fit of stars with errors drawn from these, so that its covariance has what the fit
    makes of residuals.
    """
    options, detection = options or StarOptions(), detection or DetectionOptions()
    attitude = image.camera_from_inertial
    if attitude is None:
        why = Failure(Reason.NO_ATTITUDE, f"{image.name}: stars cannot be predicted without an attitude")
        return StarForecast(in_field=0, expected=0.0, low=0.0, high=0.0, failure=why)
    stars = sky_of(image, catalog, options).field(camera, attitude)
    points = predicted_in_frame(stars.directions_inertial, camera, attitude, margin_px=0.0)
    inside = np.isfinite(points).all(axis=1)
    if body is not None:
        inside &= ~(np.linalg.norm(points - body[0], axis=1) < body[1])
    stars, points = stars.select(np.flatnonzero(inside)), points[inside]
    count, needed = len(points), options.min_matches
    photometry = None if camera.detector.estimated else camera.photometry
    if count < needed or photometry is None or image.exposure_s is None:
        text = (
            f"{image.name}: {count} stars of the catalog lie in the predicted field, and an attitude needs {needed}: "
            "raise stars.max_magnitude, or take a deeper catalog"
        )
        few = Failure(Reason.NO_CATALOG_STARS, text) if count < needed else None
        return StarForecast(in_field=count, expected=count, low=count, high=count, failure=few)
    trails = _Trails.of_camera(camera, blur_px)
    axis = rotate(attitude.inv(), [0.0, 0.0, 1.0])
    seen_as = {"color_bp_rp": stars.stars.color_bp_rp, "angle_rad": np.arccos(stars.directions_inertial @ axis)}
    light_e = photometry.star_rate_e_s(stars.stars.magnitude, **seen_as) * image.exposure_s
    ratio = light_e * trails.snr_per_electron
    alone = np.ones(count, dtype=bool)
    alone[cKDTree(points).query_pairs(_BLEND_WIDTHS * trails.long_px, output_type="ndarray")[:, 1]] = False  # fainter

    def probabilities(sigmas: float) -> Float:
        shifted = ratio * 10.0 ** (0.4 * sigmas * photometry.sigma_mag(**seen_as))
        spread = np.hypot(1.0, math.log(10.0) / 2.5 * photometry.scatter_mag * shifted)
        return np.where(alone, ndtr((shifted - detection.threshold_sigma) / spread), 0.0)

    found = probabilities(0.0)
    half = np.array([probabilities(sign).sum() for sign in (-1.0, 1.0)]) - found.sum()
    chance = math.sqrt(float(np.sum(found * (1.0 - found))))
    low, high = found.sum() + _TWO_SIGMA * np.hypot(half, chance) * np.array([-1.0, 1.0])
    forecast = StarForecast(in_field=count, expected=float(found.sum()), low=max(float(low), 0.0), high=float(high))
    random = np.random.default_rng([seed, 1])
    seen = np.flatnonzero(random.random(count) < found)[: detection.max_sources]
    if len(seen) < needed:
        text = f"{image.name}: {found.sum():.1f} stars are expected above the threshold, and an attitude needs {needed}"
        return replace(forecast, failure=Failure(Reason.TOO_FEW_DETECTIONS, text))
    stars, points, variance = stars.select(seen), points[seen], trails.centroid_variance_px2(light_e[seen])
    variance += (stars.sigma_rad * camera.model.focal_length_px)[:, None] ** 2
    return replace(forecast, **_predict_attitude(stars, points, variance, camera, image, options, random))


@dataclass(frozen=True, slots=True)
class _Trails:
    """Images of stars: widths (x, y) of their trails, px, and the noise of a pixel, electrons."""

    width_px: float
    sides_px: Float
    noise_e: float

    @classmethod
    def of_camera(cls, camera: Camera, blur_px: tuple[float, float]) -> _Trails:
        """Trails of a motion (x, y) during an exposure."""
        width = recorded_width_px(UNKNOWN_PSF_SIGMA_PX if camera.psf is None else camera.psf.sigma_px)
        long = math.hypot(width, *np.array(blur_px) / math.sqrt(12.0))
        sides = [width, long] if abs(blur_px[0]) < abs(blur_px[1]) else [long, width]
        noise_dn = math.sqrt(float(camera.detector.variance_dn2(np.zeros(()))))
        return cls(width, np.array(sides), camera.detector.gain_e_per_dn * noise_dn)

    @property
    def long_px(self) -> float:
        """Width along the trail."""
        return float(self.sides_px.max())

    @property
    def snr_per_electron(self) -> float:
        """Ratio after the matched filter, over the electrons of the star."""
        squares = self.width_px**2 + self.sides_px**2
        off_center = math.exp(-float(np.sum(1.0 / squares)) / 24.0)
        return _BACKGROUND_LOSS * off_center * self.width_px / math.sqrt(math.pi * squares.prod()) / self.noise_e

    def centroid_variance_px2(self, light_e: Float) -> Float:
        """Least variance (n, 2) of the centroids of stars of some electrons (n,)."""
        peak = light_e / (2.0 * math.pi * self.sides_px.prod()) / self.noise_e**2
        return np.asarray(self.sides_px**2 / (light_e * (1.0 + spence(1.0 + peak) / peak))[:, None])


def _predict_attitude(
    stars: StarField,
    points: Float,
    variance: Float,
    camera: Camera,
    image: Image,
    options: StarOptions,
    random: np.random.Generator,
) -> dict[str, Any]:
    """Attitude, by causes, of a fit to stars with errors drawn from their variances (n, 2); or its failure."""
    order = np.argsort(variance.sum(axis=1))
    if not options.all_stars:
        information = np.cumsum(1.0 / variance.sum(axis=1)[order])
        least = int(np.searchsorted(information, _INFORMATION * information[-1])) + 1
        order = order[: max(options.min_matches, least)]
    stars, variance = stars.select(order), variance[order]
    drawn = points[order] + random.standard_normal(variance.shape) * np.sqrt(variance)
    covariance, directions = variance[:, :, None] * np.eye(2), stars.directions_inertial
    solution = fit_attitude(directions, drawn, covariance, camera.model, outlier_sigma=options.outlier_sigma)
    if isinstance(solution, Failure):
        return {"failure": solution}
    used = stars.select(np.flatnonzero(solution.used))
    parts = attitude_parts(solution, used, response_to_camera(solution, used), camera, image, options)
    return {"covariance_rad2": sum_parts(parts, tuple(Cause)), "parts": parts}
