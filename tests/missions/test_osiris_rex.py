"""OSIRIS-REx: trajectory, bodies and cameras of the replay, and a small replay whole."""

import json
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.errors import DataError
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.units import AU_KM
from giantlike.missions import ReplaySettings, run_replay, save_replay
from giantlike.missions.osiris_rex.body import model_of, true_body
from giantlike.missions.osiris_rex.comparisons import range_error_comparisons
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.missions.osiris_rex.setup import ModelSetup, mission, user_inputs
from giantlike.missions.osiris_rex.trajectory import PlannedVisit, visits_of

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


def test_a_visit_without_kernels_has_the_range_and_the_phase_angle_that_were_asked_for() -> None:
    orbit = mission().orbit
    planned = PlannedVisit(utc="2019-02-01T00:00:00", range_km=1.5, phase_deg=90.0, turn_deg=30.0)
    (visit,) = visits_of([planned], orbit, None)
    to_sun = -orbit.state(visit.et)[0]
    cosine = float(to_sun @ visit.from_body_km) / np.linalg.norm(to_sun) / visit.range_km

    assert not visit.from_kernels
    assert_allclose(visit.range_km, 1.5, rtol=0, atol=1e-12)
    assert_allclose(np.degrees(np.arccos(cosine)), 90.0, rtol=0, atol=1e-9)


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


def test_a_shape_model_differs_from_the_truth_by_the_errors_that_it_is_to_have() -> None:
    truth = true_body(mission().body, None, seed=3, facets=8_000)
    exact = model_of(truth, ModelSetup(facets=2_000, error_m=0.0, scale=0.0, meridian_deg=0.0), seed=3)
    wrong = model_of(truth, ModelSetup(facets=2_000, error_m=1.0, scale=0.001, meridian_deg=0.0), seed=3)
    radii, wrong_radii = (np.linalg.norm(mesh.vertices_km, axis=1) for mesh in (exact, wrong))
    errors_m = 1e3 * (wrong_radii / 1.001 - radii)

    assert_allclose(truth.mean_radius_km, mission().body.mean_radius_km, rtol=0, atol=1e-12)
    assert_allclose(np.sqrt(np.mean(errors_m**2)), 1.0, rtol=0, atol=0.25)  # one draw of some 60 independent patches
    assert_allclose(truth.center_of_figure_km, 0.0, rtol=0, atol=1e-12)


def test_a_folder_without_kernels_and_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"hold no orx_\*ALT\*\.bsp"):
        user_inputs(tmp_path)
    with pytest.raises(DataError, match="this is none"):
        user_inputs(tmp_path / "missing")


@pytest.mark.real_data
def test_kernels_and_shape_of_the_mission_take_the_place_of_what_is_made_up(data_dir: Path) -> None:
    inputs = user_inputs(data_dir)
    planned = [
        PlannedVisit(utc=utc, range_km=1.0, phase_deg=10.0, turn_deg=0.0)
        for utc in ("2018-12-02T00:00:00", "2018-12-06T12:00:00", "2019-02-01T00:00:00")
    ]
    visits = visits_of(planned, mission().orbit, inputs.kernels)

    assert [visit.from_kernels for visit in visits] == [True, True, False]
    assert 20.0 < visits[0].range_km < 30.0  # the end of Approach: Bennu larger than 1,000 px in PolyCam
    assert 6.0 < visits[1].range_km < 9.0  # a flyby of Preliminary Survey
    for visit in visits[:2]:
        assert np.linalg.norm(visit.velocity_km_s) < 1e-3  # slower than walking; not what the kernel stores
    pole = visits[1].inertial_from_body.apply([0.0, 0.0, 1.0])
    assert_allclose(pole, mission().orbit.inertial_from_body(visits[1].et).apply([0.0, 0.0, 1.0]), rtol=0, atol=2e-3)
    assert inputs.shape is not None
    body = true_body(mission().body, inputs.shape, seed=1, facets=2_000)
    assert 0.23 < body.mean_radius_km < 0.26


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

    assert {"Table 1", "Fig. 3", "Fig. 8", "Fig. 10", "Fig. 12", "Fig. 14", "Fig. 18", "Fig. 22"} <= named
    assert "nothing found" not in [each.ours for each in replay.comparisons]
    assert agreeing["Fig. 10"]  # centers below a pixel
    assert agreeing["Fig. 14"]  # ranges below a percent
    assert any("No value was tuned" in each for each in replay.assumptions)
    page = (tmp_path / "report.html").read_text("utf-8")
    assert page.index("Camera calibration") < page.index("Approach") < page.index("Preliminary Survey")


@pytest.mark.slow
@pytest.mark.real_data
def test_a_small_replay_with_the_kernels_of_the_mission_has_bennu_in_every_image(
    data_dir: Path, tmp_path: Path
) -> None:
    replay = run_replay("osiris_rex", ReplaySettings(output=tmp_path, small=True, data=data_dir))
    survey = next(section for section in replay.sections if section.title == "Preliminary Survey")

    assert "1 of them on the trajectory of the mission's kernels" in survey.text
    assert {each.reference: each.agrees for each in replay.comparisons}["Fig. 18"]
    assert "nothing found" not in [each.ours for each in replay.comparisons]
