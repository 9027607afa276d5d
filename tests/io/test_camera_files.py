"""Camera models from and to the files of other programs, against those programs where they are at hand."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.wcs import WCS
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from giantlike.camera import Camera, MissionFrame
from giantlike.camera_models import BrownModel, CameraModel, EquidistantModel, OpenCVModel, OwenModel, PinholeModel
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, direction_from_radec, rotate
from giantlike.io.camera_giant import read_giant_camera
from giantlike.io.camera_ik import read_ik_camera
from giantlike.io.camera_opencv import read_opencv_camera, write_opencv_camera
from giantlike.io.camera_sip import PosedModel, camera_of_sip, read_sip_camera, sip_header
from giantlike.io.fits import write_fits
from giantlike.io.mission_frame import from_mission_frame
from tests.tolerances import FLOAT64_DIGIT, ROUND_TRIP_PX

COLUMNS, ROWS = 640, 480
LENS = BrownModel(
    fx_px=1500.0, fy_px=1497.0, cx_px=322.0, cy_px=236.0, k1=-0.2, k2=0.1, p1=5e-4, p2=-8e-4
)  # fmt: skip


def pixels(columns: int = COLUMNS, rows: int = ROWS, count: int = 300) -> Float:
    return np.random.default_rng(8).uniform([-0.5, -0.5], [columns - 0.5, rows - 0.5], (count, 2))


# --- axes of a mission


def mission_pixels(values: dict[str, float], points_mission: Float) -> Float:
    """Equations 5 to 8 of the OSIRIS-REx paper as they stand, with signs and all."""
    x, y = points_mission[:, 0] / points_mission[:, 2], points_mission[:, 1] / points_mission[:, 2]
    r2 = x**2 + y**2
    radial = 1 + values["k1"] * r2
    dx = radial * x + 2 * values["p1"] * x * y + values["p2"] * (r2 + 2 * x**2)
    dy = radial * y + values["p1"] * (r2 + 2 * y**2) + 2 * values["p2"] * x * y
    return np.stack(
        [values["fx_px"] * dx + values["skew_px"] * dy + values["cx_px"], values["fy_px"] * dy + values["cy_px"]], -1
    )


SIGNS = [(1, 1, None), (1, -1, None), (-1, 1, None), (-1, -1, None), (1, -1, "-z"), (-1, -1, "+z"), (1, 1, "+z")]


@pytest.mark.parametrize(("sign_x", "sign_y", "boresight"), SIGNS)
def test_a_model_with_negative_focal_lengths_keeps_its_pixels_and_its_frame(
    sign_x: int, sign_y: int, boresight: str | None
) -> None:
    values = {"fx_px": sign_x * 1500.0, "fy_px": sign_y * 1490.0, "cx_px": 300.0, "cy_px": 250.0, "skew_px": 2.0}
    values |= {"k1": -0.2, "p1": 3e-3, "p2": -2e-3}
    camera = from_mission_frame(BrownModel, values, boresight=boresight)  # type: ignore[arg-type]
    directions = camera.model.unproject(pixels())
    in_mission_frame = rotate(camera.camera_from_mission.inv(), directions)
    assert not camera.rows_reversed
    assert_allclose(mission_pixels(values, in_mission_frame), pixels(), rtol=0, atol=ROUND_TRIP_PX)


def test_a_mirrored_image_is_told_and_its_rows_counted_from_the_last() -> None:
    values = {"fx_px": 1500.0, "fy_px": -1490.0, "cx_px": 300.0, "cy_px": 250.0, "skew_px": 2.0}
    values |= {"k1": -0.2, "p1": 3e-3, "p2": -2e-3}
    with pytest.raises(InputError, match="mirrored"):
        from_mission_frame(BrownModel, values, boresight="+z")
    camera = from_mission_frame(BrownModel, values, boresight="+z", rows=ROWS)
    assert camera.rows_reversed
    in_mission_frame = rotate(camera.camera_from_mission.inv(), camera.model.unproject(pixels()))
    stored = pixels() * [1, -1] + [0, ROWS - 1]
    assert_allclose(mission_pixels(values, in_mission_frame), stored, rtol=0, atol=ROUND_TRIP_PX)


# --- OpenCV


OPENCV_MODELS: list[PinholeModel | BrownModel | OpenCVModel | EquidistantModel] = [
    LENS,
    OpenCVModel(fx_px=1500.1, fy_px=1497.3, cx_px=320.7, cy_px=236.2, k1=0.3, k4=0.6, p1=1e-3, s1=1e-4, s4=-2e-5),
    EquidistantModel(fx_px=300.0, fy_px=301.0, cx_px=320.0, cy_px=240.0, k1=-0.01, k4=1e-5),
]


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
@pytest.mark.parametrize("model", OPENCV_MODELS, ids=lambda m: m.type_name)
def test_opencv_files_bring_back_the_model_that_was_written(model: CameraModel, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"camera{suffix}"
    write_opencv_camera(path, model, columns=COLUMNS, rows=ROWS)
    camera = read_opencv_camera(path)
    assert camera.model == model
    assert (camera.columns, camera.rows, camera.name) == (COLUMNS, ROWS, "camera")


def test_a_file_that_opencv_wrote_projects_as_opencv_does(tmp_path: Path) -> None:
    matrix = np.array([[800.0, 0.0, 319.5], [0.0, 810.0, 239.5], [0.0, 0.0, 1.0]])
    coefficients = np.array([[0.1, -0.2, 1e-3, -2e-3, 0.05, 0.2, 0.01, 0.003]])
    storage = cv2.FileStorage(str(tmp_path / "out_camera_data.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_Width", 640)
    storage.write("Camera_Matrix", matrix)
    storage.write("Distortion_Coefficients", coefficients)
    storage.release()
    camera = read_opencv_camera(tmp_path / "out_camera_data.xml")
    points = camera.model.unproject(pixels())
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    assert_allclose(camera.model.project(points), expected[:, 0], rtol=0, atol=ROUND_TRIP_PX)
    assert (camera.columns, camera.rows) == (640, None)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_coefficients_that_opencv_wrote_as_one_dimension_are_read(suffix: str, tmp_path: Path) -> None:
    matrix = np.array([[800.0, 0.0, 319.5], [0.0, 810.0, 239.5], [0.0, 0.0, 1.0]])
    coefficients = np.array([0.1, -0.2, 1e-3, -2e-3, 0.05])
    storage = cv2.FileStorage(str(tmp_path / f"camera{suffix}"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", coefficients)
    storage.release()
    model = read_opencv_camera(tmp_path / f"camera{suffix}").model
    assert isinstance(model, BrownModel)
    assert [model.k1, model.k2, model.p1, model.p2, model.k3] == coefficients.tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("%YAML:1.0\n---\nimage_width: 640\n", "3 by 3 matrix"),
        ("hello: [\n", "."),
        (
            "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
            "   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\n"
            "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 3\n   dt: d\n   data: [ 0., 0., 0. ]\n",
            "number one of",
        ),
    ],
)
def test_a_damaged_opencv_file_is_refused_with_its_name(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yml"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_opencv_camera(path)
    assert caught.value.path == path
    with pytest.raises(DataError, match="no such file"):
        read_opencv_camera(tmp_path / "missing.yml")


def test_a_camera_file_that_exists_is_replaced_only_when_asked(tmp_path: Path) -> None:
    opencv, ours = tmp_path / "camera.yml", tmp_path / "camera.toml"
    write_opencv_camera(opencv, LENS, columns=COLUMNS, rows=ROWS)
    ours.write_text("calibrated yesterday")
    refused = CliRunner().invoke(app, ["camera", "convert", str(opencv), str(ours)])
    assert refused.exit_code == 2
    assert ours.read_text() == "calibrated yesterday"
    assert CliRunner().invoke(app, ["camera", "convert", str(opencv), str(ours), "--overwrite"]).exit_code == 0
    assert Camera.load(ours).model == LENS


def test_what_opencv_can_not_hold_is_not_written(tmp_path: Path) -> None:
    owen = OwenModel(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)
    sheared = PinholeModel(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, skew_px=0.1)
    for model in (owen, sheared):
        with pytest.raises(InputError, match="OpenCV"):
            write_opencv_camera(tmp_path / "camera.yml", model, columns=1, rows=1)
    assert not (tmp_path / "camera.yml").exists()


# --- GIANT


def giant_file(path: Path, kind: str, **values: str) -> Path:
    children = "".join(f"    <{key}>{value}</{key}>\n" for key, value in values.items())
    path.write_text(
        f'<CameraModels>\n  <OREX>\n  <navcam module="giant.camera_models.x" type="{kind}">\n{children}  </navcam>\n'
        "  </OREX>\n</CameraModels>\n"
    )
    return path


def test_a_giant_brown_camera_is_read_without_evaluating_anything(tmp_path: Path) -> None:
    path = giant_file(
        tmp_path / "cameras.xml", "BrownModel", n_rows="1944", n_cols="2592", use_a_priori="False", kx="3473.3",
        ky="np.float64(3473.4)", kxy="0.0", px="1268.7", py="949.6", k1="-0.539", k2="0.388", k3="-0.214",
        p1="-2.55e-4", p2="8.64e-4", temperature_coefficients="array([2.37e-05, 0.0, 0.0])",
        misalignment="array([0., 0., 0.])", estimation_parameters="['basic']",
    )  # fmt: skip
    camera = read_giant_camera(path)
    expected = BrownModel(
        fx_px=3473.3, fy_px=3473.4, cx_px=1268.7, cy_px=949.6, k1=-0.539, k2=0.388, k3=-0.214, p1=-2.55e-4,
        p2=8.64e-4, a1_per_c=2.37e-5,
    )  # fmt: skip
    assert camera.model == expected
    assert (camera.name, camera.columns, camera.rows, camera.ignored) == ("navcam", 2592, 1944, ())
    with pytest.raises(DataError, match="name one of its cameras, navcam"):
        read_giant_camera(path, "mapcam")


def test_a_giant_owen_camera_in_millimeters_has_the_same_pixels(tmp_path: Path) -> None:
    focal, e1, e2, e3, e4, e5, e6 = 7.6, 1e-4, -1e-3, 2e-5, 1e-5, 3e-4, -2e-4  # per powers of mm
    kx, kxy, kyx, ky = 454.0, 0.5, -0.8, 455.0  # px/mm
    path = giant_file(
        tmp_path / "cameras.xml", "OwenModel", focal_length=f"{focal}", kx=f"{kx}", kxy=f"{kxy}", kyx=f"{kyx}",
        ky=f"{ky}", px="1290.", py="960.", radial2=f"{e2}", radial4=f"{e4}", tangential_y=f"{e5}",
        tangential_x=f"{e6}", pinwheel1=f"{e1}", pinwheel2=f"{e3}", a1="1e-5",
    )  # fmt: skip
    camera = read_giant_camera(path, "navcam")
    directions = camera.model.unproject(pixels(2592, 1944))
    x, y = (rotate(camera.camera_from_mission.inv(), directions) @ np.eye(3)[:, :2]).T * focal
    z = directions[:, 2]
    x, y = x / z, y / z
    r = np.hypot(x, y)
    stretch, turn = 1 + e2 * r**2 + e4 * r**4 + e5 * y + e6 * x, e1 * r + e3 * r**3
    xd, yd = stretch * x - turn * y, stretch * y + turn * x
    theirs = np.stack([kx * xd + kxy * yd + 1290.0, kyx * xd + ky * yd + 960.0], axis=-1)
    assert_allclose(theirs, pixels(2592, 1944), rtol=0, atol=ROUND_TRIP_PX)
    assert isinstance(camera.model, OwenModel)
    assert camera.model.a1_per_c == 1e-5


def test_focal_lengths_of_a_giant_file_beyond_all_numbers_are_refused(tmp_path: Path) -> None:
    path = giant_file(tmp_path / "cameras.xml", "BrownModel", fx="1e200", fy="1e200", focal_length="1e200")
    with pytest.raises(DataError, match="infinite focal lengths"):
        read_giant_camera(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<a>", "a camera file of NASA"),
        ("<CameraModels/>", "no GIANT camera"),
        (None, "no such file"),
    ],
)
def test_a_damaged_giant_file_is_refused(text: str | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DataError, match=message):
        read_giant_camera(path)


# --- SPICE instrument kernels


IK = """KPL/IK
A camera.  INS-64361_FOCAL_LENGTH = ( 1.0 ) in the text is not data.
\\begindata
  INS-64361_FOCAL_LENGTH  = ( 628.9 )
  INS-64361_PIXEL_SIZE    = ( 8.5, 8.5 )
  INS-64361_CCD_CENTER    = {center}
  INS-64361_PIXEL_SAMPLES = ( 1024 )
  INS-64361_PIXEL_LINES   = 1024
  INS-64361_BORESIGHT     = ( 0.0, 0.0, 1.0 )
  INS-64361_FOV_SHAPE     = 'RECTANGLE'
  INS-64361_DISTORTION_C  = ( 2.21D-05 )
  INS-64362_FOCAL_LENGTH  = ( 125.0 )
\\begintext
"""


@pytest.mark.parametrize("center", ["( 511.5, 511.5 )", "( 512.5, 512.5 )", "( 512.0, 512.0 )"])
def test_an_instrument_kernel_gives_a_pinhole_whatever_its_first_pixel_is_called(center: str, tmp_path: Path) -> None:
    path = tmp_path / "ocams.ti"
    path.write_text(IK.format(center=center))
    camera = read_ik_camera(path, -64361)
    focal_px = 628.9 / 8.5e-3
    assert camera.model == PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=511.5, cy_px=511.5)
    assert (camera.columns, camera.rows, camera.ignored) == (1024, 1024, ("DISTORTION_C",))


def test_an_origin_that_can_not_be_told_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "ocams.ti"
    path.write_text(IK.format(center="( 500.0, 520.0 )"))
    with pytest.raises(DataError, match="coordinate of its first pixel"):
        read_ik_camera(path, -64361)
    camera = read_ik_camera(path, -64361, first_pixel=1.0, signs=(-1, -1))
    assert_allclose(camera.model.project([0.0, 0.0, 1.0]), [499.0, 519.0], rtol=0, atol=ROUND_TRIP_PX)
    assert_allclose(camera.camera_from_mission.as_matrix(), np.diag([-1.0, -1.0, 1.0]), rtol=0, atol=FLOAT64_DIGIT)
    with pytest.raises(DataError, match="no keyword"):
        read_ik_camera(path, -99)
    with pytest.raises(DataError, match="PIXEL_SIZE, PIXEL_PITCH is needed"):
        read_ik_camera(path, -64362)


# --- FITS


ATTITUDE = camera_from_inertial_of_pointing(83.6, -5.4, 35.0)
POSED = PosedModel(model=LENS, columns=COLUMNS, rows=ROWS, camera_from_inertial=ATTITUDE)


def sky_of(cards: dict[str, object], points_px: Float) -> Float:
    """Directions by astropy's WCS, told zero-based pixels."""
    ra, dec = WCS(cards).all_pix2world(points_px, 0).T
    return direction_from_radec(ra, dec)


def test_sip_keywords_put_every_pixel_on_the_sky_where_the_camera_does() -> None:
    header = sip_header(POSED, order=5)
    assert header.max_px < 1e-3  # terms of r^7 are left out: 0.1 r^5 inverted, at r = 0.27
    there = LENS.project(rotate(ATTITUDE, sky_of(dict(header.cards), pixels())))
    assert np.linalg.norm(there - pixels(), axis=1).max() < 1.2 * header.max_px  # between the nodes of the grid
    back = WCS(dict(header.cards)).sip.foc2pix(WCS(dict(header.cards)).sip.pix2foc(pixels(), 0), 0)
    assert np.linalg.norm(back - pixels(), axis=1).max() < 1.2 * header.inverse_max_px
    rougher = sip_header(POSED, order=2)
    assert rougher.max_px > 10 * header.max_px


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_sip_header_brings_back_camera_and_attitude(mirrored: bool) -> None:
    cards: dict[str, object] = dict(sip_header(POSED, order=5).cards)
    if mirrored:  # the same sky in an array stored from the bottom
        cards["CRPIX2"] = ROWS + 1 - float(str(cards["CRPIX2"]))
        for key in list(cards):
            if key in ("CD1_2", "CD2_2") or (key.startswith("B_") and key != "B_ORDER"):
                cards[key] = -float(str(cards[key]))
            if key[:2] in ("A_", "B_") and key[2].isdigit() and int(key[-1]) % 2:
                cards[key] = -float(str(cards[key]))
    found = camera_of_sip(cards, columns=COLUMNS, rows=ROWS)
    assert found.camera.rows_reversed == mirrored
    assert found.conversion.max_px < 2e-3
    stored = pixels() * [1, -1] + [0, ROWS - 1] if mirrored else pixels()
    there = found.camera.model.project(rotate(found.camera_from_inertial, sky_of(cards, stored)))
    assert_allclose(there, pixels(), rtol=0, atol=2e-3)
    # the camera's x axis is along the columns at the boresight, that of the header up to decentering of 1e-3 rad
    assert (found.camera_from_inertial * ATTITUDE.inv()).magnitude() < 3e-3


def test_a_camera_is_read_from_a_fits_image(tmp_path: Path) -> None:
    header = sip_header(POSED)
    path = tmp_path / "image.fits"
    write_fits(path, np.zeros((ROWS, COLUMNS), dtype=np.float32), header=dict(header.cards))
    found = read_sip_camera(path)
    assert (found.camera.columns, found.camera.rows, found.camera.name) == (COLUMNS, ROWS, "image")
    assert found.conversion.max_px < 0.1
    write_fits(tmp_path / "bare.fits", np.zeros((4, 4), dtype=np.float32))
    with pytest.raises(DataError, match="CTYPE1 must be"):
        read_sip_camera(tmp_path / "bare.fits")
    with pytest.raises(DataError, match="no such file"):
        read_sip_camera(tmp_path / "missing.fits")


def test_a_frame_wider_than_a_tangent_plane_has_no_sip_header() -> None:
    fisheye = EquidistantModel(fx_px=100.0, fy_px=100.0, cx_px=320.0, cy_px=240.0)
    with pytest.raises(InputError, match="too wide"):
        sip_header(PosedModel(model=fisheye, columns=COLUMNS, rows=ROWS, camera_from_inertial=Rotation.identity()))


# --- our own file and the command line


def test_a_camera_file_remembers_the_frame_of_the_mission(tmp_path: Path) -> None:
    turn = Rotation.from_euler("y", 180.0, degrees=True)
    camera = Camera(
        name="NavCam", columns=COLUMNS, rows=ROWS, model=LENS,
        mission_frame=MissionFrame(name="ORX_NAVCAM1", camera_from_mission=turn),
    )  # fmt: skip
    camera.save(tmp_path / "camera.toml")
    again = Camera.load(tmp_path / "camera.toml")
    assert again == camera
    assert again.mission_frame is not None
    assert again.mission_frame.name == "ORX_NAVCAM1"
    assert (again.mission_frame.camera_from_mission * turn.inv()).magnitude() < 1e-15


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("mission_frame = 3", "must be a table"),
        ("[mission_frame]\nname = 'A'", "'camera_from_mission_xyzw' is missing"),
        ("[mission_frame]\nname = 'A'\ncamera_from_mission_xyzw = [1.0, 1.0, 0.0, 0.0]", "norm 1"),
    ],
)
def test_a_wrong_mission_frame_is_refused(table: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    Camera(name="NavCam", columns=COLUMNS, rows=ROWS, model=LENS).save(path)
    path.write_text(f"{table}\n" + path.read_text() if "=" in table.split("\n")[0] else path.read_text() + "\n" + table)
    with pytest.raises(DataError, match=message):
        Camera.load(path)


def test_the_command_line_converts_a_camera_and_says_what_is_lost(tmp_path: Path) -> None:
    opencv, ours = tmp_path / "camera.yml", tmp_path / "camera.toml"
    write_opencv_camera(opencv, LENS, columns=COLUMNS, rows=ROWS)
    result = CliRunner().invoke(app, ["camera", "convert", str(opencv), str(ours), "--model", "owen", "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    written = Camera.load(ours)
    assert written.model.type_name == said["model"]["type"] == "owen"
    lost = written.model.project(LENS.unproject(pixels())) - pixels()
    assert np.linalg.norm(lost, axis=1).max() <= said["conversion"]["max_px"]
    assert said["conversion"]["coverage"] == 1.0


def test_the_command_line_shows_a_giant_camera_in_our_axes(tmp_path: Path) -> None:
    path = giant_file(
        tmp_path / "cameras.xml", "PinholeModel", focal_length="10.0", kx="100.0", ky="-100.0", px="1.0", py="2.0",
        n_rows="20", n_cols="30",
    )  # fmt: skip
    result = CliRunner().invoke(app, ["camera", "info", str(path), "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    assert said["model"]["fy_px"] == 1000.0
    assert_allclose(said["mission_frame"]["camera_from_mission_xyzw"], [0, 1, 0, 0], rtol=0, atol=FLOAT64_DIGIT)
    assert_allclose(said["ifov_urad"], 1000.0, rtol=1e-3, atol=0)  # 14 px off the axis


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info", "camera.ti"], "NAIF code"),
        (["info", "camera.dat"], "got .dat"),
        (["info", "missing.xml"], "no such file"),
        (["info", "small.yml"], "--size"),
        (["convert", "small.yml", "out.dat", "--size", "10x10"], "must end in"),
        (["convert", "small.yml", "out.toml", "--size", "10"], "must look like"),
    ],
)
def test_the_command_line_tells_a_mistake_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    storage = cv2.FileStorage("small.yml", cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.diag([10.0, 10.0, 1.0]))
    storage.release()
    result = CliRunner().invoke(app, ["camera", *arguments])
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
