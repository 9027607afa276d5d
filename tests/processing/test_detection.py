"""Detection and centroids: Cramer-Rao accuracy, honest covariances, flags, refusals, and real frames."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import binom, chi2, norm

from giantlike.catalogs import load_catalog
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, direction_from_radec, rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing import DetectionFlag, DetectionOptions, Detections, detect_sources
from giantlike.processing.detection.centroid import fit_stars
from giantlike.processing.detection.patches import cut_patches, draw_stars, pixel_shares
from giantlike.processing.psf.estimate import PsfEstimate, estimate_psf, remeasure
from giantlike.simulation.cosmic_rays import CosmicRays, draw_tracks
from tests.numerical import numerical_jacobian
from tests.sizes import slow
from tests.tolerances import FALSE_ALARM

RAMP_DN_PX = 0.4  # moved every centroid by 0.4 sigma, 7 standard errors of 324 stars, when levels were thought even
BIAS_STANDARD_ERRORS = 4.0
GAIN, READ_NOISE_E, SKY_DN = 2.0, 5.0, 100.0
NOISE_DN = float(np.sqrt(SKY_DN / GAIN + (READ_NOISE_E / GAIN) ** 2 + 1.0 / 12.0))
DETECTOR = Detector(gain_e_per_dn=GAIN, read_noise_e=READ_NOISE_E)

CRAMER_RAO_RATIO = 1.10  # requirement at a signal to noise ratio of 20 and more
BIAS_PX = 0.005  # requirement; a tenth of the random error of a star of SNR 50
PHASE_BIAS_PX = 1e-4  # without noise only rounding and the convergence limit are left
CLEAR_CENTROID_PX = 0.1  # five sigma of a star of SNR 50 and sigma 0.8 px
NOISE_RELATIVE = 0.03  # quartiles of 256 samples, median of 9 boxes
MISTAKEN_PARTICLES = 1.0 / 200.0  # requirement: fewer than one of 200
PSF_RELATIVE = 0.03  # 50 stars of SNR 100, each good to 1.5 %, and a Gaussian that is exact
OFFSET_PX = 1e-3  # single precision of the filter moves the start of a fit, not its end
DERIVATIVE = 1e-7  # central differences of a smooth function of order one
PUBLISHED_SIGMAS = 3.0  # both axes of six measurements
CATALOG_MATCH_PX = 3.0  # the reference solution has no distortion model: 11 arcsec rms of 40 arcsec pixels


def star_image(points_px: Float, flux_dn: Float, sigma_px: float, shape: tuple[int, int]) -> Float:
    """Noise-free sum of Gaussians integrated over pixels, from the normal distribution function."""
    shares = []
    for axis in (1, 0):
        edges = np.arange(shape[axis] + 1) - 0.5
        shares.append(np.diff(norm.cdf(edges[None], points_px[:, 1 - axis, None], sigma_px), axis=1))
    across, down = shares
    return np.asarray((down * flux_dn[:, None]).T @ across)


def exposed(light_dn: Float, seed: int) -> NDArray[np.uint16]:
    """Photon noise, read noise and quantization of light on the sky background."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson((light_dn + SKY_DN) * GAIN) + rng.normal(0.0, READ_NOISE_E, light_dn.shape)
    return np.clip(np.round(electrons / GAIN), 0, 65535).astype(np.uint16)


def flux_of_snr(snr: float, sigma_px: float) -> float:
    return float(snr * NOISE_DN * 2.0 * np.sqrt(np.pi * (sigma_px**2 + 1.0 / 12.0)))


def spread_points(shape: tuple[int, int], pitch_px: int, seed: int) -> Float:
    """Random places, each in its own square of a grid, at least half a pitch apart."""
    x, y = np.meshgrid(
        np.arange(pitch_px, shape[1] - pitch_px, pitch_px), np.arange(pitch_px, shape[0] - pitch_px, pitch_px)
    )
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    return grid + np.random.default_rng(seed).uniform(-pitch_px / 4, pitch_px / 4, grid.shape)


def cramer_rao_px(points_px: Float, flux_dn: float, sigma_px: float) -> float:
    """Root mean square over stars of the bound per axis: x, y, flux and background unknown, 25 x 25 pixels."""
    variances = []
    for x, y in points_px - np.round(points_px):

        def model(p: Float) -> Float:
            edges = np.arange(-12.5, 13.0)
            px, py = (np.diff(norm.cdf(edges, center, sigma_px)) for center in p[:2])
            return np.asarray(p[2] * np.outer(py, px) + p[3]).ravel()

        at = np.array([x, y, flux_dn, 0.0])
        jacobian = numerical_jacobian(model, at, 1e-4)
        information = (jacobian.T / (NOISE_DN**2 + model(at) / GAIN)) @ jacobian
        variances.append(np.diag(np.linalg.inv(information))[:2].mean())
    return float(np.sqrt(np.mean(variances)))


def nees_band(count: int, confidence: float) -> tuple[float, float]:
    """Bounds of the mean normalized squared error of ``count`` honest two-dimensional covariances."""
    tail = (1.0 - confidence) / 2.0
    return float(chi2.ppf(tail, 2 * count)) / count, float(chi2.ppf(1.0 - tail, 2 * count)) / count


def detected(pixels: NDArray[Any], **settings_: Any) -> Detections:
    result = detect_sources(pixels, **{"detector": DETECTOR, "psf_sigma_px": 0.8, **settings_})
    assert isinstance(result, Detections)
    return result


def paired(points_px: Float, to_px: Float) -> tuple[Float, NDArray[np.intp]]:
    """Distance (n,) from each of ``to_px`` (n, 2) to the nearest of ``points_px``, and which that is."""
    distance, index = cKDTree(points_px).query(to_px)
    return np.atleast_1d(distance), np.atleast_1d(index)


def nearest(found: Detections, points_px: Float) -> tuple[Float, NDArray[np.intp]]:
    return paired(found.points_px, points_px)


def flagged(found: Detections, x: float, y: float) -> DetectionFlag:
    """Flags of the detection nearest to a pixel."""
    distance, index = nearest(found, np.array([[x, y]]))
    assert distance[0] < 2.0
    return DetectionFlag(int(found.flags[index[0]]))


@pytest.mark.monte_carlo(few=80, full=160)
@pytest.mark.parametrize(
    ("sigma_px", "snr"),
    [(0.6, 20.0), slow(0.6, 60.0), slow(1.0, 20.0), slow(1.0, 60.0), slow(1.5, 20.0), (1.5, 60.0)],
)
def test_centroids_reach_the_cramer_rao_bound_without_bias_and_with_honest_covariances(
    sigma_px: float, snr: float, draws: int
) -> None:
    shape, flux = (1200, 1200), flux_of_snr(snr, sigma_px)
    errors, nees = [], []
    for seed in (11, 12, 13, 14)[: draws // 40]:
        points = spread_points(shape, 40, seed)
        found = detected(
            exposed(star_image(points, np.full(len(points), flux), sigma_px, shape), seed), psf_sigma_px=sigma_px
        )
        distance, index = nearest(found, points)
        assert (distance < 1.0).all()
        error = found.points_px[index] - points
        errors.append(error)
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[index]), error))
        assert found.noise_dn == pytest.approx(NOISE_DN, rel=NOISE_RELATIVE)
    error, squares = np.concatenate(errors), np.concatenate(nees)
    rms = float(np.sqrt(np.mean(error**2)))
    assert rms <= CRAMER_RAO_RATIO * cramer_rao_px(points[:40], flux, sigma_px)
    # The mean is itself only known to rms / sqrt(n): the requirement and three sigma of that.
    assert np.abs(error.mean(axis=0)).max() <= BIAS_PX + 3.0 * rms / np.sqrt(len(error))
    low, high = nees_band(len(squares), 0.998)
    assert low < squares.mean() < high
    assert np.mean(squares < chi2.ppf(0.99, 2)) > 0.98


def test_faint_stars_have_honest_covariances_too() -> None:
    shape, flux = (1200, 1200), flux_of_snr(10.0, 0.8)
    points = spread_points(shape, 40, 5)
    found = detected(exposed(star_image(points, np.full(len(points), flux), 0.8, shape), 5))
    distance, index = nearest(found, points)
    seen = distance < 1.0
    assert seen.mean() > 0.99
    error = found.points_px[index[seen]] - points[seen]
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[index[seen]]), error)
    low, high = nees_band(len(squares), 0.998)
    assert low < squares.mean() < high


@pytest.mark.parametrize("sigma_px", [0.6, 0.9, 1.5])
def test_the_place_of_a_star_in_its_pixel_does_not_bias_its_centroid(sigma_px: float) -> None:
    phase = np.linspace(-0.5, 0.5, 11)
    points = np.stack(np.meshgrid(phase, phase), axis=-1).reshape(-1, 2) + 10.0
    for point in points:
        image = star_image(point[None], np.array([5000.0]), sigma_px, (21, 21)) + SKY_DN
        center = np.round(point).astype(np.int64)[None]
        fit = fit_stars(
            cut_patches(image, None, center, 6, detector=Detector(gain_e_per_dn=GAIN)),
            flux_dn=np.array([4000.0]),
            psf_sigma_px=sigma_px,
        )
        assert fit.converged.all()
        assert_allclose(fit.points_px[0], point, rtol=0, atol=PHASE_BIAS_PX)


def test_derivatives_of_the_pixel_shares_are_those_of_the_shares() -> None:
    first = np.array([-3, 4], dtype=np.int64)
    at = np.array([[0.3, np.log(0.7)], [7.6, np.log(1.4)]])

    def shares(p: Float) -> Float:
        return pixel_shares(first, 8, p[:, 0], np.exp(p[:, 1]))[0]

    numerical = numerical_jacobian(shares, at, 1e-5)
    _, by_center, by_log_width = pixel_shares(first, 8, at[:, 0], np.exp(at[:, 1]))
    assert_allclose(by_center, numerical[..., 0], rtol=0, atol=DERIVATIVE)
    assert_allclose(by_log_width, numerical[..., 1], rtol=0, atol=DERIVATIVE)


def test_the_width_of_stars_is_found_from_the_image() -> None:
    for sigma_px in (0.6, 1.1, 2.5):
        points = spread_points((700, 700), 60, 3)
        light = star_image(points, np.full(len(points), flux_of_snr(100.0, sigma_px)), sigma_px, (700, 700))
        found = detected(exposed(light, 3), psf_sigma_px=None)
        assert found.psf_sigma_px == pytest.approx(sigma_px, rel=PSF_RELATIVE)
        assert len(found) == len(points)
        assert not found.flags.any()


def test_sep_finds_the_same_stars_less_accurately() -> None:
    shape = (800, 800)
    points = spread_points(shape, 40, 8)
    flux = 10.0 ** np.random.default_rng(8).uniform(3.0, 4.5, len(points))
    image = exposed(star_image(points, flux, 0.8, shape), 8)
    found = detected(image)
    pixels = image.astype(np.float32)
    sep = pytest.importorskip("sep")
    background = sep.Background(pixels)
    theirs = sep.extract(pixels - background.back(), 5.0, err=background.globalrms)
    their_points = np.stack([theirs["x"], theirs["y"]], axis=1)
    assert (nearest(found, their_points)[0] < 0.5).all()
    truth, ours = nearest(found, points)
    assert (truth < 0.5).all()
    # Twice the variance of a fit of the flux alone: background and width are unknown as well.
    flux_sigma = np.sqrt(2.0 * (flux / GAIN + flux_of_snr(1.0, 0.8) ** 2))
    assert_allclose((found.flux_dn[ours] - flux) / flux_sigma, 0.0, rtol=0, atol=5.0)  # sigmas
    their_error, _ = paired(points, their_points)
    assert np.sqrt(np.mean(truth**2)) < np.sqrt(np.mean(their_error**2))


def test_detections_come_brightest_first_and_the_signal_to_noise_ratio_is_that_of_the_flux() -> None:
    points = spread_points((400, 400), 50, 2)
    flux = np.linspace(500.0, 20_000.0, len(points))
    light = star_image(points, flux, 0.8, (400, 400))
    found = detected(exposed(light, 2))
    assert len(found) == len(points)
    assert (np.diff(found.flux_dn) <= 0).all()
    width = np.sqrt(0.8**2 + 1.0 / 12.0)
    expected_snr = found.flux_dn / (found.noise_dn * 2.0 * np.sqrt(np.pi) * width)
    assert_allclose(found.snr / expected_snr, 1.0, rtol=0, atol=0.15)  # the noise is local, to some percent
    assert found.sigma_px[0] < found.sigma_px[-1]
    assert found.area_px[0] > found.area_px[-1]
    chosen = found.select(found.snr > 100.0)
    assert len(chosen) == np.count_nonzero(found.snr > 100.0)
    assert_allclose(found.select(np.array([3, 1])).points_px, found.points_px[[3, 1]], rtol=0, atol=0)
    for field in dataclasses.fields(chosen):
        value = getattr(chosen, field.name)
        assert not isinstance(value, np.ndarray) or len(value) == len(chosen)
    strongest = detected(exposed(light, 2), options=DetectionOptions(max_sources=5))
    assert len(strongest) == 5
    assert strongest.flux_dn.min() > np.median(found.flux_dn)


def test_noise_alone_gives_no_stars() -> None:
    dark = exposed(np.zeros((1000, 1000)), 4)
    assert len(detected(dark)) <= 3  # one pixel in three million exceeds 5 sigma, give or take the noise map
    assert len(detected(dark, psf_sigma_px=None)) <= 3


def test_a_steep_background_hides_no_star_and_makes_none() -> None:
    points = spread_points((600, 600), 60, 6)
    y, x = np.indices((600, 600))
    slope = 3.0 * x + 2.0 * y + 2e-3 * (x - 300.0) ** 2
    found = detected(exposed(star_image(points, np.full(len(points), 8000.0), 0.8, (600, 600)) + slope, 6))
    assert nearest(found, points)[0].max() < 5 * CLEAR_CENTROID_PX
    assert len(found) - len(points) <= 2  # noise: 0.1 expected above 5 sigma in 360,000 pixels


def test_a_resolved_body_with_texture_does_not_become_many_stars() -> None:
    shape = (512, 512)
    points = spread_points(shape, 40, 9)
    points = points[np.hypot(*(points - 256.0).T) > 120.0]
    y, x = np.indices(shape)
    albedo = 1.0 + 0.3 * cv2.GaussianBlur(np.random.default_rng(1).normal(size=shape), (0, 0), 3.0) * 10.0
    disk = 2000.0 * (np.hypot(x - 256.0, y - 256.0) < 100.0) * np.clip((x - 200.0) / 150.0, 0.0, 1.0) * albedo
    body = cv2.GaussianBlur(np.maximum(disk, 0.0), (0, 0), 0.8)
    found = detected(exposed(star_image(points, np.full(len(points), 3000.0), 0.8, shape) + body, 9))
    stars = found.select(found.clean)
    assert nearest(stars, points)[0].max() < CLEAR_CENTROID_PX
    on_body = np.hypot(*(stars.points_px - 256.0).T) < 110.0
    assert on_body.sum() <= 0.1 * len(points)


def test_a_saturated_body_is_one_extended_source_and_not_a_star() -> None:
    y, x = np.indices((300, 300))
    disk = cv2.GaussianBlur(9000.0 * (np.hypot(x - 150.0, y - 140.0) < 25.0), (0, 0), 0.8)
    stars = np.array([[40.0, 40.0], [250.3, 60.2]])
    image = np.minimum(exposed(disk + star_image(stars, np.full(2, 3000.0), 0.8, (300, 300)), 1), 4095)
    found = detected(image, detector=dataclasses.replace(DETECTOR, saturation_dn=4095.0))
    clean = found.select(found.clean)
    assert nearest(clean, stars)[0].max() < CLEAR_CENTROID_PX
    assert len(clean) == 2
    assert DetectionFlag.EXTENDED in DetectionFlag(int(found.flags[~found.clean][0]))


def test_hot_pixels_and_trails_are_told_from_stars() -> None:
    stars = np.array([[60.3, 40.2], [120.0, 90.0]])
    image = exposed(star_image(stars, np.full(2, 4000.0), 0.8, (200, 200)), 7).astype(np.int32)
    image[150, 50] += 800
    image[20, 160:172] += 300
    for k in range(9):
        image[130 + k, 120 + k] += 400
    found = detected(image)
    assert nearest(found.select(found.clean), stars)[0].max() < CLEAR_CENTROID_PX
    assert found.clean.sum() == 2
    assert DetectionFlag.SHARP in flagged(found, 50, 150)
    assert DetectionFlag.EXTENDED in DetectionFlag(int(np.bitwise_or.reduce(found.flags)))


@pytest.mark.parametrize("sigma_px", [0.6, 0.8, 1.5])
def test_particles_are_told_from_stars(sigma_px: float) -> None:
    shape, hits = (700, 700), 300  # three times as dense as required
    points = spread_points(shape, 40, 31)
    snr = 10.0 ** np.random.default_rng(31).uniform(1.1, 2.5, len(points))
    light = star_image(points, snr * flux_of_snr(1.0, sigma_px), sigma_px, shape)
    rays = CosmicRays(hits_per_image=hits)
    charge = draw_tracks(rays, shape[1], shape[0], 0.0, np.random.default_rng(32)).deposited_e(shape[1], shape[0])
    image = np.clip(exposed(light, 33) + np.round(charge / GAIN), 0, 65535).astype(np.uint16)
    found = detected(image, psf_sigma_px=sigma_px)
    clean = found.select(found.clean)
    # Each particle covers the core of a star with a chance of 0.3 %: 0.9 stars in 256 are hit.
    assert np.count_nonzero(nearest(clean, points)[0] > 1.0) <= most_by_chance(len(points), hits * 40.0 / 700**2)
    false = np.count_nonzero(paired(points, clean.points_px)[0] > 1.5)
    assert false <= most_by_chance(hits, MISTAKEN_PARTICLES)
    names = [DetectionFlag(int(flags)) for flags in found.flags[~found.clean]]
    assert sum(DetectionFlag.COSMIC_RAY in flags for flags in names) > 0.3 * hits  # many tracks stay in one pixel
    own = detected(image, psf_sigma_px=None)
    assert own.psf_sigma_px == pytest.approx(sigma_px, rel=2 * PSF_RELATIVE)  # also from a sky full of particles


def most_by_chance(count: int, chance: float) -> float:
    """Largest number of ``count`` that a chance each explains."""
    return float(binom.ppf(1.0 - 1e-5, count, chance))


def test_stars_sharper_than_the_camera_file_says_are_still_stars() -> None:
    points = spread_points((500, 500), 50, 13)
    light = star_image(points, np.full(len(points), 6000.0), 0.5, (500, 500))
    found = detected(exposed(light, 13), psf_sigma_px=1.0)
    assert found.clean.sum() == len(points)


@pytest.mark.parametrize("flux_dn", [30_000.0, 200_000.0, 1_000_000.0])
def test_saturated_stars_are_centerd_from_their_flanks(flux_dn: float) -> None:
    star = np.array([[100.3, 99.8]])
    image = np.minimum(exposed(star_image(star, np.array([flux_dn]), 0.8, (200, 200)), 2), 4095)
    found = detected(image, detector=dataclasses.replace(DETECTOR, saturation_dn=4095.0))
    assert len(found) == 1
    assert found.clean.all()
    assert DetectionFlag.SATURATED in flagged(found, 100, 100)
    error = found.points_px[0] - star[0]
    assert error @ np.linalg.inv(found.covariance_px2[0]) @ error < chi2.ppf(0.999, 2)


def test_close_stars_are_measured_as_if_they_were_alone() -> None:
    for distance in (4.0, 5.0, 6.5):
        pair = np.array([[60.3, 60.2], [60.3 + distance, 60.7]])
        found = detected(exposed(star_image(pair, np.array([9000.0, 4000.0]), 0.8, (120, 120)), 3))
        assert len(found) == 2
        error = found.points_px - pair
        squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2), error)
        assert (squares < chi2.ppf(0.999, 2)).all()
        assert all(DetectionFlag.BLENDED in DetectionFlag(int(flags)) for flags in found.flags)


def test_bad_pixels_are_left_out_and_said_to_be() -> None:
    stars = np.array([[60.3, 60.2], [150.0, 40.0]])
    image = exposed(star_image(stars, np.full(2, 9000.0), 0.8, (200, 200)), 3)
    mask = np.zeros(image.shape, dtype=bool)
    mask[60, 61] = mask[100:160, 20:90] = True
    broken = image.copy()
    broken[mask] = 65535
    found = detected(broken, mask=mask)
    assert nearest(found, stars)[0].max() < CLEAR_CENTROID_PX
    assert len(found) == 2
    assert flagged(found, 60, 60) == DetectionFlag.MASKED
    assert flagged(found, 150, 40) == DetectionFlag.NONE
    as_nan = np.where(mask, np.nan, image)
    assert_allclose(detected(as_nan).points_px, found.points_px, rtol=0, atol=OFFSET_PX)


def test_stars_on_the_border_are_kept_and_flagged() -> None:
    stars = np.array([[0.2, 50.0], [199.3, 120.4], [100.0, -0.3]])
    found = detected(exposed(star_image(stars, np.full(3, 9000.0), 0.8, (200, 200)), 3))
    error = np.abs(found.points_px[nearest(found, stars)[1]] - stars)
    assert error.max() < CLEAR_CENTROID_PX
    assert all(DetectionFlag.CUT_BY_FRAME in DetectionFlag(int(flags)) for flags in found.flags)


@pytest.mark.parametrize("measure", ["detected", "remeasured"])
def test_a_background_that_rises_across_the_image_moves_no_centroid(measure: str) -> None:
    sigma_px, shape = 1.5, (700, 700)
    points = spread_points(shape, 35, 31)
    light = star_image(points, np.full(len(points), flux_of_snr(30.0, sigma_px)), sigma_px, shape)
    image = exposed(light + RAMP_DN_PX * np.arange(shape[1]), 32)
    found = detected(image, psf_sigma_px=sigma_px)
    if measure == "remeasured":
        psf = estimate_psf(image, found.select(np.arange(30)), detector=DETECTOR)
        assert isinstance(psf, PsfEstimate)
        found = remeasure(image, found, psf, detector=DETECTOR)
    distance, index = nearest(found, points)
    assert distance.max() < 1.0
    error, covariance = found.points_px[index] - points, found.covariance_px2[index]
    standard_error = np.sqrt(np.einsum("nii->i", covariance)) / len(points)
    assert np.abs(error.mean(axis=0)).max() < BIAS_STANDARD_ERRORS * standard_error.max()
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    low, high = nees_band(len(points), 1.0 - FALSE_ALARM)
    assert low < squares.mean() < high


@settings(max_examples=15, deadline=None)
@given(offset_dn=st.integers(0, 20_000), flip=st.booleans())
def test_an_offset_changes_nothing_and_transposed_images_give_transposed_stars(offset_dn: int, flip: bool) -> None:
    points = spread_points((150, 170), 30, 21)
    image = exposed(star_image(points, np.full(len(points), 5000.0), 0.8, (150, 170)), 21)
    moved = (image.T if flip else image).astype(np.int32) + offset_dn
    here, there = detected(image), detected(moved)
    expected = here.points_px[:, ::-1] if flip else here.points_px
    distance, index = nearest(there, expected)
    assert distance.max() < OFFSET_PX
    assert_allclose(there.background_dn[index], here.background_dn + offset_dn, rtol=0, atol=0.1)


@pytest.mark.parametrize("dtype", ["u1", "i2", ">i2", "i4", "f4", ">f4", "f8"])
def test_any_real_dtype_gives_the_same_stars(dtype: str) -> None:
    points = spread_points((120, 120), 30, 22)
    image = exposed(star_image(points, np.full(len(points), 500.0), 0.8, (120, 120)), 22)
    reference = detected(image)
    assert len(reference) == len(points)
    assert_allclose(detected(image.astype(dtype)).points_px, reference.points_px, rtol=0, atol=OFFSET_PX)


def test_images_without_information_are_refused_with_a_reason() -> None:
    def reason(pixels: NDArray[Any], **settings_: Any) -> Reason:
        result = detect_sources(pixels, detector=dataclasses.replace(DETECTOR, saturation_dn=4095.0), **settings_)
        assert isinstance(result, Failure)
        assert result.detail
        return result.reason

    assert reason(np.zeros((50, 60), dtype=np.uint16)) is Reason.NO_SIGNAL
    assert reason(np.full((50, 60), 7.5)) is Reason.NO_SIGNAL
    assert reason(np.full((50, 60), np.nan)) is Reason.NO_SIGNAL
    assert reason(exposed(np.zeros((50, 60)), 1), mask=np.ones((50, 60), dtype=bool)) is Reason.NO_SIGNAL
    assert reason(np.full((50, 60), 4095, dtype=np.uint16)) is Reason.SATURATED
    half = np.full((50, 60), 255, dtype=np.uint8)
    half[:, :20] = 30
    assert reason(half) is Reason.SATURATED


def test_a_dark_sky_is_a_value_and_tiny_images_do_no_harm() -> None:
    for shape in ((64, 64), (8, 8), (3, 40), (1, 9)):
        found = detected(np.random.default_rng(0).integers(90, 110, shape))
        assert len(found) == 0
        assert found.points_px.shape == (0, 2)
        assert found.covariance_px2.shape == (0, 2, 2)
        assert found.clean.shape == (0,)
        assert found.noise_dn > 0


@pytest.mark.parametrize(
    ("pixels", "settings_"),
    [
        (np.zeros((4, 4, 3)), {}),
        (np.zeros(5), {}),
        (np.zeros((4, 4), dtype=complex), {}),
        (np.zeros((0, 4)), {}),
        (np.eye(8), {"mask": np.zeros((8, 7), dtype=bool)}),
        (np.eye(8), {"psf_sigma_px": -1.0}),
        (np.eye(8), {"psf_sigma_px": np.nan}),
    ],
)
def test_misuse_is_an_input_error(pixels: NDArray[Any], settings_: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        detect_sources(pixels, **{"detector": DETECTOR, **settings_})


@pytest.mark.parametrize(
    "options",
    [
        {"threshold_sigma": 0.0},
        {"max_sources": 0},
        {"min_area_px": 0},
        {"max_saturated_fraction": 0.0},
        {"searches": 0},
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        DetectionOptions(**options)


@pytest.mark.real_data
def test_lorri_centroids_agree_with_the_published_measurement(data_dir: Path) -> None:
    with (data_dir / "stars" / "lorri_measured.csv").open() as table:
        rows = list(csv.DictReader(table))
    for row in rows:
        with fits.open(data_dir / "stars" / row["file"]) as hdus:
            found = detected(hdus[0].data, psf_sigma_px=None)
        published = np.array([float(row["x_px"]), float(row["y_px"])])
        sigma = np.array([float(row["sigma_x_px"]), float(row["sigma_y_px"])])
        _, index = nearest(found, published[None])
        assert found.clean[index[0]]
        assert (np.abs(found.points_px[index[0]] - published) < PUBLISHED_SIGMAS * sigma).all(), row["file"]


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("folder", "share"),
    [("tetra3", 1.0), ("cedar", 0.8)],  # cedar: JPEG, a roof, a comet, and frames with 40 stars in all
)
def test_the_brightest_clean_detections_of_real_frames_are_catalog_stars(
    data_dir: Path, folder: str, share: float
) -> None:
    catalog = load_catalog("default")
    with (data_dir / "stars" / "reference.csv").open() as table:
        rows = [row for row in csv.DictReader(table) if row["ra_deg"] and row["file"].startswith(folder)]
    assert rows
    for row in rows:
        ra, dec, roll, fov = (float(row[key]) for key in ("ra_deg", "dec_deg", "roll_deg", "fov_x_deg"))
        pixels = cv2.imread(str(data_dir / "stars" / row["file"]), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        if pixels.ndim == 3:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        found = detected(pixels, psf_sigma_px=None)
        stars = found.select(found.clean)
        sky = catalog.cone(direction_from_radec(ra, dec), np.radians(0.75 * fov), max_magnitude=9.5)
        # The reference solver measures roll to the other end of the column.
        attitude = camera_from_inertial_of_pointing(ra, dec, roll + 180.0)
        los = rotate(attitude, direction_from_radec(sky.ra_deg, sky.dec_deg))
        rows_px, columns_px = pixels.shape
        focal_px = columns_px / 2.0 / np.tan(np.radians(fov) / 2.0)
        expected = focal_px * los[:, :2] / los[:, 2:] + [(columns_px - 1) / 2.0, (rows_px - 1) / 2.0]
        distance, _ = paired(expected, stars.points_px[:30])
        assert len(distance) == 30
        assert np.mean(distance < CATALOG_MATCH_PX) >= share, row["file"]


def test_a_second_search_finds_faint_sources_among_bright_ones() -> None:
    """40 stars of SNR 200 on 96 x 96 pixels raise the noise of their gaps, in which 12 sources of SNR 8 lie."""
    width, random = np.hypot(0.7, np.sqrt(1.0 / 12.0)), np.random.default_rng(5)
    bright = random.uniform(3.0, 92.0, (40, 2))
    gaps = random.uniform(6.0, 89.0, (400, 2))
    gaps = gaps[np.linalg.norm(gaps[:, None] - bright, axis=2).min(axis=1) > 4.0]
    faint = gaps[[k for k in range(len(gaps)) if np.all(np.linalg.norm(gaps[:k] - gaps[k], axis=1) > 8.0)]][:12]
    unit_dn = 2.0 * np.sqrt(np.pi) * width
    flux = np.repeat([200.0, 8.0], [len(bright), len(faint)]) * unit_dn
    light = draw_stars((96, 96), np.vstack([bright, faint]), flux, np.full(len(flux), 0.7))
    pixels = random.normal(100.0 + light, np.sqrt(1.0 + light / 50.0))
    found = [
        detect_sources(
            pixels,
            detector=Detector(gain_e_per_dn=50.0),
            psf_sigma_px=0.7,
            options=DetectionOptions(searches=searches),
        )
        for searches in (1, 2)
    ]
    near = [
        np.linalg.norm(one.points_px - faint[:, None], axis=2).min(axis=1) < 0.5
        for one in found
        if isinstance(one, Detections)
    ]
    assert np.count_nonzero(near[0]) <= len(faint) // 2
    assert np.count_nonzero(near[1]) >= len(faint) - 1
    extra = len(found[1].points_px) - len(bright) - len(faint)  # type: ignore[union-attr]
    assert extra <= 1  # wings of the bright ones are no sources
