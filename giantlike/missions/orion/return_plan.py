"""The way back from the Moon as a plan: reference flight, passes of images, and corrections with their guidance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from giantlike.cislunar import BodyErrorModel, BodyObservation, FilterModel
from giantlike.cislunar.covariance import reference_steps
from giantlike.cislunar.filter import ATTITUDE, PARAMETERS, POSITION, STATES, Transition
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.dynamics import cislunar, moon_position_km, sun_position_km
from giantlike.missions.orion.constants import EARTH_KM, MOON_KM, earth_errors, focal_px, moon_errors, table

HOUR_S = 3600.0
MOON, EARTH = "Moon", "Earth"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedImage(Value):
    """An image of the plan, with the errors of the world."""

    observation: BodyObservation
    body: str
    range_km: float
    world_variances: Float = field(default_factory=lambda: np.zeros(3))
    world_biases: Float = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Leg(Value):
    """A piece of the plan: flight, then one image or one correction."""

    steps: tuple[Transition, ...]
    image: PlannedImage | None
    guidance: Float | None
    camera_from_inertial: Float

    @property
    def et(self) -> float:
        """Its end."""
        return self.steps[-1].et


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReturnPlan(Value):
    """The whole leg: passes, corrections, and the way to entry."""

    model: FilterModel
    reference: Float
    legs: tuple[Leg, ...]
    passes_h: tuple[float, ...]


def hours_before_entry(et: float) -> float:
    """Hours that are left."""
    return float((table("return_leg")["trajectory"]["entry_et"] - et) / HOUR_S)


def filter_model(longest_step_s: float) -> FilterModel:
    """The filter of 21 states as it is assumed to be tuned; it does not estimate the attitude."""
    numbers = table("return_leg")["filter"]
    rows = [numbers[name] for name in ("attitude", "acceleration", "accelerometer_bias", "accelerometer_scale")]
    pairs = np.repeat(np.array(rows), 3, axis=0)
    center, radius = np.array(numbers["center_bias_px"]), np.array(numbers["radius_bias_px"])
    optical = np.array([center, center, radius * [2.0, 1.0]]) / [focal_px(), 1.0]  # a diameter is two radii
    both = np.concatenate([pairs, optical])
    trajectory = table("return_leg")["trajectory"]
    return FilterModel(
        dynamics=cislunar(trajectory["start_et"], trajectory["entry_et"]),
        sigmas=both[:, 0],
        time_constants_s=both[:, 1],
        considered=np.isin(np.arange(STATES), np.arange(STATES)[ATTITUDE]),
        longest_step_s=longest_step_s,
    )


def make_plan(longest_step_s: float, image_every_s: float) -> ReturnPlan:
    """Fly the reference and record its events, the pass near the Moon that the paper leaves out included."""
    numbers = table("return_leg")
    trajectory, schedule, paper = numbers["trajectory"], numbers["schedule"], table("paper")["passes"]
    model = filter_model(longest_step_s)
    first, last = schedule["first_pass_h"], schedule["last_pass_h"]
    passes = [schedule["close_pass_h"], *np.arange(first, last - 1.0, -paper["every_h"]).tolist()]
    events: list[tuple[float, str]] = []
    for begins in passes:
        start = trajectory["entry_et"] - begins * HOUR_S
        seconds = np.arange(0.0, paper["length_h"] * HOUR_S + 1.0, image_every_s)
        half = paper["length_h"] * HOUR_S / 2.0
        events += [(start + t, MOON if t <= half else EARTH) for t in seconds.tolist()]
        if begins <= first:
            pause = schedule["correction_after_pass_h"] + paper["length_h"]
            events.append((start + pause * HOUR_S, "correction"))
    events.append((trajectory["entry_et"], "entry"))
    reference = np.concatenate([trajectory["state_km_km_s"], np.zeros(PARAMETERS)])
    legs = list(_legs(model, trajectory["start_et"], reference, events))
    return ReturnPlan(model=model, reference=reference, legs=_guide_legs(legs), passes_h=tuple(passes))


def without_close_pass(plan: ReturnPlan) -> ReturnPlan:
    """The plan of the paper: legs to images of the close pass are flown without them."""
    legs: list[Leg] = []
    before: tuple[Transition, ...] = ()
    for leg in plan.legs:
        if leg.image is not None and hours_before_entry(leg.et) > plan.passes_h[1]:
            before += leg.steps
        else:
            legs.append(replace(leg, steps=before + leg.steps))
            before = ()
    return replace(plan, legs=tuple(legs), passes_h=plan.passes_h[1:])


def with_earth(plan: ReturnPlan, errors: BodyErrorModel) -> ReturnPlan:
    """A plan in a world with other errors in images of the Earth."""
    legs = [
        leg if leg.image is None or leg.image.body != EARTH else replace(leg, image=_in_world(leg.image, errors))
        for leg in plan.legs
    ]
    return replace(plan, legs=tuple(legs))


def _in_world(image: PlannedImage, errors: BodyErrorModel) -> PlannedImage:
    """An image with the errors of a model."""
    radius_km = image.observation.radius_km
    return replace(
        image,
        world_variances=errors.measurement_sigmas(image.range_km, radius_km, focal_px()) ** 2,
        world_biases=errors.measurement_biases(image.range_km, radius_km, focal_px()),
    )


def _legs(model: FilterModel, et: float, mean: Float, events: list[tuple[float, str]]) -> Iterator[Leg]:
    """Fly to each event in turn."""
    errors = {MOON: moon_errors(), EARTH: earth_errors(as_moon=True)}
    believed = BodyErrorModel(noise_px=np.array(table("return_leg")["filter"]["noise_px"]))
    camera_from_inertial = np.eye(3)
    for time, what in events:
        steps = reference_steps(model, et, mean, time)
        et, mean = time, steps[-1].mean
        image = None
        if what in errors:
            place = moon_position_km(et) if what == MOON else np.zeros(3)
            radius_km = MOON_KM if what == MOON else EARTH_KM
            toward = place - mean[POSITION]
            distance, camera_from_inertial = float(np.linalg.norm(toward)), _camera(toward, sun_position_km(et))
            believed_sigmas = believed.measurement_sigmas(distance, radius_km, focal_px())
            observation = BodyObservation(
                et=et,
                measured=np.zeros(3),
                variances=believed_sigmas**2,
                camera_from_inertial=camera_from_inertial,
                body_position_km=place,
                radius_km=radius_km,
            )
            bare = PlannedImage(observation=observation, body=what, range_km=distance)
            image = _in_world(bare, errors[what])
        guidance = np.zeros((3, 6)) if what == "correction" else None
        yield Leg(steps=tuple(steps), image=image, guidance=guidance, camera_from_inertial=camera_from_inertial)


def _camera(toward: Float, sun: Float) -> Float:
    """Attitude (3, 3) with the boresight to a body and the x axis to the side of the Sun."""
    boresight = toward / np.linalg.norm(toward)
    up = np.cross(boresight, sun)
    up /= np.linalg.norm(up)
    return np.array([np.cross(up, boresight), up, boresight])


def _guide_legs(legs: list[Leg]) -> tuple[Leg, ...]:
    """Legs whose corrections aim at the position of the reference at entry, at the same time."""
    to_entry, guided = np.eye(6), []
    for leg in reversed(legs):
        if leg.guidance is not None:
            by_place, by_velocity = to_entry[:3, :3], to_entry[:3, 3:]
            leg = replace(leg, guidance=np.hstack([-np.linalg.solve(by_velocity, by_place), -np.eye(3)]))
        for step in reversed(leg.steps):
            to_entry = to_entry @ step.by_state
        guided.append(leg)
    return tuple(reversed(guided))
