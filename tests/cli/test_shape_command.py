"""``giantlike shape``: what a person types, what is printed and written."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from giantlike.cli.app import app
from giantlike.shapes import (
    Ellipsoid,
    FacetAlbedo,
    load_shape,
    mesh_from_ellipsoid,
    save_shape,
    sphere,
)
from tests.tolerances import FLOAT64, FLOAT64_DIGIT, FLOAT64_SUM

RADII_KM = np.array([2.0, 1.5, 1.0])
FINENESS = 5e-3  # relative: volume that 1,280 flat facets miss of an ellipsoid


def shape(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["shape", *map(str, arguments)])


def refusal(result: Result) -> str:
    """The one line that a user's mistake ends in."""
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    (line,) = result.stderr.splitlines()
    return line


@pytest.fixture
def egg(tmp_path: Path) -> Path:
    path = tmp_path / "egg.ply"
    save_shape(mesh_from_ellipsoid(Ellipsoid(radii_km=RADII_KM), facets=1280), path)
    return path


@pytest.fixture
def torn(tmp_path: Path) -> Path:
    """A ball without two of its facets, one turned, one doubled."""
    ball = mesh_from_ellipsoid(sphere(1.0), facets=320)
    faces = np.vstack([np.delete(ball.faces, [3, 200], axis=0), ball.faces[50:51]])
    faces[100] = faces[100, ::-1]
    path = tmp_path / "torn.obj"
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in ball.vertices_km.tolist()]
    path.write_text("\n".join(rows + [f"f {i} {j} {k}" for i, j, k in (faces + 1).tolist()]))
    return path


def gray(path: Path) -> NDArray[np.float64]:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels.astype(np.float64)


def middle(pixels: NDArray[np.float64]) -> tuple[float, float]:
    """Photocenter (x, y) from the middle of the picture, over its size."""
    rows, columns = np.indices(pixels.shape)
    x, y = ((grid * pixels).sum() / pixels.sum() / (len(pixels) - 1) - 0.5 for grid in (columns, rows))
    return float(x), float(y)


def test_help_names_the_four_commands_and_the_units() -> None:
    text = shape("--help").stdout
    assert all(f"\n  {name} " in text for name in ("info", "convert", "decimate", "render"))
    assert "km|m|auto" in shape("info", "--help").stdout


def test_info_prints_one_object_per_file_and_goes_on_after_a_bad_one(tmp_path: Path, egg: Path, torn: Path) -> None:
    sheet = tmp_path / "sheet.tab"
    sheet.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 nan\nf 1 2 3\n")
    result = shape("info", "nowhere.obj", sheet, torn, egg, "--json")
    assert result.exit_code == 1
    nowhere, flat, defective, whole = json.loads(result.stdout)
    assert [entry["status"] for entry in (nowhere, flat, defective, whole)] == ["failed", "failed", "suspect", "ok"]
    assert set(nowhere) == set(flat) == set(defective) == set(whole)
    assert "nowhere.obj" in nowhere["detail"]
    assert (nowhere["facets"], nowhere["volume_km3"]) == (None, None)
    assert "not finite" in flat["detail"]
    assert (flat["facets"], flat["watertight"], flat["volume_km3"]) == (1, False, None)
    assert flat["defects"]["nonfinite_vertices"] == 1
    assert (defective["facets"], defective["watertight"]) == (319, False)
    counts = {name: count for name, count in defective["defects"].items() if count}
    assert counts == {"boundary_edges": 6, "holes": 2, "duplicate_facets": 1, "inconsistent_edges": 3}


def test_the_numbers_of_info_are_those_of_an_ellipsoid(egg: Path) -> None:
    result = shape("info", egg, "--json")
    assert result.exit_code == 0
    (entry,) = json.loads(result.stdout)
    volume = 4.0 / 3.0 * np.pi * RADII_KM.prod()
    squares = RADII_KM**2
    assert (entry["file"], entry["facets"], entry["vertices"], entry["euler_number"]) == (str(egg), 1280, 642, 2)
    assert entry["watertight"] is True
    assert_allclose(entry["volume_km3"], volume, rtol=3 * FINENESS)
    assert_allclose(entry["area_km2"], 27.88, rtol=FINENESS)  # by the incomplete elliptic integrals, 27.8810
    assert_allclose(entry["center_of_figure_km"], 0.0, rtol=0, atol=FLOAT64)
    assert_allclose(entry["extents_km"], 2.0 * RADII_KM, rtol=FINENESS)
    assert_allclose(np.abs(entry["principal_axes"]), np.eye(3), rtol=0, atol=FLOAT64_SUM)
    assert_allclose(entry["principal_moments"], volume / 5.0 * (squares.sum() - squares), rtol=5 * FINENESS)
    assert_allclose(entry["best_fit_radii_km"], RADII_KM, rtol=FINENESS)
    text = shape("info", egg).stdout
    assert text.startswith(f"{egg}: ok\n  1280 facets, 642 vertices, watertight, Euler number 2\n")


def test_guessed_units_are_said_on_stderr_and_a_doubtful_size_is_refused(tmp_path: Path, egg: Path) -> None:
    result = shape("info", egg, "--units", "auto", "--json")
    assert "took the coordinates as km" in result.stderr
    assert json.loads(result.stdout)[0]["status"] == "ok"
    meters = json.loads(shape("info", egg, "--units", "m", "--json").stdout)[0]
    assert_allclose(meters["extents_km"], 2e-3 * RADII_KM, rtol=FINENESS)
    save_shape(mesh_from_ellipsoid(sphere(290.0), facets=80), tmp_path / "doubt.obj")
    doubtful = shape("info", tmp_path / "doubt.obj", "--units", "auto")
    assert doubtful.exit_code == 1
    assert "state units" in doubtful.stdout


def test_convert_writes_another_format_exactly_and_nothing_over_another_file(tmp_path: Path, egg: Path) -> None:
    target = tmp_path / "egg.tab"
    result = shape("convert", egg, target)
    assert result.exit_code == 0
    assert "1280 facets" in result.stdout
    np.testing.assert_array_equal(load_shape(target).vertices_km, load_shape(egg).vertices_km)
    assert "--overwrite" in refusal(shape("convert", egg, target))
    assert shape("convert", egg, target, "--overwrite", "--units", "m", "--json").exit_code == 0
    assert_allclose(load_shape(target).vertices_km, 1e-3 * load_shape(egg).vertices_km, rtol=FLOAT64_DIGIT)


def test_convert_and_decimate_say_that_albedo_is_left_out(tmp_path: Path, egg: Path) -> None:
    mesh = load_shape(egg)
    painted = tmp_path / "painted.npz"
    save_shape(mesh.with_albedo(FacetAlbedo(np.linspace(0.5, 1.0, len(mesh.faces)))), painted)
    assert "the albedo is left out" in shape("convert", painted, tmp_path / "plain.obj").stderr
    assert "the albedo is left out" in shape("decimate", painted, tmp_path / "few.npz", "--facets", "300").stderr
    assert not shape("convert", painted, tmp_path / "again.npz").stderr
    assert load_shape(tmp_path / "again.npz").albedo is not None


def test_convert_to_a_dsk_asks_for_body_and_frame(tmp_path: Path, egg: Path) -> None:
    target = tmp_path / "egg.bds"
    assert "--dsk-center" in refusal(shape("convert", egg, target))
    assert shape("convert", egg, target, "--dsk-center", "401", "--dsk-frame", "IAU_PHOBOS").exit_code == 0
    assert len(load_shape(target).faces) == 1280
    kernel = tmp_path / "egg.tf"
    values = "FRAME_EGG_FIXED = 1401001\nFRAME_1401001_NAME = 'EGG_FIXED'\nFRAME_1401001_CLASS = 2\n"
    values += "FRAME_1401001_CLASS_ID = 401\nFRAME_1401001_CENTER = 401\n"
    kernel.write_text(f"KPL/FK\n\\begindata\n{values}\\begintext\n")
    mission: list[str | Path] = [
        "convert",
        egg,
        tmp_path / "mission.bds",
        "--dsk-center",
        "401",
        "--dsk-frame",
        "EGG_FIXED",
    ]
    assert "EGG_FIXED" in refusal(shape(*mission))
    assert shape(*mission, "--dsk-kernel", kernel).exit_code == 0


def test_convert_repairs_on_request_and_says_what_it_did(tmp_path: Path, torn: Path) -> None:
    target = tmp_path / "whole.npz"
    result = shape("convert", torn, target, "--repair")
    assert result.exit_code == 0, result.stderr
    assert "found: 1 duplicate facets, 6 boundary edges, 2 holes, 3 inconsistent edges" in result.stdout
    assert "turned 1 facets, closed 2 holes by 2 facets\nleft: no defects" in result.stdout
    assert_allclose(
        load_shape(target).volume_km3, mesh_from_ellipsoid(sphere(1.0), facets=320).volume_km3, rtol=FLOAT64
    )


def test_decimate_keeps_so_many_facets_and_says_what_it_cost(tmp_path: Path, egg: Path) -> None:
    result = shape("decimate", egg, tmp_path / "coarse.obj", "--facets", "300", "--json")
    assert result.exit_code == 0, result.stderr
    values = json.loads(result.stdout)
    coarse = load_shape(tmp_path / "coarse.obj")
    assert len(coarse.faces) == values["facets"]
    assert 290 <= values["facets"] <= 300
    assert_allclose(values["volume_change"], coarse.volume_km3 / load_shape(egg).volume_km3 - 1.0, rtol=FLOAT64_SUM)
    assert 0.0 < values["rms_km"] < values["max_km"] < 0.2
    assert "facets must be in" in refusal(shape("decimate", egg, tmp_path / "finer.obj", "--facets", "5000"))


def test_a_picture_shows_the_body_lit_from_the_right(tmp_path: Path, egg: Path) -> None:
    path = tmp_path / "egg.png"
    result = shape("render", egg, path, "--phase", "90", "--size", "120", "--reflectance", "lambert")
    assert result.exit_code == 0, result.stderr
    pixels = gray(path)
    assert pixels.shape == (120, 120)
    assert pixels.max() == 255
    assert pixels[:, :58].max() == 0
    assert middle(pixels)[0] > 0.1
    assert abs(middle(pixels)[1]) < 0.01
    assert "--overwrite" in refusal(shape("render", egg, path))


@pytest.mark.parametrize(
    ("offset", "seen_from", "right", "down"),
    [
        ([0.0, 1.0, 0.0], ["0", "0"], 1, 0),  # over longitude 0, east is to the right
        ([0.0, 0.0, 1.0], ["0", "0"], 0, -1),  # and north is up
        ([1.0, 0.0, 0.0], ["90", "0"], -1, 0),  # over longitude 90, longitude 0 is to the left
        ([1.0, 0.0, 0.0], ["0", "90"], 0, 1),  # over the north pole, the longitude named is down
        ([1.0, 0.0, 0.0], ["0", "-90"], 0, -1),  # over the south pole it is up
    ],
)
def test_a_picture_is_taken_from_where_it_says(
    tmp_path: Path, offset: list[float], seen_from: list[str], right: int, down: int
) -> None:
    save_shape(mesh_from_ellipsoid(sphere(1.0), facets=320).translated(offset), tmp_path / "off.npz")
    result = shape(
        "render",
        tmp_path / "off.npz",
        tmp_path / "off.png",
        "--phase",
        "0",
        "--size",
        "60",
        "--sub-observer",
        *seen_from,
    )
    assert result.exit_code == 0, result.stderr
    x, y = middle(gray(tmp_path / "off.png"))
    # one radius off in a picture of 4 radii / 0.95
    assert_allclose([x, y], [0.2375 * right, 0.2375 * down], rtol=0, atol=0.01)


def test_mistakes_end_in_one_line(tmp_path: Path, egg: Path) -> None:
    assert "pictures end in .png" in refusal(shape("render", egg, tmp_path / "egg.jpg"))
    picture = tmp_path / "egg.png"
    assert "--phase" in refusal(shape("render", egg, picture, "--phase", "180"))
    assert "latitude" in refusal(shape("render", egg, picture, "--sub-observer", "0", "91"))
    assert "--size" in refusal(shape("render", egg, picture, "--size", "0"))
    assert "reflectance model" in refusal(shape("render", egg, picture, "--reflectance", "velvet"))
    assert "shape files end in" in refusal(shape("convert", egg, tmp_path / "egg.blend"))
    assert "no such file" in refusal(shape("convert", tmp_path / "nowhere.obj", tmp_path / "new.obj"))
    assert "parsec" in shape("info", egg, "--units", "parsec").stderr
    assert not picture.exists()


@pytest.mark.slow
@pytest.mark.real_data
def test_info_of_every_real_shape_is_usable(data_dir: Path) -> None:
    files = sorted((data_dir / "shapes").iterdir())
    result = shape("info", *files, "--json")
    assert result.exit_code == 0
    found = {Path(entry["file"]).name: entry for entry in json.loads(result.stdout)}
    assert len(found) == len(files)
    assert (found["eros007790.tab"]["facets"], found["vesta_5002.ply"]["facets"]) == (7790, 10000)
    assert [name for name, entry in found.items() if entry["status"] != "ok"] == ["hyperion.obj"]
    assert found["hyperion.obj"]["defects"]["holes"] == 2  # poles that were computed 72 times each
