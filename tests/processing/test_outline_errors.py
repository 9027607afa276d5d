"""Errors of points along an outline, against relief made by code that they do not share."""

from __future__ import annotations

import numpy as np
import pytest

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.independent import bumps
from giantlike.processing.correlated_fit import solution_gain
from giantlike.processing.outline_errors import OutlineErrors, averages, outline_errors
from tests.sizes import slow

RADIUS_PX = 60.0
NOISE_PX = 0.02
RELIEF_PX = 0.6
HONEST = (0.5, 2.0)  # squared errors per degree of freedom
BODIES, LIMBS_EACH = 12, 8
EXACT_SIGMA = 1.1  # sigmas of a body without relief over those of its noise


def limb(rng: np.random.Generator, arc_rad: float) -> tuple[Float, Float, Float]:
    """Directions (n, 3) of a limb of some length on a body, its points, px, and the design of shift and size."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    angles = np.arange(0.0, arc_rad, 1.5 / RADIUS_PX)
    points = RADIUS_PX * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return points @ axes[:2] / RADIUS_PX, points, np.column_stack([points / RADIUS_PX, np.ones(len(points))])


def fitted(shift: Float, points: Float, design: Float) -> tuple[Float, Float, OutlineErrors]:
    """Solution and its covariance."""
    sigma = np.full(len(points), NOISE_PX)
    errors = outline_errors(shift, design, sigma, points, radius=RADIUS_PX, least_length=1.5)
    own = errors.covariances(sigma, points)
    gain = solution_gain(design, own.for_weights)
    covariance = gain @ (own.noise + own.relief) @ gain.T
    return gain @ shift, covariance, errors


@pytest.mark.parametrize(
    ("arc_deg", "widths_deg"),
    [slow(360.0, (3.0, 15.0)), (360.0, (4.0, 8.0)), (180.0, (3.0, 15.0)), slow(180.0, (4.0, 8.0))],
)
def test_what_relief_that_nobody_declared_does_to_place_and_size_is_in_the_covariance(
    arc_deg: float, widths_deg: tuple[float, float]
) -> None:
    rng = np.random.default_rng(3)
    squared = []
    for number in range(BODIES):
        relief = bumps(number, rms=RELIEF_PX, widths_deg=widths_deg, count=150, cells=64)
        for _ in range(LIMBS_EACH):
            directions, points, design = limb(rng, np.radians(arc_deg))
            shift = relief(directions) + NOISE_PX * rng.normal(size=len(points))
            solution, covariance, _ = fitted(shift, points, design)
            squared.append(float(solution @ np.linalg.solve(covariance, solution)) / 3.0)
    assert HONEST[0] < np.mean(squared) < HONEST[1]


def test_relief_along_an_ellipse_has_no_negative_variance() -> None:
    """Its covariance is that of circles; positions of long bodies had parts that did not sum to their covariance."""
    relief = bumps(1, rms=RELIEF_PX, widths_deg=(15.0, 30.0), count=60, cells=64)
    directions, points, design = limb(np.random.default_rng(5), np.radians(360.0))
    points = points * [1.3, 0.7]
    sigma = np.full(len(points), NOISE_PX)
    errors = outline_errors(relief(directions), design, sigma, points, radius=RADIUS_PX, least_length=1.5)
    assert errors.relief_sigma > NOISE_PX
    assert np.linalg.eigvalsh(errors.covariances(sigma, points).relief)[0] > -1e-9 * RELIEF_PX**2


def test_a_body_without_relief_is_as_certain_as_its_noise_allows() -> None:
    rng = np.random.default_rng(4)
    squared, ratios = [], []
    for _ in range(60):
        _, points, design = limb(rng, np.pi)
        solution, covariance, errors = fitted(NOISE_PX * rng.normal(size=len(points)), points, design)
        squared.append(float(solution @ np.linalg.solve(covariance, solution)) / 3.0)
        noise = NOISE_PX**2 * np.linalg.inv(design.T @ design)
        ratios.append(float(np.sqrt(np.trace(covariance) / np.trace(noise))))
        assert errors.relief_sigma < NOISE_PX
    assert np.median(ratios) < EXACT_SIGMA
    assert HONEST[0] < np.mean(squared) < HONEST[1]


def test_bins_do_not_reach_over_a_gap() -> None:
    points = np.concatenate([np.arange(0.0, 60.0), np.arange(500.0, 560.0)])[:, None] * [1.0, 0.0]
    means = averages(points, np.ones(120))
    assert len(means) <= 26
    assert np.all((means[:, :60].sum(axis=1) == 0.0) | (means[:, 60:].sum(axis=1) == 0.0))
    assert np.allclose(means.sum(axis=1), 1.0, rtol=0.0, atol=1e-12)


def test_too_few_residuals_are_refused() -> None:
    with pytest.raises(InputError, match="over 4 residuals"):
        outline_errors(np.zeros(4), np.zeros((4, 3)), np.ones(4), np.zeros((4, 2)), radius=1.0, least_length=0.1)
