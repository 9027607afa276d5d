"""Streaked stars: middle, ends and length with honest covariances, and images that have none."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure
from giantlike.processing import DetectionFlag, DetectionOptions, Detections, detect_sources
from giantlike.processing.detection.patches import cut_patches
from giantlike.processing.detection.streak import StreakGuesses, fit_lines, line_shares
from tests.numerical import numerical_jacobian
from tests.processing.test_detection import (
    BIAS_STANDARD_ERRORS,
    DETECTOR,
    GAIN,
    NOISE_DN,
    RAMP_DN_PX,
    exposed,
    nearest,
    nees_band,
    spread_points,
    star_image,
)
from tests.tolerances import FALSE_ALARM

SIGMA_PX = 0.8
SUB_EXPOSURES = 60  # 0.2 px apart on the longest streak: four to the width of the PSF
DERIVATIVE = 1e-6
SHARE = 1e-5  # of the flux, against a sum of many points
LENGTH_PX = 0.5


def streaked_image(points_px: Float, flux_dn: Float, half_px: Float, shape: tuple[int, int]) -> Float:
    """Noise-free: many short exposures of a star that moves evenly, the sum of points."""
    steps = (np.arange(SUB_EXPOSURES) + 0.5) / SUB_EXPOSURES * 2.0 - 1.0
    return np.asarray(sum(star_image(points_px + t * half_px, flux_dn / SUB_EXPOSURES, SIGMA_PX, shape) for t in steps))


def found_in(image: NDArray[Any], **options: Any) -> Detections:
    result = detect_sources(image, detector=DETECTOR, psf_sigma_px=SIGMA_PX, options=DetectionOptions(**options))
    assert isinstance(result, Detections)
    return result


def test_a_line_is_the_sum_of_many_points() -> None:
    patches = cut_patches(np.zeros((31, 31)), None, np.array([[15, 15]]), 15, detector=Detector())
    half = np.array([[5.3, -3.1]])
    points = np.array([[15.2, 14.6]])
    shares, _ = line_shares(patches, points, half, SIGMA_PX)
    steps = (np.arange(2000) + 0.5) / 1000.0 - 1.0
    many = star_image(points + steps[:, None] * half, np.full(2000, 1.0 / 2000), SIGMA_PX, (31, 31))
    assert_allclose(shares[0], many, rtol=0, atol=SHARE)


def test_derivatives_of_a_line_are_those_of_its_pixels() -> None:
    patches = cut_patches(np.zeros((21, 21)), None, np.array([[10, 10]]), 10, detector=Detector())
    at = np.array([10.3, 9.8, 2.4, 1.7])

    def shares(p: Float) -> Float:
        return line_shares(patches, p[None, :2], p[None, 2:], SIGMA_PX)[0].ravel()

    _, derivatives = line_shares(patches, at[None, :2], at[None, 2:], SIGMA_PX)
    assert_allclose(derivatives[0].reshape(4, -1).T, numerical_jacobian(shares, at, 1e-5), rtol=0, atol=DERIVATIVE)


def test_middle_and_ends_of_streaks_have_honest_covariances() -> None:
    shape, half = (500, 500), np.array([4.0, -2.2])
    points = spread_points(shape, 40, 3)
    flux = np.full(len(points), 12_000.0)
    image = exposed(streaked_image(points, flux, half, shape), 4)
    n = len(points)
    detector = Detector(gain_e_per_dn=GAIN)
    patches = cut_patches(image, None, np.rint(points).astype(np.int64), 10, detector=detector, noise_dn=NOISE_DN)
    start = StreakGuesses(points + 0.3, np.tile(half * 0.8, (n, 1)), flux * 0.8, np.full(n, 100.0))
    fits = fit_lines(patches, start, SIGMA_PX)
    assert fits.converged.all()
    low, high = nees_band(n, 1.0 - FALSE_ALARM)
    error = fits.centers_px - points
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariance_px2[:, :2, :2]), error)
    assert low < squares.mean() < high
    truth = np.stack([points - half, points + half], axis=1)
    off = (fits.ends_px - truth).reshape(n, 4)
    ends_from_middle = np.kron(np.array([[1.0, -1.0], [1.0, 1.0]]), np.eye(2))
    covariance = ends_from_middle @ fits.covariance_px2 @ ends_from_middle.T
    both = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    assert chi2.ppf(FALSE_ALARM / 2, 4 * n) < both.sum() < chi2.ppf(1 - FALSE_ALARM / 2, 4 * n)
    length = (fits.lengths_px - 2.0 * np.hypot(*half)) / fits.length_sigma_px
    assert chi2.ppf(FALSE_ALARM / 2, n) < np.sum(length**2) < chi2.ppf(1 - FALSE_ALARM / 2, n)


def test_a_background_that_rises_across_the_image_moves_no_streak() -> None:
    shape, half = (700, 700), np.array([4.0, -2.2])
    points = spread_points(shape, 40, 3)
    n = len(points)
    light = streaked_image(points, np.full(n, 4000.0), half, shape)
    image = exposed(light + RAMP_DN_PX * np.arange(shape[1]), 4)
    patches = cut_patches(
        image, None, np.rint(points).astype(np.int64), 10, detector=Detector(gain_e_per_dn=GAIN), noise_dn=NOISE_DN
    )
    fits = fit_lines(
        patches, StreakGuesses(points, np.tile(half, (n, 1)), np.full(n, 4000.0), np.full(n, 100.0)), SIGMA_PX
    )
    error = (fits.centers_px - points)[fits.converged]
    assert np.abs(error.mean(axis=0) / error.std(axis=0) * np.sqrt(len(error))).max() < BIAS_STANDARD_ERRORS


@pytest.mark.parametrize("half", [(5.0, 3.0), (0.0, 6.0), (-2.2, 1.0)])
def test_streaks_common_to_an_image_are_recognized_and_their_middle_is_reported(half: tuple[float, float]) -> None:
    shape = (400, 400)
    points = spread_points(shape, 50, 8)
    flux = np.full(len(points), 15_000.0)
    image = exposed(streaked_image(points, flux, np.array(half), shape), 9).astype(np.int32)
    image[200, 25] += 3000  # a hot pixel
    found = found_in(image)
    stars = found.select(found.clean)
    distance, index = nearest(stars, points)
    assert distance.max() < 1.0
    assert len(stars) == len(points)
    assert all(DetectionFlag.STREAK in DetectionFlag(int(flags)) for flags in stars.flags)
    error = stars.points_px[index] - points
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(stars.covariance_px2[index]), error)
    low, high = nees_band(len(points), 1.0 - FALSE_ALARM)
    assert low < squares.mean() < high
    assert stars.halves_px is not None
    assert stars.half_sigma_px is not None
    length = 2.0 * np.hypot(*stars.halves_px.T)
    assert_allclose(np.median(length), 2.0 * np.hypot(*half), rtol=0, atol=LENGTH_PX)


def test_the_width_across_streaks_is_found_from_the_image() -> None:
    shape = (400, 400)
    points = spread_points(shape, 50, 8)
    image = exposed(streaked_image(points, np.full(len(points), 20_000.0), np.array([4.0, 3.0]), shape), 9)
    found = detect_sources(image, detector=DETECTOR)
    assert isinstance(found, Detections)
    assert found.clean.sum() == len(points)
    assert found.psf_sigma_px == pytest.approx(SIGMA_PX, abs=0.1)  # of eight widths tried, interpolated


def test_points_are_no_streaks_and_an_image_without_them_is_refused_where_they_were_promised() -> None:
    shape = (300, 300)
    points = spread_points(shape, 40, 5)
    image = exposed(star_image(points, np.full(len(points), 6000.0), SIGMA_PX, shape), 5)
    found = found_in(image)
    assert found.halves_px is None
    assert not any(DetectionFlag.STREAK in DetectionFlag(int(flags)) for flags in found.flags)
    refused = detect_sources(image, detector=DETECTOR, psf_sigma_px=SIGMA_PX, options=DetectionOptions(streak=True))
    assert isinstance(refused, Failure)
    assert "streak" in refused.detail


def test_tracks_in_all_directions_are_no_common_streak() -> None:
    rng = np.random.default_rng(2)
    image = exposed(np.zeros((300, 300)), 2).astype(np.int32)
    for _ in range(30):
        x, y, turn = rng.uniform(20, 280), rng.uniform(20, 280), rng.uniform(0, np.pi)
        for t in np.linspace(-5.0, 5.0, 40):
            image[round(y + t * np.sin(turn)), round(x + t * np.cos(turn))] += 100
    found = found_in(image)
    assert not any(DetectionFlag.STREAK in DetectionFlag(int(flags)) for flags in found.flags)


def test_a_line_fitted_to_a_body_stays_within_reach_of_its_patch() -> None:
    rows, columns = np.mgrid[:201, :201]
    bright_side = 3000.0 * (np.hypot(columns - 100.0, rows - 100.0) < 70.0) * np.exp((columns - 100.0) / 100.0)
    peaks = np.array([[100, 100], [140, 60], [140, 140], [165, 100], [40, 100]])
    half = 24
    patches = cut_patches(bright_side, None, peaks, half, detector=Detector(), noise_dn=5.0)
    halves, flux = np.tile([12.0, 3.0], (5, 1)), np.full(5, 1e5)
    start = StreakGuesses(centers_px=peaks.astype(float), halves_px=halves, flux_dn=flux, background_dn=np.zeros(5))
    fits = fit_lines(patches, start, SIGMA_PX)
    assert np.isfinite(fits.halves_px).all()
    assert (fits.lengths_px <= 4.0 * half).all()  # thousands of px, and minutes, before lengths were bounded


def test_detections_of_streaks_can_be_selected() -> None:
    shape = (300, 300)
    points = spread_points(shape, 50, 8)
    light = streaked_image(points, np.full(len(points), 15_000.0), np.array([5.0, 3.0]), shape)
    found = detect_sources(exposed(light, 1), detector=Detector(gain_e_per_dn=GAIN, saturation_dn=4000.0))
    assert isinstance(found, Detections)
    two = found.select(np.array([1, 0]))
    for field in dataclasses.fields(two):
        value = getattr(two, field.name)
        assert not isinstance(value, np.ndarray) or len(value) == 2
