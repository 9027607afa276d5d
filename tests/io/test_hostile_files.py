"""Files damaged in any way are read or refused in one line: never another exception, the end of the process, a hang."""

from __future__ import annotations

import contextlib
import gzip
import multiprocessing
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from giantlike._system.child import end_template, in_child
from giantlike.camera import Camera
from giantlike.core.errors import DataError, OpNavError
from giantlike.io import load_kernels
from giantlike.io.camera_opencv import read_opencv_camera
from giantlike.io.daf import require_whole_daf
from giantlike.io.image_files import read_image_file
from giantlike.shapes import load_shape
from tests.child_functions import doubles, ends, fails, fills, leaves, spins
from tests.hostile import attack, damaged
from tests.hostile_seeds import KINDS
from tests.sizes import slow

FILES, MANY_FILES = 12, 100  # of each kind
SEED = 20261122


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # astropy leaves FITS tables open
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_read_or_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / KINDS[kind].file
    KINDS[kind].write(path)
    whole = path.read_bytes()
    for number in range(3):
        path.write_bytes(damaged(kind, whole, number, SEED))
        with contextlib.suppress(OpNavError):  # any other exception fails, and so does a warning
            KINDS[kind].read(path)


@pytest.mark.slow  # the process that may end, hang or fill its memory imports half of the tests
def test_damaged_files_of_every_kind_are_read_or_refused() -> None:
    tally = attack(list(KINDS), FILES, seed=SEED)
    assert tally.problems == []
    assert tally.files == FILES * len(KINDS)
    assert tally.outcomes["refused"] > tally.files / 2  # the damage is real


@pytest.mark.parametrize(
    ("kind", "number", "seed"),
    [
        ("image compressed fits", 3692, 71),
        ("image pds4", 1893, 72),
        ("heights pds3", 24, 71),
        ("heights geotiff", 2267, 71),
        ("heights geotiff", 3790, 71),
        ("heights geotiff", 746, 73),
        ("heights tiled geotiff", 8454, 91),
        ("heights npz", 292, 71),
        ("heights tiled npz", 1744, 71),
        ("shape npz", 1158, 71),
        ("camera", 3274, 71),
        ("catalog", 1100, 71),
        ("catalog tycho2", 2430, 71),
    ],
)
def test_damaged_files_that_once_were_neither_read_nor_refused(
    kind: str, number: int, seed: int, tmp_path: Path
) -> None:
    path = tmp_path / KINDS[kind].file
    KINDS[kind].write(path)
    path.write_bytes(damaged(kind, path.read_bytes(), number, seed))
    with contextlib.suppress(OpNavError):  # any other exception fails, and so does a warning
        KINDS[kind].read(path)


@pytest.mark.slow
def test_many_damaged_files_of_every_kind_are_read_or_refused() -> None:
    tally = attack(list(KINDS), MANY_FILES, seed=SEED, first=FILES)
    assert tally.problems == []
    assert tally.files == MANY_FILES * len(KINDS)


def test_what_ends_hangs_or_fills_a_child_is_an_error_here(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\x01\x02")
    assert in_child(doubles, [path])["bytes"].tolist() == [2.0, 4.0]
    for function in (ends, leaves, spins, fills):
        with pytest.raises(ValueError, match="damaged"):
            in_child(function, [path])
        assert in_child(doubles, [path])["bytes"].tolist() == [2.0, 4.0]  # the next call is none the worse
    with pytest.raises(RuntimeError, match="Traceback"):
        in_child(fails, [path])


@pytest.mark.parametrize("processes", [1, slow(2)])
def test_calls_in_a_child_survive_a_fork_and_the_end_of_their_template(processes: int, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\x03")
    in_child(doubles, [path])
    end_template()
    assert in_child(doubles, [path])["bytes"].tolist() == [6.0]
    with multiprocessing.get_context("fork").Pool(processes) as pool:
        answers = [pool.apply_async(_double, (path,)) for _ in range(4)]
        assert in_child(doubles, [path])["bytes"].tolist() == [6.0]
        assert [answer.get(60.0) for answer in answers] == [6.0] * 4


def _double(path: Path) -> float:
    return float(in_child(doubles, [path])["bytes"][0])


def test_a_kernel_whose_sizes_or_pointers_are_wrong_never_reaches_spice(tmp_path: Path) -> None:
    path = tmp_path / KINDS["kernel spk"].file
    KINDS["kernel spk"].write(path)
    content = path.read_bytes()
    for place, value in ((8, 3), (12, 32774), (76, 999), (1024, 5.0), (1040, 1e6), (1024 + 24 + 32, 2**31 - 1)):
        damaged = bytearray(content)
        struct.pack_into("<d" if isinstance(value, float) else "<i", damaged, place, value)
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"summaries|list of|words"):
            require_whole_daf(path)
        with pytest.raises(DataError, match=r"k\.bsp"):
            KINDS["kernel spk"].read(path)


def test_what_unpacks_to_far_more_than_its_size_is_refused_before_it_takes_memory(tmp_path: Path) -> None:
    packed = gzip.compress(bytes(1_000_000)) * 300  # 300 MB in 0.3 MB
    path = tmp_path / "a.fits.gz"
    path.write_bytes(packed)
    with pytest.raises(DataError, match="unpacks to far more"):
        read_image_file(path)
    shape = tmp_path / "s.npz"
    with zipfile.ZipFile(shape, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in (("format", np.array("giantlike shape")), ("version", np.array(1))):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array)
        archive.writestr("vertices.npy", bytes(110_000_000))
    with pytest.raises(DataError, match="would take"):
        load_shape(shape)


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
