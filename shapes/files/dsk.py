"""SPICE DSK files of type 2, triangular plates, read and written by CSPICE."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from giantlike._system.child import in_child
from giantlike._system.reading import check, library_message
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.core.units import SECONDS_PER_JULIAN_YEAR
from giantlike.shapes.mesh import Faces, TriangleMesh
from giantlike.shapes.surface import Surface

# Codes of NAIF's "DSK Required Reading": segment type, data classes, coordinate system.
_DSK_TYPE = 2
_SINGLE_VALUED, _GENERAL = 1, 2  # data classes
_LATITUDINAL = 1  # coordinate system
_VALID_YEARS = 100.0  # before and after J2000: a DSK must state times; shape models have none, and missions are within
_FINE_SCALE, _COARSE_SCALE = 5.0, 4  # voxel over mean plate extent, coarse voxel over fine voxel
_MOST_VOXELS = 3_000_000  # bounds the memory of the spatial index, which has several integers of 32 bit for each
_INDEX_HEADER = 100_008  # integers that come before the lists of a spatial index (SPICE_DSK02_IXIFIX)
_CELLS_PER_PLATE = 30  # entries of the voxel lists that are allocated; a plate of mean size meets a few voxels
_BYTES_PER_VERTEX, _BYTES_PER_PLATE = 24, 12  # three float64, three 32 bit integers


@dataclass(frozen=True, slots=True, kw_only=True)
class DskIdentity:
    """Identity that a DSK states besides its plates."""

    center: int  # NAIF number of the body, such as 2101955 for Bennu
    frame: str  # body-fixed frame that SPICE knows, built in or from kernels that are loaded, such as ``IAU_PHOBOS``
    surface: int = 1  # number of the surface, which tells several shapes of one body apart

    def __post_init__(self) -> None:
        limit = 2**31
        for name, value in (("center", self.center), ("surface", self.surface)):
            require(-limit <= value < limit, f"DSK {name} must be a 32 bit number, got {value}")
        require(bool(self.frame) and self.frame.isascii(), f"DSK frame must be a name, got {self.frame!r}")


def read_dsk(path: Path) -> Surface:
    """Read all segments of a DSK as one surface, in km."""
    require_whole_das(path)
    arrays = in_child(read_segments, [path], libraries=["spiceypy"])
    return Surface(vertices=arrays["vertices"], faces=arrays["faces"], in_km=True)


def read_segments(paths: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Read all segments of one DSK by CSPICE, which a damaged file can end with its process."""
    import spiceypy

    (path,) = paths
    handle = spiceypy.dasopr(str(path))
    try:
        segments = _segments(spiceypy, handle, path.stat().st_size)
    finally:
        spiceypy.dascls(handle)
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in segments])
    faces = [plates + start for (_, plates), start in zip(segments, starts, strict=False)]
    return {"vertices": np.concatenate([vertices for vertices, _ in segments]), "faces": np.concatenate(faces)}


def _segments(spice: Any, handle: int, size: int) -> list[tuple[Float, Faces]]:
    """Vertices and plates, numbered from 0, of every segment of an open DSK of ``size`` bytes."""
    from spiceypy.utils.exceptions import NotFoundError

    segments: list[tuple[Float, NDArray[np.int64]]] = []
    descriptor = spice.dlabfs(handle)
    while True:
        kind = spice.dskgd(handle, descriptor).dtype
        check(kind == _DSK_TYPE, f"needed DSK segments of type {_DSK_TYPE}, got type {kind}")
        n_vertices, n_plates = spice.dskz02(handle, descriptor)
        bytes_needed = n_vertices * _BYTES_PER_VERTEX + n_plates * _BYTES_PER_PLATE
        if n_vertices < 1 or n_plates < 1 or bytes_needed > size:
            raise ValueError(f"a segment cannot hold {n_vertices} vertices and {n_plates} plates")
        vertices = np.array(spice.dskv02(handle, descriptor, 1, n_vertices), dtype=np.float64)
        plates = np.array(spice.dskp02(handle, descriptor, 1, n_plates), dtype=np.int64) - 1
        segments.append((vertices.reshape(-1, 3), plates.reshape(-1, 3)))
        check(sum(len(part) for part, _ in segments) * _BYTES_PER_VERTEX <= size, "the list of segments has no end")
        try:
            descriptor = spice.dlafns(handle, descriptor)
        except NotFoundError:
            return segments


def write_dsk(path: Path, mesh: TriangleMesh, identity: DskIdentity) -> None:
    """Write one segment of type 2, of class 1 if single-valued, over all directions, with its spatial index."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    vertices, plates = mesh.vertices_km.copy(), (mesh.faces + 1).astype(np.int32)  # SPICE wants writeable arrays
    parameters = np.zeros(10)  # a latitudinal system has no parameters
    data_class = _SINGLE_VALUED if bool(np.all(mesh.plane_offsets_km > 0.0)) else _GENERAL
    try:
        reals, integers = _spatial_index(spiceypy, vertices, plates)
        low_km, high_km = spiceypy.dskrb2(vertices, plates, _LATITUDINAL, parameters)
        span_s = _VALID_YEARS * SECONDS_PER_JULIAN_YEAR
        handle = spiceypy.dskopn(str(path), "giantlike", 0)
        try:
            spiceypy.dskw02(
                handle, identity.center, identity.surface, data_class, identity.frame,
                _LATITUDINAL, parameters, -np.pi, np.pi, -np.pi / 2, np.pi / 2, low_km, high_km, -span_s, span_s,
                vertices, plates, reals, integers,
            )  # fmt: skip
        finally:
            spiceypy.dskcls(handle, True)
    except SpiceyError as error:
        raise InputError(f"SPICE does not write this DSK: {library_message(error)}") from error


def _spatial_index(spice: Any, vertices: Float, plates: NDArray[np.int32]) -> tuple[Float, NDArray[np.int32]]:
    """The voxel index of CSPICE; voxels are made larger where a fine grid would have too many of them."""
    corners = vertices[plates - 1]
    mean_extent = float(np.ptp(corners, axis=1).max(axis=1).mean())
    grid = np.ptp(vertices, axis=0) / (_FINE_SCALE * mean_extent) + 2 * _COARSE_SCALE
    scale = _FINE_SCALE * max(1.0, float(np.cbrt(np.prod(grid) / _MOST_VOXELS)))
    voxels = int(np.prod(np.ptp(vertices, axis=0) / (scale * mean_extent) + 3 * _COARSE_SCALE)) + 1
    cells = _CELLS_PER_PLATE * len(plates) + 10_000
    index_size = _INDEX_HEADER + voxels + cells
    reals, integers = spice.dskmi2(vertices, plates, scale, _COARSE_SCALE, cells, voxels, cells, False, index_size)
    return reals, integers


# Layout of a DAS file, bytes and words from 0: NAIF, "DAS Required Reading", sections on file and directory records.
_RECORD_BYTES = 1024
_COUNTS_AT, _FORMAT_AT = 68, 84  # bytes, in the file record
_BYTE_ORDER = {b"LTL-IEEE": "<i4", b"BIG-IEEE": ">i4"}
_RANGES_AT, _TYPE_AT, _CLUSTERS_AT = 2, 8, 9  # words, in a directory
_WORDS_PER_RECORD = np.array([1024, 128, 256])  # characters, reals, integers


def require_whole_das(path: Path) -> None:
    """Check identity, length and directories of a DAS file, the container of a DSK, before CSPICE opens it.

    A damaged pointer can end the whole process. After file, reserved and comment records, of 1024 bytes, directories
    describe the clusters of records that follow, and point to the next directory.
    """
    records = path.stat().st_size // _RECORD_BYTES
    with path.open("rb") as file:
        head = file.read(_RECORD_BYTES)
        order = _BYTE_ORDER.get(head[_FORMAT_AT : _FORMAT_AT + 8])
        if not head.startswith(b"DAS/DSK") or len(head) < _RECORD_BYTES or order is None:
            raise ValueError("needed a SPICE DSK, the first bytes are not those of one")
        counts = np.frombuffer(head, order, 4, _COUNTS_AT).astype(np.int64)
        reserved, reserved_characters, comments, comment_characters = counts.tolist()
        if counts.min() < 0 or max(reserved_characters, comment_characters) > records * _RECORD_BYTES:
            raise ValueError("the counts of its file record cannot be true")
        number, before, last_words = 1 + reserved + comments, 0, np.zeros(3, dtype=np.int64)
        while number > 0:
            directory = _record(file, number, records, order)
            after = int(directory[1])
            last_words = _check_directory(directory, number, before, records, last_words)
            before, number = number + 1, after - 1


def _record(file: BinaryIO, number: int, records: int, order: str) -> NDArray[np.int64]:
    """Words (256,) of a record."""
    if number >= records:
        raise ValueError(f"its directory should be record {number + 1}, but it has {records}: is it cut short?")
    file.seek(number * _RECORD_BYTES)
    return np.frombuffer(file.read(_RECORD_BYTES), order).astype(np.int64)


def _check_directory(
    directory: NDArray[np.int64], number: int, before: int, records: int, last_words: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Last address (3,) of each type after a directory, record ``number`` from 0, whose predecessor is ``before``."""
    backward, after = directory[:2].tolist()
    ranges = directory[_RANGES_AT:_TYPE_AT].reshape(3, 2)
    kind, of_type, used = int(directory[_TYPE_AT]), np.zeros(3, dtype=np.int64), 0
    for place, cluster in enumerate(directory[_CLUSTERS_AT:].tolist()):
        if cluster == 0:
            break
        if place > 0:
            kind = (kind + (0 if cluster > 0 else -2)) % 3 + 1
        if not 1 <= kind <= 3:
            break
        of_type[kind - 1] += abs(cluster)
        used += abs(cluster)
    words = np.where(ranges[:, 1] > 0, ranges[:, 1] - ranges[:, 0] + 1, 0)
    starts_well = (ranges[:, 1] == 0) | (ranges[:, 0] == last_words + 1)
    fits = (words >= 0) & (words <= of_type * _WORDS_PER_RECORD) & (words > (of_type - 1) * _WORDS_PER_RECORD)
    fits |= (of_type == 0) & (words == 0)
    end = number + used + 1
    linked = backward == before and (after <= 0 or after == end + 1)
    if not (linked and starts_well.all() and fits.all() and end <= records):
        raise ValueError(f"its directory in record {number + 1} does not describe what follows: is it cut short?")
    return np.maximum(last_words, ranges[:, 1])
