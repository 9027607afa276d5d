"""Checkerboards through a fisheye: corners found where they are, a first pose, the camera found again from files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from giantlike.calibration.boards import board_corners, board_pose, find_board
from giantlike.calibration.field_map import map_difference
from giantlike.camera import Camera
from giantlike.camera_models import EquidistantModel, EquisolidModel, PinholeModel, ScaramuzzaModel
from giantlike.camera_models.affine import AffineModel
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from tests.tolerances import FLOAT64_SUM, SETTLED

COLUMNS, ROWS, ACROSS, DOWN = 480, 360, 7, 5
SUPERSAMPLING = 3
TRUTH = EquidistantModel(fx_px=210.0, fy_px=211.0, cx_px=242.0, cy_px=177.0, k1=-0.02, k2=0.003)
CORNER_PX = 0.15  # rms: straight lines are bent by the lens within the window of the refinement
CENTER_PX = 0.03  # mean over all corners; a wrong origin of pixels would give 0.5
MAP_PX = 0.3  # rms over the whole frame, corners of which no board fills; the start is off by more than 10
START_RAD, START_SIZE = 0.15, 0.15  # of a first pose with a focal length 5 % off
VIEWS = ((0.0, 0.0, 5.0), (0.6, 0.6, 7.0), (0.5, 2.6, 7.0), (0.6, 3.8, 7.0), (0.55, 5.7, 8.0), (0.3, 1.6, 6.0))
"""Angle of the middle of the board from the axis, azimuth, distance in squares."""


def pose_of(view: tuple[float, float, float], turn: float) -> tuple[Rotation, Float]:
    """Pose of a board that faces the camera but for some tenths of a radian."""
    angle, azimuth, distance = view
    direction = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    facing = Rotation.from_euler("ZY", [azimuth, angle]) * Rotation.from_euler("Z", -azimuth)
    rotation = facing * Rotation.from_rotvec([0.3 * np.cos(turn), 0.3 * np.sin(turn), 0.3 + 0.2 * turn])
    middle = board_corners(across=ACROSS, down=DOWN).mean(axis=0)
    return rotation, distance * direction - rotate(rotation, middle)


def board_image(model: AffineModel, rotation: Rotation, position: Float, noise: np.random.Generator) -> Float:
    """Picture of a board with a white margin, every pixel the mean of rays through it."""
    steps = [(np.arange(n * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5 for n in (COLUMNS, ROWS)]
    rays = rotate(rotation.inv(), model.unproject(np.stack(np.meshgrid(*steps), axis=-1)).reshape(-1, 3))
    origin = rotate(rotation.inv(), -position)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -origin[2] / rays[:, 2]
        at = origin[:2] + distance[:, None] * rays[:, :2]
    square = np.floor(at + 1.0)
    seen = distance > 0
    on_board = seen & np.all((square >= 0) & (square <= [ACROSS, DOWN]), axis=1)
    on_margin = seen & np.all((square >= -1) & (square <= [ACROSS + 1, DOWN + 1]), axis=1)
    light = np.where(on_board & (square.sum(axis=1) % 2 == 0), 20.0, np.where(on_margin, 220.0, 110.0))
    picture = light.reshape(ROWS, SUPERSAMPLING, COLUMNS, SUPERSAMPLING).mean(axis=(1, 3))
    return np.asarray(picture + noise.normal(0.0, 2.0, picture.shape))


@pytest.fixture(scope="module")
def pictures() -> list[tuple[Float, Float]]:
    """Pictures of a board, and where its corners are in them."""
    noise, corners = np.random.default_rng(1), board_corners(across=ACROSS, down=DOWN)
    made = []
    for number, view in enumerate(VIEWS):
        rotation, position = pose_of(view, float(number))
        made.append(
            (board_image(TRUTH, rotation, position, noise), TRUTH.project(rotate(rotation, corners) + position))
        )
    return made


def test_corners_are_found_where_the_board_has_them(pictures: list[tuple[Float, Float]]) -> None:
    errors = []
    for picture, truth in pictures:
        found = find_board(picture, across=ACROSS, down=DOWN)
        assert not isinstance(found, Failure), found
        _, nearest = cKDTree(truth).query(found)
        assert len(set(np.atleast_1d(nearest).tolist())) == ACROSS * DOWN
        errors.append(found - truth[nearest])
    every = np.concatenate(errors)
    assert_allclose(every.mean(axis=0), 0.0, rtol=0, atol=CENTER_PX)
    assert np.sqrt(np.mean(np.sum(every**2, axis=1))) < CORNER_PX


def test_an_image_without_the_whole_board_is_a_failure(pictures: list[tuple[Float, Float]]) -> None:
    picture, _ = pictures[0]
    for pixels in (picture[:, : COLUMNS // 2], np.zeros((60, 80))):
        found = find_board(pixels, across=ACROSS, down=DOWN)
        assert isinstance(found, Failure)
        assert found.reason is Reason.NO_PATTERN_MATCH


@pytest.mark.parametrize("behind", [False, True])
def test_the_pose_of_a_board_is_exact_with_the_right_lens_also_behind_ninety_degrees(behind: bool) -> None:
    rotation, position = pose_of((1.5 if behind else 0.4, 2.0, 3.0), 1.0)
    corners = board_corners(across=ACROSS, down=DOWN)
    pixels = TRUTH.project(rotate(rotation, corners) + position)
    assert (TRUTH.unproject(pixels)[:, 2].min() < 0) == behind
    found = board_pose(corners, pixels, TRUTH)
    assert not isinstance(found, Failure), found
    assert (found[0] * rotation.inv()).magnitude() < 1e-9  # rounding
    assert_allclose(found[1], position, rtol=0, atol=FLOAT64_SUM)


def test_a_rough_lens_gives_a_rough_pose() -> None:
    rotation, position = pose_of((0.6, 2.0, 5.0), 1.0)
    corners = board_corners(across=ACROSS, down=DOWN)
    rough = EquidistantModel(fx_px=0.95 * 210.0, fy_px=0.95 * 211.0, cx_px=239.5, cy_px=179.5)
    found = board_pose(corners, TRUTH.project(rotate(rotation, corners) + position), rough)
    assert not isinstance(found, Failure), found
    assert (found[0] * rotation.inv()).magnitude() < START_RAD
    assert np.linalg.norm(found[1] - position) < START_SIZE * np.linalg.norm(position)


def test_a_fisheye_is_calibrated_from_files(
    pictures: list[tuple[Float, Float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Drawing takes most of the time, and another test does it
    monkeypatch.setattr("giantlike.campaign.calibration.page.calibration_figures", lambda fix: [])
    for number, (picture, _) in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"board{number}.png"), np.round(np.clip(picture, 0, 255)).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((ROWS, COLUMNS), 100, dtype=np.uint8))
    files = [str(file) for file in sorted(tmp_path.glob("*.png"))]
    size = ["--board", f"{ACROSS}x{DOWN}", "--fov", "140", "--output", str(tmp_path / "out"), "--json"]
    result = CliRunner().invoke(app, ["calibrate", *files, *size, "--model", "equidistant"])
    assert result.exit_code == 1, result.stderr  # one image shows no board
    summary = json.loads(result.stdout)["calibration"]
    assert summary["status"] == "ok", summary["problem"]
    assert [row["file"] for row in summary["images_lost"]] == ["empty.png"]
    camera = Camera.load(tmp_path / "out" / "camera.toml")
    assert map_difference(TRUTH, camera.model, columns=COLUMNS, rows=ROWS).rms_px < MAP_PX
    start = Camera.from_fov(140.0, COLUMNS, ROWS, type_name="equidistant")
    assert map_difference(TRUTH, start.model, columns=COLUMNS, rows=ROWS).rms_px > 30 * MAP_PX
    page = (tmp_path / "out" / "calibration.html").read_text()
    assert "corners in 6 images" in page
    assert "stars<" not in page
    assert "star<" not in page


def test_mistakes_are_one_line(pictures: list[tuple[Float, Float]], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "board.png"), np.round(np.clip(pictures[0][0], 0, 255)).astype(np.uint8))
    (tmp_path / "text.png").write_text("no image")
    board, fisheye = ["--board", "7x5"], ["--fov", "140", "--model", "equidistant"]
    for name, arguments, message in (
        ("board.png", ["--board", "7"], "--board must be COLUMNSxROWS"),
        ("board.png", board, "--board needs --fov DEG"),
        ("board.png", [*board, *fisheye, "--estimate", "fx_px,q"], "has no parameter 'q'"),
        ("board.png", [*board, "--fov", "190", "--model", "brown"], "fov_deg must be between 0 and 170 for brown"),
        ("board.png", ["--board", "2x5", *fisheye], "at least 3 by 3 inner corners"),
        ("text.png", [*board, *fisheye], "text.png"),
    ):
        output = ["--output", str(tmp_path / "out")]
        fov = [] if "--fov" in arguments or "needs" in message else ["--fov", "140"]
        result = CliRunner().invoke(app, ["calibrate", str(tmp_path / name), *arguments, *fov, *output])
        assert result.exit_code == 2, result.output
        (line,) = result.stderr.splitlines()
        assert message in line
        assert not (tmp_path / "out").exists()


def test_a_rough_camera_of_any_type_sees_its_field() -> None:
    for kind, fov in (
        (PinholeModel, 90.0),
        (EquidistantModel, 200.0),
        (EquisolidModel, 200.0),
        (ScaramuzzaModel, 185.0),
    ):
        model = Camera.from_fov(fov, 100, 80, type_name=kind.type_name).model
        edge = model.unproject([99.5, 39.5])
        assert np.degrees(np.arctan2(edge[0], edge[2])) == pytest.approx(fov / 2, abs=SETTLED)
    with pytest.raises(InputError, match="fov_deg must be between 0 and 170"):
        Camera.from_fov(180.0, 100, 80)
