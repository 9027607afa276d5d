"""Height maps in GeoTIFF: degrees, or meters of an equirectangular projection. Needs the package tifffile."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check, reads
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.io.height_maps.grid import MOST_AT_ONCE, HeightGrid, Read, put


def open_geotiff(path: Path, radii_km: Float | None, unit_km: float | None) -> HeightGrid:
    """Open the map of a GeoTIFF in degrees, or in meters of an equirectangular projection."""
    try:
        import tifffile
    except ImportError as error:
        raise InputError("GeoTIFF needs the package tifffile: pip install 'giantlike[geotiff]'") from error
    file = tifffile.TiffFile(path)
    with contextlib.ExitStack() as unless_opened:
        unless_opened.callback(file.close)
        grid = _grid_of(path, file.pages[0], radii_km, unit_km)
        unless_opened.pop_all()
    return grid


def _grid_of(path: Path, page: Any, radii_km: Float | None, unit_km: float | None) -> HeightGrid:
    """Map of a page of a TIFF file."""
    if page.ndim != 2 or page.dtype is None or page.dtype.kind not in "iuf":
        raise ValueError(f"needed one band of numbers, got {page.dtype} of shape {page.shape}")
    tags: Mapping[str, Any] = page.geotiff_tags or {}
    rows, columns = (_count(size) for size in page.shape)
    if radii_km is None:
        major = _number(tags, "GeogSemiMajorAxisGeoKey", 0.0)
        check(major > 0.0, "it tells no radius of the body: give reference_radii_km")
        radii_km = np.array([major, major, _number(tags, "GeogSemiMinorAxisGeoKey", major)]) / 1000.0
    scale, tie = _numbers(tags, "ModelPixelScale", 2), _numbers(tags, "ModelTiepoint", 6)
    degrees = np.array([scale[0], scale[1], tie[3], tie[4]], dtype=np.float64)
    if _number(tags, "GTModelTypeGeoKey", 0.0) == 1:
        transform = _number(tags, "ProjCoordTransGeoKey", 17.0)
        if transform != 17:
            raise ValueError(f"needed degrees or the equirectangular projection (17), it has projection {transform:g}")
        parallel = math.cos(math.radians(_number(tags, "ProjStdParallel1GeoKey", 0.0)))
        radius_m = 1000.0 * float(radii_km[0])
        with np.errstate(over="ignore"):
            degrees = np.degrees(degrees / radius_m) / np.array([parallel, 1.0, parallel, 1.0])
        degrees[2] += _number(tags, "ProjCenterLongGeoKey", _number(tags, "ProjNatOriginLongGeoKey", 0.0))
    shift = 0.0 if _number(tags, "GTRasterTypeGeoKey", 1.0) == 2 else 0.5  # a tie point is a corner, or a center
    with np.errstate(over="ignore", invalid="ignore"):  # the grid refuses values that are not finite
        first = (shift - tie[0]) * degrees[0] + degrees[2], degrees[3] - (shift - tie[1]) * degrees[1]
    factor, offset = _gdal_scale(page)
    unit_km = 1e-3 if unit_km is None else unit_km
    return HeightGrid(
        rows=rows,
        columns=columns,
        first_latitude_rad=math.radians(first[1]),
        first_longitude_rad=math.radians(first[0]),
        latitude_step_rad=-math.radians(degrees[1]),
        longitude_step_rad=math.radians(degrees[0]),
        reference_radii_km=np.asarray(radii_km, dtype=np.float64),
        read=_of_segments(path, page),
        unit_km=factor * unit_km,
        offset_km=offset * unit_km,
        missing=_gdal_missing(page),
        path=path,
    )


def _number(tags: Mapping[str, Any], name: str, default: float) -> float:
    return _checked_number(name, tags.get(name, default))


def _numbers(tags: Mapping[str, Any], name: str, least: int) -> tuple[float, ...]:
    """Numbers of a georeferencing tag."""
    values = tags.get(name, ())
    if not isinstance(values, tuple | list) or len(values) < least:
        raise ValueError(f"nothing tells where the map lies: {name} is {values!r}, where {least} numbers are needed")
    return tuple(_checked_number(name, value) for value in values)


def _checked_number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is {value!r}, where a number is needed")
    return float(value)


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"a size is {value!r}, where a number is needed")
    return value


def _gdal_scale(page: Any) -> tuple[float, float]:
    """Scale and offset of the stored values, as GDAL writes them."""
    tag = page.tags.get("GDAL_METADATA")
    text = "" if tag is None else str(tag.value)
    found = {}
    for role in ("scale", "offset"):
        match = re.search(rf'role="{role}"[^>]*>\s*([-+0-9.eE]+)\s*<', text)
        found[role] = float(match[1]) if match else (1.0 if role == "scale" else 0.0)
    return found["scale"], found["offset"]


def _gdal_missing(page: Any) -> tuple[float, ...]:
    tag = page.tags.get("GDAL_NODATA")
    return () if tag is None else (float(str(tag.value).strip("\0 ")),)


def _of_segments(path: Path, page: Any) -> Read:
    """Reader of the tiles or strips of a TIFF page."""
    length, across_px = _count(page.imagelength), _count(page.imagewidth)
    height = _count(page.tilelength) if page.is_tiled else min(_count(page.rowsperstrip), length)
    width = _count(page.tilewidth) if page.is_tiled else across_px
    if height < 1 or width < 1 or height * width * page.dtype.itemsize > MOST_AT_ONCE:
        raise ValueError(f"its tiles or strips of {height} x {width} samples are too large: write it in tiles")
    across = -(-across_px // width)

    @reads("a GeoTIFF")
    def part(path: Path, rows: slice, columns: slice) -> NDArray[Any]:
        result = np.zeros((rows.stop - rows.start, columns.stop - columns.start), dtype=page.dtype)
        file = page.parent.filehandle
        for top in range(rows.start // height, (rows.stop - 1) // height + 1):
            for left in range(columns.start // width, (columns.stop - 1) // width + 1):
                index = top * across + left
                file.seek(page.dataoffsets[index])
                decoded, _, _ = page.decode(file.read(page.databytecounts[index]), index)
                if decoded is None:
                    raise ValueError(f"its tile {index} holds nothing")
                put(
                    result,
                    (rows.start, columns.start),
                    decoded.reshape(decoded.shape[-3:-1]),
                    (top * height, left * width),
                )
        return result

    return lambda rows, columns: part(path, rows, columns)
