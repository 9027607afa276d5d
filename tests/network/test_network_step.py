"""The step ``network`` of a run: landmarks in all images, restart, report, and the command on a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from benchmarks.network_truth import Sequence, Told, sequence
from giantlike.campaign import Campaign, RunResult, load_result, photos_of_run, run_campaign
from giantlike.campaign.check import check_campaign
from giantlike.cli.app import app
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.io import navigation_header, write_fits, write_geometry
from giantlike.io.geometry_table import GeometryRow
from giantlike.network import Photo, photo_of
from giantlike.shapes import TriangleMesh, save_shape
from giantlike.shapes.landmarks import load_landmarks
from tests.tolerances import FLOAT64


def write(folder: Path, **network: Any) -> tuple[Path, Sequence]:
    """Write a campaign of five images, with the a priori geometry that is told."""
    rock = sequence(2, told=Told(attitude_rad=2e-5), images=5, diameter_px=130.0, revolutions=0.3)
    rows = []
    (folder / "images").mkdir(parents=True)
    for number, image in enumerate(rock.images):
        name = f"image{number}.fits"
        geometry = rock.scene.geometry(image)
        assert not isinstance(geometry, Failure)
        assert image.camera_from_inertial is not None
        back = image.camera_from_inertial.inv()
        write_fits(folder / "images" / name, image.pixels, header=navigation_header(epoch=image.epoch, exposure_s=1.0))
        rows.append(
            GeometryRow(
                file=name,
                camera_from_inertial=image.camera_from_inertial,
                target="ROCK",
                target_position_inertial_km=rotate(back, geometry.position_camera_km),
                body_from_inertial=(back * geometry.camera_from_body).inv(),
                sun_direction_inertial=rotate(back, geometry.sun_direction_camera),
            )
        )
    write_geometry(folder / "geometry.csv", rows)
    rock.camera.save(folder / "camera.toml")
    shape = rock.scene.targets[0].shape
    assert isinstance(shape, TriangleMesh)
    save_shape(shape, folder / "rock.obj")
    table = {
        "campaign": {"name": "rock", "output": "run"},
        "images": {"files": ["images/*.fits"], "geometry": "geometry.csv", "attitude_sigma_deg": 0.002},
        "camera": {"file": "camera.toml"},
        "report": {"max_overlays": 0},
        "network": network,
        "targets": [
            {"name": "ROCK", "shape": "rock.obj", "estimators": ["moment"], "uncertainty": {"ephemeris_km": 0.2}}
        ],
    }
    (folder / "campaign.toml").write_text(tomli_w.dumps(table))
    return folder / "campaign.toml", rock


def run(path: Path) -> RunResult:
    return run_campaign(Campaign.load(path), workers=1)


def test_a_run_adjusts_the_landmarks_of_its_images_and_redoes_those_of_an_edited_one(tmp_path: Path) -> None:
    path, rock = write(tmp_path)
    first = run(path)
    summary = first.network
    assert summary is not None
    assert summary["status"] == "ok", summary
    assert [one["name"] for one in summary["images"]] == [f"image{k}.fits" for k in range(5)]
    assert first.steps["network"].redone == 5
    before, after = [], []
    for k, one in enumerate(summary["images"]):
        geometry = rock.scene.geometry(rock.images[k])
        assert not isinstance(geometry, Failure)
        attitude = rock.images[k].camera_from_inertial
        assert attitude is not None
        known = -rotate(attitude.inv(), geometry.position_camera_km)
        before.append(np.linalg.norm(known - rock.positions_km[k]))
        after.append(np.linalg.norm(np.array(one["position_km"]) - rock.positions_km[k]))
    assert np.mean(after) < 0.8 * np.mean(before)
    assert "landmarks of ROCK" in (tmp_path / "run" / "report.html").read_text()
    assert (tmp_path / "run" / "network" / "points.csv").is_file()
    assert load_result(tmp_path / "run").network == summary
    catalog = load_landmarks(tmp_path / "run" / "network" / "landmarks.npz")
    assert len(catalog) <= summary["points"]
    spc = CliRunner().invoke(app, ["network", "adjust", str(tmp_path / "run" / "network" / "SUMFILES"), "--json"])
    assert spc.exit_code == 0, spc.output

    photos = photos_of_run(first)
    assert [photo.name for photo in photos] == [f"image{k}.fits" for k in range(5)]
    for k, photo in enumerate(photos):
        truly = photo_of(rock.images[k], rock.camera, rock.scene)
        assert isinstance(truly, Photo)
        assert_allclose(photo.position_km, truly.position_km, rtol=0, atol=1e-6)
        assert photo.camera_from_inertial.approx_equal(truly.camera_from_inertial, atol=1e-9)
        assert photo.covariance_pose is not None
        assert_allclose(np.diag(photo.covariance_pose)[3:], 0.2**2, rtol=0, atol=FLOAT64)

    again = run(path)
    assert (again.steps["network"].redone, again.steps["network"].kept) == (0, 5)
    assert again.network == summary

    image = rock.images[3]
    noise = np.random.default_rng(5).normal(0.0, 3.0, image.pixels.shape)
    header = navigation_header(epoch=image.epoch, exposure_s=1.0)
    (tmp_path / "images" / "image3.fits").unlink()
    write_fits(tmp_path / "images" / "image3.fits", (image.pixels + noise).astype(np.float32), header=header)
    edited = run(path)
    assert (edited.steps["network"].redone, edited.steps["network"].kept) == (1, 4)
    assert edited.network is not None
    assert edited.network != summary

    result = CliRunner().invoke(
        app, ["network", "adjust", str(tmp_path / "run"), "--json", "-o", str(tmp_path / "out")]
    )
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["points"] == edited.network["points"]
    assert (tmp_path / "out" / "poses.csv").is_file()


def test_a_campaign_whose_network_cannot_be_is_refused(tmp_path: Path) -> None:
    path, _ = write(tmp_path)
    text = path.read_text()
    for old, new, word in (
        ("images/*.fits", "images/image0.fits", "at least two images"),
        ("[network]", "[network]\ntarget = 'PEBBLE'", "unknown target 'PEBBLE'"),
        ("[network]", "[network]\nshape = 'nowhere.obj'", "network.shape: there is no file"),
        ('shape = "rock.obj"', "shape = { radii_km = [1, 1, 1] }", "landmarks need a mesh"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(DataError, match=word):
            Campaign.load(path)
        assert any(word in str(one) and one.fatal for one in check_campaign(path))
