"""``giantlike photometry`` on real frames of one camera at two altitudes, and what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import giantlike as gl
from tests.cli.test_cli import giantlike

AIRMASS = 0.40  # of 40 against 60 degrees of altitude


@pytest.mark.slow
@pytest.mark.real_data
def test_zero_points_of_real_frames_show_the_air_and_their_errors_hold(data_dir: Path, tmp_path: Path) -> None:
    frames = sorted((data_dir / "stars" / "tetra3").glob("*.tiff"))
    geometry = "file,exposure_s\n" + "".join(f"{frame.name},0.5\n" for frame in frames)
    (tmp_path / "geometry.csv").write_text(geometry)
    (tmp_path / "campaign.toml").write_text(
        f'[campaign]\nname = "sky"\noutput = "run"\n[images]\nfiles = {[str(frame) for frame in frames]}\n'
        'geometry = "geometry.csv"\n[camera]\ncolumns = 1024\nrows = 768\nfov_deg = 11.4\n[stars]\n'
        'lost_in_space = true\n[calibration]\nmodel = "brown"\nestimate = ["fx_px", "fy_px", "k1", "p1", "p2"]\n'
        '[photometry]\nmethod = "aperture"\nzero_point_mag = 17.5\n'
    )
    assert giantlike("run", tmp_path / "campaign.toml", "--workers", "1").exit_code == 0
    result = giantlike("photometry", tmp_path / "run", "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    low, high = (
        np.mean([one["zero_point_mag"] for one in answer["images"] if f"Alt{altitude}" in one["file"]])
        for altitude in (40, 60)
    )
    assert 0.1 < (high - low) / AIRMASS < 0.4  # mag per airmass, of any site
    assert all(one["sigma_mag"] < 0.04 for one in answer["images"])
    assert set(answer["supported"].values()) == {"supported"}
    assert -0.6 < answer["photometry"]["field_term_mag"] < -0.35
    with (tmp_path / "run" / "photometry" / "fluxes.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["used"] == "true"]
    magnitude, residual = (np.array([float(row[key]) for row in rows]) for key in ("magnitude", "residual"))
    for quarter in np.array_split(np.argsort(magnitude), 4):
        assert 0.8 < np.mean(residual[quarter] ** 2) < 1.25
        assert abs(np.mean(residual[quarter])) < 3.0 / np.sqrt(len(quarter))
    camera = gl.Camera.load(tmp_path / "run" / "photometry" / "camera.toml")
    assert camera.photometry is not None
    assert abs(camera.photometry.zero_point_mag - answer["zero_point_mag"]) < 1e-9
    assert abs(answer["change_mag"] - (answer["zero_point_mag"] - 17.5)) < 1e-9


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    result = giantlike("photometry", tmp_path)
    assert result.exit_code == 2
    assert str(tmp_path) in result.stderr
