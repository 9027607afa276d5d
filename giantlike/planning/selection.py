"""Choice of the images that determine an orbit best: greedy D-optimal selection with a minimum gap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, as_finite, require, require_number
from giantlike.core.causes import Cause
from giantlike.core.frames import turned_about
from giantlike.core.values import Value, check_covariance
from giantlike.dynamics import PointMasses, fly
from giantlike.observables import apparent_by_position
from giantlike.planning.drawn import FixForecast
from giantlike.relative.place import place_jacobian
from giantlike.scene import Circumstances

_UNKNOWN_RANGE = 0.1  # sigma of an orbit without covariance, over the range of its first image, and over its time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrbitPrior(Value):
    """State of the spacecraft relative to the target that images shall improve.

    Parameters
    ----------
    et : float, TDB seconds past J2000; epoch of the state
    state : (6,) float64, km and km/s, ICRF axes; spacecraft minus target
    covariance : (6, 6) float64; of the state
    gm_km3_s2 : float, km^3/s^2; of the target; 0: motion along a straight line

    Raises
    ------
    InputError
        A wrong shape, or the covariance is not positive semi-definite.
    """

    et: float
    state: Float
    covariance: Float
    gm_km3_s2: float = 0.0

    def __post_init__(self) -> None:
        require_number(self.et, "orbit et")
        require_number(self.gm_km3_s2, "orbit gm_km3_s2", least=0.0)
        covariance = as_finite(self.covariance, (6, 6), "orbit covariance")
        check_covariance(covariance, "orbit covariance")
        self._keep(state=as_finite(self.state, (6,), "orbit state"), covariance=covariance)


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectOptions:
    """Options of the choice of images.

    Parameters
    ----------
    min_gap_s : float, s; smallest time between two images
    orbit : OrbitPrior, optional; default: state of the first image, sigma a tenth of its range, straight line
    estimator : str, optional; whose fixes count; by default the first of the plan

    Raises
    ------
    InputError
        The gap is negative.
    """

    min_gap_s: float = 0.0
    orbit: OrbitPrior | None = None
    estimator: str | None = None

    def __post_init__(self) -> None:
        require_number(self.min_gap_s, "min_gap_s", least=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement(Value):
    """What an image tells of the orbit.

    Parameters
    ----------
    et : float
    partials : (k, 7) float64; of x, y, px, and of ln range if measured, by the state and the target's size
    covariance : (k, k) float64; without the error of the size, which all images share
    weight : float; probability of a usable fix
    """

    et: float
    partials: Float
    covariance: Float
    weight: float


def _transition(orbit: OrbitPrior, et: float) -> Float:
    """Derivative (3, 6) of the position at a time by the state."""
    if orbit.gm_km3_s2 == 0.0 or et == orbit.et:
        return np.hstack([np.eye(3), (et - orbit.et) * np.eye(3)])
    return np.asarray(fly(PointMasses(orbit.gm_km3_s2), orbit.et, orbit.state, et).by_state[:3])


def measurement_of(
    et: float,
    camera: Camera,
    position_camera_km: Float,
    camera_from_inertial_matrix: Float,
    circumstances: Circumstances | None,
    fix: FixForecast,
    attitude_covariance_rad2: Float | None,
    orbit: OrbitPrior,
) -> Measurement | None:
    """Partials and covariance of a predicted fix; None where there is none."""
    if fix.covariance is None:
        return None
    size = len(fix.covariance)
    apparent_km = camera_from_inertial_matrix.T @ position_camera_km
    by_orbit = np.eye(3) if circumstances is None else apparent_by_position(apparent_km, circumstances)
    by_position = place_jacobian(camera.model, position_camera_km)
    partials = np.zeros((size, 7))
    partials[:, :6] = -(by_position @ camera_from_inertial_matrix @ by_orbit @ _transition(orbit, et))[:size]
    scale = fix.parts.get(Cause.SHAPE_SCALE, np.zeros((size, size)))
    sigma = math.sqrt(float(scale[2, 2])) if size == 3 else 0.0
    partials[2:, 6] = sigma
    covariance = fix.covariance.copy()
    covariance[2:, 2:] -= scale[2:, 2:]
    if attitude_covariance_rad2 is not None:
        turn = turned_about(position_camera_km[None], by_position[None])[0][:size]
        covariance = covariance + turn @ attitude_covariance_rad2 @ turn.T
    return Measurement(
        et=et, partials=partials, covariance=0.5 * (covariance + covariance.T), weight=1.0 - fix.failure_probability
    )


def choose_images(
    measurements: Sequence[Measurement | None], count: int, orbit: OrbitPrior, min_gap_s: float
) -> tuple[list[int], list[float], Float]:
    """Choose images one by one, each the one that lowers the determinant of the orbit's covariance most.

    Returns their indices in the order of the choice, the gain of each, half the logarithm of the ratio of determinants
    before and after, and the covariance (6, 6) of the state with all of them.
    """
    require(count >= 1, f"at least one image has to be chosen, got {count}")
    unit = np.sqrt(np.maximum(np.diag(orbit.covariance), 1e-300))
    information = np.zeros((7, 7))
    information[:6, :6] = np.linalg.inv(orbit.covariance / np.outer(unit, unit) + 1e-15 * np.eye(6))
    information[6, 6] = 1.0
    added = np.zeros((len(measurements), 7, 7))
    for number, one in enumerate(measurements):
        if one is not None:
            rows = one.partials * np.append(unit, 1.0)
            added[number] = one.weight * rows.T @ np.linalg.solve(one.covariance, rows)
    times = np.array([math.nan if one is None else one.et for one in measurements])
    free, chosen, gains = np.isfinite(times), list[int](), list[float]()

    def volumes(matrices: Float) -> Float:
        """Half the log determinants of the information on the orbit, the size of the target marginalized."""
        return np.asarray(0.5 * (np.linalg.slogdet(matrices)[1] - np.log(matrices[..., 6, 6])))

    while free.any() and len(chosen) < count:
        after = np.where(free, volumes(information + added), -np.inf)
        best = int(np.argmax(after))
        gains.append(float(after[best] - volumes(information)))
        information = information + added[best]
        chosen.append(best)
        free &= np.abs(times - times[best]) >= max(min_gap_s, 1e-9)
        free[best] = False
    covariance = np.linalg.inv(information)[:6, :6] * np.outer(unit, unit)
    return chosen, gains, 0.5 * (covariance + covariance.T)


def unknown_orbit(et: float, position_km: Float, velocity_km_s: Float, span_s: float) -> OrbitPrior:
    """Straight line through a state of the spacecraft relative to the target, uncertain by a tenth of the range."""
    sigma = _UNKNOWN_RANGE * float(np.linalg.norm(position_km))
    sigmas = np.repeat([sigma, sigma / max(span_s, 1.0)], 3)
    return OrbitPrior(et=et, state=np.concatenate([position_km, velocity_km_s]), covariance=np.diag(sigmas**2))
