"""Height maps in PDS3 images with a label, attached or in a separate file.

Source: Planetary Data System Standards Reference, version 3.8, JPL D-7669 (label syntax, pointers, IMAGE objects).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import reads
from giantlike.core.arrays import Float
from giantlike.io.decoded import HeaderValue
from giantlike.io.height_maps.grid import RADIUS_SHARE, HeightGrid, Read
from giantlike.io.pds3 import Pds3Label, image_pointer, parse_pds3, raw_layout
from giantlike.io.raw_image import vax_floats

_STEP_ERROR = 0.01  # of the step in a label, relative to the step by its limits: they are printed with four digits


def open_labeled(
    label_path: Path, start: bytes, image: Path, radii_km: Float | None, unit_km: float | None
) -> HeightGrid:
    """Open the map of a PDS3 label, whose samples are mapped into memory and read by the system where they are used."""
    label = parse_pds3(label_path, start)
    pointer = image_pointer(label_path, label)
    if pointer.file is not None and image == label_path:
        image = _beside(label_path, pointer.file)
    layout = raw_layout(label, pointer.offset_bytes)
    if layout.rows < 2 or layout.columns < 2:
        raise ValueError(f"the label gives no usable size of a map: {layout.rows} rows, {layout.columns} columns")
    if (size := image.stat().st_size) < layout.end_bytes:
        raise ValueError(f"the file is truncated: {layout.end_bytes} bytes are needed, {image.name} has {size}")

    @reads("samples of a height map")
    def part(image: Path, rows: slice, columns: slice) -> NDArray[Any]:
        # Mapped anew each time: pages of a map that stays would stay in memory with it.
        stored = np.memmap(image, np.uint8, "r", layout.offset_bytes, (layout.rows, layout.row_bytes))
        width = layout.sample_bytes
        bytes_ = slice(layout.prefix_bytes + width * columns.start, layout.prefix_bytes + width * columns.stop)
        found = np.array(stored[rows, bytes_])
        if layout.sample.startswith("vax"):
            return vax_floats(found.reshape(*found.shape[:-1], -1, width))
        return found.view(np.dtype(layout.sample))

    def read(rows: slice, columns: slice) -> NDArray[Any]:
        return part(image, rows, columns)

    return _grid_from_label(label, read, layout.rows, layout.columns, image, radii_km, unit_km)


def _grid_from_label(
    label: Pds3Label, read: Read, rows: int, columns: int, path: Path, radii_km: Float | None, unit_km: float | None
) -> HeightGrid:
    """Layout of a map by the projection of its label."""
    values = label.values
    kind = str(values.get("IMAGE_MAP_PROJECTION.MAP_PROJECTION_TYPE", "none")).upper()
    if not kind.startswith(("SIMPLE CYLINDRICAL", "SIMPLE_CYLINDRICAL", "EQUIRECTANGULAR", "CYLINDRICAL")):
        raise ValueError(f"needed a map in simple cylindrical projection, its label has {kind}")
    south, north, west, east = (
        _number(values, f"IMAGE_MAP_PROJECTION.{key}")
        for key in ("MINIMUM_LATITUDE", "MAXIMUM_LATITUDE", "WESTERNMOST_LONGITUDE", "EASTERNMOST_LONGITUDE")
    )
    sense = -1.0 if str(values.get("IMAGE_MAP_PROJECTION.POSITIVE_LONGITUDE_DIRECTION")).upper() == "WEST" else 1.0
    west, east = sense * west, sense * east
    width = (east - west) % 360.0 or 360.0
    if radii_km is None:
        radii_km = np.array(
            [_length_km(label, f"IMAGE_MAP_PROJECTION.{axis}_AXIS_RADIUS", "KM") for axis in ("A", "B", "C")]
        )
    latitude_step, longitude_step = (south - north) / rows, width / columns
    stated = values.get("IMAGE_MAP_PROJECTION.MAP_RESOLUTION")
    unit = label.units.get("IMAGE_MAP_PROJECTION.MAP_RESOLUTION", "PIX/DEG").upper()
    if isinstance(stated, int | float) and stated > 0 and unit.startswith("PIX"):
        off = max(abs(-latitude_step * stated - 1.0), abs(longitude_step * stated - 1.0))
        if not off < _STEP_ERROR:
            raise ValueError(
                f"{rows} x {columns} samples between its limits are no {stated:g} pixels to the degree as it says"
            )
    if unit_km is None:
        unit_km = 1e-3 if str(values.get("IMAGE.UNIT", "METER")).upper().startswith("M") else 1.0
    scale, offset = (
        _number(values, f"IMAGE.{key}", default) for key, default in (("SCALING_FACTOR", 1.0), ("OFFSET", 0.0))
    )
    offset_km = offset * unit_km
    if abs(offset_km) > RADIUS_SHARE * float(np.mean(radii_km)):
        offset_km -= _sphere_km(radii_km)
    return HeightGrid(
        rows=rows,
        columns=columns,
        first_latitude_rad=math.radians(north + 0.5 * latitude_step),
        first_longitude_rad=math.radians(west + 0.5 * longitude_step),
        latitude_step_rad=math.radians(latitude_step),
        longitude_step_rad=math.radians(longitude_step),
        reference_radii_km=np.asarray(radii_km, dtype=np.float64),
        read=read,
        unit_km=scale * unit_km,
        offset_km=offset_km,
        missing=tuple(
            float(value)
            for key in ("MISSING_CONSTANT", "CORE_NULL", "NULL")
            if isinstance(value := values.get(f"IMAGE.{key}"), int | float)
        ),
        path=path,
    )


def _sphere_km(radii_km: Float) -> float:
    """Radius of the sphere that a map of radii is measured from."""
    if not np.ptp(radii_km) < 1e-6 * radii_km[0]:
        raise ValueError(
            "it holds radii, and its reference is no sphere: give that of a sphere, three times, as reference_radii_km"
        )
    return float(radii_km[0])


def _number(values: Mapping[str, HeaderValue], key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"the label has {key} = {value!r}, where a number is needed")
    return float(value)


def _length_km(label: Pds3Label, key: str, usual: str) -> float:
    unit = label.units.get(key, usual).upper()
    return _number(label.values, key) * (1.0 if unit.startswith("K") else 1e-3)


def _beside(path: Path, name: str) -> Path:
    """File of a name, in any case, in the folder of another."""
    exact = path.parent / Path(name).name
    if exact.is_file():
        return exact
    found = next((one for one in sorted(path.parent.iterdir()) if one.name.lower() == exact.name.lower()), None)
    if found is None:
        raise ValueError(f"the file {name!r} that this label points to is not beside it")
    return found
