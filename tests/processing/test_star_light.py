"""What a star explains of its pixels, and how long it is, against sums in numpy."""

from __future__ import annotations

import math

import numpy as np
from numpy.testing import assert_allclose
from scipy.special import erf

from giantlike.core.arrays import Float, Mask
from giantlike.processing.detection.gauss_newton import star_light, windowed_moments
from tests.tolerances import FLOAT64_SUM

N, SIZE, GAIN, MODEL_ERROR, RADIUS, SIGMA = 40, 9, 2.0, 0.08, 3.0, 0.8


def scene() -> tuple[Float, Mask, Mask, np.ndarray, Float]:
    rng = np.random.default_rng(7)
    values = rng.normal(100.0, 4.0, (N, SIZE, SIZE))
    valid, saturated = rng.random(values.shape) > 0.05, rng.random(values.shape) < 0.03
    corner = rng.integers(0, 500, (N, 2))
    points = corner + SIZE // 2 + rng.uniform(-0.7, 0.7, (N, 2))
    values += rng.uniform(0.0, 900.0, N)[:, None, None] * shares(corner, points)
    return values, valid, saturated, corner, points


def shares(corner: np.ndarray, points: Float) -> Float:
    edges = np.arange(SIZE + 1) - 0.5
    along = [
        np.diff(erf((corner[:, k, None] + edges - points[:, k, None]) / (math.sqrt(2) * SIGMA))) / 2 for k in (0, 1)
    ]
    return np.asarray(along[1][:, :, None] * along[0][:, None, :])


def offsets(corner: np.ndarray, points: Float) -> tuple[Float, Float]:
    steps = np.arange(SIZE)
    dx, dy = (corner[:, k, None] + steps - points[:, k, None] for k in (0, 1))
    return dx[:, None, :], dy[:, :, None]


def test_the_light_of_a_star_is_that_of_weighted_least_squares_in_its_core() -> None:
    values, valid, saturated, corner, points = scene()
    level, variance, widths = np.full(N, 100.0), np.full(N, 16.0), np.full(N, SIGMA)
    light, used, left = star_light(
        values, valid, saturated, variance, corner, points, widths, level, RADIUS, GAIN, MODEL_ERROR
    )
    dx, dy = offsets(corner, points)
    expected = (dx**2 + dy**2 <= RADIUS**2) & valid & ~saturated
    assert (used == expected).all()
    share, flux = shares(corner, points), np.zeros((N, 1, 1))
    for _ in range(2):
        weight = expected / (16.0 + flux * share / GAIN)
        above = (weight * share * (values - 100.0)).sum(axis=(1, 2), keepdims=True)
        flux = np.maximum(above / (weight * share**2).sum(axis=(1, 2), keepdims=True), 0.0)
    assert_allclose(light, flux * share, rtol=0, atol=FLOAT64_SUM)
    noise = 16.0 + light / GAIN + (MODEL_ERROR * light) ** 2
    chi2 = (expected * (values - 100.0 - light) ** 2 / noise).sum(axis=(1, 2))
    assert_allclose(left, chi2, rtol=1e-12, atol=0)


def test_the_moments_of_a_star_are_a_half_and_those_of_a_line_one_along_it() -> None:
    _, valid, _, corner, points = scene()
    dx, dy = offsets(corner, points)
    window = math.sqrt(SIGMA**2 + 1 / 12)
    star = 500.0 * shares(corner, points)
    line = 500.0 * np.exp(-0.5 * ((dx - dy) / (math.sqrt(2) * window)) ** 2)
    level = np.zeros(N)
    of_star = windowed_moments(star, valid, corner, points, level, window, SIGMA)
    assert_allclose(of_star, 0.5, rtol=0, atol=FLOAT64_SUM)
    whole = np.ones_like(valid)
    longest, shortest = windowed_moments(line, whole, corner, points, level, window, SIGMA).T
    assert_allclose(longest, 1.0, rtol=0, atol=0.02)
    assert_allclose(shortest, 0.5, rtol=0, atol=0.02)
