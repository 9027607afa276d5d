"""The example solves an orbit from the observables file alone, with errors that are those it states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from giantlike.core.arrays import Float
from tests.orbit_arc import SCALE, Arc, orbit_example, write_arc

START_ET = 595_300_000.0
TRUTH = np.array([-142.0, -41.0, -23.0, 3.9e-5, 3.0e-5, 1.3e-5, 5.0e-11, 0.0, 1e-12])
FALSE_ALARM = 1e-3


def truth(gm: float) -> Arc:
    """Six days of 48 images in eight visits, of a spacecraft that falls toward a small body with sunlight behind it."""
    times = START_ET + np.concatenate([day * 86400.0 + np.arange(6) * 1200.0 for day in np.linspace(0.0, 6.0, 8)])

    def rate(_: float, state: Float) -> Float:
        return np.concatenate([state[3:], -gm * state[:3] / np.linalg.norm(state[:3]) ** 3 + TRUTH[6:]])

    dense: Any = solve_ivp(rate, (-10.0, 6.3 * 86400.0), TRUTH[:6], dense_output=True, rtol=1e-12, atol=1e-10).sol
    offset = TRUTH[:3] - dense(0.0)[:3]
    return Arc(times=times, relative_km=lambda et: np.asarray(dense(et - START_ET)[:3] + offset), per_attitude=6)


def test_errors_of_orbits_are_those_that_the_covariance_states(tmp_path: Path) -> None:
    """A look at few draws; benchmarks/orbit_determination.py has 200, on a real trajectory."""
    example, arc, draws = orbit_example(), truth(0.0), 5
    squared, fits = {False: 0.0, True: 0.0}, 0.0
    for seed in range(draws):
        write_arc(tmp_path / "o.parquet", arc, np.random.default_rng(seed))
        observations = example.read(str(tmp_path / "o.parquet"), "BENNU")
        for estimate in squared:
            solution = example.solve(observations, estimate=estimate)
            error = solution.values - TRUTH
            squared[estimate] += float(error @ np.linalg.solve(solution.covariance, error))
        fits += solution.chi2
    low, high = (float(chi2.ppf(tail, 9 * draws)) for tail in (FALSE_ALARM / 2, 1.0 - FALSE_ALARM / 2))
    assert low < squared[False] < high
    assert low < squared[True] < high
    low, high = (float(chi2.ppf(tail, (3 * 48 - 9) * draws)) for tail in (FALSE_ALARM / 2, 1.0 - FALSE_ALARM / 2))
    assert low < fits < high


def test_a_hundred_images_do_not_know_the_size_of_a_body_a_hundred_times(tmp_path: Path) -> None:
    example, arc = orbit_example(), truth(0.0)
    write_arc(tmp_path / "o.parquet", arc, np.random.default_rng(1))
    observations = example.read(str(tmp_path / "o.parquet"), "BENNU")
    solution = example.solve(observations)
    distance = float(np.linalg.norm(TRUTH[:3]))
    sigma = float(np.sqrt(np.trace(solution.covariance[:3, :3])))
    assert 0.9 * SCALE * distance < sigma < 1.2 * SCALE * distance


def test_the_pull_of_the_body_is_in_the_dynamics(tmp_path: Path) -> None:
    example = orbit_example()
    times = START_ET + np.linspace(0.0, 6.0 * 86400.0, 5)
    heavy = 1e-5  # km^3/s^2, of a body that turns the path visibly
    found = example.propagate(TRUTH, times, heavy)
    expected = np.array([truth(heavy).relative_km(et) for et in times])
    assert np.abs(found - expected).max() < 1e-2  # km; without the pull 60 km off
    assert np.abs(example.propagate(TRUTH, times, 0.0) - expected).max() > 10.0
