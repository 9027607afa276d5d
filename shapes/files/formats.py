"""Formats of shape files by the ends of their names, and one border at which damaged ones become a DataError."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from giantlike.core.errors import InputError
from giantlike.core.reading import reads
from giantlike.shapes.files.dsk import read_dsk
from giantlike.shapes.files.exchange import read_exchange, write_obj, write_stl
from giantlike.shapes.files.icq import is_icq, read_icq, write_icq
from giantlike.shapes.files.npz import read_npz, write_npz
from giantlike.shapes.files.plate_table import read_plate_table, write_plate_table
from giantlike.shapes.files.ply import write_ply
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface


def read_text(path: Path) -> Surface:
    """Read a text file that is either an ICQ model or a plate table.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Surface
        In the unit of the file.
    """
    return read_icq(path) if is_icq(path) else read_plate_table(path)


READERS: Mapping[str, tuple[str, Callable[[Path], Surface]]] = MappingProxyType(
    {
        ".obj": ("an OBJ file", read_exchange),
        ".ply": ("a PLY file", read_exchange),
        ".stl": ("an STL file", read_exchange),
        ".tab": ("a plate table", read_text),
        ".plt": ("a plate table", read_plate_table),
        ".txt": ("a plate table", read_text),
        ".icq": ("an ICQ model", read_icq),
        ".bds": ("a DSK file", read_dsk),
        ".dsk": ("a DSK file", read_dsk),
        ".npz": ("a shape archive", read_npz),
    }
)
"""Name and reader of each format, by the end of the file name."""

DSK_SUFFIXES = (".bds", ".dsk")

WRITERS: Mapping[str, Callable[[Path, TriangleMesh], None]] = MappingProxyType(
    {
        ".obj": write_obj,
        ".ply": write_ply,
        ".stl": write_stl,
        ".tab": write_plate_table,
        ".plt": write_plate_table,
        ".txt": write_icq,
        ".icq": write_icq,
        ".npz": write_npz,
    }
)
"""Writer of each format, by the end of the file name; a DSK needs its identity as well."""


def read_file(path: Path) -> Surface:
    """Read a shape file as it is.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Surface
        In the unit of the file.

    Raises
    ------
    InputError
        The file type is not known.
    DataError
        The file is missing or damaged.
    """
    known = READERS.get(path.suffix.lower())
    if known is None:
        raise InputError(f"{path}: shape files end in {', '.join(sorted(READERS))}, not {path.suffix!r}")
    what, read = known

    @reads(what)
    def surface_of(path: Path) -> Surface:
        if path.stat().st_size == 0:
            raise ValueError("the file is empty")
        return read(path)

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return surface_of(path)
