"""The filter of 21 states: beside dense filters, and consistent with errors of an independent truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.cislunar import (
    BodyObservation,
    FilterModel,
    FilterState,
    estimate_batch,
    measurement_update,
    time_update,
    udu_factors,
)
from giantlike.cislunar.filter import coast, maneuver, predict_measurement, step_ends
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.independent.flight import apply_burn
from tests.cislunar.cislunar_case import (
    MODEL,
    START,
    START_ET,
    START_SIGMAS,
    day_of_images,
    flown,
    measured,
    planned,
    started,
)
from tests.numerical import numerical_jacobian
from tests.sizes import slow
from tests.tolerances import FLOAT64, FLOAT64_SUM, RARE


def chi2_band(degrees: int) -> tuple[float, float]:
    """Bounds that a sum of squares leaves once in a million times."""
    return float(chi2.ppf(RARE / 2.0, degrees)), float(chi2.ppf(1.0 - RARE / 2.0, degrees))


CONSIDERED = np.isin(np.arange(21), [6, 7, 8, 18])
"""The attitude, as on Orion, and one of the optical biases."""

QUICK = replace(MODEL, longest_step_s=1800.0)
"""Identities of algebra hold at any step."""

GAP_H = pytest.mark.parametrize("gap_h", [6.0, pytest.param(24.0, marks=pytest.mark.slow)])
"""Hours between the begins of two passes, of which the flight between them takes the time."""


def correlated_start() -> FilterState:
    """A start with correlations, such as an earlier arc leaves."""
    rng = np.random.default_rng(4)
    mixed = np.eye(21) + 0.3 * rng.normal(size=(21, 21))
    covariance = mixed @ mixed.T * np.outer(START_SIGMAS, START_SIGMAS)
    return FilterState(START_ET, np.concatenate([START, np.zeros(15)]), udu_factors(covariance))


def images(rng: np.random.Generator, spacing_s: float = 1800.0, model: FilterModel = MODEL) -> list[BodyObservation]:
    """Images of a day by one spacecraft that flies as predicted, off by a sigma or so."""
    truth = np.concatenate([START, np.zeros(15)]) + 0.5 * START_SIGMAS
    seen = []
    et = START_ET
    for plan in planned(day_of_images(spacing_s, gap_h=6.0)):
        for end in step_ends(et, plan.et, model.longest_step_s):
            truth = coast(model, et, truth, end).mean
            et = end
        seen.append(measured(plan, truth[None], rng))
    return [replace(each, measured=each.measured[0]) for each in seen]


def turned_sum(mean: Float, change: Float) -> Float:
    """A mean after a change, in which the attitude errors follow one another."""
    moved = mean + change
    moved[6:9] = (Rotation.from_rotvec(change[6:9]) * Rotation.from_rotvec(np.array(mean[6:9]))).as_rotvec()
    return moved


def dense_joseph(state: FilterState, seen: list[BodyObservation], model: FilterModel) -> tuple[Float, Float]:
    """Mean and covariance by full matrices in Joseph's form, all three measurements of an image at once."""
    et, mean, covariance = state.et, state.mean, state.factors.composed()
    for observation in seen:
        for end in step_ends(et, observation.et, model.longest_step_s):
            step = coast(model, et, mean, end)
            covariance = step.matrix() @ covariance @ step.matrix().T + step.noise()
            et, mean = end, step.mean
        expected, design = predict_measurement(observation, mean)
        noise = np.diag(observation.variances)
        scale = 1.0 / np.sqrt(np.diag(noise))  # of the innovations, so that the inverse is well conditioned
        inner = scale[:, None] * (design @ covariance @ design.T + noise) * scale
        gain = covariance @ design.T * scale @ np.linalg.inv(inner) * scale
        gain[model.considered] = 0.0
        left = np.eye(21) - gain @ design
        covariance = left @ covariance @ left.T + gain @ noise @ gain.T
        mean = turned_sum(mean, gain @ (observation.measured - expected))
    return mean, covariance


@pytest.mark.parametrize("considered", [slow(np.zeros(21, dtype=bool)), CONSIDERED], ids=["estimated", "considered"])
def test_the_filter_is_that_of_dense_matrices(considered: np.ndarray) -> None:
    model = replace(QUICK, considered=considered)
    state, seen = correlated_start(), images(np.random.default_rng(5), model=QUICK)
    # A filter that considers states one measurement at a time has other gains than one with all three at once.
    if considered.any():
        seen = [replace(each, variances=np.array([each.variances[0], 1e6, 1e20])) for each in seen]
    mean, covariance = dense_joseph(state, seen, model)
    for observation in seen:
        state, _ = measurement_update(time_update(state, observation.et, model), observation, model)
    sigma = np.sqrt(np.diag(covariance))
    assert_allclose(
        state.factors.composed() / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=FLOAT64_SUM
    )
    assert_allclose((state.mean - mean) / sigma, 0.0, atol=FLOAT64_SUM)


def test_partials_are_those_of_the_measurement() -> None:
    rng = np.random.default_rng(6)
    mean = np.concatenate([START, np.zeros(15)]) + rng.normal(size=21) * START_SIGMAS
    plan = next(iter(planned(day_of_images())))
    plan = replace(plan, et=START_ET)
    units = np.array([1e-4, 1e-4, 1.0])[:, None]

    def shifted(scaled: Float) -> Float:
        return predict_measurement(plan, turned_sum(mean, scaled * START_SIGMAS))[0]

    numeric = numerical_jacobian(shifted, np.zeros(21), 0.1)
    partials = predict_measurement(plan, mean)[1] * START_SIGMAS
    assert_allclose(partials / units, numeric / units, rtol=1e-4, atol=1e-6)


@GAP_H
def test_errors_lie_within_the_covariance_of_an_independent_truth(gap_h: float) -> None:
    runs = 60
    result = flown(runs, seed=7, spacing_s=1200.0, gap_h=gap_h)
    low, high = chi2_band(21 * runs)
    assert low < result.state.squared_error(result.truth).sum() < high
    squared = sum(each.squared().sum() for each in result.innovations)
    low, high = chi2_band(3 * runs * len(result.innovations))
    assert low < squared < high


@pytest.mark.slow
@GAP_H
def test_considered_states_count_without_being_estimated(gap_h: float) -> None:
    runs = 40
    model = replace(MODEL, considered=CONSIDERED)
    result = flown(runs, seed=8, model=model, spacing_s=1800.0, gap_h=gap_h)
    assert not result.state.mean[:, CONSIDERED].any()
    low, high = chi2_band(21 * runs)
    assert low < result.state.squared_error(result.truth).sum() < high


def test_a_wild_measurement_is_left_out_of_its_run_alone() -> None:
    rng = np.random.default_rng(9)
    model = replace(MODEL, edit_sigmas=5.0)
    truth, state = started(3, rng)
    plan = replace(next(iter(planned(day_of_images()))), et=START_ET)
    good = measured(plan, truth, rng)
    values = np.array(good.measured)
    values[1, 0] += 0.02  # 150 px: another body, say
    edited, innovations = measurement_update(state, replace(good, measured=values), model)
    assert innovations.used.tolist() == [[True] * 3, [False, True, True], [True] * 3]
    untouched, _ = measurement_update(state, good, model)
    assert_allclose(edited.mean[[0, 2]], untouched.mean[[0, 2]], rtol=FLOAT64, atol=FLOAT64)
    low_weight = replace(good, variances=good.variances * [1e12, 1.0, 1.0])
    assert_allclose(edited.mean[1], measurement_update(state, low_weight, model)[0].mean[1], rtol=1e-8, atol=1e-12)


def test_a_burn_is_told_by_the_accelerometer() -> None:
    """Errors of attitude, bias and scale turn into those of the velocity, as the covariance says."""
    rng = np.random.default_rng(10)
    runs, change = 2000, np.array([0.02, -0.01, 0.015])  # km/s
    truth, state = started(runs, rng)
    told = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    after, sensed = apply_burn(truth, np.tile(change, (runs, 1)), told, 30.0)
    step = maneuver(START_ET, state.mean, sensed, np.tile(told.T, (runs, 1, 1)), duration_s=30.0)
    moved = FilterState(START_ET, step.mean, step.apply(state.factors))
    velocity = moved.error(after)[:, 3:6]
    claimed = moved.factors.composed()[0, 3:6, 3:6] - state.factors.composed()[0, 3:6, 3:6]
    gained = velocity - state.error(truth)[:, 3:6]
    squared = np.einsum("ki,ij,kj->k", gained, np.linalg.inv(claimed), gained).sum()
    low, high = chi2_band(3 * runs)
    assert low < squared < high


@pytest.mark.slow
def test_the_batch_agrees_with_the_filter() -> None:
    rng = np.random.default_rng(11)
    state, seen = correlated_start(), images(rng, model=QUICK)
    batch = estimate_batch(state, seen, QUICK)
    assert not isinstance(batch, Failure)
    for observation in seen:
        state, _ = measurement_update(time_update(state, observation.et, QUICK), observation, QUICK)
    sigma = state.factors.sigmas()
    assert_allclose(np.sqrt(np.diag(batch.covariance_last)) / sigma, 1.0, atol=0.01)
    assert np.abs((batch.last_mean - state.mean) / sigma).max() < 0.05  # what linearizing elsewhere may change
    low, high = chi2_band(3 * len(seen))
    assert low < batch.squared_residual < high + 21.0  # the start is half a sigma off in all states


def test_a_batch_that_still_moves_after_its_iterations_is_a_failure() -> None:
    seen = images(np.random.default_rng(11), model=QUICK)[:2]
    batch = estimate_batch(correlated_start(), seen, QUICK, most_iterations=1)
    assert isinstance(batch, Failure)
    assert batch.reason is Reason.NOT_CONVERGED


def test_the_batch_is_the_filter_where_the_problem_is_linear() -> None:
    """Without innovations both linearize about the same path: covariances must agree to rounding."""
    state, seen = correlated_start(), []
    prior = state
    for plan in planned(day_of_images(2400.0, gap_h=6.0)):
        state = time_update(state, plan.et, QUICK)
        exact = replace(plan, measured=predict_measurement(plan, state.mean)[0])
        state, _ = measurement_update(state, exact, QUICK)
        seen.append(exact)
    batch = estimate_batch(prior, seen, QUICK)
    assert not isinstance(batch, Failure)
    assert batch.iterations == 1
    sigma = state.factors.sigmas()
    scale = np.outer(sigma, sigma)
    assert_allclose(batch.covariance_last / scale, state.factors.composed() / scale, atol=1e-6)  # inverse of the data
    assert_allclose((batch.last_mean - state.mean) / sigma, 0.0, atol=1e-6)


def test_an_image_of_another_time_is_refused() -> None:
    plan = next(iter(planned(day_of_images())))
    with pytest.raises(InputError, match="update it first"):
        measurement_update(correlated_start(), plan, MODEL)
