"""A day on the way back from the Moon: two passes of images, and the independent truth of many spacecraft."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import erfa
import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from scipy.interpolate import CubicSpline

from giantlike.cislunar import (
    BodyErrorModel,
    BodyObservation,
    FilterModel,
    FilterState,
    measurement_update,
    time_update,
    udu_factors,
)
from giantlike.cislunar.filter import Innovations
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.dynamics import GM_EARTH_KM3_S2, GM_MOON_KM3_S2, GM_SUN_KM3_S2, PointMasses, ThirdBody, fly
from giantlike.independent.flight import Processes, PullingBodies, fly_spacecraft, observe_body

START_ET = 629_868_960.0
START = np.array([-318090.516, 116693.901, 80282.4906, 0.171139216, -0.115181303, 0.176852145])
"""25,000 km from the Moon, 4.6 days before the entry into the Earth's atmosphere."""
RADII_KM = {"moon": 1737.4, "earth": 6378.137}
FOCAL_PX = 7312.5
ERRORS = BodyErrorModel(noise_px=np.array([0.15, 0.06, 0.12]), relief_px_km=14584.0 * np.array([1.0, 0.5, 1.0]))
SIGMAS = np.repeat([7e-5, 5e-10, 3e-7, 1e-4, 3e-5], 3)
"""15 arcsec, 0.5 um/s^2, 30 micro-g, 1e-4 and 0.2 px, as steady sigmas of the parameters."""
TIMES_S = np.repeat([7200.0, 21600.0, 86400.0, 86400.0, 86400.0], 3)
START_SIGMAS = np.concatenate([np.repeat([20.0, 2e-4], 3), SIGMAS])  # km, km/s


def mean_places() -> tuple[Callable[[float], Float], Callable[[float], Float]]:
    """Places of the Moon and the Sun from the Earth, km, by splines through hourly places of astropy."""
    ets = START_ET + np.arange(-3.0, 125.0) * 3600.0
    times = Time(2_451_545.0, ets / 86_400.0, format="jd", scale="tdb")
    earth, moon, sun = (
        get_body_barycentric(name, times, ephemeris="builtin").xyz.to_value("km").T for name in ("earth", "moon", "sun")
    )
    return CubicSpline(ets, moon - earth), CubicSpline(ets, sun - earth)


MOON_KM, SUN_KM = mean_places()
SKY = PullingBodies(GM_EARTH_KM3_S2, GM_MOON_KM3_S2, GM_SUN_KM3_S2, MOON_KM, SUN_KM)
MODEL = FilterModel(
    dynamics=PointMasses(GM_EARTH_KM3_S2, (ThirdBody(GM_MOON_KM3_S2, MOON_KM), ThirdBody(GM_SUN_KM3_S2, SUN_KM))),
    sigmas=SIGMAS,
    time_constants_s=TIMES_S,
    longest_step_s=600.0,
)


def day_of_images(spacing_s: float = 600.0, gap_h: float = 24.0) -> list[tuple[float, str]]:
    """Times and bodies of images: a pass of 2 h on the Moon, one on the Earth some hours after its start."""
    passes = ((START_ET + 3600.0, "moon"), (START_ET + (1.0 + gap_h) * 3600.0, "earth"))
    return [(et + t, body) for et, body in passes for t in np.arange(0.0, 7200.0 + 1.0, spacing_s).tolist()]


def planned(images: list[tuple[float, str]]) -> Iterator[BodyObservation]:
    """What is known of images beforehand: told attitude to the body, x axis to the Sun, and variances."""
    et, state = START_ET, START
    for time, body in images:
        if time > et:
            et, state = time, fly(MODEL.dynamics, et, state, time).state
        place = MOON_KM(et) if body == "moon" else np.zeros(3)
        boresight = (place - state[:3]) / np.linalg.norm(place - state[:3])
        up = np.cross(boresight, SUN_KM(et))
        up /= np.linalg.norm(up)
        distance = float(np.linalg.norm(place - state[:3]))
        yield BodyObservation(
            et=et,
            measured=np.zeros(3),
            variances=ERRORS.measurement_sigmas(distance, RADII_KM[body], FOCAL_PX) ** 2,
            camera_from_inertial=np.array([np.cross(up, boresight), up, boresight]),
            body_position_km=place,
            radius_km=RADII_KM[body],
        )


def started(runs: int, rng: np.random.Generator) -> tuple[Float, FilterState]:
    """Truths (runs, 21), and the same a priori estimate of all."""
    reference = np.concatenate([START, np.zeros(15)])
    truth = reference + rng.normal(0.0, START_SIGMAS, (runs, 21))
    upper = np.broadcast_to(np.eye(21), (runs, 21, 21))
    factors = replace(udu_factors(np.diag(START_SIGMAS**2)), upper=upper, diagonal=np.tile(START_SIGMAS**2, (runs, 1)))
    return truth, FilterState(START_ET, np.tile(reference, (runs, 1)), factors)


def measured(plan: BodyObservation, truth: Float, rng: np.random.Generator) -> BodyObservation:
    """The image of a plan as many spacecraft take it: errors of the diameter in pixels become those of the range."""
    distance = float(np.mean(np.linalg.norm(plan.body_position_km - truth[:, :3], axis=1)))
    sigmas = ERRORS.sigmas_px(distance) * [1.0, 1.0, 2.0] / FOCAL_PX
    seen = observe_body(
        truth,
        plan.camera_from_inertial,
        plan.body_position_km,
        plan.radius_km,
        rng.normal(0.0, sigmas, (len(truth), 3)),
    )
    return replace(plan, measured=seen)


@dataclass(frozen=True, slots=True, eq=False)
class Flown(Value):
    """The end of a Monte Carlo: truths, estimates, and innovations of all images."""

    truth: Float
    state: FilterState
    innovations: tuple[Innovations, ...]


def flown(runs: int, seed: int, model: FilterModel = MODEL, spacing_s: float = 600.0, gap_h: float = 24.0) -> Flown:
    """Fly spacecraft through a day, each with its filter."""
    rng = np.random.default_rng(seed)
    truth, state = started(runs, rng)
    found = []
    for plan in planned(day_of_images(spacing_s, gap_h)):
        truth = fly_spacecraft(truth, state.et, plan.et, SKY, Processes(SIGMAS, TIMES_S), rng)
        state = time_update(state, plan.et, model)
        state, innovations = measurement_update(state, measured(plan, truth, rng), model)
        found.append(innovations)
    return Flown(truth, state, tuple(found))


def moon98_km(et: float) -> Float:
    """Place of the Moon by the theory itself, to check the spline."""
    return np.asarray(erfa.moon98(2_451_545.0, et / 86_400.0)["p"]) * 149_597_870.7
