"""ISIS cubes of one band: pixels by GDAL (rasterio, an optional extra), times by the label.

Source: ISIS "SpecialPixel.h": values that mean null, and low and high saturation of instrument and representation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.child import in_child
from giantlike._system.reading import check, reads
from giantlike.core.arrays import Mask
from giantlike.core.extras import require_extra
from giantlike.io.decoded import DecodedImage
from giantlike.io.label_times import label_epoch, label_exposure_s
from giantlike.io.pds3 import parse_pds3

CUBE_START = re.compile(rb"\s*Object\s*=\s*IsisCube\b")  # first words of the label of a cube

_INSTRUMENT = "IsisCube.Instrument."
LABEL_NAMES = {"StartTime": "START_TIME", "StopTime": "STOP_TIME", "ExposureDuration": "EXPOSURE_DURATION"}
"""Items of a cube's instrument group, and their names in PDS3 labels."""
_VALID = {"uint8": (1, 254), "uint16": (3, 65522), "int16": (-32752, 32767), "uint32": (3, 4294967282)}
"""Least and greatest value of each integer type that is a measurement (reference 1)."""
_LEAST_FLOAT = np.float32(-3.4028226550889045e38)
"""Special values of floating cubes lie at and below this one, the null (0xFF7FFFFB, reference 1)."""


@reads("an ISIS cube")
def decode_isis_cube(path: Path, data: bytes) -> DecodedImage:
    """Decode an ISIS cube with its label attached."""
    require_extra("rasterio", extra="planetary", purpose="reading ISIS cubes")
    label = parse_pds3(path, data)
    if any(name.endswith("^Core") for name in label.raw):
        raise ValueError("its pixels are in another file: make a cube with an attached label (ISIS cubeatt)")
    arrays = in_child(read_cube, [path], libraries=["rasterio"])
    values = label.values
    times, units = _pds3_names(values), _pds3_names(label.units)
    exposure_s = label_exposure_s(times, units)
    return DecodedImage(
        pixels=arrays["pixels"],
        mask=arrays["mask"],
        format="isis",
        epoch=label_epoch(times, exposure_s),
        exposure_s=exposure_s,
        header=dict(values),
    )


def read_cube(paths: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Read the only band of a cube by GDAL, which a damaged file might end with its process."""
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    (path,) = paths
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    with rasterio.open(path, driver="ISIS3") as cube:
        check(cube.count == 1, f"only cubes of one band are read, got {cube.count}: take one by ISIS explode")
        bytes_needed = cube.width * cube.height * np.dtype(cube.dtypes[0]).itemsize
        if bytes_needed > path.stat().st_size:
            raise ValueError(f"it is truncated: {bytes_needed} bytes of pixels are needed, the file has fewer")
        stored, scale, offset = cube.read(1), cube.scales[0], cube.offsets[0]
    mask = _special(stored)
    if (scale, offset) == (1.0, 0.0):
        return {"pixels": stored, "mask": mask}
    return {"pixels": np.where(mask, 0.0, stored * scale + offset).astype(np.float32), "mask": mask}


def _special(stored: NDArray[Any]) -> Mask:
    """True where a stored value means null or saturation."""
    if stored.dtype.kind == "f":
        return ~(stored > _LEAST_FLOAT)
    least, most = _VALID[stored.dtype.name]
    return (stored < least) | (stored > most)


def _pds3_names(items: Mapping[str, Any]) -> dict[str, Any]:
    """Times of a cube under the names that they have in PDS3 labels."""
    return {name: items[_INSTRUMENT + key] for key, name in LABEL_NAMES.items() if _INSTRUMENT + key in items}
