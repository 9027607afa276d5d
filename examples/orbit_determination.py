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

``giantlike.independent.orbit``, which does the work, uses numpy, scipy and pyarrow alone, and this script spiceypy for
kernels: it is what another program would do with the file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import numpy as np

from giantlike.independent.orbit import Array, Dynamics, Maneuver, Observation, RefusedError, read, solve


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
