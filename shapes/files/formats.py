"""Which format a shape file has, and one kind of error whatever the parser stumbles over."""

from __future__ import annotations

import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from giantlike.core.errors import DataError, InputError, OpNavError
from giantlike.shapes.files.dsk import read_dsk
from giantlike.shapes.files.exchange import read_exchange, write_obj, write_stl
from giantlike.shapes.files.icq import is_icq, read_icq, write_icq
from giantlike.shapes.files.npz import read_npz, write_npz
from giantlike.shapes.files.plate_table import read_plate_table, write_plate_table
from giantlike.shapes.files.ply import write_ply
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface

_PARSER_ERRORS = (
    ValueError, LookupError, TypeError, AttributeError, EOFError, NotImplementedError, AssertionError, ArithmeticError,
    NameError, MemoryError, RecursionError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def read_text(path: Path) -> Surface:
    """Read a text file that is either an ICQ model or a plate table."""
    return read_icq(path) if is_icq(path) else read_plate_table(path)


READERS: Mapping[str, tuple[str, Callable[[Path], Surface]]] = MappingProxyType(
    {
        ".obj": ("OBJ file", read_exchange),
        ".ply": ("PLY file", read_exchange),
        ".stl": ("STL file", read_exchange),
        ".tab": ("plate table", read_text),
        ".plt": ("plate table", read_plate_table),
        ".txt": ("plate table", read_text),
        ".icq": ("ICQ model", read_icq),
        ".bds": ("DSK file", read_dsk),
        ".dsk": ("DSK file", read_dsk),
        ".npz": ("shape archive", read_npz),
    }
)
"""What a file is called and who reads it, by the end of its name."""

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
"""Who writes a file, by the end of its name; a DSK needs its identity as well."""


def read_file(path: Path) -> Surface:
    """Read a shape file as it is.

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
    try:
        if path.stat().st_size == 0:
            raise DataError(path, "the shape file is empty")
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return read(path)
    except OpNavError:
        raise
    except OSError as error:
        raise DataError(path, f"cannot read the shape file: {error.strerror or error}") from error
    except _PARSER_ERRORS as error:
        text = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(path, f"damaged {what}: {text}") from error
