"""Formats of shape files by the ends of their names, and one border at which damaged ones become a DataError."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from giantlike._system.reading import check, reads
from giantlike.core.errors import InputError
from giantlike.shapes.albedo import Albedo, FacetAlbedo, VertexAlbedo
from giantlike.shapes.files.dsk import read_dsk
from giantlike.shapes.files.exchange import read_exchange, write_obj, write_stl
from giantlike.shapes.files.icq import is_icq, read_icq, write_icq
from giantlike.shapes.files.npz import read_npz, write_npz
from giantlike.shapes.files.plate_table import read_plate_table, write_plate_table
from giantlike.shapes.files.ply import write_ply
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface


def read_text(path: Path) -> Surface:
    """Read a text file that is either an ICQ model or a plate table."""
    return read_icq(path) if is_icq(path) else read_plate_table(path)


@dataclass(frozen=True, slots=True)
class ShapeFormat:
    """A format of shape files."""

    name: str  # with its article, for messages
    read: Callable[[Path], Surface]  # takes a path and returns a :class:`~giantlike.shapes.surface.Surface`
    write: Callable[[Path, TriangleMesh], None] | None  # None for a DSK, which needs its identity too
    albedo: tuple[type[Albedo], ...] = ()  # kinds of albedo that files can hold


_DSK = ShapeFormat("a DSK file", read_dsk, None)
FORMATS: Mapping[str, ShapeFormat] = MappingProxyType(
    {
        ".obj": ShapeFormat("an OBJ file", read_exchange, write_obj),
        ".ply": ShapeFormat("a PLY file", read_exchange, write_ply),
        ".stl": ShapeFormat("an STL file", read_exchange, write_stl),
        ".tab": ShapeFormat("a plate table", read_text, write_plate_table),
        ".plt": ShapeFormat("a plate table", read_plate_table, write_plate_table),
        ".txt": ShapeFormat("a plate table", read_text, write_icq, (VertexAlbedo,)),
        ".icq": ShapeFormat("an ICQ model", read_icq, write_icq, (VertexAlbedo,)),
        ".bds": _DSK,
        ".dsk": _DSK,
        ".npz": ShapeFormat("a shape archive", read_npz, write_npz, (FacetAlbedo, VertexAlbedo)),
    }
)
"""Formats by the end of the file name."""


def format_of(path: Path) -> ShapeFormat:
    """Return the format of a file by the end of its name."""
    known = FORMATS.get(path.suffix.lower())
    if known is None:
        raise InputError(f"{path}: shape files end in {', '.join(sorted(FORMATS))}, not {path.suffix!r}")
    return known


def read_file(path: Path) -> Surface:
    """Read a shape file as it is."""
    known = format_of(path)

    def read(path: Path) -> Surface:
        check(path.stat().st_size != 0, "the file is empty")
        return known.read(path)

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return reads(known.name)(read)(path)
