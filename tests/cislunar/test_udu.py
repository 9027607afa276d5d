"""U D U^T operations beside the dense ones they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.cislunar import udu_factors
from giantlike.cislunar.udu import (
    UduFactors,
    considered_update,
    gauss_markov_step,
    gram_schmidt,
    plus_dyad,
    scalar_update,
)
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from tests.tolerances import FLOAT64_CHAIN

N = 7


def covariances(rng: np.random.Generator, *leading: int) -> Float:
    """Covariances of correlated states whose units differ by six orders."""
    scale = np.geomspace(1e-3, 1e3, N)
    roots = rng.normal(size=(*leading, N, N)) * scale[:, None]
    return np.asarray(roots @ np.swapaxes(roots, -1, -2))


def assert_same(ours: UduFactors | Float, dense: Float) -> None:
    """Compare covariances in units of their standard deviations."""
    composed = ours.composed() if isinstance(ours, UduFactors) else ours
    sigma = np.sqrt(np.diagonal(dense, axis1=-2, axis2=-1))
    scale = sigma[..., :, None] * sigma[..., None, :]
    assert_allclose(composed / scale, dense / scale, rtol=0.0, atol=FLOAT64_CHAIN)


def assert_triangular(factors: UduFactors) -> None:
    n = factors.upper.shape[-1]
    lower = np.tril(np.ones((n, n), dtype=bool), -1)
    assert not factors.upper[..., lower].any()
    assert (np.diagonal(factors.upper, axis1=-2, axis2=-1) == 1.0).all()
    assert (factors.diagonal >= 0.0).all()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(15)


def test_factors_compose_to_the_covariance(rng: np.random.Generator) -> None:
    dense = covariances(rng, 4)
    factors = udu_factors(dense)
    assert_triangular(factors)
    assert_same(factors, dense)
    assert_allclose(factors.sigmas(), np.sqrt(np.diagonal(dense, axis1=-2, axis2=-1)), rtol=FLOAT64_CHAIN)


def test_a_state_that_is_known_keeps_a_variance_of_zero(rng: np.random.Generator) -> None:
    dense = covariances(rng)
    dense[2] = dense[:, 2] = 0.0
    factors = gauss_markov_step(udu_factors(dense), 2, 0.5, 0.0)
    assert_triangular(factors)
    assert factors.sigmas()[2] == 0.0


def test_gram_schmidt_is_a_time_update(rng: np.random.Generator) -> None:
    dense, matrix, push = covariances(rng, 3), rng.normal(size=(3, N, N)), rng.normal(size=(3, N, 2))
    factors = udu_factors(dense)
    weights = np.concatenate([factors.diagonal, np.full((3, 2), 0.3)], axis=-1)
    updated = gram_schmidt(np.concatenate([matrix @ factors.upper, push], axis=-1), weights)
    assert_triangular(updated)
    transposed = np.swapaxes(matrix, -1, -2)
    assert_same(updated, matrix @ dense @ transposed + 0.3 * push @ np.swapaxes(push, -1, -2))


def test_a_dyad_is_added(rng: np.random.Generator) -> None:
    dense, vector = covariances(rng, 3), rng.normal(size=(3, N)) * np.geomspace(1e-2, 1e2, N)
    added = plus_dyad(udu_factors(dense), np.array([0.0, 0.5, 2.0]), vector)
    assert_triangular(added)
    weights = np.array([0.0, 0.5, 2.0])[:, None, None]
    assert_same(added, dense + weights * vector[:, :, None] * vector[:, None, :])


def test_a_dyad_fills_a_singular_covariance() -> None:
    added = plus_dyad(UduFactors(np.eye(3), np.zeros(3)), 2.0, np.array([1.0, 2.0, 3.0]))
    assert_allclose(added.composed(), 2.0 * np.outer([1, 2, 3], [1, 2, 3]), atol=FLOAT64_CHAIN)


@pytest.mark.parametrize("index", range(N))
def test_a_gauss_markov_step_changes_one_state(rng: np.random.Generator, index: int) -> None:
    dense = covariances(rng, 2)
    matrix, noise = np.eye(N), np.zeros((N, N))
    matrix[index, index], noise[index, index] = 0.8, 0.36 * dense[0, index, index]
    stepped = gauss_markov_step(udu_factors(dense), index, 0.8, noise[index, index])
    assert_triangular(stepped)
    assert_same(stepped, matrix @ dense @ matrix + noise)


def test_a_scalar_measurement_is_that_of_a_joseph_update(rng: np.random.Generator) -> None:
    dense, partials = covariances(rng, 3), rng.normal(size=(3, N))
    update = scalar_update(udu_factors(dense), partials, 0.7)
    assert_triangular(update.factors)
    variance = np.einsum("ki,kij,kj->k", partials, dense, partials) + 0.7
    gain = (dense @ partials[..., None])[..., 0] / variance[:, None]
    assert_allclose(update.variance, variance, rtol=FLOAT64_CHAIN)
    left = np.eye(N) - gain[:, :, None] * partials[:, None, :]
    joseph = left @ dense @ np.swapaxes(left, -1, -2) + 0.7 * gain[:, :, None] * gain[:, None, :]
    assert_same(update.factors, joseph)
    assert_allclose(update.gain / gain, 1.0, atol=FLOAT64_CHAIN)


def test_considered_states_keep_mean_and_variance(rng: np.random.Generator) -> None:
    dense, partials = covariances(rng), rng.normal(size=N)
    considered = np.arange(N) >= 4
    update = considered_update(scalar_update(udu_factors(dense), partials, 0.7), considered)
    variance = partials @ dense @ partials + 0.7
    gain = np.where(considered, 0.0, dense @ partials / variance)
    left = np.eye(N) - np.outer(gain, partials)
    assert_same(update.factors, left @ dense @ left.T + 0.7 * np.outer(gain, gain))
    assert not update.gain[considered].any()
    assert_allclose(update.factors.sigmas()[considered] ** 2, np.diag(dense)[considered], rtol=FLOAT64_CHAIN)


def test_factors_stay_positive_where_the_short_covariance_update_does_not() -> None:
    """A vague prior and two precise measurements of almost one direction: the textbook loss of all digits."""
    small = 1e-9
    short = np.eye(2) / small**2
    factors = udu_factors(short)
    for partials in (np.array([1.0, small]), np.array([1.0, 1.0])):
        factors = scalar_update(factors, partials, 1.0).factors
        gain = short @ partials / (partials @ short @ partials + 1.0)
        short = (np.eye(2) - np.outer(gain, partials)) @ short
    assert_allclose(factors.sigmas(), [1.0, np.sqrt(2.0)], rtol=1e-6)  # by hand, for small -> 0
    assert np.diag(short).min() <= 0.0


@pytest.mark.parametrize(
    "call", [lambda f: scalar_update(f, np.ones(2), 0.0), lambda f: plus_dyad(f, -1.0, np.ones(2))]
)
def test_what_would_lose_the_diagonal_is_refused(call: object) -> None:
    assert callable(call)
    with pytest.raises(InputError, match=r"positive|>= 0"):
        call(udu_factors(np.eye(2)))
