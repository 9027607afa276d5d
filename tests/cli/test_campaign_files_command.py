"""``giantlike check`` and ``init``: every mistake at once, with line and remedy; a campaign file from a folder."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner, Result

from giantlike.campaign.file.config import Campaign
from giantlike.cli.app import app
from giantlike.core.time import time_from_utc
from giantlike.io import navigation_header, write_fits, write_geometry
from giantlike.io.geometry_table import GeometryRow
from tests.campaign_files import CAMERA, campaign_table

WRONG = """\
[campaign]
name = "test"
output = "run"
color = "red"

[images]
files = ["images/*.fits", "nothing/*.fits"]

[camera]
file = "camera.toml"

[stars]
loast_in_space = true
options = { min_matche = 3 }

[[targets]]
name = "PEBBLE"
estimators = ["limb_maching", "moment"]
shape = "none.obj"
reflectance = { model = "lambrt" }
options.limb_matching = { max_iterations = -1 }

[[targets]]
name = "OTHER"
estimators = ["moment"]
shape = { radii_km = [1, 1, 1] }
units = "miles"
"""


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    for name, exposure_s in (("a", 2.0), ("b", 1e-3)):
        header = navigation_header(epoch=None, exposure_s=exposure_s)
        write_fits(
            tmp_path / "images" / f"{name}.fits", np.zeros((CAMERA.rows, CAMERA.columns), np.uint16), header=header
        )
    CAMERA.save(tmp_path / "camera.toml")
    row = GeometryRow(file="a.fits", target="PEBBLE", target_position_inertial_km=np.array([0.0, 0.0, 30.0]))
    write_geometry(tmp_path / "geometry.csv", [row])
    return tmp_path


def found(path: Path) -> dict[int | None, str]:
    """Texts by line of what ``check`` says of a campaign file."""
    result = giantlike("check", path, "--json")
    assert "Traceback" not in result.output
    answer = json.loads(result.stdout)
    assert result.exit_code == (2 if answer["mistakes"] else 0)
    return {mistake["line"]: mistake["text"] for mistake in answer["found"]}


def test_all_mistakes_of_all_sections_are_told_at_once_with_line_and_remedy(folder: Path) -> None:
    path = folder / "campaign.toml"
    path.write_text(WRONG)
    mistakes = found(path)
    lines = WRONG.splitlines()
    expected = {
        'color = "red"': "unknown key campaign.color; keys there are name, output",
        'files = ["images/*.fits", "nothing/*.fits"]': "no file matches 'nothing/*.fits'",
        "loast_in_space = true": "did you mean 'lost_in_space'?",
        "options = { min_matche = 3 }": "did you mean 'min_matches'?",
        'estimators = ["limb_maching", "moment"]': "did you mean 'limb_matching'?",
        'shape = "none.obj"': "there is no file 'none.obj'",
        'reflectance = { model = "lambrt" }': "model must be one of",
        "options.limb_matching = { max_iterations = -1 }": "max_iterations must be a whole number in [1, 50], got -1",
        'units = "miles"': "expected 'km', 'm' or 'auto', got 'miles'",
    }
    for line, text in expected.items():
        assert text in mistakes.pop(lines.index(line) + 1), line
    assert mistakes == {}


def test_what_is_allowed_and_not_meant_is_told(folder: Path) -> None:
    table: dict[str, Any] = campaign_table()
    table["targets"][0] |= {"options": {"ellipse_fit": {}}, "shape": {"radii_km": [300.0, 300.0, 300.0]}}
    table["stars"]["lost_in_space"] = True
    table["targets"].append({"name": "GHOST", "shape": {"radii_km": [1.0, 1.0, 1.0]}, "estimators": ["moment"]})
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(table))
    texts = " ".join(found(path).values())
    assert "PEBBLE has a radius of 300 km, and the camera is within it in 1 images ('a.fits': range 30 km)" in texts
    assert "options of ellipse_fit, which is not in estimators and does not run" in texts
    assert "target 'GHOST': no row in" in texts
    assert "images.geometry" not in texts
    assert "2 mistakes, 3 warnings" in giantlike("check", path).stdout  # the third: no row for b.fits


def test_a_clock_that_was_never_set_is_told(folder: Path) -> None:
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(campaign_table()))
    for name, utc in (("a", "2024-05-01T00:00:00"), ("b", "1990-01-01T00:00:00"), ("c", "2024-05-01T00:00:09")):
        header = navigation_header(epoch=time_from_utc(utc), exposure_s=2.0)
        pixels = np.zeros((CAMERA.rows, CAMERA.columns), np.uint16)
        write_fits(folder / "images" / f"{name}.fits", pixels, header=header)
    told = " ".join(
        mistake["text"] for mistake in json.loads(giantlike("check", path, "--images", "--json").stdout)["found"]
    )
    assert "b.fits: its epoch is -34.3 years from those of the other images" in told
    assert "a.fits: its epoch" not in told


def test_a_run_without_any_attitude_is_told_with_two_remedies(folder: Path) -> None:
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(campaign_table() | {"stars": {"lost_in_space": False}}))
    told = " ".join(one["text"] for one in json.loads(giantlike("check", path, "--images", "--json").stdout)["found"])
    assert "no image has an a priori attitude" in told
    assert "lost_in_space = true" in told


def test_a_misspelled_target_is_told_beside_an_unknown_key_with_where_options_belong(folder: Path) -> None:
    table: dict[str, Any] = campaign_table()
    table["targets"][0] |= {"name": "PEBLE", "limb_matching": {"max_iterations": 3}}
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(table))
    texts = " ".join(found(path).values())
    assert "target 'PEBLE' (did you mean 'PEBBLE'?): no row in" in texts
    assert "options of an estimator go into [targets.options.limb_matching]" in texts


def test_an_image_of_another_size_and_a_file_that_is_no_toml_are_told(folder: Path) -> None:
    path = folder / "campaign.toml"
    table = {key: value for key, value in campaign_table().items() if key != "targets"}
    path.write_text(tomli_w.dumps(table | {"stars": {"lost_in_space": True}}))
    assert giantlike("check", path).exit_code == 0
    write_fits(folder / "images" / "c.fits", np.zeros((10, 10), np.uint16))
    assert giantlike("check", path).exit_code == 0
    answer = json.loads(giantlike("check", path, "--images", "--json").stdout)["found"]
    (small,) = [mistake["text"] for mistake in answer if mistake["fatal"]]
    assert re.search(r"c\.fits.*10", small)
    path.write_text("[campaign]\nname = \n")
    assert "line 2" in " ".join(found(path).values())
    assert 2 in found(path)


def test_init_writes_a_campaign_file_that_loads_and_tells_what_it_saw(folder: Path) -> None:
    path = folder / "new.toml"
    assert giantlike("init", folder / "images", "--fov", "20", "--output", path).exit_code == 0
    campaign = Campaign.load(path)
    assert [image.key for image in campaign.images] == ["a.fits", "b.fits"]
    assert (campaign.camera.columns, campaign.camera.rows) == (CAMERA.columns, CAMERA.rows)
    assert campaign.stars is not None
    assert campaign.stars.long_exposure_s == 1.0  # there are exposures of 2 s and of 1 ms
    assert "an exposure time in 2" in path.read_text()
    assert "is there already" in giantlike("init", folder / "images", "--fov", "20", "--output", path).stderr
    assert "one of --camera FILE" in giantlike("init", folder / "images", "--output", folder / "x.toml").stderr
    assert "holds no image" in giantlike("init", folder, "--fov", "20", "--output", folder / "x.toml").stderr


def test_init_takes_a_preset_or_a_mission_that_fits_the_images(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    write_fits(tmp_path / "images" / "a.fits", np.zeros((256, 256), np.uint16), header={})
    for option in ("--preset", "--mission"):
        path = tmp_path / f"{option[2:]}.toml"
        assert giantlike("init", tmp_path / "images", option, "cassini_nac", "--output", path).exit_code == 0
        assert Campaign.load(path).camera.columns == 256
        assert giantlike("check", path, "--images").exit_code == 0
        unknown = giantlike("init", tmp_path / "images", option, "casini_nac", "--output", tmp_path / "x.toml")
        assert unknown.exit_code == 2
        assert "cassini_nac" in unknown.stderr
    write_fits(tmp_path / "images" / "a.fits", np.zeros((640, 640), np.uint16), header={})
    path = tmp_path / "resampled.toml"
    assert giantlike("init", tmp_path / "images", "--preset", "cassini_nac", "--output", path).exit_code == 0
    assert "binned = [640, 640]" in path.read_text()
    assert Campaign.load(path).camera.columns == 640
    write_fits(tmp_path / "images" / "a.fits", np.zeros((300, 256), np.uint16), header={})
    other = giantlike("init", tmp_path / "images", "--preset", "cassini_nac", "--output", tmp_path / "x.toml")
    assert other.exit_code == 2
    assert "1024 x 1024 pixels and the images 256 x 300" in other.stderr


def test_completion_is_offered() -> None:
    assert "--install-completion" in giantlike("--help").stdout
