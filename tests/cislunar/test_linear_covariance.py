"""Linear covariance beside the filter's own and beside flown runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.cislunar import FilterState, measurement_update, time_update, udu_factors
from giantlike.cislunar.covariance import Dispersed, after_coast, after_correction, after_image
from giantlike.cislunar.filter import maneuver
from giantlike.cislunar.linear_covariance import JointDispersion
from giantlike.core.arrays import Float
from giantlike.independent.flight import Processes, apply_burn, fly_spacecraft, observe_body
from tests.bands import mean_square_band
from tests.cislunar.cislunar_case import (
    MODEL,
    SIGMAS,
    SKY,
    START,
    START_ET,
    START_SIGMAS,
    TIMES_S,
    day_of_images,
    planned,
    started,
)
from tests.cislunar.test_cislunar_filter import CONSIDERED
from tests.tolerances import FLOAT64_SUM

NO_DISPERSION = np.zeros((21, 21))
FAST = replace(MODEL, longest_step_s=1800.0, considered=CONSIDERED)
GUIDANCE = np.hstack([-2e-6 * np.eye(3), -0.5 * np.eye(3)])
"""1/s and of the velocity: takes out half of the error of the velocity, and some of the position."""
BODY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
BURN_S, EXECUTION_KM_S, SENSING_KM_S = 20.0, 3e-5, 1e-5
NOISE_FACTOR, BIAS = 1.5, np.array([2e-5, -1e-5, 30.0])
"""Of the world's noise over that believed, and its biases: tangents, and km."""


def begin(dispersion: Float) -> Dispersed:
    reference = np.concatenate([START, np.zeros(15)])
    error = np.diag(START_SIGMAS**2)
    return Dispersed(JointDispersion.at_start(dispersion, error), FilterState(START_ET, reference, udu_factors(error)))


def test_the_analysis_of_a_world_as_believed_is_the_covariance_of_the_filter() -> None:
    at = begin(np.diag((3.0 * START_SIGMAS) ** 2))
    for plan in planned(day_of_images(3600.0, gap_h=6.0)):
        at = after_image(after_coast(at, plan.et, FAST), plan, FAST)
    at = after_correction(at, GUIDANCE, BODY.T, duration_s=BURN_S, sensing_km_s=SENSING_KM_S)
    mean, covariance = at.joint.navigation_error()
    sigma = at.state.factors.sigmas()
    assert not mean.any()
    # Truth and estimate are alike to a hundredth: their difference loses two digits squared of the dispersion.
    scale = np.outer(sigma, sigma)
    assert_allclose(covariance / scale, at.state.factors.composed() / scale, atol=100.0 * FLOAT64_SUM)


@pytest.mark.monte_carlo(few=60, full=250)
def test_the_analysis_is_what_flown_runs_do_in_a_world_that_the_filter_does_not_know(draws: int) -> None:
    rng = np.random.default_rng(21)
    truth, state = started(draws, rng)
    at = begin(NO_DISPERSION)
    # The estimate starts at the reference, and the truth off it.
    start = np.diag(START_SIGMAS**2)
    at = at._replace(joint=JointDispersion(np.zeros(42), np.block([[start, NO_DISPERSION], [NO_DISPERSION] * 2])))
    processes = Processes(SIGMAS, TIMES_S)
    for plan in planned(day_of_images(1800.0, gap_h=6.0)):
        variances = NOISE_FACTOR**2 * plan.variances
        at = after_coast(at, plan.et, FAST)
        at = after_image(at, plan, FAST, world_variances=variances, world_biases=BIAS)
        truth = fly_spacecraft(truth, state.et, plan.et, SKY, processes, rng)
        seen = observe_body(
            truth, plan.camera_from_inertial, plan.body_position_km, plan.radius_km, np.zeros((draws, 3))
        )
        seen = seen + BIAS + rng.normal(0.0, np.sqrt(variances), (draws, 3))
        state, _ = measurement_update(time_update(state, plan.et, FAST), replace(plan, measured=seen), FAST)
    at = after_correction(
        at, GUIDANCE, BODY.T, duration_s=BURN_S, execution_km_s=EXECUTION_KM_S, sensing_km_s=SENSING_KM_S
    )
    reference = at.state.mean
    change = (state.mean - reference)[:, :6] @ GUIDANCE.T + rng.normal(0.0, EXECUTION_KM_S, (draws, 3))
    truth, sensed = apply_burn(truth, change, BODY, BURN_S)
    sensed = sensed + rng.normal(0.0, SENSING_KM_S, sensed.shape)
    turned = np.tile(BODY.T, (draws, 1, 1))
    step = maneuver(state.et, state.mean, sensed, turned, duration_s=BURN_S, sigma_km_s=SENSING_KM_S)
    state = FilterState(step.et, step.mean, step.apply(state.factors))
    for (mean, covariance), found in (
        (at.joint.navigation_error(), state.error(truth)[:, :6]),
        (at.joint.truth(), (truth - reference)[:, :6]),
    ):
        sigma = np.sqrt(np.diag(covariance))[:6]
        low, high = mean_square_band(draws - 1)
        assert np.all((found.var(axis=0, ddof=1) / sigma**2 > low) & (found.var(axis=0, ddof=1) / sigma**2 < high))
        assert_allclose(found.mean(axis=0) / sigma, mean[:6] / sigma, atol=5.0 / np.sqrt(draws))
    believed = state.factors.sigmas().mean(axis=0)[:3]
    actual = np.sqrt(np.diag(at.joint.navigation_error()[1]))[:3]
    assert (actual > 1.1 * believed).any()  # the world is worse than the filter believes
