"""Shape models written to files: the whole file or none, and never over another one unasked."""

from __future__ import annotations

from pathlib import Path

from giantlike._system.atomic import replacing
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.shapes.files.dsk import DskIdentity, write_dsk
from giantlike.shapes.files.formats import format_of
from giantlike.shapes.mesh import TriangleMesh


def save_shape(
    mesh: TriangleMesh, path: str | Path, *, overwrite: bool = False, dsk: DskIdentity | None = None
) -> None:
    """Write a mesh in km, in the format that belongs to the end of the file name.

    Parameters
    ----------
    mesh : TriangleMesh
    path : path-like
        ``.obj``, ``.ply``, ``.tab`` or ``.plt`` (plate table) and ``.npz`` keep float64 to the last bit, ``.stl`` is
        single precision. ``.icq`` and ``.txt`` (ICQ model) take only a mesh that is connected as one. ``.bds`` and
        ``.dsk`` need ``dsk``. Albedo by facet and by vertex is kept in ``.npz``, by vertex in an ICQ model, and
        nowhere else.
    overwrite : bool; True to replace an existing file
    dsk : DskIdentity, optional; body, frame and surface that a DSK must name

    Raises
    ------
    InputError
        The file type is not known or cannot hold this mesh, the file exists, or ``dsk`` is missing.
    DataError
        The file system refused the write.
    """
    path = Path(path)
    writer = format_of(path).write
    require(overwrite or not path.exists(), f"{path} exists: name another file, or allow overwriting (--overwrite)")
    with replacing(path) as part:
        if writer is not None:
            writer(part, mesh)
        elif dsk is not None:
            write_dsk(part, mesh, dsk)
        else:
            raise InputError(f"{path}: a DSK must say which body and frame it describes: give both")


def keeps_albedo(mesh: TriangleMesh, path: str | Path) -> bool:
    """Return True if :func:`save_shape` writes all of the albedo in the format of a file."""
    return mesh.albedo is None or isinstance(mesh.albedo, format_of(Path(path)).albedo)
