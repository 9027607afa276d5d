"""Linear covariance of the filter of 21 states along a reference: flight, images and corrections.

Each function takes a :class:`~giantlike.cislunar.linear_covariance.JointDispersion` and the state of the filter on
the reference, and returns both after the step. The gains are the filter's; the true images may have other noise and
biases.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from giantlike.cislunar.filter import (
    ACCELEROMETER_BIAS,
    STATES,
    VELOCITY,
    BodyObservation,
    FilterModel,
    FilterState,
    Transition,
    coast,
    maneuver,
    predict_measurement,
    step_ends,
)
from giantlike.cislunar.linear_covariance import (
    JointDispersion,
    dispersed_correction,
    dispersed_measurement,
    dispersed_step,
)
from giantlike.cislunar.udu import considered_update, scalar_update
from giantlike.core.arrays import Float, as_finite


class Dispersed(NamedTuple):
    """Dispersion of truth and estimate, and the filter on the reference."""

    joint: JointDispersion
    state: FilterState  # its mean is the reference


def reference_steps(model: FilterModel, et: float, mean: Float, until: float) -> list[Transition]:
    """Steps of free flight along a reference from a mean (21,), which several analyses may share."""
    steps = []
    for end in step_ends(et, until, model.longest_step_s):
        steps.append(coast(model, et, mean, end))
        et, mean = end, steps[-1].mean
    return steps


def after_steps(at: Dispersed, steps: Iterable[Transition]) -> Dispersed:
    """Dispersions after steps of the reference."""
    joint, state = at
    for step in steps:
        joint = dispersed_step(joint, step.matrix(), step.noise())
        state = FilterState(step.et, step.mean, step.apply(state.factors))
    return Dispersed(joint, state)


def after_coast(at: Dispersed, until: float, model: FilterModel) -> Dispersed:
    """Dispersions after free flight. ``until`` in TDB seconds past J2000."""
    return after_steps(at, reference_steps(model, at.state.et, at.state.mean, until))


def after_image(
    at: Dispersed,
    observation: BodyObservation,
    model: FilterModel,
    *,
    world_variances: ArrayLike | None = None,
    world_biases: ArrayLike = (0.0, 0.0, 0.0),
) -> Dispersed:
    """Dispersions after an image. ``world_variances``, ``world_biases`` (3,)."""
    believed = as_finite(observation.variances, (3,), "variances")
    variances = believed if world_variances is None else as_finite(world_variances, (3,), "world_variances")
    biases = as_finite(world_biases, (3,), "world_biases")
    joint, state = at
    factors, partials = state.factors, predict_measurement(observation, state.mean)[1]
    for k, design in enumerate(partials):
        update = considered_update(scalar_update(factors, design, believed[k]), model.considered)
        joint = dispersed_measurement(joint, update.gain, design, float(variances[k]), float(biases[k]))
        factors = update.factors
    return Dispersed(joint, FilterState(state.et, state.mean, factors))


def after_correction(
    at: Dispersed,
    guidance: Float,
    inertial_from_body: Float,
    *,
    duration_s: float = 0.0,
    execution_km_s: float = 0.0,
    sensing_km_s: float = 0.0,
) -> Dispersed:
    """Dispersions after a small burn towards the reference, which itself has none.

    ``guidance`` (3, 6): change of the velocity by the estimated deviation of position and velocity from the reference.
    """
    joint, state = at
    step = maneuver(
        state.et, state.mean, np.zeros(3), inertial_from_body, duration_s=duration_s, sigma_km_s=sensing_km_s
    )
    commanded = np.zeros((STATES, STATES))
    commanded[VELOCITY, :6] = guidance
    by_parameters = np.zeros((STATES, STATES))
    by_parameters[VELOCITY, ACCELEROMETER_BIAS] = -duration_s * inertial_from_body
    execution, sensing = (_of_velocity(sigma) for sigma in (execution_km_s, sensing_km_s))
    moved = dispersed_correction(joint, commanded, by_parameters, execution, sensing)
    return Dispersed(moved, FilterState(step.et, state.mean, step.apply(state.factors)))


def _of_velocity(sigma_km_s: float) -> Float:
    """Covariance (21, 21) of an error of the velocity."""
    covariance = np.zeros((STATES, STATES))
    covariance[VELOCITY, VELOCITY] = sigma_km_s**2 * np.eye(3)
    return covariance
