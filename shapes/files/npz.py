"""The compact binary form: a numpy archive that is read as fast as the disk gives it, without pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from giantlike.shapes.albedo import FacetAlbedo, VertexAlbedo
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface

_FORMAT, _VERSION = "giantlike shape", 1
_BY_VERTEX, _BY_FACET = "albedo_by_vertex", "albedo_by_facet"


def read_npz(path: Path) -> Surface:
    """Read what :func:`write_npz` wrote: vertices in km to the last bit, faces, and albedo if there is one.

    Raises
    ------
    ValueError, KeyError and what else a damaged archive gives
        The file is damaged, no shape, or of a later version.
    """
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        if "format" not in archive or str(archive["format"]) != _FORMAT:
            raise ValueError("the archive holds no shape")
        if (version := int(archive["version"])) != _VERSION:
            raise ValueError(f"needed version {_VERSION} of the format, got {version}: update giantlike")
        if (units := str(archive["units"])) != "km":
            raise ValueError(f"needed vertices in km, got {units!r}")
        vertices, faces = archive["vertices"], archive["faces"]
        if vertices.dtype != np.float64 or faces.dtype.kind not in "ui":
            raise ValueError(f"needed float64 vertices and whole faces, got {vertices.dtype} and {faces.dtype}")
        albedo: VertexAlbedo | FacetAlbedo | None = None
        if _BY_VERTEX in archive:
            albedo = VertexAlbedo(archive[_BY_VERTEX])
        elif _BY_FACET in archive:
            albedo = FacetAlbedo(archive[_BY_FACET])
    return Surface(vertices=vertices, faces=faces.astype(np.int64), in_km=True, albedo=albedo)


def write_npz(path: Path, mesh: TriangleMesh) -> None:
    """Write vertices (km, float64), faces, name, and albedo by facet or by vertex."""
    arrays: dict[str, Any] = {"vertices": mesh.vertices_km, "faces": mesh.faces}
    if len(mesh.vertices_km) <= np.iinfo(np.uint32).max:
        arrays["faces"] = mesh.faces.astype(np.uint32)
    if isinstance(mesh.albedo, VertexAlbedo):
        arrays[_BY_VERTEX] = mesh.albedo.values
    elif isinstance(mesh.albedo, FacetAlbedo):
        arrays[_BY_FACET] = mesh.albedo.values
    with path.open("wb") as file:
        np.savez(file, format=_FORMAT, version=_VERSION, units="km", name=mesh.name, **arrays)
