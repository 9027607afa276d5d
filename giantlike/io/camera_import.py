"""Camera files of other programs, distinguished by their names and contents."""

from __future__ import annotations

from pathlib import Path

from giantlike._system.reading import reads
from giantlike.core.errors import InputError
from giantlike.io.camera_giant import read_giant_camera
from giantlike.io.camera_ik import read_ik_camera
from giantlike.io.camera_opencv import read_opencv_camera
from giantlike.io.camera_sip import read_sip_camera
from giantlike.io.mission_frame import Boresight, ImportedCamera
from giantlike.io.spc_geometry import read_sumfile_camera

FOREIGN_SUFFIXES = (".xml", ".yml", ".yaml", ".ti", ".fits", ".fit", ".fts", ".sum")
"""File name extensions that :func:`read_foreign_camera` knows."""


def read_foreign_camera(
    path: str | Path,
    *,
    name: str | None = None,
    instrument_id: int | None = None,
    first_pixel: float | None = None,
    boresight: Boresight | None = None,
) -> ImportedCamera:
    """Read a camera from an OpenCV, GIANT, SPICE instrument-kernel, FITS or SUMFILE."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".ti":
        if instrument_id is None:
            raise InputError(
                f"{path}: the NAIF code of the instrument is needed, as a kernel can hold several: give --instrument "
                "ID (instrument_id in Python), the number after INS in its keywords"
            )
        return read_ik_camera(path, instrument_id, first_pixel=first_pixel, boresight=boresight or "+z")
    if suffix in (".fits", ".fit", ".fts"):
        return read_sip_camera(path).camera
    if suffix == ".sum":
        return read_sumfile_camera(path)
    if suffix in (".xml", ".yml", ".yaml"):
        if suffix == ".xml" and _is_giant(path):
            return read_giant_camera(path, name, boresight=boresight)
        return read_opencv_camera(path)
    known = ", ".join(FOREIGN_SUFFIXES)
    raise InputError(f"{path}: camera files of other programs are {known}, got {path.suffix or 'no extension'}")


@reads("a camera file")
def _is_giant(path: Path) -> bool:
    """True for an XML file whose root element is GIANT's."""
    return b"<CameraModels" in path.read_bytes()[:4096]
