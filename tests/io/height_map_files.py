"""Files of height maps for tests: PDS3 images with labels as LOLA's, GeoTIFF in degrees and meters, archives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile

LABEL = """PDS_VERSION_ID = "PDS3"
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = {record}
^IMAGE = {pointer}
OBJECT = IMAGE
  NAME = HEIGHT
  LINES = {rows}
  LINE_SAMPLES = {columns}
  SAMPLE_TYPE = LSB_INTEGER
  SAMPLE_BITS = 16
  UNIT = METER
  SCALING_FACTOR = 0.5
  OFFSET = 1737400.
  /* radius in meters = (stored value * SCALING_FACTOR) + OFFSET */
END_OBJECT = IMAGE
OBJECT = IMAGE_MAP_PROJECTION
  MAP_PROJECTION_TYPE = "{projection}"
  A_AXIS_RADIUS = 1737.4 <KM>
  B_AXIS_RADIUS = 1737.4 <KM>
  C_AXIS_RADIUS = 1737.4 <KM>
  POSITIVE_LONGITUDE_DIRECTION = "EAST"
  MAP_RESOLUTION = {resolution} <PIX/DEG>
  MAXIMUM_LATITUDE = 90 <DEG>
  MINIMUM_LATITUDE = -90 <DEG>
  WESTERNMOST_LONGITUDE = 0 <DEG>
  EASTERNMOST_LONGITUDE = 360 <DEG>
END_OBJECT = IMAGE_MAP_PROJECTION
END
"""


def heights_km(rows: int = 18) -> np.ndarray:
    """Heights (rows, 2 rows), km, that differ everywhere, in steps of half a meter."""
    return 1e-3 * (np.arange(2 * rows**2).reshape(rows, 2 * rows) * 0.5 - 100.0)


def write_pds3(
    path: Path, *, attached: bool = False, projection: str = "SIMPLE CYLINDRICAL", resolution: float = 0.1
) -> Path:
    """Map of :func:`heights_km` as an image with its label in it or beside it; the path of the image."""
    heights = heights_km()
    rows, columns = heights.shape
    known = {
        "record": 2 * columns,
        "rows": rows,
        "columns": columns,
        "projection": projection,
        "resolution": resolution,
    }
    stored = np.rint(heights * 2000.0).astype("<i2").tobytes()
    if attached:
        label = LABEL.format(pointer=30, **known).encode().ljust(29 * 2 * columns)
        path.write_bytes(label + stored)
        return path
    path.write_bytes(stored)
    path.with_suffix(".lbl").write_text(LABEL.format(pointer=f'"{path.name.upper()}"', **known))
    return path


def write_geotiff(path: Path, *, meters: bool = False, tile: int | None = None, **tags: Any) -> Path:
    """Map of :func:`heights_km` as a GeoTIFF in whole half meters, from -180 deg in degrees and from 0 in meters."""
    heights = heights_km()
    step = 10.0 * (1737400.0 * np.pi / 180.0 if meters else 1.0)
    west = 0.0 if meters else -180.0
    stored = np.rint(np.roll(heights, 0 if meters else 18, axis=1) * 2000.0).astype(np.int16)
    keys = [1, 1, 0, 4, 1024, 0, 1, 1 if meters else 2, 1025, 0, 1, 1, 2057, 34736, 1, 0, 2058, 34736, 1, 0]
    extra: list[tuple[Any, ...]] = [
        (33550, "d", 3, (step, step, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, west, 9.0 * step, 0.0), True),
        (34735, "H", len(keys), keys, True),
        (34736, "d", 1, 1737400.0, True),
        (42112, "s", 0, '<GDALMetadata><Item name="SCALE" sample="0" role="scale">0.5</Item></GDALMetadata>', True),
        (42113, "s", 0, "-32768", True),
    ]
    stored[3, 5] = -32768 if tags.pop("hole", False) else stored[3, 5]
    tifffile.imwrite(path, stored, tile=None if tile is None else (tile, tile), extratags=extra, metadata=None, **tags)
    return path
