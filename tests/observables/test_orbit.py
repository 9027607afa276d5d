"""The example solves an orbit from the observables file alone, with errors that are those it states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spiceypy
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.time import time_from_et, utc_text
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


@pytest.mark.monte_carlo(few=2, full=5)
def test_errors_of_orbits_are_those_that_the_covariance_states(tmp_path: Path, draws: int) -> None:
    """A look at few draws; benchmarks/orbit_determination.py has 200, on a real trajectory."""
    example, arc = orbit_example(), truth(0.0)
    squared, fits = {False: 0.0, True: 0.0}, 0.0
    for seed in range(draws):
        write_arc(tmp_path / "o.parquet", arc, np.random.default_rng(seed))
        observations = example.read(str(tmp_path / "o.parquet"))
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


def test_attitudes_that_drift_after_the_image_of_stars_contradict_no_orbit(tmp_path: Path) -> None:
    """Held in common, a walk of 0.18 px a step leaves chi-squares of 310 to 470 for 135 degrees of freedom."""
    example, arc = orbit_example(), replace(truth(0.0), drift_rad=5e-5)
    write_arc(tmp_path / "o.parquet", arc, np.random.default_rng(2))
    solution = example.solve(example.read(str(tmp_path / "o.parquet")), estimate=True)
    low, high = (float(chi2.ppf(tail, 3 * 48 - 9)) for tail in (FALSE_ALARM / 2, 1.0 - FALSE_ALARM / 2))
    assert low < solution.chi2 < high


def test_a_hundred_images_do_not_know_the_size_of_a_body_a_hundred_times(tmp_path: Path) -> None:
    example, arc = orbit_example(), truth(0.0)
    write_arc(tmp_path / "o.parquet", arc, np.random.default_rng(1))
    observations = example.read(str(tmp_path / "o.parquet"))
    solution = example.solve(observations)
    distance = float(np.linalg.norm(TRUTH[:3]))
    sigma = float(np.sqrt(np.trace(solution.covariance[:3, :3])))
    assert 0.9 * SCALE * distance < sigma < 1.2 * SCALE * distance


def test_the_pull_of_the_body_is_in_the_dynamics(tmp_path: Path) -> None:
    example = orbit_example()
    times = START_ET + np.linspace(0.0, 6.0 * 86400.0, 5)
    heavy = 1e-5  # km^3/s^2, of a body that turns the path visibly
    found = example.Dynamics("BENNU", {"BENNU": heavy}).fly(TRUTH, times)
    expected = np.array([truth(heavy).relative_km(et) for et in times])
    assert np.abs(found - expected).max() < 1e-2  # km; without the pull 60 km off
    assert np.abs(example.Dynamics("BENNU").fly(TRUTH, times) - expected).max() > 10.0


GM = {"SATURN": 3.7931206e7, "RHEA": 153.942, "DIONE": 73.116, "TETHYS": 41.214}
MOONS = {"RHEA": (527_000.0, 4.5), "DIONE": (377_000.0, 2.7), "TETHYS": (295_000.0, 1.9)}
MANEUVER = np.array([8e-3, -6e-3, 4e-3])
TURN_S = 30_000.0


def moon(name: str) -> Callable[[float], Float]:
    """Circular orbit of a moon, of a radius in km and a period in days, relative to Saturn."""
    radius, period = MOONS[name]

    def place(et: float) -> Float:
        angle = 2.0 * np.pi * (et - START_ET) / (period * 86400.0) + period
        return radius * np.array([np.cos(angle), np.sin(angle), 0.05 * np.sin(angle)])

    return place


def tour(places: Mapping[str, Callable[[float], Float]], start_et: float = START_ET) -> tuple[Arc, Float]:
    """A day of 48 images of moons in turn about Saturn, with a maneuver; and the true unknowns."""
    start = np.array([2.3e5, -7.6e5, 3.1e4, 3.4, 7.9, -0.8, 3e-11, -2e-11, 1e-11])
    turn_et = start_et + TURN_S

    def rate(et: float, state: Float) -> Float:
        total = -GM["SATURN"] * state[:3] / np.linalg.norm(state[:3]) ** 3 + start[6:]
        for name, place in places.items():
            there = place(et)
            total += GM[name] * (there - state[:3]) / np.linalg.norm(there - state[:3]) ** 3
            total -= GM[name] * there / np.linalg.norm(there) ** 3
        return np.concatenate([state[3:], total])

    def path(first: float, last: float, state: Float) -> Any:
        return solve_ivp(rate, (first, last), state, method="DOP853", dense_output=True, rtol=1e-12, atol=1e-9).sol

    before, backward = path(start_et, turn_et, start[:6]), path(start_et, start_et - 10.0, start[:6])
    after = path(turn_et, start_et + 90_000.0, before(turn_et) + np.append(np.zeros(3), MANEUVER))

    def relative_km(et: float) -> Float:
        return np.asarray((backward if et < start_et else before if et < turn_et else after)(et)[:3])

    times = start_et + np.linspace(0.0, 86_400.0, 48)
    arc = Arc(times=times, relative_km=relative_km, per_attitude=6, bodies=places)
    return arc, np.append(start, MANEUVER)


@pytest.mark.monte_carlo(few=1, full=4)
def test_a_tour_of_three_moons_solves_for_its_maneuver(tmp_path: Path, draws: int) -> None:
    moons = {name: moon(name) for name in MOONS}
    example, (arc, true) = orbit_example(), tour(moons)
    places = {"SATURN": lambda _: np.zeros(3)} | moons
    maneuver = example.Maneuver(START_ET + TURN_S, 1e-2)
    flown = example.Dynamics("SATURN", GM, lambda name, et: places[name](et), (maneuver,))
    squared = 0.0
    for seed in range(draws):
        write_arc(tmp_path / "o.parquet", arc, np.random.default_rng(seed))
        observations = example.read(str(tmp_path / "o.parquet"))
        solution = example.solve(observations, flown, start=true + np.array([30.0] * 3 + [1e-3] * 3 + [0.0] * 6))
        assert set(solution.normalized) == set(MOONS)
        error = solution.values - true
        squared += float(error @ np.linalg.solve(solution.covariance, error))
    low, high = (float(chi2.ppf(tail, 12 * draws)) for tail in (FALSE_ALARM / 2, 1.0 - FALSE_ALARM / 2))
    assert low < squared < high
    with pytest.raises(example.RefusedError, match="look for a maneuver"):
        example.solve(observations, replace(flown, maneuvers=()), start=true[:9])


@pytest.mark.slow
@pytest.mark.real_data
def test_the_command_solves_about_saturn_by_kernels_and_refuses_what_is_not_determined(
    tmp_path: Path, data_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels = [str(data_dir / "kernels" / name) for name in ("cassini/051122AP_SCPSE_05326_05333.bsp", "gm_de440.tpc")]
    start_et = 185_976_000.0  # 2005-11-23, away from close approaches
    with spiceypy.KernelPool(kernels):

        def place(name: str) -> Callable[[float], Float]:
            return lambda et: np.asarray(spiceypy.spkpos(name, et, "J2000", "NONE", "SATURN")[0])

        def center(et: float) -> tuple[Float, Float]:
            state = np.asarray(spiceypy.spkezr("SATURN", et, "J2000", "NONE", "SSB")[0])
            return state[:3], state[3:]

        arc, true = tour({name: place(name) for name in MOONS}, start_et)
        arc = replace(arc, center=center)
        path = tmp_path / "o.parquet"
        write_arc(path, arc, np.random.default_rng(3))
        write_arc(tmp_path / "one.parquet", replace(arc, times=arc.times[:1]), np.random.default_rng(3))
    turn = utc_text(time_from_et(start_et + TURN_S), 0)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["orbit_determination.py", *arguments])
        try:
            code = orbit_example().main()
        finally:
            spiceypy.kclear()
        return code, *capsys.readouterr()

    about = ["--center", "SATURN", "--kernels", ",".join(kernels)]
    code, out, err = run(str(path), *about, "--maneuver", f"{turn}=10000")
    assert (code, err) == (0, "")
    solved = [line.split() for line in out.splitlines() if "+-" in line]
    off = [(float(words[-4]), float(words[-2])) for words in solved]
    units = np.array([1.0] * 3 + [1e6] * 3 + [1e12] * 3 + [1e6] * 3)
    errors = [(value - truth) / sigma for (value, sigma), truth in zip(off, true * units, strict=True)]
    assert len(errors) == 12
    assert max(map(abs, errors)) < 4.5
    code, _, err = run(str(path), *about)
    assert code == 1
    assert "look for a maneuver" in err
    code, _, err = run(str(tmp_path / "one.parquet"), *about)
    assert code == 1
    assert "more are needed" in err
    code, _, err = run(str(path))
    assert code == 1
    assert "--kernels" in err
    for kernel in ("gone.bsp", kernels[1]):  # missing, and without the moons
        code, _, err = run(str(path), "--center", "SATURN", "--kernels", kernel)
        assert code == 1
        assert "kernels: SPICE(" in err
    code, _, err = run(str(tmp_path / "gone.parquet"))
    assert code == 1
    assert "gone.parquet" in err
