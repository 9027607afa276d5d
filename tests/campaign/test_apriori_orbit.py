"""A priori of an orbit: SUMFILEs as geometry of a campaign, and a covariance that varies along the arc."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spiceypy
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.campaign.check import check_campaign
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.image_loading import open_image, scene_of
from giantlike.campaign.run.runner import run_campaign
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.time import time_from_utc
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.image import Image
from giantlike.io.camera_import import read_foreign_camera
from giantlike.io.observables_file import read_observables
from giantlike.io.spc_sumfile import Sumfile, write_sumfile
from giantlike.io.spice import load_kernels
from giantlike.scene import Scene, TargetGeometry
from giantlike.shapes import Ellipsoid
from tests.campaign.test_viewing import POSITION_KM, circumstances, picture, write
from tests.campaign_files import BODY_TURN, CAMERA, RADII_KM, SUN_CAMERA

__all__ = ["picture"]

EPOCH = "2024-05-01T00:00:00"
ET = 767793669.1855  # of this epoch
SIGMA_KM, SIGMA_RAD = np.array([0.02, 0.05, 0.01]), np.array([1e-4, 2e-4, 3e-4])
PCK = """KPL/PCK
\\begindata
NAIF_BODY_NAME += 'PEBBLE'
NAIF_BODY_CODE += 2999999
BODY2999999_POLE_RA = ( 30. 0. 0. )
BODY2999999_POLE_DEC = ( 50. 0. 0. )
BODY2999999_PM = ( 10. 360. 0. )
\\begintext
"""


def sumfile(folder: Path, name: str = "PEBBLE.SUM", **changes: Any) -> None:
    (folder / "SUMFILES").mkdir(exist_ok=True)
    axes = BODY_TURN.as_matrix()
    content: dict[str, Any] = {
        "name": "PEBBLE",
        "epoch": time_from_utc(EPOCH),
        "columns": 320,
        "rows": 280,
        "thresholds_dn": (0, 60000),
        "focal_length_mm": 90.0,
        "center_px": np.array([160.3, 139.6]),
        "pixels_per_mm": np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]]),
        "target_km": axes.T @ POSITION_KM,
        "camera_from_body": BODY_TURN,
        "sun_direction_body": axes.T @ SUN_CAMERA,
        "sigma_target_km": SIGMA_KM,
        "sigma_pointing_rad": SIGMA_RAD,
    }
    write_sumfile(folder / "SUMFILES" / name, Sumfile(**(content | changes)))


def campaign_of(folder: Path, picture: bytes, **changes: Any) -> Path:
    (folder / "pebble.png").write_bytes(picture)
    return write(folder, [], images={"files": ["pebble.png"], "geometry": "SUMFILES"}, **changes)


def predicted(path: Path) -> tuple[Image, TargetGeometry, tuple[str, ...]]:
    campaign = Campaign.load(path)
    prepared = open_image(campaign, campaign.images[0])
    scene = scene_of(campaign, prepared.image, campaign.targets[0], Ellipsoid(radii_km=np.array(RADII_KM)))
    assert isinstance(scene, Scene)
    geometry = scene.geometry(prepared.image)
    assert isinstance(geometry, TargetGeometry)
    return prepared.image, geometry, prepared.notes


def assert_as_declared(geometry: TargetGeometry) -> None:
    """Ten digits of a SUMFILE."""
    assert_allclose(geometry.position_camera_km, POSITION_KM, rtol=0, atol=1e-7)
    assert_allclose(geometry.sun_direction_camera, SUN_CAMERA, rtol=0, atol=1e-9)
    assert (geometry.camera_from_body * BODY_TURN.inv()).magnitude() < 1e-9
    axes = BODY_TURN.as_matrix()
    assert_allclose(geometry.covariance_ephemeris_km2, axes * SIGMA_KM**2 @ axes.T, rtol=0, atol=1e-11)


def test_sumfiles_are_the_geometry_of_a_campaign_in_axes_of_the_body(tmp_path: Path, picture: bytes) -> None:
    sumfile(tmp_path)
    path = campaign_of(tmp_path, picture)
    assert [str(one) for one in check_campaign(path, all_images=True)] == []
    image, geometry, notes = predicted(path)
    assert notes == ("no a priori attitude: axes of the body are used as inertial axes",)
    assert image.et == pytest.approx(ET, abs=1e-3)
    assert_as_declared(geometry)
    result = run_campaign(Campaign.load(path), workers=1)
    (row,) = (row for row in result.observations if row.estimator == "limb_matching")
    assert row.status == "ok"
    assert row.center_px == pytest.approx(CAMERA.model.project(POSITION_KM).tolist(), abs=0.05)
    rows, _ = read_observables(tmp_path / "run" / "observables.parquet")
    turn = image.camera_from_inertial
    assert turn is not None
    covariance = np.reshape(np.array(rows[0].covariance_ephemeris_icrf_km2, dtype=np.float64), (3, 3))
    assert_allclose(covariance, np.diag(SIGMA_KM**2), rtol=0, atol=1e-11)  # inertial axes are those of the body
    assert_allclose(np.diag(np.reshape(np.array(rows[0].attitude_covariance_rad2), (3, 3))), SIGMA_RAD**2, rtol=1e-9)


def test_the_attitude_follows_from_the_orientation_of_the_body_by_spice(tmp_path: Path, picture: bytes) -> None:
    sumfile(tmp_path)
    (tmp_path / "pebble.tpc").write_text(PCK)
    path = campaign_of(tmp_path, picture, spice={"kernels": ["pebble.tpc"], "spacecraft": "-999"})
    with load_kernels(["pebble.tpc"], tmp_path):
        image, geometry, notes = predicted(path)
        assert image.et is not None
        emission = image.et - float(np.linalg.norm(POSITION_KM)) / SPEED_OF_LIGHT_KM_S
        body_from_inertial = Rotation.from_matrix(spiceypy.tipbod("J2000", 2999999, emission))
    assert not any("inertial axes" in note for note in notes)
    assert_as_declared(geometry)
    assert image.camera_from_inertial is not None
    assert (image.camera_from_inertial * (BODY_TURN * body_from_inertial).inv()).magnitude() < 1e-9


def test_axes_of_a_sumfile_that_point_against_columns_and_rows_are_turned(tmp_path: Path, picture: bytes) -> None:
    half = Rotation.from_euler("z", 180.0, degrees=True)
    sumfile(
        tmp_path,
        pixels_per_mm=np.array([[-10.0, 0.0, 0.0], [0.0, -10.0, 0.0]]),
        camera_from_body=half * BODY_TURN,
    )
    assert_as_declared(predicted(campaign_of(tmp_path, picture))[1])
    imported = read_foreign_camera(tmp_path / "SUMFILES" / "PEBBLE.SUM")
    assert_allclose(imported.model.project(POSITION_KM), CAMERA.model.project(POSITION_KM), rtol=0, atol=1e-9)
    assert (imported.columns, imported.rows, imported.rows_reversed) == (320, 280, False)
    assert (imported.camera_from_mission * half.inv()).magnitude() < 1e-12


@pytest.mark.parametrize("name", ["target_km", "sigma_target_km", "sigma_pointing_rad"])
def test_huge_numbers_of_sumfiles_are_refused(tmp_path: Path, picture: bytes, name: str) -> None:
    """Their squares would overflow."""
    huge: dict[str, Any] = {name: np.array([1e160, 0.0, 0.0])}
    sumfile(tmp_path, **huge)
    with pytest.raises(DataError, match="3 numbers are needed"):
        Campaign.load(campaign_of(tmp_path, picture))


def test_sumfiles_that_fit_no_image_or_no_body_are_refused(tmp_path: Path, picture: bytes) -> None:
    path = campaign_of(tmp_path, picture)
    with pytest.raises(DataError, match="SUMFILES"):
        Campaign.load(path)
    sumfile(tmp_path, pixels_per_mm=np.array([[10.0, 0.0, 0.0], [0.0, -10.0, 0.0]]))
    with pytest.raises(DataError, match="mirrored"):
        Campaign.load(path)
    sumfile(tmp_path, pixels_per_mm=np.array([[10.0, 0.0, 1e-3], [0.0, 10.0, 0.0]]))
    with pytest.raises(DataError, match="K has distortion"):
        read_foreign_camera(tmp_path / "SUMFILES" / "PEBBLE.SUM")
    sumfile(tmp_path, pixels_per_mm=np.zeros((2, 3)))
    with pytest.raises(DataError, match="must not be 0"):
        Campaign.load(path)
    sumfile(tmp_path, columns=640)
    with pytest.raises(DataError, match="640 x 280 pixels"):
        Campaign.load(path)
    sumfile(tmp_path, name="OTHER.SUM", epoch=time_from_utc(EPOCH))
    sumfile(tmp_path)
    with pytest.raises(DataError, match="another SUMFILE of PEBBLE"):
        Campaign.load(path)
    (tmp_path / "SUMFILES" / "OTHER.SUM").unlink()
    (tmp_path / "pebble.png").rename(tmp_path / "stone.png")
    path.write_text(path.read_text().replace("pebble.png", "stone.png"))
    with pytest.raises(DataError, match="no image has the name of a SUMFILE"):
        Campaign.load(path)


def arc(folder: Path, seconds: float, matrices: list[Float]) -> None:
    names = "et,cx_x_km2,cy_x_km2,cy_y_km2,cz_x_km2,cz_y_km2,cz_z_km2"
    lines = [
        ",".join([repr(ET + sign * seconds), *map(repr, matrix[np.tril_indices(3)].tolist())])
        for sign, matrix in zip((-1.0, 1.0), matrices, strict=True)
    ]
    (folder / "arc.csv").write_text("\n".join([names, *lines]) + "\n")


def with_arc(folder: Path, picture: bytes) -> Path:
    (folder / "pebble.png").write_bytes(picture)
    path = write(folder, circumstances() | {"epoch_utc": EPOCH})
    path.write_text(path.read_text() + '\n[targets.uncertainty]\nephemeris_table = "arc.csv"\n')
    return path


def test_a_covariance_by_epoch_is_that_of_each_image(tmp_path: Path, picture: bytes) -> None:
    before, after = np.diag([4e-4, 1e-4, 9e-4]), np.diag([16e-4, 1e-4, 1e-4])
    arc(tmp_path, 500.0, [before, after])
    path = with_arc(tmp_path, picture)
    assert [str(one) for one in check_campaign(path, all_images=True)] == []
    assert Campaign.load(path).targets[0].uncertainty.ephemeris_km == pytest.approx(0.04)
    geometry = predicted(path)[1]
    assert_allclose(geometry.covariance_ephemeris_km2, (before + after) / 2.0, rtol=0, atol=1e-9)  # camera axes: ICRF
    arc(tmp_path, 500.0, [before, -after])
    assert any("ephemeris_table" in str(one) and "line 3" in str(one) for one in check_campaign(path))
    arc(tmp_path, -500.0, [before, after])  # the same epochs, in the other order
    assert [str(one) for one in check_campaign(path, all_images=True)] == []
    (tmp_path / "arc.csv").write_text((tmp_path / "arc.csv").read_text().replace(repr(ET - 500.0), repr(ET + 100.0)))
    found = [str(one) for one in check_campaign(path, all_images=True)]
    assert any("covers" in text and "is needed" in text for text in found), found
    starry = path.read_text() + "\n[stars]\nlong_exposure_s = 1e-4\n"
    path.write_text(starry.replace(f'epoch_utc = "{EPOCH}"', f'epoch_utc = "{EPOCH}"\nexposure_s = 1.0'))
    found = [str(one) for one in check_campaign(path, all_images=True)]
    assert not any("is needed" in text and "covers" in text for text in found), found  # no body is looked for in it
    (tmp_path / "arc.csv").unlink()
    assert any("ephemeris_table: there is no file 'arc.csv'" in str(one) for one in check_campaign(path))
