"""A navigation filter on images of bodies: extended, multiplicative in attitude, with U D U^T factors, of 21 states.

The states in order: position, velocity, attitude error, unmodeled acceleration, bias and scale factor of the
accelerometer, bias of the optical measurements; each of three. Position and velocity are flown and their covariance
goes through Gram-Schmidt; the other fifteen are first-order Gauss-Markov processes, each a rank-one step. Any state may
be considered: its errors count in covariance and gains, it is not estimated. Measurements beyond ``edit_sigmas`` of
their innovation are left out. Everything takes leading axes: a thousand runs of a Monte Carlo are one call.
Equations are of Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.cislunar.body_measurements import (
    disk_diameter,
    measurement_partials,
    range_from_disk_diameter,
    range_per_diameter,
    tangent_angles,
)
from giantlike.cislunar.udu import UduFactors, considered_update, gauss_markov_step, gram_schmidt, scalar_update
from giantlike.core.arrays import Float, Mask, as_finite, as_floats, require
from giantlike.core.deprecation import forward_names
from giantlike.core.frames import skew
from giantlike.core.values import Value
from giantlike.dynamics import PointMasses, cislunar, fly

__getattr__ = forward_names(__name__, {__name__: "predicted:predict_measurement"}, until="0.4")

POSITION, VELOCITY = slice(0, 3), slice(3, 6)
ATTITUDE, ACCELERATION = slice(6, 9), slice(9, 12)
ACCELEROMETER_BIAS, ACCELEROMETER_SCALE = slice(12, 15), slice(15, 18)
OPTICAL_BIAS = slice(18, 21)
FLOWN, PARAMETERS, STATES = 6, 15, 21
LONGEST_STEP_S = 300.0
"""Noise of parameters enters at the ends of steps: driven variances are low by step / time constant."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterModel(Value):
    """Beliefs of a filter about dynamics and parameters, and its options.

    Parameters
    ----------
    dynamics : PointMasses
    sigmas : (15,) float64
        Steady standard deviations of the parameters: attitude, rad; unmodeled acceleration, km/s^2; accelerometer
        bias, km/s^2, and scale; optical biases of the two tangents and of the disk diameter.
    time_constants_s : (15,) float64, s; of the parameters; infinite for constants
    considered : (21,) bool; states that are not estimated
    edit_sigmas : float; a measurement farther from its prediction is left out
    longest_step_s : float, s; longer coasts are divided
    """

    dynamics: PointMasses = field(default_factory=cislunar)
    sigmas: Float
    time_constants_s: Float
    considered: Mask = field(default_factory=lambda: np.zeros(STATES, dtype=bool))
    edit_sigmas: float = math.inf
    longest_step_s: float = LONGEST_STEP_S

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigmas", as_finite(self.sigmas, (PARAMETERS,), "sigmas"))
        times = as_floats(self.time_constants_s, (PARAMETERS,), "time_constants_s")
        require(bool((times > 0.0).all()), "time_constants_s must be positive; infinite for constants")
        object.__setattr__(self, "time_constants_s", times)
        require(self.considered.shape == (STATES,), f"considered must have shape ({STATES},)")
        accelerations = times[ACCELERATION.start - FLOWN : ACCELERATION.stop - FLOWN]
        require(bool((accelerations == accelerations[0]).all()), "the unmodeled acceleration has one time constant")
        require(self.edit_sigmas > 0.0 and self.longest_step_s > 0.0, "edit_sigmas and longest_step_s must be positive")
        Value.__post_init__(self)


@dataclass(frozen=True, slots=True, eq=False)
class FilterState(Value):
    """An estimate at a time.

    Parameters
    ----------
    et : float, TDB seconds past J2000
    mean : (..., 21) float64; position and velocity from the central body, km and km/s; parameters
    factors : UduFactors
        Of the covariance of the error; the attitude error is a small rotation about the camera axes that follows the
        estimated one.
    """

    et: float
    mean: Float
    factors: UduFactors

    def error(self, truth: ArrayLike) -> Float:
        """Errors (..., 21), truth minus estimate, multiplicative in attitude."""
        actual = as_floats(truth, (STATES,), "truth")
        error = actual - self.mean
        error[..., ATTITUDE] = _compose_rotations(actual[..., ATTITUDE], -self.mean[..., ATTITUDE])
        return error

    def squared_error(self, truth: ArrayLike) -> Float:
        """Normalized squared error (...) from a truth (..., 21): with the mean 21 for a consistent filter."""
        error = self.error(truth)
        independent = np.linalg.solve(self.factors.upper, error[..., None])[..., 0]
        return np.asarray(np.sum(independent**2 / self.factors.diagonal, axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class Transition(Value):
    """A linear step of the 21 states: of a flight or a maneuver."""

    et: float  # at the end
    mean: Float  # (..., 21); at the end
    by_state: Float  # (..., 6, 6); position and velocity at the end by those at the start
    by_parameters: Float  # (..., 6, 15); the same by the parameters at the start
    decay: Float  # decay, variance: (15,); factor of each parameter, and variance of its noise
    variance: Float
    velocity_variance: float = 0.0  # in km^2/s^2; of independent noise of each component of the velocity

    def matrix(self) -> Float:
        """Return the transition matrix of all states. Returns (..., 21, 21)."""
        matrix = np.zeros((*self.by_state.shape[:-2], STATES, STATES))
        matrix[..., :FLOWN, :FLOWN] = self.by_state
        matrix[..., :FLOWN, FLOWN:] = self.by_parameters
        matrix[..., FLOWN:, FLOWN:] = np.diag(self.decay)
        return matrix

    def noise(self) -> Float:
        """Return the covariance of the noise of all states. Returns (21, 21)."""
        variances = np.concatenate([np.zeros(3), np.full(3, self.velocity_variance), self.variance])
        return np.diag(variances)

    def apply(self, factors: UduFactors) -> UduFactors:
        """Factors of a covariance after the step."""
        upper, diagonal = np.array(factors.upper), np.array(factors.diagonal)
        crossed = self.by_state @ upper[..., :FLOWN, FLOWN:] + self.by_parameters @ upper[..., FLOWN:, FLOWN:]
        rows, weights = self.by_state @ upper[..., :FLOWN, :FLOWN], diagonal[..., :FLOWN]
        if self.velocity_variance > 0.0:
            push = np.broadcast_to(np.eye(FLOWN)[:, VELOCITY], (*rows.shape[:-1], 3))
            rows = np.concatenate([rows, push], axis=-1)
            extra = np.full((*weights.shape[:-1], 3), self.velocity_variance)
            weights = np.concatenate([weights, extra], axis=-1)
        flown = gram_schmidt(rows, weights)
        upper[..., :FLOWN, :FLOWN], diagonal[..., :FLOWN] = flown.upper, flown.diagonal
        upper[..., :FLOWN, FLOWN:] = crossed
        result = UduFactors(upper, diagonal)
        for k in range(PARAMETERS):
            if self.decay[k] != 1.0 or self.variance[k] != 0.0:
                result = gauss_markov_step(result, FLOWN + k, self.decay[k], self.variance[k])
        return result


def coast(model: FilterModel, et: float, mean: Float, until: float) -> Transition:
    """One step of free flight. ``et``, ``until`` in TDB seconds past J2000; ``mean`` (..., 21), at the start."""
    ages = np.asarray(-(until - et) / model.time_constants_s)
    decay = np.exp(ages)
    first = ACCELERATION.start - FLOWN
    flight = fly(
        model.dynamics,
        et,
        mean[..., :FLOWN],
        until,
        acceleration_km_s2=mean[..., ACCELERATION],
        time_constant_s=float(model.time_constants_s[first]),
    )
    by_parameters = np.zeros((*mean.shape[:-1], FLOWN, PARAMETERS))
    by_parameters[..., first : first + 3] = flight.by_acceleration
    after = np.concatenate([flight.state, decay * mean[..., FLOWN:]], axis=-1)
    variance = -np.expm1(2.0 * ages) * model.sigmas**2
    return Transition(until, after, flight.by_state, by_parameters, decay, variance)


def maneuver(
    et: float,
    mean: Float,
    sensed_km_s: Float,
    inertial_from_body: Float,
    *,
    duration_s: float = 0.0,
    sigma_km_s: float = 0.0,
) -> Transition:
    """A short burn as accelerometers sensed it, (..., 3), body axes, from a mean (..., 21).

    Sensed is ``(1 + scale) * change + bias * duration`` along the axes of the body, and noise.
    """
    change = sensed_km_s - mean[..., ACCELEROMETER_BIAS] * duration_s - mean[..., ACCELEROMETER_SCALE] * sensed_km_s
    inertial = inertial_from_body @ _turns(-mean[..., ATTITUDE])
    after = np.array(mean)
    after[..., VELOCITY] += (inertial @ change[..., None])[..., 0]
    by_parameters = np.zeros((*mean.shape[:-1], FLOWN, PARAMETERS))
    by_parameters[..., VELOCITY, _of(ATTITUDE)] = inertial @ skew(change)
    by_parameters[..., VELOCITY, _of(ACCELEROMETER_BIAS)] = -duration_s * inertial
    by_parameters[..., VELOCITY, _of(ACCELEROMETER_SCALE)] = -inertial * sensed_km_s[..., None, :]
    by_state = np.broadcast_to(np.eye(FLOWN), (*mean.shape[:-1], FLOWN, FLOWN))
    return Transition(et, after, by_state, by_parameters, np.ones(PARAMETERS), np.zeros(PARAMETERS), sigma_km_s**2)


def time_update(state: FilterState, until: float, model: FilterModel) -> FilterState:
    """Estimate after free flight.

    Parameters
    ----------
    state : FilterState
    until : float, TDB seconds past J2000
    model : FilterModel
    """
    for end in step_ends(state.et, until, model.longest_step_s):
        step = coast(model, state.et, state.mean, end)
        state = FilterState(end, step.mean, step.apply(state.factors))
    return state


def step_ends(et: float, until: float, longest_s: float) -> list[float]:
    """Ends, s, of equal steps that are no longer than allowed; empty where ``until`` is ``et``."""
    count = math.ceil(abs(until - et) / longest_s)
    return [et + (until - et) * k / count for k in range(1, count)] + [until] * (count > 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyObservation(Value):
    """A body as an image shows it.

    Parameters
    ----------
    et : float, TDB seconds past J2000
    measured : (..., 3) float64; tangents of the two angles, and the range in km
    variances : (..., 3) float64; of independent noise
    camera_from_inertial : (..., 3, 3) float64; as declared; the true one is the rotation by the attitude error after it
    body_position_km : (3,) float64, km; apparent position of the body relative to the central body of the flight
    radius_km : float, km
    """

    et: float
    measured: Float
    variances: Float
    camera_from_inertial: Float
    body_position_km: Float
    radius_km: float


def predict_measurement(observation: BodyObservation, mean: Float) -> tuple[Float, Float]:
    """Measurement (..., 3) that an estimate (..., 21) predicts, and its derivative by the states (eqs. 1-12)."""
    camera_from_inertial = _turns(mean[..., ATTITUDE]) @ observation.camera_from_inertial
    to_body = observation.body_position_km - mean[..., POSITION]
    place = (camera_from_inertial @ to_body[..., None])[..., 0]
    distance = np.linalg.norm(place, axis=-1)
    bias = mean[..., OPTICAL_BIAS]
    across = disk_diameter(distance, observation.radius_km) + bias[..., 2]
    seen_range = range_from_disk_diameter(across, observation.radius_km)
    measurement = np.concatenate([tangent_angles(place) + bias[..., :2], seen_range[..., None]], axis=-1)
    by_place = measurement_partials(place)
    # The biased diameter belongs to a sphere at the apparent range: chain rule of the derivatives there and at the true
    # one.
    slope = range_per_diameter(seen_range, observation.radius_km)
    by_place[..., 2, :] *= (slope / range_per_diameter(distance, observation.radius_km))[..., None]
    partials = np.zeros((*measurement.shape, STATES))
    partials[..., POSITION] = -by_place @ camera_from_inertial
    partials[..., ATTITUDE] = -by_place @ skew(place)
    partials[..., 0, OPTICAL_BIAS.start] = partials[..., 1, OPTICAL_BIAS.start + 1] = 1.0
    partials[..., 2, OPTICAL_BIAS.start + 2] = slope
    return measurement, partials


@dataclass(frozen=True, slots=True, eq=False)
class Innovations(Value):
    """Measured minus predicted values, one after the other."""

    values: Float  # values, variances: (..., 3); of each given those before it: independent if consistent
    variances: Float
    used: Mask  # (..., 3); False where the measurement was left out

    def squared(self) -> Float:
        """Normalized squared innovation: in a consistent filter its mean is the number of measurements."""
        return np.asarray(np.sum(self.values**2 / self.variances, axis=-1))


def measurement_update(
    state: FilterState, observation: BodyObservation, model: FilterModel
) -> tuple[FilterState, Innovations]:
    """Estimate after an image, its measurements one at a time.

    Parameters
    ----------
    state : FilterState; at the time of the image
    observation : BodyObservation
    model : FilterModel

    Returns
    -------
    state : FilterState
    innovations : Innovations

    Raises
    ------
    InputError
        The state is of another time.
    """
    require(state.et == observation.et, f"the state is of {state.et}, the image of {observation.et}: update it first")
    expected, partials = predict_measurement(observation, state.mean)
    residuals = observation.measured - expected
    variances = np.broadcast_to(observation.variances, residuals.shape)
    factors, change = state.factors, np.zeros_like(state.mean)
    found = [np.zeros_like(residuals) for _ in range(3)]
    for k in range(residuals.shape[-1]):
        design = partials[..., k, :]
        update = considered_update(scalar_update(factors, design, variances[..., k]), model.considered)
        innovation = residuals[..., k] - np.sum(design * change, axis=-1)
        used = innovation**2 <= model.edit_sigmas**2 * update.variance
        change = change + np.where(used, innovation, 0.0)[..., None] * update.gain
        factors = UduFactors(
            np.where(used[..., None, None], update.factors.upper, factors.upper),
            np.where(used[..., None], update.factors.diagonal, factors.diagonal),
        )
        for table, value in zip(found, (innovation, update.variance, used), strict=True):
            table[..., k] = value
    mean = state.mean + change
    mean[..., ATTITUDE] = _compose_rotations(change[..., ATTITUDE], state.mean[..., ATTITUDE])
    return FilterState(state.et, mean, factors), Innovations(found[0], found[1], found[2] > 0.0)


def _of(states: slice) -> slice:
    """The same states counted among the parameters."""
    return slice(states.start - FLOWN, states.stop - FLOWN)


def _turns(rotation_vectors: Float) -> Float:
    """Matrices (..., 3, 3) of rotation vectors (..., 3)."""
    flat = np.array(rotation_vectors).reshape(-1, 3)
    return Rotation.from_rotvec(flat).as_matrix().reshape(*rotation_vectors.shape, 3)


def _compose_rotations(after: Float, before: Float) -> Float:
    """Rotation vectors (..., 3) of one rotation after another."""
    first, second = (Rotation.from_rotvec(np.array(each).reshape(-1, 3)) for each in (before, after))
    return (second * first).as_rotvec().reshape(before.shape)
