"""The point spread function from the stars of an image: truth, standard errors, variation over the field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.stats import chi2, multivariate_normal

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing import Detections
from giantlike.processing.psf.empirical import empirical_psf
from giantlike.processing.psf.estimate import PsfEstimate, estimate_psf, remeasure
from giantlike.processing.psf.profile import PsfKind, shape_shares
from tests.processing.test_detection import (
    DETECTOR,
    SKY_DN,
    detected,
    exposed,
    flux_of_snr,
    nearest,
    nees_band,
    spread_points,
    star_image,
)
from tests.tolerances import FALSE_ALARM

SHAPE = (500, 500)
SIGMA_PX = 0.9
SHARE = 1e-5
ERROR_SIGMAS = 5.0
OVERSAMPLED = 9  # midpoints a pixel: the truth is a plain sum, the estimator's is Gauss-Legendre


def moffat(dx: Float, dy: Float, hwhm_px: float, beta: float) -> Float:
    """Round Moffat function of unit sum, by its half width at half maximum."""
    alpha2 = hwhm_px**2 / (2.0 ** (1.0 / beta) - 1.0)
    return np.asarray((beta - 1.0) / (np.pi * alpha2) * (1.0 + (dx**2 + dy**2) / alpha2) ** -beta)


def drawn(
    points_px: Float, flux_dn: Float, profile: Callable[[Float, Float, float, float], Float], half: int = 20
) -> Float:
    """Image of stars of any profile, a plain sum over sub-pixels."""
    image = np.zeros(SHAPE)
    steps = (np.arange((2 * half + 1) * OVERSAMPLED) + 0.5) / OVERSAMPLED - 0.5 - half
    for (x, y), flux in zip(points_px, flux_dn, strict=True):
        column, row = round(x), round(y)
        dx, dy = steps[None, :] + column - x, steps[:, None] + row - y
        fine = profile(dx, dy, x, y)
        cell = fine.reshape(2 * half + 1, OVERSAMPLED, 2 * half + 1, OVERSAMPLED).mean(axis=(1, 3))
        top, left = row - half, column - half
        inside = image[max(top, 0) : row + half + 1, max(left, 0) : column + half + 1]
        inside += flux * cell[max(-top, 0) :, max(-left, 0) :][: inside.shape[0], : inside.shape[1]]
    return image


def estimated(image: NDArray[Any], found: Detections, **options: Any) -> PsfEstimate:
    result = estimate_psf(image, found, detector=DETECTOR, **options)
    assert isinstance(result, PsfEstimate)
    return result


def test_shares_of_the_family_are_those_of_a_normal_distribution_and_of_a_moffat_function() -> None:
    corner, point = np.array([[0, 0]]), np.array([[10.2, 9.7]])
    shape = np.array([[np.log(0.9), 0.2, -0.1, 0.0]])
    covariance = 0.81 * np.array([[1.2, -0.1], [-0.1, 0.8]])
    fine = (np.arange(21 * 9) + 0.5) / 9 - 0.5
    grid = np.stack(np.meshgrid(fine, fine), axis=-1)
    normal = multivariate_normal(point[0], covariance).pdf(grid).reshape(21, 9, 21, 9).mean(axis=(1, 3))
    assert_allclose(shape_shares(corner, 21, point, shape)[0], normal, rtol=0, atol=2e-4)  # of the plain sum
    wings = np.array([[np.log(0.9), 0.0, 0.0, 0.4]])
    expected = moffat(grid[..., 0] - 10.2, grid[..., 1] - 9.7, 0.9 * np.sqrt(2 * np.log(2)), 2.5)
    expected = expected.reshape(21, 9, 21, 9).mean(axis=(1, 3))
    assert_allclose(shape_shares(corner, 21, point, wings)[0], expected, rtol=0, atol=3e-4)


def test_the_width_of_round_stars_is_found_with_its_standard_error() -> None:
    points = spread_points(SHAPE, 50, 3)
    flux = np.full(len(points), flux_of_snr(80.0, SIGMA_PX))
    squares = []
    for seed in range(4):
        image = exposed(star_image(points, flux, SIGMA_PX, SHAPE), seed)
        psf = estimated(image, detected(image, psf_sigma_px=SIGMA_PX))
        squares.append(((psf.sigma_px - SIGMA_PX) / psf.sigma_error_px) ** 2)
        assert psf.n_used >= 0.9 * len(points)
        assert psf.reduced_chi2 == pytest.approx(1.0, abs=0.1)
        assert psf.residual_power < 0.01
    assert sum(squares) < chi2.ppf(1 - FALSE_ALARM, 4)


def test_elongated_stars_give_their_ellipse() -> None:
    covariance = 0.9**2 * np.array([[1.3, 0.2], [0.2, 0.7]])
    inverse = np.linalg.inv(covariance)
    scale = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))

    def profile(dx: Float, dy: Float, x: float, y: float) -> Float:
        q = inverse[0, 0] * dx**2 + inverse[1, 1] * dy**2 + 2.0 * inverse[0, 1] * dx * dy
        return np.asarray(scale * np.exp(-0.5 * q))

    points = spread_points(SHAPE, 60, 4)
    image = exposed(drawn(points, np.full(len(points), 20_000.0), profile, half=8), 4)
    psf = estimated(image, detected(image, psf_sigma_px=SIGMA_PX), kind=PsfKind.ELONGATED)
    truth = np.array([np.log(0.9), 0.3, 0.2])
    error = psf.coefficients[:, 0] - truth
    assert error @ np.linalg.inv(psf.covariance) @ error < chi2.ppf(1 - FALSE_ALARM, 3)
    round_one = estimated(image, detected(image, psf_sigma_px=SIGMA_PX))
    assert round_one.reduced_chi2 > 2.0 * psf.reduced_chi2


def test_wings_are_found_and_centroids_with_them_have_honest_covariances() -> None:
    hwhm, beta = 0.9 * np.sqrt(2.0 * np.log(2.0)), 3.0

    def profile(dx: Float, dy: Float, x: float, y: float) -> Float:
        return moffat(dx, dy, hwhm, beta)

    points = spread_points(SHAPE, 60, 5)
    image = exposed(drawn(points, np.full(len(points), 20_000.0), profile), 5)
    found = detected(image, psf_sigma_px=None)
    psf = estimated(image, found, kind=PsfKind.MOFFAT)
    assert psf.coefficients[3, 0] == pytest.approx(1.0 / beta, abs=0.05)  # light beyond the patches counts as level
    assert psf.sigma_px == pytest.approx(0.9, rel=0.03)
    assert psf.residual_power < estimated(image, found).residual_power
    again = remeasure(image, found, psf, detector=DETECTOR)
    distance, index = nearest(again, points)
    assert distance.max() < 1.0
    error = again.points_px[index] - points
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(again.covariance_px2[index]), error)
    low, high = nees_band(len(points), 1.0 - FALSE_ALARM)
    assert low < squares.mean() < high


@pytest.mark.parametrize("sigma_px", [0.7, 1.2])
def test_stars_without_wings_are_given_none(sigma_px: float) -> None:
    points = spread_points(SHAPE, 50, 8)
    flux = np.full(len(points), flux_of_snr(80.0, sigma_px))
    image = exposed(star_image(points, flux, sigma_px, SHAPE), 8)
    psf = estimated(image, detected(image, psf_sigma_px=None), kind=PsfKind.MOFFAT)
    sigma_of_wings = np.sqrt(psf.covariance[3, 3])
    assert abs(psf.coefficients[3, 0]) < ERROR_SIGMAS * sigma_of_wings
    assert sigma_of_wings < 0.05
    assert abs(psf.sigma_px - sigma_px) < ERROR_SIGMAS * psf.sigma_error_px


def test_a_width_that_varies_over_the_field_is_followed() -> None:
    def sigma(x: float, y: float) -> float:
        return float(0.8 + 0.3 * ((x - 249.5) / 249.5) ** 2 + 0.1 * (y - 249.5) / 249.5)

    def profile(dx: Float, dy: Float, x: float, y: float) -> Float:
        width = sigma(x, y)
        return np.asarray(np.exp(-0.5 * (dx**2 + dy**2) / width**2) / (2.0 * np.pi * width**2))

    points = spread_points(SHAPE, 50, 6)
    image = exposed(drawn(points, np.full(len(points), 30_000.0), profile, half=8), 6)
    psf = estimated(image, detected(image, psf_sigma_px=None), degree=2)
    places = np.array([[250.0, 250.0], [50.0, 250.0], [450.0, 400.0]])
    expected = [sigma(*place) for place in places]
    # A quadratic in ln sigma is not one in sigma: good to a percent.
    assert_allclose(np.exp(psf.shapes_at(places)[:, 0]), expected, rtol=0, atol=0.03)
    flat = estimated(image, detected(image, psf_sigma_px=None))
    assert psf.reduced_chi2 < flat.reduced_chi2


def test_the_empirical_function_follows_what_the_analytic_shape_misses() -> None:
    def profile(dx: Float, dy: Float, x: float, y: float) -> Float:
        core = np.exp(-0.5 * (dx**2 + dy**2) / 0.8**2) / (2.0 * np.pi * 0.8**2)
        ring = np.exp(-0.5 * (np.hypot(dx, dy) - 2.5) ** 2 / 0.5**2) / 19.69  # 2 pi 2.5 sqrt(2 pi) 0.5
        return np.asarray(0.9 * core + 0.1 * ring)

    points = spread_points(SHAPE, 40, 7)
    image = exposed(drawn(points, np.full(len(points), 60_000.0), profile, half=10), 7)
    found = detected(image, psf_sigma_px=None)
    psf = estimated(image, found)
    again = remeasure(image, found, psf, detector=DETECTOR)
    empirical = empirical_psf(image, again, psf, detector=DETECTOR)
    assert empirical.n_used >= 0.9 * len(points)
    fine = (np.arange(9 * 9) + 0.5) / 9 - 4.5
    away = np.stack(np.meshgrid(np.arange(-4.0, 5.0), np.arange(-4.0, 5.0)), axis=-1)
    truth = profile(fine[None, :], fine[:, None], 0.0, 0.0).reshape(9, 9, 9, 9).mean(axis=(1, 3))
    analytic = shape_shares(np.array([[0, 0]]), 9, np.array([[4.0, 4.0]]), psf.shapes_at([[250.0, 250.0]]))[0]
    scale = float(np.sum(again.flux_dn) / (60_000.0 * len(again)))  # the flux is that under the analytic shape
    better, worse = empirical.shares_at(away) * scale - truth, analytic * scale - truth
    assert np.sqrt(np.mean(better**2)) < 0.4 * np.sqrt(np.mean(worse**2))
    assert empirical.shares_at([9.0, 0.0]) == 0.0
    with pytest.raises(InputError):
        empirical_psf(image, again, psf, detector=DETECTOR, oversampling=0)


def test_too_few_stars_and_misuse_are_said() -> None:
    image = exposed(star_image(np.array([[30.0, 30.0]]), np.array([9000.0]), 0.8, (60, 60)), 1)
    found = detected(image)
    result = estimate_psf(image, found, detector=DETECTOR)
    assert isinstance(result, Failure)
    assert result.reason is Reason.TOO_FEW_DETECTIONS
    with pytest.raises(InputError, match="degree"):
        estimate_psf(image, found, detector=DETECTOR, degree=7)
    with pytest.raises(InputError, match="mask"):
        estimate_psf(image, found, detector=DETECTOR, mask=np.zeros((3, 3), dtype=bool))


def test_no_stars_stay_no_stars() -> None:
    image = np.full((50, 50), SKY_DN) + np.random.default_rng(1).normal(0.0, 3.0, (50, 50))
    found = detected(image)
    points = spread_points(SHAPE, 60, 5)
    bright = exposed(star_image(points, np.full(len(points), 9000.0), 0.8, SHAPE), 5)
    psf = estimated(bright, detected(bright))
    assert len(remeasure(image, found.select(np.zeros(len(found), dtype=bool)), psf, detector=DETECTOR)) == 0
