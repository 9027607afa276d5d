"""Covariance of an arc: a state that moves along a straight line comes back between epochs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.time import time_from_et, utc_text
from giantlike.io.orbit_covariance import COLUMNS, read_orbit_covariance

ET = 7.0e8
ROUNDING = 1e-12  # relative


def write(path: Path, times: Float, matrices: Float, *, utc: bool = False) -> Path:
    size = matrices.shape[1]
    rows = [matrix[np.tril_indices(size)] for matrix in matrices]
    names = ["epoch_utc" if utc else "et", *COLUMNS[: len(rows[0])]]
    epochs = [utc_text(time_from_et(each)) if utc else repr(float(each)) for each in times]
    lines = [",".join([epoch, *map(repr, row.tolist())]) for epoch, row in zip(epochs, rows, strict=True)]
    path.write_text("\n".join([",".join(names), *lines[::-1]]) + "\n")
    return path


def straight(seconds: Float, start: Float) -> Float:
    """Covariance of a state that moves along a straight line."""
    moves = [np.block([[np.eye(3), each * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]]) for each in seconds]
    return np.array([move @ start @ move.T for move in moves])


def test_columns_are_those_of_an_orbit_ephemeris_message() -> None:
    assert COLUMNS[:6] == ("cx_x_km2", "cy_x_km2", "cy_y_km2", "cz_x_km2", "cz_y_km2", "cz_z_km2")
    assert (COLUMNS[6], COLUMNS[9], COLUMNS[-1]) == ("cx_dot_x_km2_s", "cx_dot_x_dot_km2_s2", "cz_dot_z_dot_km2_s2")
    assert len(COLUMNS) == 21


@pytest.mark.parametrize("utc", [False, True])
def test_a_state_is_carried_between_epochs_and_a_position_is_linear(tmp_path: Path, utc: bool) -> None:
    root = np.random.default_rng(1).normal(size=(6, 6)) * np.repeat([1.0, 1e-3], 3)[:, None]
    times, between = np.array([0.0, 600.0, 1800.0]), np.array([0.0, 250.0, 1799.0])
    start = root @ root.T
    known = read_orbit_covariance(write(tmp_path / "state.csv", ET + times, straight(times, start), utc=utc))
    for second, expected in zip(between, straight(between, start)[:, :3, :3], strict=True):
        # UTC is written to the microsecond
        assert_allclose(known.at(ET + second), expected, rtol=1e-8 if utc else ROUNDING)
    places = straight(times, start)[:, :3, :3]
    known = read_orbit_covariance(write(tmp_path / "place.csv", ET + times, places))
    assert_allclose(known.at(ET + 300.0), places[:2].mean(axis=0), rtol=ROUNDING)
    assert known.largest_sigma_km == pytest.approx(np.sqrt(np.linalg.eigvalsh(places).max()))


def test_what_is_no_covariance_of_the_arc_is_refused(tmp_path: Path) -> None:
    known = read_orbit_covariance(write(tmp_path / "one.csv", np.array([ET]), np.eye(3)[None]))
    assert_allclose(known.at(ET), np.eye(3), rtol=0)
    for et in (ET - 1.0, ET + 1.0):
        with pytest.raises(DataError, match=r"one\.csv.*covers .* UTC, and .* is needed"):
            known.at(et)
    write(tmp_path / "bad.csv", ET + np.arange(2.0), np.array([np.eye(3), np.diag([1.0, -1.0, 1.0])]))
    with pytest.raises(DataError, match="line 2: the covariance"):
        read_orbit_covariance(tmp_path / "bad.csv")
    write(tmp_path / "twice.csv", np.array([ET, ET]), np.array([np.eye(3)] * 2))
    with pytest.raises(DataError, match="line 3, column et: an epoch other than that of line 2"):
        read_orbit_covariance(tmp_path / "twice.csv")
    (tmp_path / "half.csv").write_text("et,cx_x_km2,cy_x_km2,cy_y_km2,cz_x_km2,cz_y_km2,cz_z_km2\n1,1,0,1,0,0,\n")
    with pytest.raises(DataError, match=r"cz_z_km2.*must be filled together"):
        read_orbit_covariance(tmp_path / "half.csv")
