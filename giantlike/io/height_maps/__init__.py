"""Files of height maps: equirectangular grids in PDS3 images, GeoTIFF and numpy archives, read block by block.

Opening checks the layout and the size; samples are read where they are needed, so that a map larger than the
memory can be used. All are read into ``grid``, and each format has a module.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from giantlike._system.reading import reads
from giantlike.core.arrays import Float
from giantlike.io.height_maps.archive import open_archive, write_height_archive
from giantlike.io.height_maps.geotiff import open_geotiff
from giantlike.io.height_maps.grid import HeightGrid, joined_grid, require_usable
from giantlike.io.height_maps.labeled import open_labeled
from giantlike.io.pds3 import LABEL_START

__all__ = ["HeightGrid", "joined_grid", "read_height_grid", "require_usable", "write_height_archive"]

_LABEL_BYTES = 1_000_000  # beginning of a file in which a label is searched; labels of maps have some kilobytes


def read_height_grid(
    path: str | Path, *, reference_radii_km: ArrayLike | None = None, unit_km: float | None = None
) -> HeightGrid:
    """Open a map of heights: a PDS3 image with its label, a GeoTIFF or a numpy archive."""
    return _open_grid(Path(path), None if reference_radii_km is None else np.asarray(reference_radii_km), unit_km)


@reads("a height map")
def _open_grid(path: Path, radii_km: Float | None, unit_km: float | None) -> HeightGrid:
    with path.open("rb") as file:
        start = file.read(_LABEL_BYTES)
    if start.startswith(b"PK"):
        return open_archive(path, radii_km)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return open_geotiff(path, radii_km, unit_km)
    if LABEL_START.match(start):
        return open_labeled(path, start, path, radii_km, unit_km)
    label = next((one for one in (path.with_suffix(end) for end in (".lbl", ".LBL")) if one.is_file()), None)
    if label is None:
        raise ValueError("it is no GeoTIFF, no numpy archive and no PDS3 image with a label in it or beside it (.lbl)")
    return open_labeled(label, label.read_bytes()[:_LABEL_BYTES], path, radii_km, unit_km)
