"""OSIRIS-REx: trajectory, bodies and cameras of the replay, and a small replay whole."""

import json
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.arrays import unit
from giantlike.core.errors import DataError
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.units import AU_KM
from giantlike.missions import ReplaySettings, run_replay, save_replay
from giantlike.missions.osiris_rex.body import model_of, radii_of, true_body
from giantlike.missions.osiris_rex.comparisons import range_error_comparisons
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.missions.osiris_rex.setup import ModelSetup, mission, user_inputs
from giantlike.missions.osiris_rex.trajectory import Waypoint, fly, kernel_ranges_km

PERIHELION_UTC = "2019-01-11T00:00:00"  # JPL Horizons: 2010-08-30.64 and seven periods of 436.65 d
SPEED_KM_S = 1e-6  # central differences of positions of 1e8 km over 1000 s
PIXEL = 1e-9  # rounding of pixels of some thousands


def test_bennu_is_nearest_to_the_sun_when_it_was() -> None:
    orbit = mission().orbit
    et = et_from_time(time_from_utc(PERIHELION_UTC))
    position, velocity = orbit.state(et)

    assert_allclose(np.linalg.norm(position) / AU_KM, 0.8969, rtol=0, atol=2e-4)  # perihelion of the same page
    step_s = 500.0
    difference = (orbit.state(et + step_s)[0] - orbit.state(et - step_s)[0]) / (2.0 * step_s)
    assert_allclose(velocity, difference, rtol=0, atol=SPEED_KM_S)


def test_a_waypoint_has_its_range_and_phase_angle() -> None:
    orbit = mission().orbit
    et, place_km, along = Waypoint(utc="2019-02-01T00:00:00", range_km=1.5, phase_deg=90.0, turn_deg=30.0).place(orbit)
    to_sun = -orbit.state(et)[0]

    assert_allclose(np.linalg.norm(place_km), 1.5, rtol=0, atol=1e-12)
    assert_allclose([to_sun @ place_km / np.linalg.norm(to_sun), along @ place_km], 0.0, rtol=0, atol=1e-9)


def test_a_phase_flies_near_its_waypoints_with_maneuvers_that_err_as_stated() -> None:
    orex = mission()
    survey = next(each for each in orex.phases if each.key == "preliminary_survey")
    ends = [each.place(orex.orbit) for each in survey.waypoints]
    flight = fly(survey.waypoints, [et for et, *_ in ends[1:]], orex.orbit, orex.flight, trim_mm_s=None, seed=1)
    missed = [np.linalg.norm(flight.states[et][:3] - place) for et, place, _ in ends[1:]]
    planned = np.array([each.planned_km_s for each in flight.maneuvers])
    sigmas = np.array([each.sigma_km_s for each in flight.maneuvers])[:, None]

    assert max(missed) < 0.5  # km of 11; a sigma of 0.8 mm/s for one or two days and 6 % of sunlight
    assert np.linalg.norm(planned, axis=1).min() > 1e-4  # passes of a day
    assert 0.5 < np.sqrt(np.mean(((flight.executed_km_s - planned) / sigmas) ** 2)) < 1.6


def test_cameras_image_what_the_equations_and_signs_of_table_1_say() -> None:
    text = (files("giantlike.missions.osiris_rex") / "mission.toml").read_text("utf-8")
    for key, camera in tomllib.loads(text)["cameras"].items():
        table, model = camera["table1"], mission().cameras[key].model
        half = 0.5 * np.array([camera["columns"], camera["rows"]]) / table["fx_px"]
        points = np.random.default_rng(1).uniform(-half, half, (20, 2))
        x, y = points.T  # of the paper's camera axes, y up
        r2 = x**2 + y**2
        radial = 1.0 + table["k1"] * r2 + table.get("k2", 0.0) * r2**2 + table.get("k3", 0.0) * r2**3
        p1, p2, warm = table["p1"], table["p2"], 1.0 + 20.0 * table.get("a1_per_c", 0.0)
        u = warm * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2))
        v = warm * (y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y)
        pixels = np.stack([table["fx_px"] * u + table["cx_px"], table["fy_px"] * v + table["cy_px"]], axis=-1)
        ours = np.stack([x, -y, np.ones_like(x)], axis=-1)

        assert table["fy_px"] < 0.0
        assert_allclose(model.at_temperature(20.0).project(ours), pixels, rtol=0, atol=PIXEL)
        assert_allclose(mission().cameras[key].view(20.0).project(ours), pixels, rtol=0, atol=PIXEL)


def test_a_shape_model_differs_from_the_truth_by_the_errors_that_it_is_to_have() -> None:
    truth = true_body(mission().body, None, seed=3, cells=128)
    exact = model_of(truth, ModelSetup(facets=2_000, error_m=0.0, scale=0.0, meridian_deg=0.0), seed=3)
    wrong = model_of(truth, ModelSetup(facets=2_000, error_m=1.0, scale=0.001, meridian_deg=0.0), seed=3)
    radii, wrong_radii = (np.linalg.norm(mesh.vertices_km, axis=1) for mesh in (exact, wrong))
    errors_m = 1e3 * (wrong_radii / 1.001 - radii)

    assert_allclose(np.sqrt(np.mean(errors_m**2)), 1.0, rtol=0, atol=0.25)  # one draw of some 60 independent patches
    fine = model_of(truth, ModelSetup(facets=50_000, error_m=0.0, scale=0.0, meridian_deg=0.0), seed=3)
    assert_allclose(fine.mean_radius_km, mission().body.mean_radius_km, rtol=0, atol=1e-4)
    assert_allclose(fine.center_of_figure_km, 0.0, rtol=0, atol=1e-4)


def test_a_folder_without_kernels_and_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"hold no orx_\*ALT\*\.bsp"):
        user_inputs(tmp_path)
    with pytest.raises(DataError, match="this is none"):
        user_inputs(tmp_path / "missing")


@pytest.mark.real_data
def test_kernels_and_shape_of_the_mission_take_the_place_of_what_is_made_up(data_dir: Path) -> None:
    inputs = user_inputs(data_dir)
    utcs = ("2018-12-02T00:00:00", "2018-12-06T12:00:00", "2019-02-01T00:00:00")
    ranges = kernel_ranges_km([et_from_time(time_from_utc(utc)) for utc in utcs], inputs.kernels)

    assert 20.0 < ranges[0] < 30.0  # the end of Approach: Bennu larger than 1,000 px in PolyCam
    assert 6.0 < ranges[1] < 9.0  # a flyby of Preliminary Survey
    assert np.isnan(ranges[2])
    assert inputs.shape is not None
    body = true_body(mission().body, inputs.shape, seed=1, cells=64)
    assert 0.23 < float(np.mean(radii_of(body, unit(np.random.default_rng(1).normal(size=(500, 3)))))) < 0.26


def test_a_correlation_that_no_range_error_moves_is_not_called_biased() -> None:
    still = np.full((1, 3, 2), 0.1)
    study = RangeErrorStudy(
        range_errors=np.array([-0.04, 0.0, 0.04]),
        phases_deg=np.array([60.0]),
        correlation_px=still,
        fitted_px=still,
    )

    assert [comparison.agrees for comparison in range_error_comparisons(study)] == [False, False]


@pytest.mark.slow
def test_a_small_replay_compares_figures_tables_and_numbers(tmp_path: Path) -> None:
    settings = ReplaySettings(output=tmp_path, small=True)
    replay = run_replay("osiris_rex", settings)
    save_replay(replay, settings)
    found = json.loads((tmp_path / "replay.json").read_text("utf-8"))["comparisons"]
    named = {each["reference"] for each in found}
    agreeing = {each.reference: each.agrees for each in replay.comparisons}

    assert {"Table 1", "Fig. 3", "Fig. 16", "Fig. 18", "Fig. 20", "Fig. 22"} <= named
    assert "nothing found" not in [each.ours for each in replay.comparisons]
    assert agreeing["Fig. 18"]  # centers within a pixel of the orbit fitted to the observables
    assert next(each for each in replay.comparisons if "maneuvers" in each.what).agrees
    assert any("No value was tuned" in each for each in replay.assumptions)
    page = (tmp_path / "report.html").read_text("utf-8")
    assert page.index("Template matching") < page.index("Camera calibration") < page.index("Picture")
