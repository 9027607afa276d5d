"""Numpy archives of shapes: read as fast as the disk gives them, without pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.archives import array_of, open_archive_of_arrays, single_value, unpacked_sizes
from giantlike.shapes.albedo import FacetAlbedo, VertexAlbedo
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface

_FORMAT, _VERSION = "giantlike shape", 1
_SMALL_BYTES = 100_000_000  # arrays of this size are read at any size of the file
_MOST_COMPRESSION = 100  # arrays over file: meshes and heights are compressed to a half to a tenth
_ALBEDO = {"albedo_by_vertex": VertexAlbedo, "albedo_by_facet": FacetAlbedo}


def archive_arrays(path: Path, form: str, version: int) -> Mapping[str, NDArray[Any]]:
    """Read all arrays of a numpy archive that has a format and a version."""
    with path.open("rb") as file, open_archive_of_arrays(file) as archive:
        needed = sum(unpacked_sizes(archive).values())
        if needed > max(_SMALL_BYTES, _MOST_COMPRESSION * path.stat().st_size):
            raise ValueError(f"its arrays would take {needed / 1e6:.0f} MB, too much for a file of its size")
        if "format" not in archive or single_value(archive, "format", "U") != form:
            raise ValueError(f"the archive holds no {form.removeprefix('giantlike ')}")
        if (found := single_value(archive, "version", "iu")) != version:
            raise ValueError(f"needed version {version} of the format, got {found}: update giantlike")
        return {name: array_of(archive, name) for name in archive.files}


def read_npz(path: Path) -> Surface:
    """Read an archive of :func:`write_npz`: vertices in km to the last bit, faces, and albedo if there is one."""
    arrays = archive_arrays(path, _FORMAT, _VERSION)
    if (units := single_value(arrays, "units", "U")) != "km":
        raise ValueError(f"needed vertices in km, got {units!r}")
    vertices, faces = arrays["vertices"], arrays["faces"]
    if vertices.dtype != np.float64 or faces.dtype.kind not in "ui":
        raise ValueError(f"needed float64 vertices and whole faces, got {vertices.dtype} and {faces.dtype}")
    albedo = next((kind(arrays[name]) for name, kind in _ALBEDO.items() if name in arrays), None)
    return Surface(vertices=vertices, faces=faces.astype(np.int64), in_km=True, albedo=albedo)


def write_npz(path: Path, mesh: TriangleMesh) -> None:
    """Write vertices (km, float64), faces, name, and albedo by facet or by vertex."""
    faces = mesh.faces.astype(np.uint32) if len(mesh.vertices_km) <= np.iinfo(np.uint32).max else mesh.faces
    arrays: dict[str, NDArray[Any]] = {"vertices": mesh.vertices_km, "faces": faces}
    if isinstance(mesh.albedo, VertexAlbedo | FacetAlbedo):
        arrays |= {name: mesh.albedo.values for name, kind in _ALBEDO.items() if isinstance(mesh.albedo, kind)}
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, format=_FORMAT, version=_VERSION, units="km", name=mesh.name, **arrays)
