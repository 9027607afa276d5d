"""Solve the arc of a spacecraft near a body from the observables file of a run, and from nothing else.

Batch least squares over the position and velocity of the spacecraft relative to the body at the first image, and a
constant acceleration (of sunlight, and of whatever else is slow); the body pulls with ``--gm``. Attitudes, the size of
the body, its pole and the camera are considered: they are not estimated, and their errors, each common to all rows that
share it, enter the covariance. ``--estimate`` solves for them, with what is known of them as a priori.

    python examples/orbit_determination.py demo-output/run/observables.parquet --target MOON

Only numpy, scipy and pyarrow are used: it is what another program would do with the file.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import parquet
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]

POSITION_KM, VELOCITY_KM_S = 1e6, 1.0  # a priori sigmas of the state: none, in effect
ACCELERATION_KM_S2 = 1e-10  # a priori sigma: twice that of sunlight on a spacecraft at 1 au
DIFFERENCES = [1e-3] * 3 + [1e-8] * 3 + [1e-14] * 3  # km, km/s, km/s^2: a meter over some days, of ranges of km
STEPS = 8
SETTLED = 1e-3  # of a sigma
OWN = ("noise", "background", "psf", "edge", "reflectance", "albedo", "relief", "altitude", "orientation")
"""Parts of the covariance of which no derivative is given: taken as new in each row."""


@dataclass(frozen=True)
class Observation:
    """One row: epoch, direction and range from the spacecraft to the body, and how pixels follow from them."""

    et: float
    direction: Array
    range_km: float
    ranged: bool
    by_position: Array
    noise: Array
    shared: dict[str, tuple[Array, Array]]

    def residual(self, relative_km: Array) -> Array:
        """Observed less computed (pixel, line and, if measured, range) for a body at (3,) km from the spacecraft."""
        plane = relative_km / float(relative_km @ self.direction) - self.direction
        pixels = -self.by_position[:2] @ plane * self.range_km
        if not self.ranged:
            return pixels
        return np.append(pixels, self.range_km - np.linalg.norm(relative_km))


@dataclass(frozen=True)
class Solution:
    """State (km, km/s) relative to the body and acceleration (km/s^2), with their covariance (9, 9)."""

    et: float
    values: Array
    covariance: Array
    chi2: float
    n_residuals: int


def read(path: str, target: str | None) -> list[Observation]:
    """Preferred fixes of a target in order of time."""
    table = parquet.read_table(path)
    camera = json.loads(table.schema.metadata[b"camera_parameters"])
    rows = [row for row in table.to_pylist() if row["kind"] == "body" and row["preferred"]]
    names = sorted({row["target"] for row in rows})
    if target is None and len(names) != 1:
        raise SystemExit(f"{path}: name a target with --target: {', '.join(names) or 'there is none'}")
    chosen = [row for row in rows if row["target"] == (target or names[0]) and row["geometric_direction_icrf"]]
    if not chosen:
        raise SystemExit(f"{path}: no preferred fix of {target} with a geometric direction; it has {', '.join(names)}")
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
        (f"camera {camera}", "partial_camera_parameters", len(camera_covariance), camera_covariance.ravel()),
    ):
        if count and row[partial] is not None and covariance is not None:
            matrix = np.reshape(covariance, (count, count)) if np.size(covariance) > 1 else covariance * np.eye(count)
            shared[key] = np.reshape(row[partial], (3, count))[:size], np.asarray(matrix, dtype=np.float64)
    return Observation(
        et=row["epoch_et_s"],
        direction=np.array(row["geometric_direction_icrf"]),
        range_km=range_km,
        ranged=ranged,
        by_position=np.reshape(row["partial_target_position"], (3, 3)),
        noise=noise,
        shared=shared,
    )


def squared(sigma: float | None) -> float | None:
    return None if sigma is None else sigma**2


def propagate(values: Array, times: Array, gm: float) -> Array:
    """Positions (n, 3) of the spacecraft relative to the body, km."""

    def rate(_: float, state: Array) -> Array:
        pull = -gm * state[:3] / np.linalg.norm(state[:3]) ** 3 if gm else np.zeros(3)
        return np.concatenate([state[3:], pull + values[6:]])

    if times[-1] == times[0]:
        return np.repeat(values[None, :3], len(times), axis=0)
    start = times[0]
    done = solve_ivp(
        rate, (0.0, times[-1] - start), values[:6], t_eval=times - start, method="DOP853", rtol=1e-11, atol=1e-9
    )
    return np.asarray(done.y[:3].T)


def first_guess(observations: list[Observation]) -> Array:
    """Straight line through the measured positions; those without a range are taken at the computed one."""
    times = np.array([each.et for each in observations])
    places = np.array([-each.range_km * each.direction for each in observations])
    slope, place = np.polyfit(times - times[0], places, 1) if np.ptp(times) > 0 else (np.zeros(3), places[0])
    return np.concatenate([place, slope, np.zeros(3)])


def solve(
    observations: list[Observation],
    *,
    gm: float = 0.0,
    estimate: bool = False,
    acceleration_sigma: float = ACCELERATION_KM_S2,
) -> Solution:
    """Batch least squares; shared errors are considered, or estimated with what is known of them."""
    times = np.array([each.et for each in observations])
    keys = {key: matrix for each in observations for key, (_, matrix) in each.shared.items()}
    starts = dict(zip(keys, np.cumsum([0, *(len(matrix) for matrix in keys.values())]).tolist(), strict=False))
    n_shared = sum(len(matrix) for matrix in keys.values())
    prior = np.diag(np.array([POSITION_KM] * 3 + [VELOCITY_KM_S] * 3 + [acceleration_sigma] * 3) ** -2.0)
    known = np.zeros((n_shared, n_shared))
    for key, matrix in keys.items():
        known[starts[key] : starts[key] + len(matrix), starts[key] : starts[key] + len(matrix)] = matrix
    weights = _block([np.linalg.inv(each.noise) for each in observations])
    values, steps = first_guess(observations), np.array(DIFFERENCES)
    for _ in range(STEPS):
        places = propagate(values, times, gm)
        by_shared = np.vstack(
            [_by_shared(each, place, starts, n_shared) for each, place in zip(observations, places, strict=True)]
        )
        residuals = _residuals(observations, places)
        moved = (propagate(values + step, times, gm) for step in np.diag(steps))
        design = np.array([residuals - _residuals(observations, each) for each in moved]).T / steps
        if estimate:
            design = np.hstack([design, by_shared])
            apart = np.zeros((9 + n_shared, 9 + n_shared))
            apart[:9, :9], apart[9:, 9:] = prior, np.linalg.inv(known)
        else:
            apart = prior
        pulled = np.concatenate([-prior @ np.concatenate([np.zeros(6), values[6:]]), np.zeros(len(apart) - 9)])
        covariance = _inverse(design.T @ weights @ design + apart)
        change = (covariance @ (design.T @ weights @ residuals + pulled))[:9]
        values = values + change
        if float(np.max(np.abs(change) / np.sqrt(np.diag(covariance))[:9])) < SETTLED:
            break
    if not estimate:
        sensitivity = covariance @ design.T @ weights @ by_shared
        covariance = covariance + sensitivity @ known @ sensitivity.T
    residuals = _residuals(observations, propagate(values, times, gm))
    total = np.linalg.inv(weights) + by_shared @ known @ by_shared.T
    return Solution(
        et=float(times[0]),
        values=values,
        covariance=covariance[:9, :9],
        chi2=float(residuals @ np.linalg.solve(total, residuals)),
        n_residuals=len(residuals),
    )


def _inverse(matrix: Array) -> Array:
    """Inverse of an information matrix whose units differ by many orders."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale))


def _residuals(observations: list[Observation], places: Array) -> Array:
    return np.concatenate([each.residual(-place) for each, place in zip(observations, places, strict=True)])


def _by_shared(each: Observation, place: Array, starts: dict[str, int], count: int) -> Array:
    """Derivatives of one observation by all shared parameters.

    That of a range goes by the range: the solved one has less noise than the measured one, which the file has.
    """
    rows = np.zeros((len(each.noise), count))
    for key, (partial, matrix) in each.shared.items():
        rows[:, starts[key] : starts[key] + len(matrix)] = partial
    rows[2:] *= np.linalg.norm(place) / each.range_km
    return rows


def _block(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    whole, at = np.zeros((size, size)), 0
    for block in blocks:
        whole[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", help="observables.parquet of a run")
    parser.add_argument("--target", help="needed where the file has several")
    parser.add_argument("--gm", type=float, default=0.0, help="gravitational parameter of the body, km^3/s^2")
    parser.add_argument("--estimate", action="store_true", help="solve for attitudes, size, pole and camera as well")
    arguments = parser.parse_args()
    observations = read(arguments.file, arguments.target)
    solution = solve(observations, gm=arguments.gm, estimate=arguments.estimate)
    sigma = np.sqrt(np.diag(solution.covariance))
    print(f"{len(observations)} observations, {solution.n_residuals} residuals, chi-square {solution.chi2:.1f}")
    print(f"spacecraft relative to the body, ICRF, at et {solution.et:.3f} s (TDB past J2000)")
    for name, unit, factor, start in (
        ("position", "km", 1.0, 0),
        ("velocity", "mm/s", 1e6, 3),
        ("acceleration", "nm/s^2", 1e12, 6),
    ):
        for axis, k in zip("xyz", range(start, start + 3), strict=True):
            print(f"  {name} {axis}: {factor * solution.values[k]:16.6f} +- {factor * sigma[k]:.6f} {unit}")


if __name__ == "__main__":
    main()
