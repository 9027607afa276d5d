"""A finished run to look at."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import Float
from giantlike.ephemeris import ApparentGeometry
from giantlike.io import write_fits, write_geometry
from giantlike.io.geometry_table import GeometryRow
from giantlike.relative.landmarks.selection import landmarks_of
from giantlike.shapes import irregular_body, save_shape
from giantlike.shapes.landmarks import LandmarkCatalog, save_landmarks
from tests.campaign_files import Truth, write_campaign
from tests.limb_images import CAMERA, body_image

Made: TypeAlias = tuple[Path, dict[str, Truth]]
SPECKLED_PX = ((110, 155), (210, 255))
"""Columns and rows of a square of noise over landmarks, which cannot be found there."""


@pytest.fixture(scope="package")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Campaign file of a finished run, and the truth of its images."""
    path, truth = write_campaign(tmp_path_factory.mktemp("bench"), visits=1)
    run_campaign(Campaign.load(path), workers=1)
    return path, truth


@pytest.fixture
def campaign(made: Made, tmp_path: Path) -> Path:
    """Campaign file of a copy of that run, to be edited."""
    shutil.copytree(made[0].parent, tmp_path / "copy")
    return tmp_path / "copy" / made[0].name


@pytest.fixture
def run(campaign: Path) -> Path:
    return Campaign.load(campaign).output


@dataclass(frozen=True, kw_only=True, eq=False)
class RockRun:
    """A run of one image of a body by landmarks, and where in the image they are in truth."""

    run: Path
    file: str
    landmarks: LandmarkCatalog
    position_camera_km: Float
    camera_from_body: Rotation

    def px(self, names: Sequence[str]) -> Float:
        places = {landmark.name: landmark.point_body_km for landmark in self.landmarks.landmarks}
        points_km = self.camera_from_body.apply(np.array([places[name] for name in names])) + self.position_camera_km
        return CAMERA.model.project(points_km)


@pytest.fixture(scope="package")
def rock(tmp_path_factory: pytest.TempPathFactory) -> RockRun:
    folder = tmp_path_factory.mktemp("rock")
    shape = irregular_body(2, facets=10_000)
    one = body_image(shape, 1, phase_deg=35.0, radius_px=110.0)
    told = one.believed(off_px=(8.0, -6.0)).target.ephemeris
    assert isinstance(told, ApparentGeometry)
    pixels, ((left, right), (top, bottom)) = one.image.pixels.copy(), SPECKLED_PX
    speckle = np.random.default_rng(5).uniform(0, 3000, (bottom - top, right - left))
    pixels[top:bottom, left:right] = speckle.astype(pixels.dtype)
    write_fits(folder / "rock.fits", pixels)
    row = GeometryRow(
        file="rock.fits",
        camera_from_inertial=Rotation.identity(),
        target="BODY",
        target_position_inertial_km=told.position_inertial_km,
        body_from_inertial=told.inertial_from_body.inv(),
        sun_direction_inertial=told.sun_direction_inertial,
    )
    write_geometry(folder / "geometry.csv", [row])
    save_shape(shape, folder / "rock.ply")
    landmarks = landmarks_of(shape)
    save_landmarks(landmarks, folder / "landmarks.npz")
    replace(CAMERA, name="rock camera").save(folder / "camera.toml")
    table = {
        "campaign": {"name": "rock", "output": "run"},
        "images": {"files": ["rock.fits"], "geometry": "geometry.csv"},
        "camera": {"file": "camera.toml"},
        "targets": [
            {
                "name": "BODY",
                "shape": "rock.ply",
                "units": "km",
                "estimators": ["surface_features"],
                "options": {"surface_features": {"landmarks": "landmarks.npz"}},
            }
        ],
    }
    (folder / "campaign.toml").write_text(tomli_w.dumps(table))
    run_campaign(Campaign.load(folder / "campaign.toml"), workers=1)
    return RockRun(
        run=folder / "run",
        file="rock.fits",
        landmarks=landmarks,
        position_camera_km=one.position_camera_km,
        camera_from_body=told.inertial_from_body,
    )


def make_suspect(run: Path, file: str, of: tuple[str, str] = ("", ""), flag: str = "far_from_prediction") -> None:
    """Let a check object to a stored result: a fix of a target by an estimator, or the attitude."""
    folder = RunFolder.open(run)
    kind: type[AttitudeRecord] | type[ObservationRecord] = ObservationRecord if of[0] else AttitudeRecord
    record, key = folder.load(kind, file, of), folder.keys(kind)[file, *of]
    assert record is not None
    with folder.writing():
        folder.save(record.replace(status="suspect", flags=[*record.flags, flag]), key)
