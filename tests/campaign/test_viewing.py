"""``[geometry]``: a picture without any header is measured with angles alone."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation

from giantlike.campaign.check import check_campaign
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.image_loading import open_image, scene_of
from giantlike.campaign.run.runner import run_campaign
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.core.time import time_from_utc
from giantlike.ephemeris import ApparentGeometry
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import Ellipsoid
from giantlike.simulation import Shot, Sources, simulate_image
from tests.campaign_files import BODY_TURN, CAMERA, RADII_KM, SUN_CAMERA, campaign_table
from tests.io.test_epic_metadata import RECORDS

POSITION_KM = np.array([1.5, 0.8, 32.0])


def degrees(vector: np.ndarray) -> tuple[float, float]:
    """Latitude and east longitude."""
    return math.degrees(math.asin(vector[2])), math.degrees(math.atan2(vector[1], vector[0]))


def clockwise_from_up(arrow_camera: np.ndarray) -> float:
    start, end = (CAMERA.model.project(POSITION_KM + length * arrow_camera) for length in (-1e-4, 1e-4))
    return math.degrees(math.atan2(end[0] - start[0], -(end[1] - start[1])))


def circumstances() -> dict[str, Any]:
    """What a press kit would say of the scene."""
    viewer = -POSITION_KM / np.linalg.norm(POSITION_KM)
    (seen_lat, seen_lon), (lit_lat, lit_lon) = (
        degrees(rotate(BODY_TURN.inv(), vector)) for vector in (viewer, SUN_CAMERA)
    )
    return {
        "center_px": CAMERA.model.project(POSITION_KM).round().tolist(),
        "range_km": round(float(np.linalg.norm(POSITION_KM)), 1),
        "north_azimuth_deg": clockwise_from_up(rotate(BODY_TURN, np.array([0.0, 0.0, 1.0]))),
        "sub_observer_latitude_deg": seen_lat,
        "sub_observer_longitude_deg": seen_lon,
        "sub_solar_latitude_deg": lit_lat,
        "sub_solar_longitude_deg": lit_lon,
        "phase_angle_deg": round(math.degrees(math.acos(SUN_CAMERA @ viewer)), 0),
        "sun_azimuth_deg": round(clockwise_from_up(SUN_CAMERA - (SUN_CAMERA @ viewer) * viewer), -1),
    }


def write(folder: Path, geometry: Any, **changes: Any) -> Path:
    """A campaign of one PNG; the camera declares the PEBBLE's picture to be 8 bit."""
    table = {key: value for key, value in campaign_table().items() if key != "stars"}
    table["images"] = {"files": ["pebble.png"]}
    table["geometry"] = geometry
    table["targets"][0]["estimators"] = ["limb_matching"]
    CAMERA.save(folder / "camera.toml")
    table |= changes
    (folder / "campaign.toml").write_text(tomli_w.dumps(table))
    return folder / "campaign.toml"


@pytest.fixture(scope="module")
def picture() -> bytes:
    scene = Scene(
        targets=(
            Target(
                name="PEBBLE",
                shape=Ellipsoid(radii_km=np.array(RADII_KM)),
                ephemeris=ApparentGeometry(
                    position_inertial_km=POSITION_KM, inertial_from_body=BODY_TURN, sun_direction_inertial=SUN_CAMERA
                ),
            ),
        )
    )
    shot = Shot(
        name="pebble",
        epoch=time_from_utc("2024-05-01T00:00:00"),
        exposure_s=1.5e-4,
        camera_from_inertial=Rotation.identity(),
    )
    pixels = simulate_image(shot, CAMERA, Sources(scene=scene), seed=1).image.pixels
    encoded, png = cv2.imencode(".png", np.asarray(pixels, dtype=np.uint16))
    assert encoded
    return bytes(png)


def test_a_picture_is_measured_with_angles_alone(tmp_path: Path, picture: bytes) -> None:
    (tmp_path / "pebble.png").write_bytes(picture)
    path = write(tmp_path, circumstances())
    assert [str(one) for one in check_campaign(path, all_images=True)] == []
    campaign = Campaign.load(path)
    prepared = open_image(campaign, campaign.images[0])
    assert prepared.notes == ("no a priori attitude: camera axes are used as inertial axes",)
    scene = scene_of(campaign, prepared.image, campaign.targets[0], Ellipsoid(radii_km=np.array(RADII_KM)))
    assert not isinstance(scene, Failure)
    found = scene.geometry(prepared.image, "PEBBLE")
    assert isinstance(found, TargetGeometry)
    assert (found.camera_from_body * BODY_TURN.inv()).magnitude() < 1e-3  # the center is rounded to a pixel
    result = run_campaign(campaign, workers=1)
    rows = [row for row in result.observations if row.estimator == "limb_matching"]
    assert [row.status for row in rows] == ["ok"]
    assert rows[0].center_px == pytest.approx(CAMERA.model.project(POSITION_KM).tolist(), abs=0.05)
    assert rows[0].range_km == pytest.approx(np.linalg.norm(POSITION_KM), rel=2e-3)


def test_an_attitude_of_the_header_turns_the_whole_scene(tmp_path: Path, picture: bytes) -> None:
    """Geometry in camera axes holds with any attitude, also with one from stars."""
    (tmp_path / "pebble.png").write_bytes(picture)
    campaign = Campaign.load(write(tmp_path, circumstances()))
    image = open_image(campaign, campaign.images[0]).image
    shape = Ellipsoid(radii_km=np.array(RADII_KM))
    seen = []
    for attitude in (Rotation.identity(), Rotation.from_rotvec([0.3, -1.0, 2.0])):
        turned = image.with_attitude(attitude)
        scene = scene_of(campaign, turned, campaign.targets[0], shape)
        assert not isinstance(scene, Failure)
        geometry = scene.geometry(turned)
        assert isinstance(geometry, TargetGeometry)
        seen.append(geometry)
    np.testing.assert_allclose(seen[0].position_camera_km, seen[1].position_camera_km, rtol=0, atol=1e-12)
    np.testing.assert_allclose(seen[0].sun_direction_camera, seen[1].sun_direction_camera, rtol=0, atol=1e-12)
    assert (seen[0].camera_from_body * seen[1].camera_from_body.inv()).magnitude() < 1e-12


def test_the_range_follows_from_the_size_in_the_picture_and_has_to_agree_with_it(tmp_path: Path) -> None:
    (tmp_path / "pebble.png").write_bytes(b"")
    by_size = {"diameter_px": 2 * 1.1 / 32.0 * 900.0, "sun_azimuth_deg": 90.0, "phase_angle_deg": 40.0}
    sphere = {"targets": [{"name": "PEBBLE", "shape": {"radii_km": [1.1] * 3}, "estimators": ["moment"]}]}
    seen = Campaign.load(write(tmp_path, [by_size], **sphere)).geometry["pebble.png"].seen["PEBBLE"]
    assert np.linalg.norm(seen.position_camera_km) == pytest.approx(32.0, rel=1e-3)
    # clockwise from up: to the right, on the side of the camera; at the middle of the frame, 160 px from the axis
    assert seen.sun_direction_camera[0] == pytest.approx(math.sin(math.radians(40.0)), abs=1e-3)
    pds = {"azimuth_zero": "right", "sun_azimuth_deg": 0.0}
    same = Campaign.load(write(tmp_path, [by_size | pds], **sphere)).geometry["pebble.png"].seen["PEBBLE"]
    np.testing.assert_allclose(same.sun_direction_camera, seen.sun_direction_camera, rtol=0, atol=1e-12)
    with pytest.raises(DataError, match=r"geometry\[0\]: range_km is 40, but a body 2.2 km wide has 61.875 px at 32"):
        Campaign.load(write(tmp_path, [by_size | {"range_km": 40.0}], **sphere))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file": "stone.png"}, "0 images have the name 'stone.png'"),
        ({"target": "STONE"}, r"expected the name of one of the targets \(PEBBLE\), got 'STONE'"),
        ({"phase_angle_deg": 20.0}, r"phase angle is 20 deg, but the sub-solar point is"),
        ({"range_km": None}, "give range_km, or diameter_px"),
        ({"sub_observer_longitude_deg": None}, "may be left out for a body of revolution"),
        ({"sub_solar_longitude_deg": None}, "sub_solar_latitude_deg and sub_solar_longitude_deg belong together"),
        ({"north_azimuth_deg": None}, "both the north azimuth and the sub-observer point"),
        ({"center_px": [1.0]}, r"center_px: expected \[x, y\]"),
        ({"longitude": 3.0}, r"unknown key geometry\[0\].longitude"),
    ],
)
def test_a_table_that_does_not_describe_the_picture_is_refused(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    (tmp_path / "pebble.png").write_bytes(b"")
    table = {key: value for key, value in (circumstances() | change).items() if value is not None}
    with pytest.raises(DataError, match=message):
        Campaign.load(write(tmp_path, table))


def test_an_unknown_pole_needs_no_orientation_and_is_taken_as_up_in_the_image(tmp_path: Path, picture: bytes) -> None:
    (tmp_path / "pebble.png").write_bytes(picture)
    oblate = {"name": "PEBBLE", "shape": {"radii_km": [1.1, 1.1, 1.0]}, "estimators": ["moment"]}
    sun = {"range_km": 32.0, "sun_azimuth_deg": 110.0, "phase_angle_deg": 60.0}
    for uncertainty in ({}, {"pole_deg": "unknown"}):
        path = write(tmp_path, sun, targets=[oblate | {"uncertainty": uncertainty}])
        campaign = Campaign.load(path)
        image = open_image(campaign, campaign.images[0]).image.with_attitude(Rotation.from_rotvec([0.3, 2.0, 0.1]))
        scene = scene_of(campaign, image, campaign.targets[0], campaign.targets[0].load_shape())
        if not uncertainty:
            assert isinstance(scene, Failure)
            assert "north, sub-observer point" in scene.detail
            continue
        assert not isinstance(scene, Failure)
        geometry = scene.geometry(image)
        assert isinstance(geometry, TargetGeometry)
        pole = rotate(geometry.camera_from_body, np.array([0.0, 0.0, 1.0]))
        np.testing.assert_allclose(pole, [0.0, -1.0, 0.0], rtol=0, atol=1e-12)


def test_the_metadata_of_epic_are_the_geometry_of_its_pictures(tmp_path: Path) -> None:
    (record, _) = RECORDS
    name = f"epic_1b_{record['identifier']}.png"
    encoded, png = cv2.imencode(".png", np.zeros((1024, 1024), np.uint8))
    assert encoded
    (tmp_path / name).write_bytes(bytes(png))
    (tmp_path / "epic.json").write_text(json.dumps(RECORDS))
    earth = {"name": "EARTH", "shape": {"radii_km": [6378.137, 6378.137, 6356.752]}, "estimators": ["moment"]}
    path = write(
        tmp_path,
        [],
        images={"files": [name], "geometry": "epic.json"},
        camera={"preset": "dscovr_epic", "binned": 2, "detector": {"gamma": "sRGB"}},
        targets=[earth],
    )
    assert [str(one) for one in check_campaign(path, all_images=True)] == []
    campaign = Campaign.load(path)
    image = open_image(campaign, campaign.images[0]).image
    scene = scene_of(campaign, image, campaign.targets[0], campaign.targets[0].load_shape())
    assert not isinstance(scene, Failure)
    geometry = scene.geometry(image)
    assert isinstance(geometry, TargetGeometry)
    np.testing.assert_allclose(campaign.camera.model.project(geometry.position_camera_km), 511.5, rtol=0, atol=1e-6)
    assert math.degrees(geometry.phase_angle_rad) == pytest.approx(9.88, abs=0.01)


def test_a_row_of_the_table_and_a_geometry_of_the_same_image_are_refused(tmp_path: Path) -> None:
    (tmp_path / "pebble.png").write_bytes(b"")
    (tmp_path / "geometry.csv").write_text("file,target,target_x_km,target_y_km,target_z_km\npebble.png,PEBBLE,0,0,3\n")
    images = {"files": ["pebble.png"], "geometry": "geometry.csv"}
    with pytest.raises(DataError, match=r"has a row in images\.geometry too"):
        Campaign.load(write(tmp_path, circumstances(), images=images))
