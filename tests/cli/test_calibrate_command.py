"""``giantlike calibrate``, and runs that calibrate: files in, a camera with its covariance out, or why not."""

from __future__ import annotations

import contextlib
import csv
import json
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from scipy.stats import chi2
from typer.testing import CliRunner, Result

from giantlike.calibration.field_map import map_difference
from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, model_to_mapping
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.store.run_folder import RESULTS_FILE
from giantlike.cli.app import app
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import DataError
from giantlike.core.frames import camera_from_inertial_of_pointing
from giantlike.core.time import time_from_utc
from giantlike.io import navigation_header, write_fits
from giantlike.simulation import Shot, Sources, simulate_image
from giantlike.simulation.incident import SimulationOptions
from tests.campaign_files import OBSERVER, sky
from tests.tolerances import FALSE_ALARM, FLOAT64_SUM

MAP_PX = 0.02  # rms over the field: 160 stars of 0.1 px in each of four images give 0.003
REAL_RMS_PX = 0.13  # required of the bright stars of the real frames; faint ones have more noise
ESTIMATE = ["fx_px", "fy_px", "k1"]
TRUTH = Camera(
    name="eye",
    columns=480,
    rows=400,
    model=BrownModel(fx_px=1500.0, fy_px=1503.0, cx_px=239.5, cy_px=199.5, k1=-0.3),
    psf=GaussianPsf(sigma_px=0.9),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=60000.0, bias_dn=100.0),
)
POINTINGS_DEG = ((80.0, 10.0, 20.0), (310.0, 40.0, 110.0), (20.0, 57.0, 200.0), (285.0, -8.0, 300.0))


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def campaign(folder: Path, output: str, **changes: Any) -> Path:
    table: dict[str, Any] = {
        "campaign": {"name": "eye test", "output": output},
        "images": {"files": ["*.fits"]},
        "camera": {"columns": TRUTH.columns, "rows": TRUTH.rows, "fov_deg": 1.04 * TRUTH.fov_deg},
        "stars": {"max_magnitude": 7.5},
        "calibration": {"estimate": ESTIMATE},
        "report": {"max_overlays": 0},
    }
    path = folder / f"{output}.toml"
    path.write_text(tomli_w.dumps(table | changes))
    return path


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with four images of stars, of which nobody says where the camera points."""
    folder = tmp_path_factory.mktemp("calibration")
    for number, pointing in enumerate(POINTINGS_DEG):
        shot = Shot(
            name=f"sky{number}.fits",
            epoch=time_from_utc(f"2024-05-01T0{number}:00:00"),
            exposure_s=1.0,
            camera_from_inertial=camera_from_inertial_of_pointing(*pointing),
            observer=OBSERVER,
        )
        taken = simulate_image(
            shot, TRUTH, Sources(catalog=sky()), seed=number, options=SimulationOptions(max_magnitude=8.0)
        )
        header = navigation_header(
            epoch=shot.epoch,
            exposure_s=shot.exposure_s,
            observer_position_km=OBSERVER.position_km,
            observer_velocity_km_s=OBSERVER.velocity_km_s,
        )
        write_fits(folder / shot.name, taken.image.pixels, header=header | {"CCDTEMP": 10.0 * number})
    return folder


@pytest.fixture(scope="module")
def done(images: Path) -> tuple[Path, Result]:
    path = campaign(images, "done")
    return path, giantlike("calibrate", path, "--workers", "1", "--json")


def attitudes(folder: Path) -> list[dict[str, str]]:
    """Rows of ``attitudes.csv`` but for the time they took."""
    with (folder / "attitudes.csv").open() as stream:
        return [{key: value for key, value in row.items() if key != "time_s"} for row in csv.DictReader(stream)]


def test_a_camera_is_calibrated_from_its_size_a_rough_field_of_view_and_stars(done: tuple[Path, Result]) -> None:
    path, result = done
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)["calibration"]
    assert summary["status"] == "ok"
    assert summary["settled"]
    assert summary["targets"] == "stars"
    assert summary["all_stars"]["min_snr"] == 0.0
    assert summary["all_stars"]["count"] == pytest.approx(summary["n_used"], rel=0.1)
    assert [one["name"] for one in summary["parameters"]] == ESTIMATE
    camera = Camera.load(path.parent / "done" / "camera.toml")
    assert map_difference(TRUTH.model, camera.model, columns=480, rows=400).rms_px < MAP_PX
    known = camera.uncertainty
    assert known is not None
    assert known.estimated == tuple(ESTIMATE)
    assert known.n_images == 4
    names = camera.model.parameter_names
    truth = dict(zip(TRUTH.model.parameter_names, TRUTH.model.parameters, strict=True))
    error = np.array([camera.model.parameters[names.index(name)] - truth[name] for name in ESTIMATE])
    # Detection and catalog have errors of their own, so twice the covariance is allowed
    assert error @ np.linalg.solve(2.0 * known.covariance, error) < chi2.isf(FALSE_ALARM, len(ESTIMATE))


def test_attitudes_are_those_with_the_calibrated_camera(done: tuple[Path, Result]) -> None:
    folder = done[0].parent / "done"
    camera = Camera.load(folder / "camera.toml")
    rows = attitudes(folder)
    assert [row["status"] for row in rows] == ["ok"] * 4
    assert {float(row["fov_deg"]) for row in rows} == {camera.fov_deg}
    for row, (ra, dec, roll) in zip(rows, POINTINGS_DEG, strict=True):
        assert abs(float(row["dec_deg"]) - dec) < 0.01  # 0.26 px, of an attitude good to 0.01 px
        assert abs((float(row["ra_deg"]) - ra) * np.cos(np.radians(dec))) < 0.01
        assert abs(float(row["roll_deg"]) - roll) < 0.1


def test_report_and_tables_say_what_was_done(done: tuple[Path, Result]) -> None:
    folder = done[0].parent / "done"
    page = (folder / "calibration.html").read_text()
    for text in ("<code>k1</code>", "supported by the data", "Correlation of the parameters", "Rejected observations"):
        assert text in page
    assert "<img" not in page  # one file that needs nothing else
    assert "src=" not in page
    with (folder / "calibration_residuals.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    summary = json.loads((folder / "calibration.json").read_text())
    used = np.array(
        [[float(row[f"{a}_px"]) - float(row[f"predicted_{a}_px"]) for a in "xy"] for row in rows if row["used"] == "1"]
    )
    assert len(used) == summary["n_used"]
    assert np.sqrt(np.mean(np.sum(used**2, axis=1))) == pytest.approx(summary["rms_px"], rel=FLOAT64_SUM)
    assert "calibration.html" in (folder / "report.html").read_text()


def result_text(folder: Path) -> str:
    return (folder / "calibration.json").read_text()


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes most of the time; once is enough."""
    monkeypatch.setattr("giantlike.campaign.calibration.page.calibration_figures", lambda fix: [])
    monkeypatch.setattr("giantlike.campaign.report.figures.attitude_figures", lambda result: [])


@pytest.mark.usefixtures("no_figures")
def test_a_run_goes_on_from_a_calibration_that_was_killed_and_gives_the_same(done: tuple[Path, Result]) -> None:
    path, _ = done
    folder = path.parent / "done"
    before, camera = attitudes(folder), (folder / "camera.toml").read_text()
    with contextlib.closing(sqlite3.connect(folder / RESULTS_FILE)) as connection, connection:
        for step, file in (("calibration", "sky1.fits"), ("attitude", "sky1.fits"), ("attitude", "sky3.fits")):
            connection.execute("DELETE FROM records WHERE step = ? AND file = ?", (step, file))
    (folder / "attitudes.csv").unlink()
    result = giantlike("run", path, "--workers", "1", "--resume")
    assert result.exit_code == 0, result.stderr
    assert attitudes(folder) == before
    assert (folder / "camera.toml").read_text() == camera
    log = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    again = [
        line["file"]
        for line in log[[line["event"] for line in log].index("run_finished") :]
        if line["event"] == "image"
    ]
    assert sorted(again) == ["sky1.fits", "sky3.fits"]


@pytest.mark.usefixtures("no_figures")
def test_a_calibration_that_misses_a_criterion_says_why_and_is_not_used(images: Path) -> None:
    changes = {"estimate": ESTIMATE, "criteria": {"max_residual_px": 1e-3}, "temperature_keyword": "CCDTEMP"}
    files = {"files": ["sky1.fits", "sky3.fits"]}
    path = campaign(images, "strict", calibration=changes, camera=TRUTH.to_mapping(), images=files)
    result = giantlike("calibrate", path, "--workers", "1")
    assert result.exit_code == 1
    assert "calibration not accepted: residual rms is" in result.stderr
    assert "at most 0.001 is accepted" in result.stderr
    folder = images / "strict"
    assert not (folder / "camera.toml").exists()
    assert "Why it is not used" in (folder / "calibration.html").read_text()
    assert {float(row["fov_deg"]) for row in attitudes(folder) if row["fov_deg"]} <= {TRUTH.fov_deg}
    summary = json.loads(result_text(folder))
    assert [one["temperature_c"] for one in summary["images"]] == [10.0, 30.0]


def test_calibration_frames_of_a_file_go_with_images_of_stars(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    noise = np.random.default_rng(2).normal(size=(3, 200, 240))
    for number in range(2):
        write_fits(tmp_path / "frames" / f"dark{number}.fits", 100.0 + noise[number], header={"EXPTIME": 1.0})
    header = navigation_header(epoch=time_from_utc("2024-05-01T00:00:00"), exposure_s=1.0)
    write_fits(tmp_path / "empty_sky.fits", 100.0 + noise[2], header=header)
    (tmp_path / "frames" / "frames.toml").write_text('[calibration_frames]\ndark = ["dark*.fits"]\n')
    output = tmp_path / "out"
    result = giantlike(
        *("calibrate", tmp_path / "empty_sky.fits", "--fov", "18", "--frames", tmp_path / "frames" / "frames.toml"),
        *("--output", output, "--workers", "1"),
    )
    assert result.exit_code == 1  # no stars
    frames = Campaign.load(output / "campaign.toml").frames
    assert frames is not None
    assert [path.name for path in frames.dark] == ["dark0.fits", "dark1.fits"]
    provenance = json.loads((output / "run" / "provenance.json").read_text())
    assert list(provenance["inputs"]["calibration_frames_sha256"]["dark"]) == [
        f"../frames/dark{k}.fits" for k in range(2)
    ]


def test_mistakes_are_one_line(images: Path) -> None:
    for arguments, message in (
        ((campaign(images, "none", calibration={}),), "key calibration.estimate is missing"),
        ((images / "sky0.fits",), "give a campaign file, or images with --fov DEG"),
        (
            (images / "sky0.fits", "--fov", "18", "--estimate", "q1", "--output", images / "wrong"),
            "has no parameter 'q1'",
        ),
    ):
        result = giantlike("calibrate", *arguments)
        assert result.exit_code == 2
        (line,) = result.stderr.splitlines()
        assert message in line
    assert not (images / "wrong" / "campaign.toml").exists()  # nothing in the way of the next attempt


def test_a_camera_file_keeps_the_covariance_and_refuses_a_wrong_one(tmp_path: Path) -> None:
    table = {"columns": 10, "rows": 10, "model": model_to_mapping(TRUTH.model)}
    known = {"estimated": ["k1"], "covariance": [[1e-4]], "residual_sigma_px": 0.1, "n_observations": 9, "n_images": 2}
    path = tmp_path / "camera.toml"
    path.write_text(tomli_w.dumps(table | {"calibration": known}))
    camera = Camera.load(path)
    camera.save(path)
    again = Camera.load(path).uncertainty
    assert again is not None
    assert again.to_mapping() == known
    for change, message in (
        ({"estimated": ["k9"]}, "has no parameter 'k9'"),
        ({"covariance": [[1.0, 0.0], [0.0, 1.0]]}, r"covariance must have shape \(1, 1\)"),
        ({"sigma": 1.0}, "unknown key 'sigma'"),
    ):
        path.write_text(tomli_w.dumps(table | {"calibration": known | change}))
        with pytest.raises(DataError, match=message):
            Camera.load(path)


@pytest.mark.slow
@pytest.mark.real_data
def test_real_frames_of_one_camera_are_fitted_to_their_centroid_noise(data_dir: Path, tmp_path: Path) -> None:
    frames = sorted((data_dir / "stars" / "tetra3").glob("*.tiff"))
    result = giantlike("calibrate", *frames, "--fov", "11", "--output", tmp_path / "tetra3", "--workers", "1", "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)["calibration"]
    brightest = min((one for one in summary["residuals"] if one["kind"] == "magnitude"), key=lambda one: one["middle"])
    assert brightest["rms_px"] <= REAL_RMS_PX
    assert brightest["count"] > 100
    assert summary["n_used"] > 800
    assert summary["n_rejected"] < 10
