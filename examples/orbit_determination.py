"""Solve the arc of a spacecraft from the observables file of a run, and from nothing else but gravity and ephemerides.

Batch least squares over the position and velocity of the spacecraft relative to a central body at the first image, a
constant acceleration (of sunlight, and of whatever else is slow), and the velocity changes of maneuvers. Attitudes,
sizes and poles of the bodies, the camera, and errors of the ephemerides are considered: they are not estimated, and
their errors, each common to all rows that share it, enter the covariance. ``--estimate`` solves for them, with what is
known of them as a priori.

    python examples/orbit_determination.py demo-output/run/observables.parquet --target MOON
    python examples/orbit_determination.py run/observables.parquet --center SATURN --kernels sat.bsp,gm.tpc
        --maneuver 2005-11-27T10:00:00=5 --ephemeris-km 3

One target needs no kernel: the spacecraft then flies relative to it. Several targets need ephemerides of all of them
and of the central body. Kernels give gravitational parameters too; ``--gm NAME=KM3_S2`` replaces them.

Exit code 1: the data do not determine the orbit, or contradict it beyond chance.

Only numpy, scipy, pyarrow and, for kernels, spiceypy are used: it is what another program would do with the file.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
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
    """A change of velocity at an epoch, with the a priori sigma (km/s) of each component about zero."""

    et: float
    sigma_km_s: float


def stay(_: str, __: float) -> Array:
    """Place of a body that is itself the center."""
    return np.zeros(3)


@dataclass(frozen=True)
class Dynamics:
    """Point masses with gravitational parameters (km^3/s^2), their places relative to the center, and maneuvers."""

    center: str
    gm: dict[str, float] = field(default_factory=dict)
    place: Callable[[str, float], Array] = stay
    maneuvers: tuple[Maneuver, ...] = ()
    acceleration_sigma: float = ACCELERATION_KM_S2

    def pull(self, et: float, position: Array) -> Array:
        """Acceleration (..., 3) of the spacecraft relative to the center."""
        total = np.zeros_like(position)
        for name, gm in self.gm.items():
            body = self.place(name, et)
            total += gm * (body - position) / np.linalg.norm(body - position, axis=-1, keepdims=True) ** 3
            if name != self.center:
                total -= gm * body / np.linalg.norm(body) ** 3
        return total

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
        return np.concatenate([state[..., 3:], self.pull(et, state[..., :3]) + push], axis=-1).ravel()


@dataclass(frozen=True)
class Solution:
    """State (km, km/s) relative to the center, acceleration (km/s^2) and velocity changes (km/s), with covariance."""

    et: float
    values: Array
    covariance: Array
    chi2: float
    n_residuals: int
    normalized: dict[str, float]


def read(path: str, targets: Sequence[str] = ()) -> list[Observation]:
    """Preferred fixes of targets, by default of all, in order of time."""
    table = parquet.read_table(path)
    camera = json.loads(table.schema.metadata[b"camera_parameters"])
    rows = [row for row in table.to_pylist() if row["kind"] == "body" and row["preferred"]]
    names = sorted({row["target"] for row in rows})
    missing = set(targets) - set(names)
    chosen = [row for row in rows if row["target"] in (targets or names) and row["geometric_direction_icrf"]]
    if missing or not chosen:
        raise RefusedError(
            f"{path}: no preferred fix of {', '.join(sorted(missing)) or 'any body'} with a geometric direction; "
            f"it has {', '.join(names) or 'none'}"
        )
    camera_covariance = np.array(camera["covariance"], dtype=np.float64)
    return sorted((observation(row, camera_covariance) for row in chosen), key=lambda each: each.et)


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
        (f"scale of {body}", "partial_shape_scale", 1, squared(row["sigma_shape_scale"])),
        (f"pole of {body}", "partial_pole", 2, squared(row["sigma_pole_rad"])),
        (f"spin of {body}", "partial_spin", 1, squared(row["sigma_spin_rad"])),
        (f"sun of {body}", "partial_sun", 3, squared(row["sigma_sun_rad"])),
        (f"camera {camera}", "partial_camera_parameters", len(camera_covariance), camera_covariance.ravel()),
    ):
        if count and row[partial] is not None and covariance is not None:
            matrix = np.reshape(covariance, (count, count)) if np.size(covariance) > 1 else covariance * np.eye(count)
            shared[key] = np.reshape(row[partial], (3, count))[:size], np.asarray(matrix, dtype=np.float64)
    position_km, velocity_km_s = row["observer_position_icrf_km"], row["observer_velocity_icrf_km_s"]
    known = row["states_origin"] == "SOLAR SYSTEM BARYCENTER" and position_km is not None
    return Observation(
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


def squared(sigma: float | None) -> float | None:
    """Square of a sigma, if there is one."""
    return None if sigma is None else sigma**2


def first_guess(observations: list[Observation], dynamics: Dynamics) -> Array:
    """Polynomial through the measured positions; those without a range are taken at the computed one."""
    times = np.array([each.et for each in observations])
    since = (times - times[0]) / max(float(np.ptp(times)), 1.0)
    places = np.array([dynamics.place(each.target, each.et) - each.range_km * each.direction for each in observations])
    *_, slope, place = np.polyfit(since, places, min(DEGREE, len(set(times.tolist())) - 1))
    return np.concatenate([place, slope / max(float(np.ptp(times)), 1.0), np.zeros(3 + 3 * len(dynamics.maneuvers))])


def solve(
    observations: list[Observation],
    dynamics: Dynamics | None = None,
    *,
    start: Array | None = None,
    estimate: bool = False,
) -> Solution:
    """Batch least squares; shared errors are considered, or estimated with what is known of them.

    To estimate them is to weight the data with the covariance that holds their errors.
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
    check_solution(covariance, squares + float(information @ values**2), n_residuals, nearest_km)
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
    units, weight = dynamics.units, np.sqrt(dynamics.information)

    def weighted(scaled: Array) -> Array:
        return np.append(np.linalg.solve(root, residuals(scaled * units)), weight * scaled * units)

    def slopes(scaled: Array) -> Array:
        by_data = np.linalg.solve(root, derivatives(residuals, scaled * units, dynamics))
        return np.vstack([-by_data * units, np.diag(weight * units)])

    found = least_squares(weighted, values / units, jac=slopes, method="lm", x_scale="jac")
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


def dynamics_from(arguments: argparse.Namespace, observations: list[Observation]) -> tuple[Dynamics, Array | None]:
    """Dynamics of the command line, and the state at the first image by the file, where kernels have the center."""
    targets = list(dict.fromkeys(each.target for each in observations))
    center = arguments.center or targets[0]
    first = observations[0]
    maneuvers = tuple(Maneuver(et_of(utc, first), 1e-6 * float(size)) for utc, size in arguments.maneuver)
    if not arguments.kernels:
        if targets != [center]:
            raise RefusedError(
                f"{', '.join(targets)} about {center}: several bodies need --kernels, or name one by --target"
            )
        gm = dict.fromkeys([center], float(arguments.gm[-1][1])) if arguments.gm else {}
        return Dynamics(center, gm, maneuvers=maneuvers), None
    import spiceypy

    def ask(function: Callable[..., Any], *inputs: Any) -> Any:
        try:
            return function(*inputs)
        except spiceypy.utils.exceptions.SpiceyError as error:
            raise RefusedError(f"kernels: {' '.join(f'{error.short} {error.long}'.split())}") from error

    ask(spiceypy.furnsh, arguments.kernels)

    def place(name: str, et: float) -> Array:
        return np.asarray(ask(spiceypy.spkpos, name, et, "J2000", "NONE", center)[0])

    gm = dict[str, float]()
    for name in dict.fromkeys([center, *targets, *arguments.pull]):
        given = [value for key, value in arguments.gm if key in (name, "")]
        gm[name] = float(given[0]) if given else float(ask(spiceypy.bodvrd, name, "GM", 1)[1][0])
    start = None
    if first.observer is not None:
        state = np.concatenate(first.observer) - ask(spiceypy.spkezr, center, first.et, "J2000", "NONE", "SSB")[0]
        start = np.concatenate([state, np.zeros(3 + 3 * len(maneuvers))])
    return Dynamics(center, gm, place, maneuvers), start


def et_of(utc: str, first: Observation) -> float:
    """TDB seconds past J2000 of a UTC epoch in the same stretch between leap seconds as the first image."""
    epochs = [datetime.fromisoformat(text).replace(tzinfo=UTC) for text in (utc, first.utc)]
    return first.et + (epochs[0] - epochs[1]).total_seconds()


def named(text: str) -> tuple[str, str]:
    """Name and value of NAME=VALUE; a bare value has no name."""
    name, _, value = text.rpartition("=")
    return name, value


def main() -> int:
    """Solve, print, and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", help="observables.parquet of a run")
    parser.add_argument("--target", type=lambda text: text.split(","), default=[], help="names, by default all")
    parser.add_argument("--center", help="central body; by default the one target")
    parser.add_argument("--kernels", type=lambda text: text.split(","), help="ephemerides and gravitational parameters")
    parser.add_argument("--pull", type=lambda text: text.split(","), default=[], help="further bodies that pull")
    parser.add_argument("--gm", type=named, action="append", default=[], help="[NAME=]km^3/s^2")
    parser.add_argument("--maneuver", type=named, action="append", default=[], help="UTC=sigma in mm/s of an impulse")
    parser.add_argument("--ephemeris-km", type=float, default=0.0, help="sigma of each body relative to the center")
    parser.add_argument("--estimate", action="store_true", help="solve for the shared errors as well")
    arguments = parser.parse_args()
    try:
        observations = read(arguments.file, arguments.target)
        dynamics, start = dynamics_from(arguments, observations)
        if arguments.ephemeris_km > 0.0:
            for each in observations:
                if each.target != dynamics.center:
                    by_place = each.by_position[: len(each.noise)]
                    each.shared[f"ephemeris of {each.target}"] = by_place, arguments.ephemeris_km**2 * np.eye(3)
        solution = solve(observations, dynamics, start=start, estimate=arguments.estimate)
    except (RefusedError, OSError) as refused:
        print(f"no orbit: {refused}", file=sys.stderr)
        return 1
    sigma = np.sqrt(np.diag(solution.covariance))
    print(f"{len(observations)} observations, {solution.n_residuals} residuals, chi-square {solution.chi2:.1f}")
    for name, rms in solution.normalized.items():
        print(f"  {name}: rms of residuals over sigma {rms:.2f}")
    print(f"spacecraft relative to {dynamics.center}, ICRF, at et {solution.et:.3f} s (TDB past J2000)")
    rows = [("position", "km", 1.0), ("velocity", "mm/s", 1e6), ("acceleration", "nm/s^2", 1e12)]
    rows += [(f"maneuver {utc}", "mm/s", 1e6) for utc, _ in arguments.maneuver]
    for k, (name, unit, factor) in enumerate(rows):
        for axis, n in zip("xyz", range(3 * k, 3 * k + 3), strict=True):
            print(f"  {name} {axis}: {factor * solution.values[n]:16.6f} +- {factor * sigma[n]:.6f} {unit}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
