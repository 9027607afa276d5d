"""Files damaged in any way are read or refused in one line: never another exception, the end of the process, a hang."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
import spiceypy

from giantlike.camera import Camera
from giantlike.core.child import in_child
from giantlike.core.errors import DataError
from giantlike.io import load_kernels
from giantlike.io.camera_opencv import read_opencv_camera
from tests.child_functions import doubles, ends, fails, fills, leaves, spins
from tests.hostile import attack
from tests.hostile_seeds import KINDS

IN_CHILD = ("shape bds", "kernel pck", "kernel lsk", "kernel fk", "kernel spk")  # a process for each file: slow
FILES, FILES_IN_CHILD = 12, 3
SEED = 20261122


def test_damaged_files_of_every_kind_are_read_or_refused() -> None:
    tally = attack([kind for kind in KINDS if kind not in IN_CHILD], FILES, seed=SEED)
    assert tally.problems == []
    assert tally.files == FILES * (len(KINDS) - len(IN_CHILD))
    assert tally.outcomes["refused"] > tally.files / 2  # the damage is real


def test_damaged_kernels_are_read_or_refused() -> None:
    tally = attack(IN_CHILD, FILES_IN_CHILD, seed=SEED)
    assert tally.problems == []
    assert tally.files == FILES_IN_CHILD * len(IN_CHILD)


def test_what_ends_hangs_or_fills_a_child_is_an_error_here(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\x01\x02")
    assert in_child(doubles, [path])["bytes"].tolist() == [2.0, 4.0]
    for function in (ends, leaves, spins, fills):
        with pytest.raises(ValueError, match="damaged"):
            in_child(function, [path])
    with pytest.raises(RuntimeError, match="Traceback"):
        in_child(fails, [path])


def test_many_quotes_in_a_text_kernel_take_no_time(tmp_path: Path) -> None:
    path = tmp_path / "k.tf"
    path.write_bytes(b"KPL/FK\n\\begindata\nBODY1_RADII = (" + b"'" * 101 + b"\n\\begintext\n")
    with contextlib.suppress(DataError), load_kernels([path], tmp_path):  # either is right; it used to take for ever
        pass
    assert spiceypy.ktotal("ALL") == 0


@pytest.mark.parametrize("nest", ["a = " + "[" * 3000, "x = " + "1" * 5000, "a" + ".a" * 3000 + " = 1"])
def test_toml_that_is_nested_or_long_beyond_reason_is_refused(tmp_path: Path, nest: str) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(nest + "\n")
    with pytest.raises(DataError, match=r"camera\.toml"):
        Camera.load(path)


def test_the_camera_file_of_ros_is_read_too(tmp_path: Path) -> None:
    path = tmp_path / "ros.yaml"
    path.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: nav\ndistortion_model: plumb_bob\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [800., 0, 319.5, 0, 810, 239.5, 0, 0, 1]\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, -0.2, 1.0e-3, 2e-3, 0]\n"
    )
    camera = read_opencv_camera(path)
    assert (camera.columns, camera.rows) == (640, 480)
    assert camera.model.parameters[:4].tolist() == [800.0, 810.0, 319.5, 239.5]
