"""Ellipses through points: exact, unbiased where least squares is not, and as uncertain as they say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.geometry.conic_fit import ConicFit, conic_matrix, ellipse_of, fit_ellipse
from tests.tolerances import FLOAT64_ROOT, RARE, SETTLED

STEP = 1e-6  # of central differences, in standard deviations of the coefficients
ELLIPSE = np.array([512.0, 380.0, 150.0, 120.0, 0.6])


def on_ellipse(ellipse: Float, turn: Float) -> Float:
    x, y, major, minor, angle = ellipse
    along, across = major * np.cos(turn), minor * np.sin(turn)
    return np.stack(
        [x + np.cos(angle) * along - np.sin(angle) * across, y + np.sin(angle) * along + np.cos(angle) * across],
        axis=-1,
    )


def fitted(points: Float, sigma: float = 1.0) -> ConicFit:
    fit = fit_ellipse(points, sigma=sigma)
    assert isinstance(fit, ConicFit), fit
    return fit


def ellipse_covariance(fit: ConicFit) -> Float:
    """Covariance (5, 5) of ``fit.ellipse``, by differences along the axes of the covariance of the coefficients."""
    values, vectors = np.linalg.eigh(fit.covariance)
    sides = []
    for step in (np.sqrt(np.maximum(values, 0.0)) * vectors).T * STEP:
        change = ellipse_of(fit.coefficients + step) - ellipse_of(fit.coefficients - step)
        change[4] = (change[4] + 0.5 * np.pi) % np.pi - 0.5 * np.pi
        sides.append(change / (2.0 * STEP))
    return np.array(sides).T @ np.array(sides)


@pytest.mark.parametrize("arc", [0.8, np.pi, 2 * np.pi])
@pytest.mark.parametrize("place", [(0.0, 0.0), (512.0, -3800.0)])
def test_points_on_an_ellipse_give_that_ellipse(arc: float, place: tuple[float, float]) -> None:
    ellipse = np.array([*place, 150.0, 120.0, 2.2])
    fit = fitted(on_ellipse(ellipse, np.linspace(0.3, 0.3 + arc, 40)))
    assert_allclose(fit.ellipse[:4], ellipse[:4], rtol=0, atol=150.0 * FLOAT64_ROOT / min(arc, 1.0) ** 4)
    assert_allclose(fit.ellipse[4], 2.2, rtol=0, atol=SETTLED / min(arc, 1.0) ** 4)
    assert np.abs(fit.residuals).max() < 150.0 * FLOAT64_ROOT
    inside = np.array([*ellipse[:2], 1.0])
    assert inside @ conic_matrix(fit.coefficients) @ inside > 0


@pytest.mark.monte_carlo(few=60, full=400)
def test_half_an_ellipse_in_noise_is_unbiased_and_as_uncertain_as_it_says(draws: int) -> None:
    rng, sigma = np.random.default_rng(4), 0.6
    turn = np.linspace(0.0, np.pi, 60)
    truth = on_ellipse(ELLIPSE, turn)
    found, nees = [], []
    for _ in range(draws):
        noisy = truth + sigma * rng.normal(size=truth.shape)
        fit = fitted(noisy, sigma)
        error = fit.ellipse - ELLIPSE
        error[4] = (error[4] + np.pi / 2) % np.pi - np.pi / 2
        found.append(error)
        nees.append(float(error @ np.linalg.solve(ellipse_covariance(fit), error)))
    errors = np.array(found)
    standard = errors.std(axis=0) / np.sqrt(draws)
    assert np.all(np.abs(errors.mean(axis=0)) < 5.0 * standard)
    low, high = (float(chi2.ppf(chance, 5 * draws)) / draws for chance in (RARE, 1.0 - RARE))
    assert 0.95 * low < np.mean(nees) < 1.1 * high  # covariances to first order


def test_short_noisy_arcs_are_not_pulled_small_as_least_squares_pulls_them() -> None:
    rng, sigma, draws, found, plain = np.random.default_rng(1), 1.0, 120, [], []
    truth = on_ellipse(ELLIPSE, np.linspace(0.0, 2.0, 300))
    for _ in range(draws):
        noisy = truth + sigma * rng.normal(size=truth.shape)
        found.append(fitted(noisy, sigma).ellipse[3] - ELLIPSE[3])
        plain.append(least_squares_minor(noisy) - ELLIPSE[3])
    standard = float(np.std(found)) / np.sqrt(draws)
    assert np.mean(plain) < -12.0 * standard
    assert abs(np.mean(found)) < 5.0 * standard


def least_squares_minor(points: Float) -> float:
    """Semi-minor axis by the eigenvector of the least eigenvalue, coordinates normalized."""
    middle, scale = points.mean(axis=0), points.std()
    x, y = ((points - middle) / scale).T
    design = np.stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones_like(x)], axis=-1)
    theta = np.linalg.svd(design)[2][-1]
    return float(ellipse_of(theta)[3]) * float(scale)


def test_weights_let_good_points_rule() -> None:
    rng = np.random.default_rng(5)
    truth = on_ellipse(ELLIPSE, np.linspace(0.0, 5.0, 80))
    sigma = np.where(np.arange(80) % 2 == 0, 0.02, 3.0)
    fit = fit_ellipse(truth + sigma[:, None] * rng.normal(size=truth.shape), sigma=sigma)
    assert isinstance(fit, ConicFit)
    assert np.sqrt(np.diag(ellipse_covariance(fit))[:4]).max() < 0.03
    error = fit.ellipse - ELLIPSE
    assert error @ np.linalg.solve(ellipse_covariance(fit), error) < float(chi2.ppf(1.0 - RARE, 5))


def mean_radius(fit: ConicFit) -> tuple[float, float]:
    """Radius of the circle of the same area, and its standard deviation."""
    radius = float(np.sqrt(fit.ellipse[2] * fit.ellipse[3]))
    by_ellipse = np.array([0.0, 0.0, radius / fit.ellipse[2], radius / fit.ellipse[3], 0.0]) / 2.0
    return radius, float(np.sqrt(by_ellipse @ ellipse_covariance(fit) @ by_ellipse))


def test_the_mean_radius_of_a_circle_is_certain_where_its_axes_are_alike() -> None:
    rng, sigma = np.random.default_rng(6), 0.3
    circle = np.array([10.0, 20.0, 100.0, 100.0, 0.0])
    errors = []
    for _ in range(100):
        truth = on_ellipse(circle, np.linspace(0.0, 2 * np.pi, 100, endpoint=False))
        fit = fitted(truth + sigma * rng.normal(size=truth.shape), sigma)
        radius, sigma_radius = mean_radius(fit)
        errors.append((radius - 100.0) / sigma_radius)
    assert_allclose(sigma_radius, sigma / np.sqrt(100), rtol=0.05)
    assert np.mean(np.square(errors)) < float(chi2.ppf(1.0 - RARE, 100)) / 100


def test_what_is_no_ellipse_is_refused() -> None:
    turn = np.linspace(-1.0, 1.0, 30)
    few = fit_ellipse(on_ellipse(ELLIPSE, turn[:5]))
    line = fit_ellipse(np.stack([turn, 2.0 * turn], axis=-1))
    branch = fit_ellipse(np.stack([np.cosh(2 * turn), np.sinh(2 * turn)], axis=-1))
    for failure, reason in (
        (few, Reason.TOO_FEW_DETECTIONS),
        (line, Reason.DEGENERATE_GEOMETRY),
        (branch, Reason.DEGENERATE_GEOMETRY),
    ):
        assert isinstance(failure, Failure)
        assert failure.reason is reason
    with pytest.raises(InputError, match="finite"):
        fit_ellipse(np.full((9, 2), np.nan))
    with pytest.raises(InputError, match="sigma"):
        fit_ellipse(on_ellipse(ELLIPSE, turn), sigma=0.0)
