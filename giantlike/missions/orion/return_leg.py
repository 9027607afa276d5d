"""The way back from the Moon: linear covariance of a plan, and flown runs of the same filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from giantlike.cislunar import BodyObservation, FilterState, measurement_update, time_update, udu_factors
from giantlike.cislunar.covariance import Dispersed, after_correction, after_image, after_steps
from giantlike.cislunar.filter import STATES, maneuver
from giantlike.cislunar.linear_covariance import JointDispersion
from giantlike.cislunar.udu import UduFactors
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.dynamics import GM_EARTH_KM3_S2, GM_MOON_KM3_S2, GM_SUN_KM3_S2
from giantlike.independent.flight import Processes, PullingBodies, apply_burn, fly_spacecraft, observe_body
from giantlike.missions.orion.constants import EARTH_KM, table
from giantlike.missions.orion.return_plan import Leg, PlannedImage, ReturnPlan
from giantlike.missions.replay import ReplaySettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class History(Value):
    """Standard deviations and means along the leg.

    ``error`` and ``strayed`` are of position and velocity (k, 6), after each leg: truth minus estimate, and truth minus
    reference; ``believed`` are sigmas of the filter.
    """

    et: Float
    error_mean: Float
    error_sigma: Float
    strayed_mean: Float
    strayed_sigma: Float
    believed: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Delivery(Value):
    """Dispersion at the entry interface: angle against the corridor, degrees."""

    angle_mean_deg: float
    angle_sigma_deg: float


def analyze_plan(
    plan: ReturnPlan, *, with_images: bool = True, as_believed: bool = False
) -> tuple[History, Delivery, Dispersed]:
    """Linear covariance of a plan; ``as_believed`` is a world with the noise that the filter believes and no biases."""
    numbers = table("return_leg")
    start, burns = numbers["start"], numbers["burns"]
    error = np.diag(np.concatenate([np.repeat(start["navigation"], 3), plan.model.sigmas]) ** 2)
    strayed = np.zeros((STATES, STATES))
    strayed[:6, :6] = np.diag(np.repeat(start["dispersion"], 3) ** 2)
    # The truth owns the errors of its parameters, of which the estimate knows nothing.
    joint = JointDispersion.at_start(strayed, np.zeros((STATES, STATES)))
    covariance = np.array(joint.covariance)
    covariance[:6, :6] += error[:6, :6]
    covariance[6:STATES, 6:STATES] += error[6:, 6:]
    state = FilterState(numbers["trajectory"]["start_et"], plan.reference, udu_factors(error))
    at, rows = Dispersed(JointDispersion(joint.mean, covariance), state), []
    for leg in plan.legs:
        at = after_steps(at, leg.steps)
        if leg.image is not None and with_images:
            believed = leg.image.observation.variances
            at = after_image(
                at,
                leg.image.observation,
                plan.model,
                world_variances=believed if as_believed else leg.image.world_variances,
                world_biases=np.zeros(3) if as_believed else leg.image.world_biases,
            )
        if leg.guidance is not None:
            at = after_correction(
                at,
                leg.guidance,
                leg.camera_from_inertial.T,
                duration_s=burns["duration_s"],
                execution_km_s=burns["execution"],
                sensing_km_s=burns["sensing"],
            )
        rows.append(_row(at))
    history = History(**dict(zip(_COLUMNS, map(np.array, zip(*rows, strict=True)), strict=True)))
    slope = angle_slope(at.state.mean)
    mean, covariance = at.joint.truth()
    delivery = Delivery(
        angle_mean_deg=float(entry_angle_deg(at.state.mean[:6])) + float(slope @ mean[:6]),
        angle_sigma_deg=float(np.sqrt(slope @ covariance[:6, :6] @ slope)),
    )
    return history, delivery, at


_COLUMNS = ("et", "error_mean", "error_sigma", "strayed_mean", "strayed_sigma", "believed")


def _row(at: Dispersed) -> tuple[Any, ...]:
    """A row of the history."""
    (error, spread), (strayed, far) = at.joint.navigation_error(), at.joint.truth()
    sigmas = [np.sqrt(np.diag(each))[:6] for each in (spread, far)]
    return at.state.et, error[:6], sigmas[0], strayed[:6], sigmas[1], at.state.factors.sigmas()[:6]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flown(Value):
    """Flown runs: their history and delivery, and of each run the angle, degrees, and the speed, km/s, at entry."""

    history: History
    delivery: Delivery
    angles_deg: Float
    speeds_km_s: Float


def flown(plan: ReturnPlan, settings: ReplaySettings, runs: int) -> Flown:
    """The same plan flown: independent truths, each with its filter."""
    numbers, rng = table("return_leg"), np.random.default_rng(settings.seed)
    start = numbers["start"]
    sigmas = np.concatenate([np.repeat(start["navigation"], 3), plan.model.sigmas])
    strayed = np.zeros((runs, STATES))
    strayed[:, :6] = rng.normal(0.0, np.repeat(start["dispersion"], 3), (runs, 6))
    mean = plan.reference + strayed
    truth = mean + rng.normal(0.0, sigmas, (runs, STATES))
    factors = UduFactors(np.tile(np.eye(STATES), (runs, 1, 1)), np.tile(sigmas**2, (runs, 1)))
    state = FilterState(numbers["trajectory"]["start_et"], mean, factors)
    moon, sun = (each.position_km for each in plan.model.dynamics.third_bodies)
    sky = PullingBodies(GM_EARTH_KM3_S2, GM_MOON_KM3_S2, GM_SUN_KM3_S2, moon, sun)
    processes = Processes(plan.model.sigmas, plan.model.time_constants_s)
    rows = []
    for done, leg in enumerate(plan.legs):
        settings.progress("flown runs", done, len(plan.legs))
        truth = fly_spacecraft(truth, state.et, leg.et, sky, processes, rng)
        state = time_update(state, leg.et, plan.model)
        reference = leg.steps[-1].mean
        if leg.image is not None:
            seen = _seen(leg.image, truth, rng)
            state, _ = measurement_update(state, seen, plan.model)
        if leg.guidance is not None:
            truth, state = _correct(leg, truth, state, rng)
        error, away = state.error(truth)[:, :6], (truth - reference)[:, :6]
        sigma = state.factors.sigmas()[:, :6].mean(axis=0)
        rows.append((leg.et, error.mean(axis=0), error.std(axis=0), away.mean(axis=0), away.std(axis=0), sigma))
    history = History(**dict(zip(_COLUMNS, map(np.array, zip(*rows, strict=True)), strict=True)))
    angles = entry_angle_deg(truth[:, :6])
    delivery = Delivery(angle_mean_deg=float(angles.mean()), angle_sigma_deg=float(angles.std()))
    speeds = np.linalg.norm(truth[:, 3:6], axis=1)
    return Flown(history=history, delivery=delivery, angles_deg=angles, speeds_km_s=speeds)


def _seen(image: PlannedImage, truth: Float, rng: np.random.Generator) -> BodyObservation:
    """The image as many spacecraft take it, each with the world's noise and bias."""
    plan = image.observation
    exact = observe_body(
        truth, plan.camera_from_inertial, plan.body_position_km, plan.radius_km, np.zeros((len(truth), 3))
    )
    noise = rng.normal(0.0, np.sqrt(image.world_variances), exact.shape)
    return replace(plan, measured=exact + image.world_biases + noise)


def _correct(leg: Leg, truth: Float, state: FilterState, rng: np.random.Generator) -> tuple[Float, FilterState]:
    """Truth and estimate after a correction that the estimate commands."""
    burns, guidance = table("return_leg")["burns"], leg.guidance
    assert guidance is not None
    away = (state.mean - leg.steps[-1].mean)[:, :6]
    change = away @ guidance.T + rng.normal(0.0, burns["execution"], (len(truth), 3))
    truth, sensed = apply_burn(truth, change, leg.camera_from_inertial, burns["duration_s"])
    sensed = sensed + rng.normal(0.0, burns["sensing"], sensed.shape)
    inertial = np.tile(leg.camera_from_inertial.T, (len(truth), 1, 1))
    step = maneuver(state.et, state.mean, sensed, inertial, duration_s=burns["duration_s"], sigma_km_s=burns["sensing"])
    return truth, FilterState(step.et, step.mean, step.apply(state.factors))


def entry_angle_deg(states: Float) -> Float:
    """Flight path angle (...) where states (..., 6) near the Earth cross the entry interface; -0 where they pass it by.

    Of the ellipse through each state: energy and angular momentum say how steep it crosses that radius.
    """
    radius = EARTH_KM + table("return_leg")["trajectory"]["entry_altitude_km"]
    position, velocity = states[..., :3], states[..., 3:6]
    distance = np.linalg.norm(position, axis=-1)
    energy = np.sum(velocity**2, axis=-1) / 2.0 - GM_EARTH_KM3_S2 / distance
    speed = np.sqrt(2.0 * (energy + GM_EARTH_KM3_S2 / radius))
    momentum = np.linalg.norm(np.cross(position, velocity), axis=-1)
    return np.asarray(-np.degrees(np.arccos(np.minimum(momentum / (radius * speed), 1.0))))


def angle_slope(mean: Float) -> Float:
    """Derivative (6,) of the entry angle by position and velocity, degrees per km and per km/s, by differences."""
    slope = np.zeros(6)
    for k, step in enumerate(np.repeat([0.1, 1e-4], 3)):
        ends = np.tile(mean[:6], (2, 1))
        ends[:, k] += [step, -step]
        high, low = entry_angle_deg(ends)
        slope[k] = (high - low) / (2.0 * step)
    return slope
