"""Orbit determination from the observables files of runs, and from nothing else but gravity and ephemerides.

Batch least squares over the position and velocity of the spacecraft relative to a central body at the first image, an
acceleration (of sunlight, and of whatever else is slow), and the velocity changes of maneuvers. Attitudes, sizes and
poles of the bodies and the camera are considered: their errors, each common to all rows that share it, enter the
covariance; or they are estimated, with what is known of them as a priori. It is what another program would do with the
file: it shares no code with the estimators.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import parquet
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.stats import chi2

Array = NDArray[np.float64]

POSITION_KM, VELOCITY_KM_S = 1e6, 1.0  # units of the state; it has no a priori
ACCELERATION_KM_S2 = 1e-10  # a priori sigma: twice the acceleration of a spacecraft at 1 au by sunlight
DIFFERENCES = [1e-3] * 3 + [1e-8] * 3 + [1e-14] * 3  # km, km/s, km/s^2: a meter over some days, of ranges of km
DEGREE = 3  # of the first guess: an arc of less than a revolution
HOUR_S, AU_KM = 3600.0, 149_597_870.7
ROUNDS = 3  # of shared partials, which depend weakly on the solution
OPEN = 0.1  # sigma of the position over the distance to the nearest body: the linear covariance ends there
FALSE_ALARM = 1e-6  # rate at which correct data are called a contradiction
OWN = ("noise", "background", "psf", "edge", "reflectance", "albedo", "relief", "altitude", "orientation")
"""Parts of the covariance of which no derivative is given: taken as new in each row."""


class RefusedError(Exception):
    """The data do not determine an orbit, or contradict it."""


@dataclass(frozen=True)
class Observation:
    """One row: epoch, direction and range from the spacecraft to a body, and how pixels follow from them.

    ``shared`` has the derivative by each error that rows share, and its covariance.
    """

    file: str
    estimator: str
    status: str
    attitude_source: str
    et: float
    utc: str
    target: str
    direction: Array
    range_km: float
    ranged: bool
    by_position: Array
    noise: Array
    shared: dict[str, tuple[Array, Array]]
    observer: tuple[Array, Array] | None

    def residual(self, relative_km: Array) -> Array:
        """Observed less computed pixel, line and, if any, range, of bodies at (..., 3) km from the spacecraft."""
        plane = relative_km / (relative_km @ self.direction)[..., None] - self.direction
        pixels = -self.range_km * plane @ self.by_position[:2].T
        if not self.ranged:
            return np.asarray(pixels)
        short = self.range_km - np.linalg.norm(relative_km, axis=-1, keepdims=True)
        return np.concatenate([pixels, short], axis=-1)


@dataclass(frozen=True)
class Maneuver:
    """A change of velocity at an epoch, with the a priori sigma (km/s) of each component about the planned (3,)."""

    et: float
    sigma_km_s: float
    planned_km_s: tuple[float, float, float] = (0.0, 0.0, 0.0)


def stay(_: str, __: float) -> Array:
    """Place of a body that is itself the center."""
    return np.zeros(3)


@dataclass(frozen=True)
class Dynamics:
    """Point masses with gravitational parameters (km^3/s^2), their places relative to the center, and maneuvers.

    The acceleration is constant, with an a priori of ``acceleration_sigma`` about zero; with a ``sun`` that has a place
    it is that of sunlight: away from it, along the motion of it and across, as the inverse square of its distance,
    stated at 1 au, with an a priori about ``sunlight`` away from it. ``oblateness`` of the center: J2 times the square
    of its radius, km^2, and pole.
    """

    center: str
    gm: dict[str, float] = field(default_factory=dict)
    place: Callable[[str, float], Array] = stay
    maneuvers: tuple[Maneuver, ...] = ()
    acceleration_sigma: float = ACCELERATION_KM_S2
    sun: str = ""
    sunlight: float = 0.0
    oblateness: tuple[float, Array] | None = None

    def pull(self, et: float, position: Array) -> Array:
        """Acceleration (..., 3) of the spacecraft relative to the center."""
        total = np.zeros_like(position)
        for name, gm in self.gm.items():
            body = self.place(name, et)
            total += gm * (body - position) / np.linalg.norm(body - position, axis=-1, keepdims=True) ** 3
            if name != self.center:
                total -= gm * body / np.linalg.norm(body) ** 3
        if self.oblateness is not None:
            j2_km2, pole = self.oblateness
            squared, along = np.sum(position**2, axis=-1)[..., None], (position @ pole)[..., None]
            zonal = (1.0 - 5.0 * along**2 / squared) * position + 2.0 * along * pole
            total -= 1.5 * self.gm[self.center] * j2_km2 * zonal / squared**2.5
        return total

    def axes(self, et: float) -> Array:
        """Acceleration (3, 3) by each component of the estimated one."""
        if not self.sun:
            return np.eye(3)
        sun, later = self.place(self.sun, et), self.place(self.sun, et + HOUR_S)
        normal = np.cross(sun, later)
        away, normal = -sun / np.linalg.norm(sun), normal / np.linalg.norm(normal)
        return np.stack([away, np.cross(normal, away), normal], axis=-1) * AU_KM**2 / (sun @ sun)

    @property
    def apriori(self) -> Array:
        """A priori values of the unknowns (9 + 3 m,), but for the state."""
        return np.array(
            [0.0] * 6 + [self.sunlight, 0.0, 0.0] + [v for each in self.maneuvers for v in each.planned_km_s]
        )

    @property
    def information(self) -> Array:
        """A priori inverse variances of the unknowns (9 + 3 m,); none of the state."""
        sigmas = [self.acceleration_sigma] * 3 + [each.sigma_km_s for each in self.maneuvers for _ in range(3)]
        return np.concatenate([np.zeros(6), np.array(sigmas) ** -2.0])

    @property
    def units(self) -> Array:
        """Size of each unknown (9 + 3 m,)."""
        kicks = [each.sigma_km_s for each in self.maneuvers for _ in range(3)]
        return np.array([POSITION_KM] * 3 + [VELOCITY_KM_S] * 3 + [self.acceleration_sigma] * 3 + kicks)

    @property
    def differences(self) -> Array:
        """Steps (9 + 3 m,) of numerical derivatives."""
        return np.array(DIFFERENCES + [DIFFERENCES[3]] * (3 * len(self.maneuvers)))

    def fly(self, values: Array, times: Array) -> Array:
        """Positions (..., n, 3) of the spacecraft relative to the center, km, for unknowns (..., 9 + 3 m).

        The start is the first of the times; all flights take common steps.
        """
        epochs, order = np.unique(times, return_inverse=True)
        places, state, start = np.empty((*values.shape[:-1], len(epochs), 3)), values[..., :6], float(epochs[0])
        stops = [each.et for each in self.maneuvers]
        for k in [*np.argsort(stops).tolist(), None]:
            end = float(epochs[-1]) if k is None else min(stops[k], float(epochs[-1]))
            inside = np.flatnonzero((epochs >= start) & (epochs <= end))
            if end > start:
                flown = solve_ivp(
                    self._rate,
                    (start, end),
                    state.ravel(),
                    t_eval=np.union1d(epochs[inside], [start, end]),
                    args=(values[..., 6:9],),
                    method="DOP853",
                    rtol=1e-11,
                    atol=1e-9,
                )
                if not flown.success:
                    raise RefusedError(
                        f"the flight from {start:.0f} to {end:.0f} cannot be integrated: {flown.message}"
                    )
                states = flown.y.T.reshape(-1, *state.shape)
                places[..., inside, :] = np.moveaxis(states[np.isin(flown.t, epochs[inside]), ..., :3], 0, -2)
                state, start = states[-1], end
            elif inside.size:
                places[..., inside, :] = state[..., None, :3]
            if k is not None:
                kick = values[..., 9 + 3 * k : 12 + 3 * k]
                state = np.concatenate([state[..., :3], state[..., 3:] + kick], axis=-1)
        return np.asarray(places[..., order, :])

    def _rate(self, et: float, flat: Array, push: Array) -> Array:
        """Derivative of states (..., 6) by time."""
        state = flat.reshape(*push.shape[:-1], 6)
        change = self.pull(et, state[..., :3]) + push @ self.axes(et).T
        return np.concatenate([state[..., 3:], change], axis=-1).ravel()


@dataclass(frozen=True)
class Solution:
    """State (km, km/s) relative to the center, acceleration (km/s^2) and velocity changes (km/s), with covariance."""

    et: float
    values: Array
    covariance: Array
    chi2: float
    n_residuals: int
    normalized: dict[str, float]


def read(path: str, targets: Sequence[str] = (), *, every: bool = False) -> list[Observation]:
    """Preferred fixes, or all, of targets, by default of all, in order of time."""
    table = parquet.read_table(path)
    camera = json.loads(table.schema.metadata[b"camera_parameters"])
    rows = [row for row in table.to_pylist() if row["kind"] == "body" and (every or row["preferred"])]
    names = sorted({row["target"] for row in rows})
    missing = set(targets) - set(names)
    chosen = [row for row in rows if row["target"] in (targets or names) and row["geometric_direction_icrf"]]
    if missing or not chosen:
        raise RefusedError(
            f"{path}: no preferred fix of {', '.join(sorted(missing)) or 'any body'} with a geometric direction; "
            f"it has {', '.join(names) or 'none'}"
        )
    camera_covariance = np.array(camera["covariance"], dtype=np.float64)
    return sorted(split_drift([observation(row, camera_covariance) for row in chosen]), key=lambda each: each.et)


def split_drift(observations: list[Observation]) -> list[Observation]:
    """Observations that share the smallest covariance of each attitude; the rest, its drift, is noise of the row."""
    smallest: dict[str, Array] = {}
    for each in observations:
        for key, (_, matrix) in each.shared.items():
            smallest[key] = min(smallest.get(key, matrix), matrix, key=np.trace)
    split = []
    for each in observations:
        noise, shared = each.noise, {}
        for key, (partial, matrix) in each.shared.items():
            values, axes = np.linalg.eigh(matrix - smallest[key])
            drift = partial @ axes * np.sqrt(np.maximum(values, 0.0))
            noise, shared[key] = noise + drift @ drift.T, (partial, smallest[key])
        split.append(replace(each, noise=noise, shared=shared))
    return split


def observation(row: dict[str, Any], camera_covariance: Array) -> Observation:
    """Observation of a row of the file."""
    ranged = row["geometric_position_icrf_km"] is not None
    size = 3 if ranged else 2
    position = row["geometric_position_icrf_km"] if ranged else row["geometric_direction_icrf"]
    range_km = float(np.linalg.norm(position)) if ranged else row["computed_apparent_range_km"]
    parts = [row[f"part_{name}"] for name in OWN if row[f"part_{name}"] is not None]
    noise = sum((np.reshape(part, (3, 3))[:size, :size] for part in parts), np.zeros((size, size)))
    shared: dict[str, tuple[Array, Array]] = {}
    body, camera = row["shared_body"], row["shared_camera"]
    for key, partial, count, covariance in (
        (f"attitude {row['shared_attitude']}", "partial_attitude", 3, row["attitude_covariance_rad2"]),
        (f"scale of {body}", "partial_shape_scale", 1, square(row["sigma_shape_scale"])),
        (f"pole of {body}", "partial_pole", 2, square(row["sigma_pole_rad"])),
        (f"spin of {body}", "partial_spin", 1, square(row["sigma_spin_rad"])),
        (f"sun of {body}", "partial_sun", 3, square(row["sigma_sun_rad"])),
        (f"camera {camera}", "partial_camera_parameters", len(camera_covariance), camera_covariance.ravel()),
    ):
        if count and row[partial] is not None and covariance is not None:
            matrix = np.reshape(covariance, (count, count)) if np.size(covariance) > 1 else covariance * np.eye(count)
            shared[key] = np.reshape(row[partial], (3, count))[:size], np.asarray(matrix, dtype=np.float64)
    position_km, velocity_km_s = row["observer_position_icrf_km"], row["observer_velocity_icrf_km_s"]
    known = row["states_origin"] == "SOLAR SYSTEM BARYCENTER" and position_km is not None
    return Observation(
        file=row["file"],
        estimator=row["estimator"],
        status=row["status"],
        attitude_source=row["attitude_source"],
        et=row["epoch_et_s"],
        utc=row["epoch_utc"],
        target=row["target"],
        direction=np.array(row["geometric_direction_icrf"]),
        range_km=range_km,
        ranged=ranged,
        by_position=np.reshape(row["partial_target_position"], (3, 3)),
        noise=noise,
        shared=shared,
        observer=(np.array(position_km), np.array(velocity_km_s)) if known else None,
    )


def square(sigma: float | None) -> float | None:
    """Square of a sigma, if there is one."""
    return None if sigma is None else sigma**2


def first_guess(observations: list[Observation], dynamics: Dynamics) -> Array:
    """Polynomial through the measured positions; those without a range are taken at the computed one."""
    times = np.array([each.et for each in observations])
    since = (times - times[0]) / max(float(np.ptp(times)), 1.0)
    places = np.array([dynamics.place(each.target, each.et) - each.range_km * each.direction for each in observations])
    *_, slope, place = np.polyfit(since, places, min(DEGREE, len(set(times.tolist())) - 1))
    return np.concatenate([place, slope / max(float(np.ptp(times)), 1.0), dynamics.apriori[6:]])


def solve(
    observations: list[Observation],
    dynamics: Dynamics | None = None,
    *,
    start: Array | None = None,
    estimate: bool = False,
    check: bool = True,
) -> Solution:
    """Batch least squares; shared errors are considered, or estimated with what is known of them.

    To estimate them is to weight the data with the covariance that holds their errors. Without the check, a solution
    that the data contradict is returned too.
    """
    dynamics = Dynamics(observations[0].target) if dynamics is None else dynamics
    times, information = np.array([each.et for each in observations]), dynamics.information
    n_residuals = sum(len(each.noise) for each in observations)
    if n_residuals <= 6 or np.ptp(times) == 0.0:
        epochs = len(set(times.tolist()))
        raise RefusedError(
            f"{n_residuals} residuals of {epochs} epochs do not determine and check six unknowns: more are needed"
        )
    noise = block_diagonal([each.noise for each in observations])
    values = first_guess(observations, dynamics) if start is None else start

    there = np.array([dynamics.place(each.target, each.et) for each in observations])

    def residuals(trials: Array) -> Array:
        relative = there - dynamics.fly(trials, times)
        each_row = [each.residual(relative[..., k, :]) for k, each in enumerate(observations)]
        return np.concatenate(each_row, axis=-1)

    for _ in range(ROUNDS):
        by_shared, known = shared_errors(observations, dynamics, dynamics.fly(values, times))
        total = noise + by_shared @ known @ by_shared.T
        root = np.asarray(np.linalg.cholesky(total if estimate else noise))
        values = minimize(residuals, values, root, dynamics)
    design = np.linalg.solve(root, derivatives(residuals, values, dynamics))
    covariance = invert(design.T @ design + np.diag(information))
    if not estimate:
        gain = covariance @ design.T @ np.linalg.solve(root, by_shared)
        covariance = covariance + gain @ known @ gain.T
    left, nearest_km = residuals(values), float(np.linalg.norm(there - dynamics.fly(values, times), axis=1).min())
    squares = float(left @ np.linalg.solve(total, left))
    if check:
        apriori = float(information @ (values - dynamics.apriori) ** 2)
        check_solution(covariance, squares + apriori, n_residuals, nearest_km)
    sigma = np.sqrt(np.diag(total))
    names = np.concatenate([[each.target] * len(each.noise) for each in observations])
    return Solution(
        et=float(times[0]),
        values=values,
        covariance=covariance,
        chi2=squares,
        n_residuals=n_residuals,
        normalized={
            name: float(np.sqrt(np.mean((left / sigma)[names == name] ** 2))) for name in dict.fromkeys(names.tolist())
        },
    )


def minimize(residuals: Callable[[Array], Array], values: Array, root: Array, dynamics: Dynamics) -> Array:
    """Unknowns with the smallest weighted squares, by Levenberg and Marquardt."""
    units, weight, expected = dynamics.units, np.sqrt(dynamics.information), dynamics.apriori

    def weigh(scaled: Array) -> Array:
        return np.append(np.linalg.solve(root, residuals(scaled * units)), weight * (scaled * units - expected))

    def slopes(scaled: Array) -> Array:
        by_data = np.linalg.solve(root, derivatives(residuals, scaled * units, dynamics))
        return np.vstack([-by_data * units, np.diag(weight * units)])

    found = least_squares(weigh, values / units, jac=slopes, method="lm", x_scale="jac")
    if not found.success:
        raise RefusedError(f"no flight under these forces follows the data: {found.message}")
    return np.asarray(found.x * units)


def derivatives(residuals: Callable[[Array], Array], values: Array, dynamics: Dynamics) -> Array:
    """Derivatives (n, k) of the computed observations, by central differences."""
    steps = np.diag(dynamics.differences)
    low, high = np.split(residuals(values + np.concatenate([-steps, steps])), 2)
    return np.asarray((low - high).T / (2.0 * dynamics.differences))


def check_solution(covariance: Array, squares: float, n_residuals: int, range_km: float) -> None:
    """Refuse a solution that the data leave open, or that they contradict."""
    sigma_km = math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    if not sigma_km < OPEN * range_km:
        raise RefusedError(
            f"the data leave the position open by {sigma_km:.3g} km (sigma), {range_km:.3g} km from the nearest body"
        )
    chance = float(chi2.sf(squares, n_residuals - 6))
    if not chance > FALSE_ALARM:
        raise RefusedError(
            f"chi-square {squares:.3g} of {n_residuals} residuals (chance {chance:.1e}): the dynamics or the stated "
            "errors are wrong; look for a maneuver, a missing mass, or a body whose fixes differ from the others"
        )


def shared_errors(observations: list[Observation], dynamics: Dynamics, places: Array) -> tuple[Array, Array]:
    """Derivatives (n, s) of the observations by all shared errors, and the covariance (s, s) of these.

    Derivatives of ranges go by the range: the solved one has less noise than the measured one, which the file has.
    """
    keys = {key: matrix for each in observations for key, (_, matrix) in each.shared.items()}
    ends = np.cumsum([len(matrix) for matrix in keys.values()]).tolist()
    spans = {key: slice(end - len(matrix), end) for (key, matrix), end in zip(keys.items(), ends, strict=True)}
    rows = []
    for each, at in zip(observations, places, strict=True):
        row = np.zeros((len(each.noise), ends[-1] if ends else 0))
        for key, (partial, _) in each.shared.items():
            row[:, spans[key]] = partial
        row[2:] *= np.linalg.norm(dynamics.place(each.target, each.et) - at) / each.range_km
        rows.append(row)
    return np.vstack(rows), block_diagonal(list(keys.values()))


def invert(information: Array) -> Array:
    """Inverse of an information matrix whose units differ by many orders."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if not values[0] > len(values) * np.finfo(np.float64).eps * values[-1]:
        raise RefusedError("the data do not determine the unknowns: a combination of them changes no residual")
    return np.asarray((vectors / values) @ vectors.T * np.outer(scale, scale))


def block_diagonal(blocks: list[Array]) -> Array:
    """Matrix with blocks on its diagonal."""
    size = sum(len(block) for block in blocks)
    whole, at = np.zeros((size, size)), 0
    for block in blocks:
        whole[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return whole
