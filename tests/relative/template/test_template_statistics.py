"""Covariances of a photometric fit: errors of the model of stated size, against draws of such errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from giantlike.core.causes import Cause
from giantlike.core.statistics import excess
from giantlike.image_model.columns import Block, Columns, Prior
from giantlike.image_model.field import MarkingModes
from giantlike.relative.template.covariance import LinearFit
from tests.tolerances import FLOAT64

SHAPE = (40, 44)
DRAWS = 600
SCATTER = 6.0 / np.sqrt(DRAWS)  # of a sample variance over its mean: six of its standard deviations
GRID = 0.05  # of a variance: a field that is filtered on pixels is a little wider correlated than stated


def test_the_covariance_of_a_stated_error_is_that_of_drawn_fields() -> None:
    """Fields of unit variance with the stated correlation, times the error, through the linear fit."""
    random, length_px = np.random.default_rng(3), 3.0
    rows, columns = np.indices(SHAPE) / 20.0 - 1.0
    design = np.stack([np.ones(SHAPE), rows, columns, rows * columns])
    weights = 1.0 + 0.5 * columns
    error = np.exp(-(rows**2) / 0.3) * np.sign(columns)
    prior = Prior(np.zeros(4), np.array([0.0, 0.0, 0.0, 50.0]))
    block = Block(effect="plane", cause=Cause.BACKGROUND, matrix=design, prior=prior)
    fit = LinearFit(Columns.from_blocks([block], np.zeros(SHAPE), weights), np.zeros(4))
    stated = fit.error_covariance(error, length_px=length_px)

    flat = design.reshape(4, -1)
    inverse = np.linalg.inv((flat * weights.ravel()) @ flat.T + np.diag(prior.information))
    moved = []
    for _ in range(DRAWS):
        white = random.normal(size=(SHAPE[0] + 40, SHAPE[1] + 40))
        field = gaussian_filter(white, length_px / np.sqrt(2.0))[20:-20, 20:-20]
        field *= np.sqrt(2.0 * np.pi) * length_px  # of unit variance
        moved.append(inverse @ flat @ (weights * error * field).ravel())
    root_inverse = np.linalg.inv(np.linalg.cholesky(stated))
    whitened = root_inverse @ np.cov(np.array(moved).T) @ root_inverse.T
    assert_allclose(np.linalg.eigvalsh(whitened), 1.0, rtol=0, atol=SCATTER + GRID)


def test_the_larger_of_two_covariances_is_below_neither() -> None:
    random = np.random.default_rng(4)
    for _ in range(20):
        first, second = (root @ root.T for root in random.normal(size=(2, 3, 3)))
        both = first + excess(first, second)
        for one in (first, second):
            assert np.linalg.eigvalsh(both - one).min() > -1e-9 * np.trace(both)
    assert_allclose(excess(first, 0.5 * first), 0.0, rtol=0, atol=FLOAT64 * np.trace(first))


def test_parameters_and_markings_absorb_the_squares_that_drawn_errors_lose() -> None:
    """Errors of a thin edge that are correlated over a good part of the body."""
    random, length_px, radius_px = np.random.default_rng(5), 6.0, 16.0
    rows, columns = np.indices(SHAPE, dtype=np.float64) - 20.0
    distance = np.hypot(rows, columns)
    light = np.clip(radius_px + 0.5 - distance, 0.0, 1.0)
    layout = Block(effect="gain", cause=Cause.REFLECTANCE, matrix=light[None], prior=Prior.of_sigmas([np.inf]))
    block, weights = Columns.from_blocks([layout], light, np.ones(SHAPE)), np.full(SHAPE, 400.0)
    modes = MarkingModes.across(light, np.array([20.0, 20.0]), radius_px)
    problem = Columns(block.layout, light[None], block.prior, light, weights, modes, 0.01 * modes.spectrum(0.5))
    error = 0.01 * (np.abs(distance - radius_px) < 1.0)
    _, stated = LinearFit(problem, np.ones(1)).absorb(error, length_px)

    absorbed = []
    for _ in range(DRAWS):
        field = gaussian_filter(random.normal(size=(SHAPE[0] + 80, SHAPE[1] + 80)), length_px)[40:-40, 40:-40]
        drawn = np.sqrt(error) * field * np.sqrt(4.0 * np.pi) * length_px
        solved = replace(problem, data=drawn).solve()
        assert solved is not None
        absorbed.append(float(np.vdot(weights * drawn, solved.model)))
    scatter = float(np.std(absorbed)) / np.sqrt(DRAWS)
    assert_allclose(stated, np.mean(absorbed), rtol=GRID, atol=3.0 * scatter)
