"""``giantlike network``: what is shown and written, and exit codes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from giantlike.cli.app import app
from tests.io.test_isis_network import CONTROL_NETWORK

RUNNER = CliRunner()


def test_a_network_is_shown_as_text_and_json(tmp_path: Path) -> None:
    path = tmp_path / "n.pvl"
    path.write_text(CONTROL_NETWORK)
    shown = RUNNER.invoke(app, ["network", "read", str(path)])
    assert shown.exit_code == 0
    assert "2 points on Moon (1 Constrained, 1 Free), 2 measures" in shown.stdout
    table = json.loads(RUNNER.invoke(app, ["network", "read", str(path), "--json"]).stdout)
    assert table["views_per_point"] == {"1": 2}
    assert (table["ignored_points"], table["ignored_measures"], table["without_position"]) == (1, 2, 1)


def test_apollo_is_adjusted_into_a_folder(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "networks" / "apollo15"
    if not folder.is_dir():
        pytest.skip(f"{folder} is missing")
    command = ["network", "adjust", str(folder / "apolloNet.pvl"), "--images", str(folder)]
    reduced = [*command, "--reduction", "4", "--loss", "linear", "--outlier-sigmas", "inf", "--scale-by-residuals"]
    done = RUNNER.invoke(app, [*reduced, "-o", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0
    summary = json.loads(done.stdout)
    assert summary == json.loads((tmp_path / "out" / "result.json").read_text())
    assert abs(summary["sigma0"] - 2.036212) < 1e-6
    assert summary["datum"] == "32 known points"
    with (tmp_path / "out" / "points.csv").open() as file:
        points = {row["point"]: row for row in csv.DictReader(file)}
    with (folder / "expected_points.csv").open() as file:
        expected = {row["point"]: row for row in csv.DictReader(file)}
    for name, row in expected.items():
        found = np.array([float(points[name][f"{axis}_km"]) for axis in "xyz"])
        assert np.abs(found - [float(row[f"{axis}_km"]) for axis in "xyz"]).max() < 0.001
    with (tmp_path / "out" / "poses.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 7
    wrong = RUNNER.invoke(app, command)
    assert wrong.exit_code == 2
    assert "reduced by 4" in wrong.stderr
    empty = RUNNER.invoke(app, ["network", "adjust", str(folder / "apolloNet.pvl"), "--images", str(tmp_path)])
    assert empty.exit_code == 2
    assert "no *.isd" in empty.stderr
