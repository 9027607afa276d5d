"""An effect that is averaged over on and off: exact models stay as they are, and one that shows is estimated."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.image_model.columns import Prior, when_seen
from giantlike.image_model.optics import ovality

PRIOR = Prior.of_sigmas([10.0, 0.5], np.array([0.0, 0.2]))
DESIGN = np.stack([np.ones(50), np.linspace(-1.0, 2.0, 50)], axis=1)
SIGMA = 0.05


def posterior(data: Float) -> tuple[Float, Float]:
    information = DESIGN.T @ DESIGN / SIGMA**2 + np.diag(PRIOR.information)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return covariance @ (DESIGN.T @ data / SIGMA**2 + PRIOR.information * PRIOR.mean), covariance


def averaged(slope: float, seed: int) -> tuple[Float, Float]:
    noise = np.random.default_rng(seed).normal(scale=SIGMA, size=50)
    return when_seen(*posterior(DESIGN @ [1.0, slope] + noise), slice(1, 2), PRIOR)


def test_the_odds_are_those_of_the_two_marginal_likelihoods() -> None:
    data = DESIGN @ [1.0, 0.22] + np.random.default_rng(1).normal(scale=SIGMA, size=50)

    def log_likelihood(slope_sigma: float) -> float:
        variances = np.diag([10.0**2, slope_sigma**2])
        covariance = DESIGN @ variances @ DESIGN.T + SIGMA**2 * np.eye(50)
        off = data - DESIGN @ PRIOR.mean
        return float(-0.5 * off @ np.linalg.solve(covariance, off) - 0.5 * np.linalg.slogdet(covariance)[1])

    odds = 0.1 / 0.9 * np.exp(log_likelihood(0.5) - log_likelihood(0.0))
    values, _ = when_seen(*posterior(data), slice(1, 2), PRIOR)
    free, _ = posterior(data)
    assert_allclose((values[1] - 0.2) / (free[1] - 0.2), odds / (1.0 + odds), rtol=1e-6)


def test_an_absent_effect_costs_a_tenth_of_what_an_evident_one_does() -> None:
    """Variance of the mean in units of that without the effect."""
    without = 1.0 / (50.0 / SIGMA**2 + PRIOR.information[0])
    absent, evident = (
        float(np.median([averaged(slope, seed)[1][0, 0] / without for seed in range(40)])) for slope in (0.2, 1.0)
    )
    assert_allclose(evident, posterior(np.zeros(50))[1][0, 0] / without, rtol=1e-6)
    assert 0.0 < absent - 1.0 < 0.1 * (evident - 1.0)


def test_errors_of_averages_are_as_large_as_stated() -> None:
    squares = []
    for slope in (0.2, 0.25, 0.3, 0.6):
        for seed in range(100):
            values, covariance = averaged(slope, seed)
            off = values - [1.0, slope]
            squares.append(float(off @ np.linalg.solve(covariance, off)) / 2.0)
    assert 0.5 < float(np.mean(squares)) < 1.3


def test_ovality_is_the_derivative_of_the_variance_along_normals() -> None:
    angles = np.linspace(0.0, 6.0, 13)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    round_px2, excess, covariance = 0.5, 0.1, -0.05
    matrix = np.array([[round_px2 + excess, covariance], [covariance, round_px2 - excess]])
    along = np.einsum("ni,ij,nj->n", normals, matrix, normals)
    assert_allclose(along, round_px2 + np.array([excess, covariance]) @ ovality(normals), rtol=1e-12)
