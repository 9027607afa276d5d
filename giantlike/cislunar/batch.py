"""The problem of the filter solved at once: all images of an arc, noise of the parameters as part of the data.

The unknowns are the 21 states at the start; process noise makes the covariance of the measurements dense. Gauss-Newton
iterations linearize about the estimate; for a linear problem filter and batch agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from giantlike._system.processes import one_thread
from giantlike.cislunar.filter import (
    STATES,
    BodyObservation,
    FilterModel,
    FilterState,
    coast,
    predict_measurement,
    step_ends,
)
from giantlike.core.arrays import Float, require, symmetric
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BatchSolution(Value):
    """States at both ends of an arc."""

    first_mean: Float  # first_mean, last_mean: (21,); at the start, and at the last image
    last_mean: Float
    covariance_first: Float  # covariance_first, covariance_last: (21, 21); of their errors
    covariance_last: Float
    residuals: Float  # (m, 3); measured minus predicted
    squared_residual: float  # normalized by the covariance of data and a priori state; expected: number of measurements
    iterations: int


@one_thread()
def estimate_batch(
    start: FilterState,
    observations: Sequence[BodyObservation],
    model: FilterModel,
    *,
    most_iterations: int = 10,
    settled_sigmas: float = 1e-4,
) -> BatchSolution | Failure:
    """Estimate the states of an arc from all of its images at once.

    Parameters
    ----------
    start : FilterState; a priori, of one spacecraft, not later than the first image; all states are estimated
    observations : sequence of BodyObservation; in order of time, at least one
    model : FilterModel
    most_iterations : int
    settled_sigmas : float; iterations end when no state moves by more of its sigma

    Returns
    -------
    BatchSolution or Failure
        ``not_converged``.

    Raises
    ------
    InputError
        There are no observations, or they are not in order.
    """
    times = [start.et, *(each.et for each in observations)]
    require(len(observations) > 0, "observations must hold at least one image")
    require(bool((np.diff(times) >= 0.0).all()), "observations must be in order of time and not before the start")
    prior, covariance = start.mean, start.factors.composed()
    mean = prior
    for iteration in range(1, most_iterations + 1):
        arc = _arc(start.et, mean, observations, model)
        seen = arc.design @ covariance
        total = seen @ arc.design.T + arc.covariance
        solution = np.linalg.solve(total, arc.residuals - arc.design @ (prior - mean))
        found = prior + seen.T @ solution
        covariance_first = covariance - seen.T @ np.linalg.solve(total, seen)
        moved = float(np.max(np.abs(found - mean) / np.sqrt(np.diag(covariance_first))))
        if moved < settled_sigmas:
            last_by_data = arc.last_by_first @ seen.T + arc.last_with_data
            last_prior = arc.last_by_first @ covariance @ arc.last_by_first.T + arc.last_noise
            covariance_last = last_prior - last_by_data @ np.linalg.solve(total, last_by_data.T)
            return BatchSolution(
                first_mean=found,
                last_mean=arc.last_mean + arc.last_by_first @ (prior - mean) + last_by_data @ solution,
                covariance_first=symmetric(covariance_first),
                covariance_last=symmetric(covariance_last),
                residuals=arc.residuals.reshape(-1, 3),
                squared_residual=float((arc.residuals - arc.design @ (prior - mean)) @ solution),
                iterations=iteration,
            )
        mean = found
    return Failure(Reason.NOT_CONVERGED, f"the states of the arc still move by {moved:.2g} sigma: check the start")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Arc:
    """Residuals (3 m,) about an arc, their derivative by the first state and covariance, and the same of the end."""

    residuals: Float
    design: Float
    covariance: Float
    last_mean: Float
    last_by_first: Float
    last_noise: Float
    last_with_data: Float


def _arc(et: float, mean: Float, observations: Sequence[BodyObservation], model: FilterModel) -> _Arc:
    """Fly an arc from its first state and measure along it."""
    by_first, noise = np.eye(STATES), np.zeros((STATES, STATES))
    earlier = np.zeros((STATES, 0))  # covariance of the noise in the present state with that in the data so far
    rows, residuals = [], []
    size = 3 * len(observations)
    covariance = np.zeros((size, size))
    for k, observation in enumerate(observations):
        for end in step_ends(et, observation.et, model.longest_step_s):
            step = coast(model, et, mean, end)
            matrix = step.matrix()
            by_first, earlier = matrix @ by_first, matrix @ earlier
            noise = matrix @ noise @ matrix.T + step.noise()
            et, mean = end, step.mean
        expected, partials = predict_measurement(observation, mean)
        rows.append(partials @ by_first)
        residuals.append(observation.measured - expected)
        here = slice(3 * k, 3 * k + 3)
        covariance[here, : 3 * k] = partials @ earlier
        covariance[: 3 * k, here] = covariance[here, : 3 * k].T
        covariance[here, here] = partials @ noise @ partials.T + np.diag(observation.variances)
        earlier = np.concatenate([earlier, noise @ partials.T], axis=1)
    return _Arc(
        residuals=np.concatenate(residuals),
        design=np.concatenate(rows),
        covariance=covariance,
        last_mean=mean,
        last_by_first=by_first,
        last_noise=noise,
        last_with_data=earlier,
    )
