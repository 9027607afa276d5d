"""The field of markings against dense linear algebra on a few pixels."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from giantlike.core.arrays import Float
from giantlike.image_model.field import AMPLITUDES, FieldSums, MarkingModes, prior_of_amplitudes

ROUNDING = 1e-9
RADIUS_PX = 9.0


def a_disk(seed: int = 0) -> tuple[MarkingModes, Float, Float]:
    """Modes across a disk in a box of 24 x 26 pixels, their images (m, n), and weights (24, 26)."""
    y, x = np.mgrid[:24, :26]
    light = np.sqrt(np.clip(1.0 - ((x - 12.0) ** 2 + (y - 11.0) ** 2) / RADIUS_PX**2, 0.0, None))
    modes = MarkingModes.across(light, np.array([12.0, 11.0]), RADIUS_PX, modes=5)
    weights = np.random.default_rng(seed).uniform(0.5, 2.0, light.shape)
    return modes, modes.image(np.eye(modes.count)).reshape(modes.count, -1), weights


def sums_of(modes: MarkingModes, columns: Float, values: Float, weights: Float) -> FieldSums:
    shape = modes.light.shape
    weighted = (columns * weights.ravel()).reshape(-1, *shape)
    return FieldSums(
        gram=modes.gram(weights),
        cross=modes.products(weighted),
        scores=modes.products(weights * values.reshape(shape)),
        information=columns @ (columns * weights.ravel()).T,
        right=columns @ (weights.ravel() * values),
    )


def test_products_and_gram_are_the_sums_over_all_pixels() -> None:
    modes, images, weights = a_disk()
    values = np.random.default_rng(1).normal(size=weights.shape)
    assert_allclose(modes.products(values), images @ values.ravel(), rtol=0, atol=ROUNDING)
    assert_allclose(modes.gram(weights), (images * weights.ravel()) @ images.T, rtol=0, atol=ROUNDING)


def test_the_variances_of_the_modes_add_up_over_the_square() -> None:
    square = MarkingModes.across(np.ones((45, 45)), np.array([22.0, 22.0]), 18.0, modes=5)
    spectrum = square.spectrum(0.5)
    variance = spectrum @ square.image(np.eye(square.count)).reshape(square.count, -1) ** 2
    assert_allclose(variance.mean(), spectrum.sum(), rtol=0, atol=ROUNDING)
    assert spectrum[0] == 0.0  # what is the same everywhere is left to the brightness
    assert 0.5 < spectrum.sum() < 1.0


def test_the_columns_are_those_of_generalized_least_squares() -> None:
    modes, images, weights = a_disk()
    random = np.random.default_rng(2)
    columns, values = random.normal(size=(3, weights.size)), random.normal(size=weights.size)
    variances = 0.2**2 * modes.spectrum(0.5)
    solved = sums_of(modes, columns, values, weights).solve(variances)
    inverse = np.linalg.inv(np.diag(1.0 / weights.ravel()) + (images.T * variances) @ images)
    normal = columns @ inverse @ columns.T
    assert_allclose(solved.information, normal, rtol=0, atol=ROUNDING)
    assert_allclose(solved.right, columns @ inverse @ values, rtol=0, atol=ROUNDING)
    effective = columns - (images.T @ solved.steps).T  # scores by the field alone
    scores = effective * weights.ravel() @ images.T
    assert_allclose(solved.scatter, (scores * variances) @ scores.T, rtol=0, atol=ROUNDING)


def test_the_amplitude_is_averaged_by_the_likelihood_of_the_values() -> None:
    modes, images, weights = a_disk()
    weights = 400.0 * weights
    random = np.random.default_rng(3)
    spectrum = modes.spectrum(0.5)
    values = random.normal(size=weights.size) / np.sqrt(weights.ravel())
    values += (0.2 * np.sqrt(spectrum) * random.normal(size=modes.count)) @ images
    nothing = np.zeros((0, weights.size))
    found = sums_of(modes, nothing, values, weights).variances(spectrum[None])
    noise = np.diag(1.0 / weights.ravel())
    logs = [
        multivariate_normal.logpdf(values, cov=noise + amplitude**2 * (images.T * spectrum) @ images)
        for amplitude in AMPLITUDES
    ]
    chances = np.exp(np.array(logs) - max(logs)) * prior_of_amplitudes()
    expected = chances @ AMPLITUDES**2 / chances.sum()
    assert_allclose(found, expected * spectrum, rtol=1e-6, atol=0)


def test_values_without_markings_leave_next_to_none() -> None:
    modes, _, weights = a_disk()
    weights = 1e6 * weights
    values = np.random.default_rng(4).normal(size=weights.size) / np.sqrt(weights.ravel())
    column = modes.light.reshape(1, -1)
    spectra = np.stack([modes.spectrum(length) for length in (0.25, 0.5)])
    found = sums_of(modes, column, values + 3.0 * column[0], weights).variances(spectra)
    assert np.sqrt(found.sum()) < 2e-3
