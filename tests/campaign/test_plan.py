"""``giantlike plan``: from a plan file to a folder that renders and runs, and back to the plan."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from giantlike.campaign import Campaign, write_plan
from giantlike.campaign.check import check_campaign
from giantlike.campaign.plan.compare import compare_plan
from giantlike.campaign.plan.file import PlanSetup
from giantlike.campaign.render.plan import RenderPlan
from giantlike.campaign.render.run import render_images
from giantlike.cli.app import app
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Failure
from giantlike.core.photometry import Photometry
from giantlike.core.time import time_from_et
from giantlike.io import write_geometry
from giantlike.io.geometry_table import GeometryRow
from giantlike.terrain import HeightMap
from tests.simulated import ET, small_camera

Change = Callable[[dict[str, Any]], Any]
RUNNER = CliRunner()


def write_plan_file(folder: Path, change: Change = lambda table: None) -> Path:
    """A plan of three images of an ellipsoid, the last with the camera turned away."""
    camera = replace(small_camera(160), photometry=Photometry(zero_point_e_s=2e4))
    camera.save(folder / "camera.toml")
    row = GeometryRow(
        file="a.fits",
        epoch=time_from_et(ET),
        camera_from_inertial=Rotation.identity(),
        target="BALL",
        target_position_inertial_km=np.array([0.0, 0.0, 1000.0]),
        body_from_inertial=Rotation.identity(),
        sun_direction_inertial=np.array([0.8, 0.0, -0.6]),
    )
    away = Rotation.from_euler("x", 180.0, degrees=True)
    later = [replace(row, file=f"{name}.fits", epoch=time_from_et(ET + 600.0 * k)) for k, name in ((1, "b"), (2, "c"))]
    write_geometry(folder / "candidates.csv", [row, later[0], replace(later[1], camera_from_inertial=away)])
    table: dict[str, Any] = {
        "plan": {
            "geometry": "candidates.csv",
            "exposures_s": [0.003, 0.01, 0.03],
            "estimators": ["cross_correlation"],
            "draws": 1,
            "truth": {"relief": 0.002, "albedo": 0.03},
            "select": {"count": 2, "min_gap_s": 60.0},
        },
        "camera": {"file": "camera.toml"},
        "stars": {"catalog": "default"},
        "targets": [{"name": "BALL", "shape": {"radii_km": [20.0, 19.0, 18.0]}, "uncertainty": {"scale": 0.003}}],
    }
    change(table)
    path = folder / "plan.toml"
    path.write_text(tomli_w.dumps(table))
    return path


def test_a_plan_renders_and_its_campaign_has_no_mistake(tmp_path: Path) -> None:
    done = RUNNER.invoke(app, ["plan", str(write_plan_file(tmp_path)), "--output", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert [row["file"] for row in told["images"]] == ["a.fits", "b.fits"]
    assert [row["reason"] for row in told["refused"]] == ["out_of_frame"]
    with (tmp_path / "out" / "plan.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert abs(float(rows[0]["diameter_px"]) - 37.96) < 0.01
    assert float(rows[0]["peak_05_dn"]) < float(rows[0]["peak_dn"]) < float(rows[0]["peak_95_dn"])
    assert float(rows[0]["gain"]) > 0.0
    assert "BALL" in (tmp_path / "out" / "plan.html").read_text()
    (first, second) = render_images(RenderPlan.load(tmp_path / "out" / "scene.toml"))
    low, high = (float(rows[0][f"peak_{level}_dn"]) for level in ("05", "95"))
    assert low - 150.0 < first.peak_dn - small_camera().detector.bias_dn < high + 150.0  # with the noise of a peak
    assert second.path.name == "b.fits"
    assert [str(one) for one in check_campaign(tmp_path / "out" / "campaign.toml") if one.fatal] == []


MISTAKES: dict[str, tuple[Change, str]] = {
    "no candidates": (lambda table: table["plan"].pop("geometry"), "there is no candidate: give geometry"),
    "no exposure": (lambda table: table["plan"].pop("exposures_s"), "a.fits: no exposure time: give exposures_s"),
    "exposure 0": (lambda table: table["plan"].update(exposures_s=[0.0]), "exposures_s must be > 0"),
    "unknown key": (lambda table: table["plan"].update(keepout_deg=3.0), "unknown key plan.keepout_deg"),
    "unknown estimator": (lambda table: table["plan"].update(estimators=["best"]), "unknown estimator 'best'"),
    "window without kernels": (
        lambda table: table["plan"].update(window=[{"start": "2024-01-01", "stop": "2024-01-02", "step_s": 60.0}]),
        r"plan.window: epochs of a window need \[spice\]",
    ),
    "orbit of five numbers": (
        lambda table: table["plan"].update(
            orbit={"epoch_utc": "2024-01-31T19:00:00", "state": [1.0] * 5, "covariance": np.eye(6).tolist()}
        ),
        "plan.orbit: orbit state must have shape",
    ),
    "orbit of rows of two lengths": (
        lambda table: table["plan"].update(
            orbit={"epoch_utc": "2024-01-31T19:00:00", "state": [1.0] * 6, "covariance": [[1.0] * 6, [1.0]]}
        ),
        "plan.orbit: orbit covariance",
    ),
    "estimator twice": (lambda table: table["plan"].update(estimators=["moment"] * 2), "moment is named twice"),
    "options": (lambda table: table["targets"][0].update(options={"moment": {}}), r"targets\[0\].options: a plan has"),
    "covariance by epoch": (
        lambda table: table["targets"][0].update(uncertainty={"ephemeris_table": "orbit.csv"}),
        r"targets\[0\].uncertainty.ephemeris_table: a plan takes one sigma",
    ),
    "negative relief": (lambda table: table["plan"]["truth"].update(relief=-0.1), "truth relief must be >= 0"),
    "no target": (lambda table: table["plan"].update(target="MOON"), "no target 'MOON'"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_of_a_plan_file_is_one_line_with_its_name(name: str, tmp_path: Path) -> None:
    change, text = MISTAKES[name]
    path = write_plan_file(tmp_path, lambda table: (table["plan"].update(draws=1), change(table)))
    with pytest.raises((InputError, DataError), match=text):
        PlanSetup.load(path).plan()


def test_a_plan_without_use_fails_with_its_reason(tmp_path: Path) -> None:
    path = write_plan_file(tmp_path, lambda table: table["plan"].update(keep_out_deg=170.0))
    done = RUNNER.invoke(app, ["plan", str(path)])
    assert done.exit_code == 1
    assert "sun_keep_out: none of 3 candidates is of use" in done.stdout


def test_the_campaign_has_all_that_is_declared_of_a_body(tmp_path: Path) -> None:
    moon = {"name": "MOON", "shape": {"radii_km": [20.0, 20.0, 20.0]}, "spice_body": "MOON"}
    declared = {
        "air": True,
        "atmosphere": {"altitude_km": 0.3, "sigma_km": 0.1},
        "rings": {"inner_km": 25.0, "outer_km": 30.0},
        "uncertainty": {"pole_deg": "unknown", "sun_deg": 0.5, "scale": 0.01, "albedo": 0.3, "ephemeris_km": 2.0},
    }
    heights = HeightMap.from_array(np.full((18, 36), 0.1), reference_radii_km=[20.0] * 3, sigma_km=0.02)
    heights.save(tmp_path / "heights.npz")

    def change(table: dict[str, Any]) -> None:
        table["plan"].update(estimators=[], target="BALL")
        del table["plan"]["select"]
        table["targets"][0].update(declared)
        table["targets"].append(moon | {"terrain": "heights.npz", "air": False})

    setup = PlanSetup.load(write_plan_file(tmp_path, change))
    assert [each for each in setup.warnings if "scene.toml" in each] == [
        "BALL: scene.toml renders it without its atmosphere, rings",
        "MOON: scene.toml renders it without its terrain",
    ]
    made = setup.plan()
    assert not isinstance(made, Failure)
    write_plan(made[0], tmp_path / "out")
    (tmp_path / "out" / "images").mkdir()
    for image in made[0].usable:
        (tmp_path / "out" / "images" / image.candidate.name).touch()
    planned = PlanSetup.load(tmp_path / "plan.toml").targets
    run = Campaign.load(tmp_path / "out" / "campaign.toml").targets
    for before, after in zip(planned, run, strict=True):
        assert after.uncertainty == before.uncertainty
        for name in ("atmosphere", "rings", "air"):
            assert getattr(after.limb, name) == getattr(before.limb, name)
    carried = run[1].limb.height_map()
    assert carried is not None
    assert_allclose(carried.heights_km([0.0, 0.0, 1.0]), 0.1)
    assert carried.sigma_km == 0.02


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("target"),
        lambda content: content["images"][0].pop("file"),
        lambda content: content["images"][0].pop("stars"),
        lambda content: content["images"][0].update(x_px=None),
        lambda content: content["images"][0].update(range_km=-1.0),
        lambda content: content["images"][0]["fixes"]["moment"].pop("covariance"),
        lambda content: content["images"][0]["fixes"]["moment"].update(covariance=[[1.0, 0.0], [0.0, -1.0]]),
        lambda content: content["images"][0]["fixes"]["moment"].update(covariance=[[1.0]]),
        lambda content: content["images"][0]["fixes"]["moment"].update(failure_probability="low"),
    ],
)
def test_a_damaged_plan_is_refused_in_one_line(damage: Change, tmp_path: Path) -> None:
    fix = {"covariance": [[1.0, 0.0], [0.0, 1.0]], "failure_probability": 0.1}
    image = {"file": "a.fits", "stars": 3.0, "x_px": 1.0, "y_px": 2.0, "range_km": 10.0, "fixes": {"moment": fix}}
    content: dict[str, Any] = {"target": "BALL", "images": [image]}
    damage(content)
    (tmp_path / "plan.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="cannot be read as a plan"):
        compare_plan(tmp_path, tmp_path)


def test_what_is_no_plan_is_refused(tmp_path: Path) -> None:
    done = RUNNER.invoke(app, ["plan", "compare", str(tmp_path), str(tmp_path)])
    assert done.exit_code == 2
    assert "cannot be read as a plan" in done.output
    assert RUNNER.invoke(app, ["plan", "compare", str(tmp_path)]).exit_code == 2
