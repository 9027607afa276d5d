"""Height maps in numpy archives: one array, or tiles that are read one by one."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import ArrayLike, NDArray

from giantlike._system.archives import array_of, open_archive_of_arrays, unpacked_sizes
from giantlike._system.reading import check, reads
from giantlike.core.arrays import Float
from giantlike.io.height_maps.grid import MOST_AT_ONCE, HeightGrid, Read, put, tiles_of

_FORMAT, _VERSION = "giantlike heights", 1
_TILE = 512  # samples along the side of a tile that is written: a megabyte in single precision
_MOST_COMPRESSION = 100  # arrays over file: heights are compressed to a half to a tenth


def open_archive(path: Path, radii_km: Float | None) -> HeightGrid:
    """Open the map of an archive: one array, or tiles that are read one by one."""
    archive = open_archive_of_arrays(path)
    names = set(archive.files)
    sizes = unpacked_sizes(archive)
    if radii_km is None:
        radii_km = np.atleast_1d(_small(archive, sizes, "reference_radii_km").astype(np.float64))
        radii_km = np.repeat(radii_km, 3) if radii_km.size == 1 else radii_km
    bounds = _small(archive, sizes, "bounds_deg") if "bounds_deg" in names else np.array([-90.0, 90.0, 0.0, 360.0])
    if bounds.shape != (4,) or not np.isfinite(bounds.astype(np.float64)).all():
        raise ValueError("bounds_deg must hold south, north, west and east")
    south, north, west, east = (float(value) for value in bounds)
    if "heights_km" in names:
        limit = min(MOST_AT_ONCE, max(100_000_000, _MOST_COMPRESSION * path.stat().st_size))
        if sizes["heights_km"] > limit:
            raise ValueError(
                f"heights_km takes {sizes['heights_km'] / 1e6:.0f} MB: write larger maps with HeightMap.save"
            )
        whole = array_of(archive, "heights_km")
        if whole.ndim != 2 or whole.dtype.kind not in "iuf":
            raise ValueError(
                f"heights_km must be numbers in rows and columns, got {whole.dtype} of shape {whole.shape}"
            )
        (rows, columns), read = whole.shape, _of_array(whole)
    elif "tile" in names and "shape" in names:
        rows, columns = (int(size) for size in _small(archive, sizes, "shape"))
        tile = int(_small(archive, sizes, "tile"))
        check(1 <= tile <= 8192, f"needed tiles of 1 to 8192 samples, got {tile}")
        read = _of_tiles(path, archive, sizes, tile)
    else:
        raise ValueError("needed an array heights_km, or the tiles that HeightMap.save writes")
    return HeightGrid(
        rows=rows,
        columns=columns,
        first_latitude_rad=math.radians(north - 0.5 * (north - south) / max(rows, 1)),
        first_longitude_rad=math.radians(west + 0.5 * (east - west) / max(columns, 1)),
        latitude_step_rad=-math.radians(north - south) / max(rows, 1),
        longitude_step_rad=math.radians(east - west) / max(columns, 1),
        reference_radii_km=np.asarray(radii_km, dtype=np.float64),
        read=read,
        path=path,
        sigma_km=abs(float(_small(archive, sizes, "sigma_km"))) if "sigma_km" in names else None,
    )


def _small(archive: NpzFile, sizes: Mapping[str, int], name: str) -> NDArray[Any]:
    """A few numbers of an archive."""
    check(name in sizes, f"the archive holds no {name}")
    if sizes[name] > 1000:
        raise ValueError(f"{name} must be a few numbers, it takes {sizes[name]} bytes")
    array = array_of(archive, name)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be a few numbers")
    return array


def _of_array(whole: NDArray[Any]) -> Read:
    return lambda rows, columns: whole[rows, columns]


def _of_tiles(path: Path, archive: NpzFile, sizes: Mapping[str, int], tile: int) -> Read:
    @reads("tiles of a height map")
    def part(path: Path, rows: slice, columns: slice) -> NDArray[np.float32]:
        result = np.full((rows.stop - rows.start, columns.stop - columns.start), np.nan, dtype=np.float32)
        for i, j in tiles_of(rows, columns, tile):
            name = f"tile_{i}_{j}"
            if sizes.get(name, 0) > 4 * tile**2 + 1000:
                raise ValueError(f"{name} takes {sizes[name]} bytes, more than {tile} x {tile} single numbers")
            put(result, (rows.start, columns.start), array_of(archive, name), (i * tile, j * tile))
        return result

    return lambda rows, columns: part(path, rows, columns)


def write_height_archive(path: str | Path, grid: HeightGrid, *, sigma_km: float, tile: int = _TILE) -> None:
    """Write a map as a numpy archive in tiles, one at a time in memory."""
    half = 0.5 * grid.longitude_step_rad
    west = math.degrees(grid.first_longitude_rad - half)
    north = math.degrees(grid.first_latitude_rad - 0.5 * grid.latitude_step_rad)
    bounds = [
        north + math.degrees(grid.latitude_step_rad) * grid.rows,
        north,
        west,
        west + math.degrees(grid.longitude_step_rad) * grid.columns,
    ]
    known: dict[str, ArrayLike] = {
        "format": _FORMAT,
        "version": _VERSION,
        "shape": [grid.rows, grid.columns],
        "tile": tile,
        "bounds_deg": bounds,
        "reference_radii_km": grid.reference_radii_km,
        "sigma_km": sigma_km,
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in known.items():
            _write_member(archive, name, np.asarray(value))
        for i, j in tiles_of(slice(0, grid.rows), slice(0, grid.columns), tile):
            rows = slice(i * tile, min((i + 1) * tile, grid.rows))
            columns = slice(j * tile, min((j + 1) * tile, grid.columns))
            _write_member(archive, f"tile_{i}_{j}", grid.block(rows, columns))


def _write_member(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        np.lib.format.write_array(file, array, allow_pickle=False)
