"""Shape models of every format as one mesh in km."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from giantlike._system.reading import file_sha256
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.shapes.files.formats import read_file
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface

_KM_PER_UNIT = {"km": 1.0, "m": 1e-3}
_MAX_OPENNESS = 0.01  # sum of the area vectors over the area: a flat hole of 1 % of the area gives this
_SURELY_KM, _SURELY_M = 30.0, 3000.0
"""A radius below the first is taken as km, above the second as m: between them are Bennu, 290 m, and Vesta, 290 km."""
_LARGEST_KM = 1e30  # far beyond any body, far below where sixth powers overflow


class UnitsWarning(UserWarning):
    """The unit of a shape file was guessed from the size of the body."""


def load_shape(path: str | Path, *, units: str = "km") -> TriangleMesh:
    """Read a closed triangle mesh.

    Parameters
    ----------
    path : path-like
        ``.obj``, ``.ply``, ``.stl``; plate tables ``.tab``, ``.plt``, ``.txt``; ICQ models of stereophotoclinometry
        ``.icq``, ``.txt``, ``.tab``; SPICE DSK type 2 ``.bds``, ``.dsk``; archives ``.npz`` of :func:`save_shape`.
    units : {"km", "m", "auto"}
        Unit of the coordinates in the file; a DSK and an ``.npz`` are always in km. ``auto`` takes a largest radius
        below 30 as km and one above 3000 as m, and warns; it refuses values in between, where both exist (Bennu is
        290 m, Vesta 290 km).

    Returns
    -------
    TriangleMesh
        In km, with the name and the SHA-256 of the file; coincident vertices are merged, facets without area dropped
        and normals turned outward. For other defects see :func:`~giantlike.shapes.defects.defects_of`.

    Raises
    ------
    InputError
        ``units`` or the file type is not known.
    DataError
        The file is missing, damaged, holds no facets or a surface that is not closed, or ``auto`` cannot decide.

    Warns
    -----
    UnitsWarning
        ``auto`` took a unit.

    Notes
    -----
    A plate table holds either ``v x y z`` and ``f i j k`` rows, or counts, vertex rows and plate rows, each with
    or without a leading row number. Indices from 0 and from 1 are distinguished. Quadrilaterals are split.
    """
    return mesh_of(path, read_surface(path, units=units))


def read_surface(path: str | Path, *, units: str = "km") -> Surface:
    """Read the surface of a shape file, as :func:`load_shape`, however broken, in km: for a look and for repair."""
    path = Path(path)
    require(units in ("km", "m", "auto"), f"units must be km, m or auto, got {units!r}")
    surface = read_file(path)
    if surface.in_km:
        return surface
    if units == "auto":
        units, remark = guessed_units(path, surface)
        warnings.warn(remark, UnitsWarning, stacklevel=3)
    factor = _KM_PER_UNIT[units]
    return replace(surface, vertices=surface.vertices if factor == 1.0 else surface.vertices * factor, in_km=True)


def mesh_of(path: str | Path, surface: Surface) -> TriangleMesh:
    """Make a closed mesh of a surface that was read from a file."""
    path = Path(path)
    largest = float(np.abs(surface.vertices[surface.finite_vertices]).max(initial=0.0))
    if largest > _LARGEST_KM:
        raise DataError(path, f"not a usable triangle mesh: it has coordinates of {largest:.3g} km")
    if surface.faces.size and surface.valid_faces.all() and surface.finite_vertices.all():
        surface = surface.merge_vertices()
    try:
        mesh = TriangleMesh(surface.vertices, surface.faces, path.stem, file_sha256(path), surface.albedo)
    except InputError as error:
        raise DataError(path, f"not a usable triangle mesh: {error}") from error
    if mesh.openness > _MAX_OPENNESS:
        raise DataError(
            path,
            f"the surface is not closed (its area vectors sum to {mesh.openness:.0%} of its area): "
            "facets are missing; is the file cut short?",
        )
    return mesh


def guessed_units(path: Path, surface: Surface) -> tuple[str, str]:
    """Guess the unit of a file from its largest finite radius."""
    radius = float(np.linalg.norm(surface.vertices[surface.finite_vertices], axis=1).max(initial=0.0))
    if _SURELY_KM < radius < _SURELY_M:
        raise DataError(path, f'a largest radius of {radius:.4g} can be km or m: state units = "km" or "m"')
    units = "km" if radius <= _SURELY_KM else "m"
    remark = f"{path}: took the coordinates as {units}, for a largest radius of {radius:.4g}; state units to be sure"
    return units, remark
