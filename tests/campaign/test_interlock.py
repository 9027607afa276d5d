"""The interlock of two sensors over a campaign, from runs and from tables."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from typer.testing import CliRunner

from giantlike.campaign.interlock import interlock_of, write_interlock
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotation_between
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.io.attitude_series import AttitudeSeries, read_attitude_csv, write_attitude_csv

SECOND_FROM_FIRST = Rotation.from_euler("yxz", [90.3, -0.4, 12.0], degrees=True)
SIGMA = np.array([5.0, 6.0, 40.0]) / ARCSEC_PER_RAD
IMPOSSIBLE = 1e-6


def _series(rng: np.random.Generator, times: Float, truth: Rotation, sigma_rad: Float) -> AttitudeSeries:
    noise = Rotation.from_rotvec(sigma_rad * rng.normal(size=(len(times), 3)))
    return AttitudeSeries(
        et=times,
        camera_from_inertial=noise * truth,
        covariance_rad2=np.tile(np.diag(sigma_rad**2), (len(times), 1, 1)),
        names=tuple(f"t{k}" for k in range(len(times))),
    )


def _two(rng: np.random.Generator, folder: Path, count: int, *, scatter_rad: float = 0.0) -> tuple[Path, Path]:
    """Tables of two sensors that look at random attitudes at the same times, but for 5 ms."""
    times = np.arange(0.0, 60.0 * count, 60.0)
    first = Rotation.random(count, rng=rng)
    shaking = Rotation.from_rotvec(scatter_rad * rng.normal(size=(count, 3)))
    write_attitude_csv(folder / "first.csv", _series(rng, times, first, SIGMA))
    write_attitude_csv(folder / "second.csv", _series(rng, times + 0.005, shaking * SECOND_FROM_FIRST * first, SIGMA))
    return folder / "first.csv", folder / "second.csv"


@pytest.mark.slow
def test_the_interlock_errs_as_its_covariance_says(tmp_path: Path) -> None:
    rng = np.random.default_rng(30)
    squares = []
    for _ in range(40):
        fix = interlock_of(*_two(rng, tmp_path, 12)).alignment
        error = rotation_between(fix.rotation, SECOND_FROM_FIRST)
        squares.append(error @ np.linalg.solve(fix.covariance_rad2, error))
    assert chi2.ppf(IMPOSSIBLE, 120) < sum(squares) < chi2.isf(IMPOSSIBLE, 120)


def test_a_mounting_that_shakes_shows_as_scatter_and_widens_the_covariance(tmp_path: Path) -> None:
    rng = np.random.default_rng(31)
    steady = interlock_of(*_two(rng, tmp_path, 36)).summary()
    shaken = interlock_of(*_two(rng, tmp_path, 36, scatter_rad=100.0 / ARCSEC_PER_RAD)).summary()
    assert shaken["reduced_chi2"] > 10.0 * steady["reduced_chi2"]
    assert shaken["sigma_arcsec"]["x"] > 3.0 * steady["sigma_arcsec"]["x"]
    # 36 pairs know a standard deviation to 12 %: six times that.
    assert 30.0 < shaken["scatter_arcsec"]["x"] < 170.0


def test_attitudes_without_a_partner_in_time_are_left_out_and_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(32)
    first, second = _two(rng, tmp_path, 10)
    lines = second.read_text().splitlines()
    second.write_text("\n".join([lines[0], *lines[3:]]) + "\n")
    result = interlock_of(first, second)
    assert (len(result.et), result.unpaired) == (8, 2)
    assert result.names[0] == ("t2", "t2")


def test_rows_without_an_epoch_are_left_out_and_counted(tmp_path: Path) -> None:
    first, second = _two(np.random.default_rng(32), tmp_path, 10)
    header, *lines = first.read_text().splitlines()
    for k in (2, 6):
        cells = lines[k].split(",")
        lines[k] = ",".join([cells[0], "", "", *cells[3:]])
    first.write_text("\n".join([header, *lines]) + "\n")
    result = interlock_of(first, second)
    assert (len(result.et), result.unpaired) == (8, 2)
    with pytest.raises(DataError, match="t2: an epoch is needed"):
        read_attitude_csv(first)
    first.write_text("\n".join([header, lines[2]]) + "\n")
    with pytest.raises(DataError, match="no row has an epoch"):
        interlock_of(first, second)


def test_sensors_that_never_look_at_once_have_no_interlock(tmp_path: Path) -> None:
    first, second = _two(np.random.default_rng(33), tmp_path, 3)
    with pytest.raises(InputError, match=r"within 0\.001 s, the nearest are 0\.005 s apart"):
        interlock_of(first, second, tolerance_s=0.001)


def test_a_single_attitude_pairs_with_the_nearest_of_many(tmp_path: Path) -> None:
    rng = np.random.default_rng(34)
    first, second = _two(rng, tmp_path, 5)
    lines = first.read_text().splitlines()
    for row in (1, 3, 5):
        (tmp_path / "one.csv").write_text("\n".join([lines[0], lines[row]]) + "\n")
        assert interlock_of(tmp_path / "one.csv", second).names == ((f"t{row - 1}", f"t{row - 1}"),)
        assert interlock_of(second, tmp_path / "one.csv").names == ((f"t{row - 1}", f"t{row - 1}"),)


def test_a_table_of_attitudes_comes_back_as_it_was_written_whatever_the_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(35)
    series = _series(rng, np.array([-5.5, 0.0, 1e9 / 3]), Rotation.random(3, rng=rng), SIGMA)
    write_attitude_csv(tmp_path / "a.csv", series)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "b.csv").write_text("\n".join([lines[0], *reversed(lines[1:])]) + "\n")
    read = read_attitude_csv(tmp_path / "b.csv")
    assert read.et.tolist() == series.et.tolist()
    assert read.names == series.names
    assert np.abs(read.covariance_rad2 - series.covariance_rad2).max() == 0.0
    assert np.max((read.camera_from_inertial * series.camera_from_inertial.inv()).magnitude()) < 1e-15


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("qx,qy,qz,qw\n0,0,0,1\n", "epoch_utc or et"),
        ("et,qx,qy,qz,qw\n0,,,,\n", "must be filled in every row"),
        ("et,qx,qy,qz,qw\n0,0,0,0,2\n", "line 2, column qx"),
        ("et,roll\n0,0\n", "unknown column 'roll'"),
        (
            "et,qx,qy,qz,qw,cov_xx_rad2,cov_xy_rad2,cov_xz_rad2,cov_yy_rad2,cov_yz_rad2,cov_zz_rad2\n"
            "0,0,0,0,1,-1,0,0,1,0,1\n",
            "positive definite",
        ),
    ],
)
def test_a_damaged_table_is_refused_with_the_place(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=problem):
        read_attitude_csv(tmp_path / "a.csv")


def test_a_pair_without_covariance_cannot_be_weighted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("et,qx,qy,qz,qw\n0,0,0,0,1\n")
    with pytest.raises(DataError, match="covariance is needed"):
        interlock_of(tmp_path / "a.csv", tmp_path / "a.csv")


def test_what_is_written_agrees_with_the_result(tmp_path: Path) -> None:
    result = interlock_of(*_two(np.random.default_rng(36), tmp_path, 8))
    files = write_interlock(result, tmp_path / "out")
    said = json.loads(files[0].read_text())
    rotation = Rotation.from_quat(said["second_from_first_xyzw"])
    assert (rotation * result.alignment.rotation.inv()).magnitude() < 1e-15
    assert abs(said["rotation_angle_deg"] - np.degrees(SECOND_FROM_FIRST.magnitude())) < 0.01
    rows = list(csv.DictReader(files[1].read_text().splitlines()))
    assert len(rows) == 8
    assert abs(float(rows[0]["residual_z_arcsec"]) - result.alignment.residuals_rad[0, 2] * ARCSEC_PER_RAD) < 1e-3
    assert files[2].read_text().rstrip().endswith("</svg>")


def test_the_command_tells_people_and_machines(tmp_path: Path) -> None:
    first, second = _two(np.random.default_rng(37), tmp_path, 8)
    arguments = ["interlock", str(first), str(second), "--output", str(tmp_path / "out")]
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0
    assert "8 of 8 pairs used" in shown.stdout
    assert json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)["n_pairs"] == 8
    assert CliRunner().invoke(app, [*arguments, "--tolerance", "-1"]).exit_code == 2
