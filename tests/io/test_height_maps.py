"""Height maps of every format: the same heights at the same places, and clear refusals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose

from giantlike import DataError, InputError
from giantlike.io.height_maps import read_height_grid
from giantlike.terrain import HeightMap
from tests.io.height_map_files import heights_km, write_geotiff, write_pds3

SINGLE_KM = 1e-6  # float32 of a tenth of a kilometer

FORMATS: dict[str, Callable[[Path], Path]] = {
    "pds3 beside": lambda folder: write_pds3(folder / "ldem_0.img"),
    "pds3 label": lambda folder: write_pds3(folder / "ldem_0.img").with_suffix(".lbl"),
    "pds3 in it": lambda folder: write_pds3(folder / "a.img", attached=True),
    "geotiff degrees": lambda folder: write_geotiff(folder / "a.tif"),
    "geotiff meters": lambda folder: write_geotiff(folder / "a.tif", meters=True),
    "geotiff tiles": lambda folder: write_geotiff(folder / "a.tif", tile=16, compression="zlib"),
    "archive": lambda folder: _archive(folder / "a.npz"),
}


def _archive(path: Path) -> Path:
    np.savez(path, heights_km=heights_km(), reference_radii_km=1737.4, sigma_km=0.02)
    return path


def centers() -> np.ndarray:
    """Directions (18, 36, 3) of the samples: from 85 deg of latitude to -85, from 5 deg of longitude to 355."""
    latitude, longitude = np.radians(85.0 - 10.0 * np.arange(18))[:, None], np.radians(5.0 + 10.0 * np.arange(36))
    parts = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


@pytest.mark.parametrize("name", FORMATS)
def test_all_formats_hold_the_same_heights_at_the_same_places(name: str, tmp_path: Path) -> None:
    opened = HeightMap.open(FORMATS[name](tmp_path))
    assert_allclose(opened.heights_km(centers()), heights_km(), rtol=0, atol=SINGLE_KM)
    assert_allclose(opened.radii_km(centers()), 1737.4 + heights_km(), rtol=0, atol=SINGLE_KM)
    assert opened.sigma_km == (0.02 if name == "archive" else 0.0)


def test_a_value_that_stands_for_nothing_is_no_height(tmp_path: Path) -> None:
    opened = HeightMap.open(write_geotiff(tmp_path / "a.tif", meters=True, hole=True))
    assert np.isnan(opened.heights_km(centers()[3, 5]))
    assert np.isfinite(opened.heights_km(centers()[3, 8]))


def test_unit_and_radii_of_the_user_win_over_the_file(tmp_path: Path) -> None:
    path = write_geotiff(tmp_path / "a.tif")
    opened = HeightMap.open(path, unit_km=2e-3, reference_radii_km=[1738.0, 1738.0, 1736.0])
    assert_allclose(opened.heights_km(centers()), 2.0 * heights_km(), rtol=0, atol=2 * SINGLE_KM)
    assert_allclose(opened.grid.reference_radii_km, [1738.0, 1738.0, 1736.0])


def test_only_the_blocks_that_are_asked_for_are_read(tmp_path: Path) -> None:
    """A map of 3 GB that takes no place on the disk is opened and looked up."""
    path = write_pds3(tmp_path / "big.img")
    label = path.with_suffix(".lbl")
    text = label.read_text().replace("LINES = 18", "LINES = 28800").replace("LINE_SAMPLES = 36", "LINE_SAMPLES = 57600")
    label.write_text(text.replace("MAP_RESOLUTION = 0.1", "MAP_RESOLUTION = 160"))
    with path.open("r+b") as file:
        file.truncate(2 * 28800 * 57600)
    grid = read_height_grid(path)
    assert grid.block(slice(20_000, 20_010), slice(50_000, 50_020)).shape == (10, 20)
    assert HeightMap(grid=grid).heights_km([0.3, 0.2, -0.6]) == 0.0


def quarter(path: Path, rows: slice, columns: slice) -> Path:
    """A part of the map in a file of its own."""
    whole, step = heights_km(), 10.0
    np.savez(
        path,
        heights_km=whole[rows, columns],
        reference_radii_km=[1737.4] * 3,
        bounds_deg=[90 - step * rows.stop, 90 - step * rows.start, step * columns.start, step * columns.stop],
        sigma_km=0.01 * (1 + rows.start),
    )
    return path


def quarters(folder: Path) -> list[Path]:
    return [
        quarter(folder / f"{i}{j}.npz", slice(*rows), slice(*columns))
        for i, rows in enumerate(((9, 18), (0, 9)))
        for j, columns in enumerate(((20, 36), (0, 20)))
    ]


def test_a_map_in_several_files_is_one_map_in_whatever_order(tmp_path: Path) -> None:
    files = quarters(tmp_path)
    joined = HeightMap.open(files)
    assert_allclose(joined.heights_km(centers()), heights_km(), rtol=0, atol=SINGLE_KM)
    assert joined.sigma_km == pytest.approx(0.1)
    assert joined.grid.global_columns
    joined.save(tmp_path / "whole.npz")
    again = HeightMap.open(tmp_path / "whole.npz")
    assert_allclose(again.heights_km(centers()), heights_km(), rtol=0, atol=SINGLE_KM)
    partly = HeightMap.open([files[0], files[3]]).heights_km(centers())
    assert np.isnan(partly[:9, 20:]).all()
    assert_allclose(partly[:8, :19], heights_km()[:8, :19], rtol=0, atol=SINGLE_KM)  # beside nothing there is none
    assert HeightMap.open(files).sha256 == joined.sha256 != HeightMap.open(files[:3]).sha256


def test_files_that_are_not_of_one_map_are_not_joined(tmp_path: Path) -> None:
    files = quarters(tmp_path)
    np.savez(tmp_path / "fine.npz", heights_km=np.zeros((18, 40)), reference_radii_km=[1737.4] * 3,
             bounds_deg=[0, 90, 0, 200])  # fmt: skip
    with pytest.raises(DataError, match=r"fine\.npz.*step of latitude"):
        HeightMap.open([files[0], tmp_path / "fine.npz"])
    np.savez(tmp_path / "off.npz", heights_km=np.zeros((9, 20)), reference_radii_km=[1737.4] * 3,
             bounds_deg=[-5, 85, 3, 203])  # fmt: skip
    with pytest.raises(DataError, match=r"off\.npz.*lie between"):
        HeightMap.open([files[0], tmp_path / "off.npz"])
    with pytest.raises(InputError, match="needs a file"):
        HeightMap.open([])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda t: t.replace("SIMPLE CYLINDRICAL", "POLAR STEREOGRAPHIC"), "POLAR STEREOGRAPHIC"),
        (lambda t: t.replace("LINES = 18", "LINES = 1800"), "truncated"),
        (lambda t: t.replace("LINES = 18", "LINES = 9"), "pixels to the degree"),
        (lambda t: t.replace("MAXIMUM_LATITUDE = 90", "MAXIMUM_LATITUDE = 90 <DEG>\n A = 1"), ""),
        (lambda t: t.replace("A_AXIS_RADIUS = 1737.4", "A_AXIS_RADIUS = none"), "A_AXIS_RADIUS"),
        (lambda t: t.replace("B_AXIS_RADIUS = 1737.4", "B_AXIS_RADIUS = 1700.0"), "no sphere"),
        (lambda t: t.replace("OFFSET = 1737400.", "OFFSET = 600000."), "another unit|radii"),
        (lambda t: t.replace("END\n", "\n"), "END"),
        (lambda t: t.replace("SAMPLE_BITS = 16", "SAMPLE_BITS = 12"), "12 bits"),
        (lambda t: t.replace('"BAD.IMG"', '"other.img"'), "other.img|not beside"),
    ],
)
def test_a_label_that_is_wrong_is_refused_with_path_and_reason(
    change: Callable[[str], str], text: str, tmp_path: Path
) -> None:
    label = write_pds3(tmp_path / "bad.img").with_suffix(".lbl")
    label.write_text(change(label.read_text()))
    if not text:
        HeightMap.open(label)
        return
    with pytest.raises(DataError, match=text) as caught:
        HeightMap.open(label)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"heights": np.zeros((4, 8))}, "reference_radii_km"),
        ({"reference_radii_km": 1737.4}, "heights_km"),
        ({"reference_radii_km": 1737.4, "heights_km": np.zeros(4)}, "rows and columns"),
        ({"reference_radii_km": -1.0, "heights_km": np.zeros((4, 8))}, "positive radii"),
        ({"reference_radii_km": 1737.4, "heights_km": np.zeros((4, 8)), "bounds_deg": [0.0, 200.0, 0, 9]}, "latitudes"),
        ({"reference_radii_km": 1737.4, "heights_km": np.zeros((4, 8)), "bounds_deg": [-9, 9, 0, 900]}, "steps|360"),
    ],
)
def test_an_archive_that_is_no_map_is_refused(arrays: dict[str, np.ndarray], text: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", allow_pickle=False, **arrays)
    with pytest.raises(DataError, match=text):
        HeightMap.open(tmp_path / "a.npz")


def test_what_is_missing_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        HeightMap.open(tmp_path / "none.tif")
    (tmp_path / "a.img").write_bytes(bytes(100))
    with pytest.raises(DataError, match="label"):
        HeightMap.open(tmp_path / "a.img")
    with pytest.raises(InputError, match="unit_km"):
        HeightMap.open(write_pds3(tmp_path / "b.img"), unit_km=-1.0)


def test_an_archive_of_zeros_larger_than_the_memory_is_refused_before_it_is_read(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", heights_km=np.zeros((6000, 12000)), reference_radii_km=1737.4)
    with pytest.raises(DataError, match="576 MB"):
        HeightMap.open(tmp_path / "a.npz")


def test_a_geotiff_whose_pixel_scale_is_no_list_is_refused_with_that_value(tmp_path: Path) -> None:
    """It raised a TypeError."""
    path = write_geotiff(tmp_path / "a.tif")
    with tifffile.TiffFile(path, mode="r+b") as file:
        file.pages[0].tags[33550].overwrite(5.0)
    with pytest.raises(DataError, match=r"ModelPixelScale is 5\.0, where 2 numbers are needed"):
        HeightMap.open(path)
