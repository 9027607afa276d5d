"""``giantlike search`` on made images of stars with one that moves, and what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import giantlike as gl
from giantlike.catalogs import load_catalog
from giantlike.core.frames import camera_from_inertial_of_pointing
from giantlike.core.time import time_from_et
from giantlike.processing.detection.patches import draw_stars
from giantlike.stars.field import Sky
from tests.cli.test_cli import giantlike

SIZE, FOV_DEG, RATE_PX_S, STEP_S, ET = 256, 8.0, 0.11, 10.0, 7.6e8


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of six images with a small drift, in which a source of SNR 40 moves by a pixel an image."""
    folder, random = tmp_path_factory.mktemp("search"), np.random.default_rng(3)
    camera, sky = gl.Camera.from_fov(FOV_DEG, SIZE, SIZE), Sky(catalog=load_catalog("default"), et=ET)
    rows = ["file,epoch_utc,exposure_s"]
    for k in range(6):
        attitude = camera_from_inertial_of_pointing(80.0 + 0.05 * k, 20.0 - 0.03 * k, 10.0)
        field = sky.field(camera, attitude)
        stars = camera.model.project(attitude.apply(np.array(field.directions_inertial)))
        inside = camera.contains(stars)
        flux = 10.0 ** (0.4 * (14.0 - field.stars.magnitude[inside]))
        ahead = camera.model.unproject(np.array([120.0 + RATE_PX_S * STEP_S * k, 90.0]))
        mover = camera.model.project(
            attitude.apply(camera_from_inertial_of_pointing(80.0, 20.0, 10.0).inv().apply(ahead))
        )
        points = np.vstack([stars[inside], mover])
        light = draw_stars((SIZE, SIZE), points, np.append(flux, 500.0), np.full(len(points), 0.8))
        pixels = random.poisson(light * 4.0) / 4.0 + random.normal(50.0, 4.0, light.shape)
        fits.PrimaryHDU(pixels.astype(np.float32)).writeto(folder / f"{k}.fits")
        rows.append(f"{k}.fits,{time_from_et(ET + STEP_S * k).utc.isot},1.0")
    (folder / "geometry.csv").write_text("\n".join(rows) + "\n")
    (folder / "campaign.toml").write_text(
        '[campaign]\nname = "moving"\noutput = "run"\n[images]\nfiles = ["*.fits"]\ngeometry = "geometry.csv"\n'
        f"[camera]\ncolumns = {SIZE}\nrows = {SIZE}\nfov_deg = {FOV_DEG}\n[stars]\nlost_in_space = true\n"
    )
    result = giantlike("run", folder / "campaign.toml", "--workers", "1")
    assert result.exit_code == 0, result.stderr
    return folder / "run"


def test_the_one_that_moves_is_the_one_track(run: Path) -> None:
    result = giantlike("search", run, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["accepted"] == 1
    assert answer["sources"]["star"] > 100
    track = answer["tracks"][0]
    assert track["detections"] == 6
    assert track["rate_px_s"] == pytest.approx(RATE_PX_S, abs=0.01)
    assert track["model"] == "sky_line"
    with (run / "search" / "tracks.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(answer["tracks"])
    with (run / "search" / "sources.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["track"] == "1" for row in rows) == 6
    assert (run / "search" / "sources.parquet").is_file()
    assert (run / "search" / "search.html").read_text().count("<figure>") >= 6


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--body", "CERES"), "no body 'CERES'"),
        (("--max-rate", "-1"), "max_rate_px_s"),
        (("--gm", "0"), "--gm"),
        (("--min-detections", "2"), "min_detections"),
    ],
)
def test_wrong_options_are_refused_with_one_line(run: Path, options: tuple[str, str], told: str) -> None:
    result = giantlike("search", run, *options)
    assert result.exit_code == 2
    assert told in result.stderr
    assert "Traceback" not in result.stderr


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    result = giantlike("search", tmp_path)
    assert result.exit_code == 2
    assert "Traceback" not in result.stderr
