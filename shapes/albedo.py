"""Relative albedo of a surface: by facet, by vertex, or from a map of longitude and latitude.

Relative albedo multiplies the value of the reflectance law: 1 leaves it as it is, 0 is black.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Float, Indices, Mask, as_finite, as_floats, require
from giantlike.core.documented import documented_by
from giantlike.core.errors import InputError
from giantlike.core.values import Value

Faces = NDArray[np.int64]

_POLE_RAD = 1e-9  # an edge of a map this close to a pole, or to a full turn, is there: rounding of degrees to radians


@runtime_checkable
class Albedo(Protocol):
    """Relative albedo over the surface of a shape; an immutable value."""

    @property
    def sha256(self) -> str:
        """Hash of the numbers that define it; hexadecimal."""
        ...

    def at(self, points_body_km: Float, facets: Indices, barycentric: Float | None) -> Float:
        """Relative albedo (n,) at points (n, 3) of the surface, km, body axes.

        ``facets`` (n,), that the points lie on, 0 on an ellipsoid; ``barycentric`` (n, 3), weights of the three corners
        of those facets, as ``TriangleMesh.barycentric`` gives them: only albedo by vertex reads them, and refuses None.
        """
        ...


@documented_by(Albedo)
@dataclass(frozen=True, slots=True, eq=False)
class FacetAlbedo(Value):
    """One relative albedo for each facet of a mesh.

    Parameters
    ----------
    values : (m,) float64; in the order of the facets that the mesh is made from

    Raises
    ------
    InputError
        A value is negative or not finite.
    """

    values: Float
    sha256: str = field(init=False)

    def __post_init__(self) -> None:
        values = _check_values(self.values, 1)
        self._keep(values=values, sha256=_hash("facets", values))

    def at(self, points_body_km: Float, facets: Indices, barycentric: Float | None) -> Float:
        return np.asarray(self.values[facets])


@dataclass(frozen=True, slots=True, eq=False)
class VertexAlbedo(Value):
    """A relative albedo for each vertex of a mesh, linear over each facet.

    Parameters
    ----------
    values : (n,) float64; in the order of the vertices
    faces : (m, 3) int64, optional; the facets of the mesh; filled in by the mesh that takes this albedo

    Raises
    ------
    InputError
        A value is negative or not finite.
    """

    values: Float
    faces: Faces | None = None
    sha256: str = field(init=False)

    def __post_init__(self) -> None:
        values = _check_values(self.values, 1)
        self._keep(values=values, sha256=_hash("vertices", values))

    def at(self, points_body_km: Float, facets: Indices, barycentric: Float | None) -> Float:
        """Relative albedo (n,) interpolated between the corners of the facets.

        Raises InputError where the facets of the mesh, or ``barycentric``, are missing.
        """
        if self.faces is None or barycentric is None:
            missing = "the facets of its mesh: use mesh.with_albedo(...)" if self.faces is None else "barycentric"
            raise InputError(f"albedo by vertex needs {missing}")
        return np.asarray(np.einsum("nc,nc->n", barycentric, self.values[self.faces[facets]]))


@documented_by(Albedo)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlbedoMap(Value):
    """A map of relative albedo over longitude and planetocentric latitude, simple cylindrical.

    Parameters
    ----------
    values : (rows, columns) float64; values at the centers of the map's pixels, interpolated bilinearly
    longitude_edges_rad : (float, float), rad
        East longitudes of the outer edges of the first and the last column; decreasing for a map that counts west.
        A full turn wraps around.
    latitude_edges_rad : (float, float), rad
        Latitudes of the outer edges of the first and the last row. A row that ends at a pole goes over into its
        mean there, so that the pole has one value.
    outside : float; relative albedo where the map has none
    center_body_km : (3,) float64, km, body; where longitude and latitude are counted from

    Raises
    ------
    InputError
        A value is negative or not finite, or the edges leave the sphere.
    """

    values: Float
    longitude_edges_rad: tuple[float, float] = (0.0, 2.0 * math.pi)
    latitude_edges_rad: tuple[float, float] = (0.5 * math.pi, -0.5 * math.pi)
    outside: float = 1.0
    center_body_km: Float = field(default_factory=lambda: np.zeros(3))
    sha256: str = field(init=False)

    def __post_init__(self) -> None:
        values = _check_values(self.values, 2)
        west, east = (float(edge) for edge in self.longitude_edges_rad)
        first, last = (float(edge) for edge in self.latitude_edges_rad)
        turn = abs(east - west)
        require(
            0.0 < turn <= 2.0 * math.pi + _POLE_RAD,
            f"longitude_edges_rad must be apart, and not more than a turn, got {west} and {east}",
        )
        require(
            first != last and max(abs(first), abs(last)) <= 0.5 * math.pi + _POLE_RAD,
            f"latitude_edges_rad must differ and lie in [-pi/2, pi/2], got {first} and {last}",
        )
        require(0.0 <= self.outside < math.inf, f"outside must be finite and >= 0, got {self.outside}")
        center = as_finite(self.center_body_km, (3,), "center_body_km")
        self._keep(
            values=values,
            longitude_edges_rad=(west, east),
            latitude_edges_rad=(first, last),
            center_body_km=center,
            sha256=_hash("map", values, np.array([west, east, first, last, self.outside]), center),
        )

    def at(self, points_body_km: Float, facets: Indices, barycentric: Float | None) -> Float:
        x, y, z = np.moveaxis(as_floats(points_body_km, (3,), "points_body_km") - self.center_body_km, -1, 0)
        row, column, inside = self._place(np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)))
        rows, columns = self.values.shape
        upper, down = _neighbors(row, rows)
        if self._wraps:
            left = np.floor(column).astype(np.int64)
            right, across = (left + 1) % columns, column - left
            left %= columns
        else:
            left, across = _neighbors(column, columns)
            left, right = np.maximum(left, 0), np.minimum(left + 1, columns - 1)
        above, below = (
            (1.0 - across) * self._row_values(near, left) + across * self._row_values(near, right)
            for near in (upper, upper + 1)
        )
        return np.where(inside, (1.0 - down) * above + down * below, self.outside)

    def translated(self, offset_body_km: ArrayLike) -> AlbedoMap:
        """Return the map with an offset (3,), km, body axes, added to its center."""
        return replace(self, center_body_km=self.center_body_km + as_floats(offset_body_km, (3,), "offset_body_km"))

    @property
    def _wraps(self) -> bool:
        west, east = self.longitude_edges_rad
        return abs(east - west) >= 2.0 * math.pi - _POLE_RAD

    def _place(self, longitude_rad: Float, latitude_rad: Float) -> tuple[Float, Float, Mask]:
        """Row and column (n,), pixel centers at whole numbers, and whether the map is there."""
        west, east = self.longitude_edges_rad
        first, last = self.latitude_edges_rad
        rows, columns = self.values.shape
        along = ((longitude_rad - west) * math.copysign(1.0, east - west)) % (2.0 * math.pi) / abs(east - west)
        down = (latitude_rad - first) / (last - first)
        inside = (along <= 1.0) | self._wraps
        inside &= (down >= -_POLE_RAD) & (down <= 1.0 + _POLE_RAD)
        return np.clip(down, 0.0, 1.0) * rows - 0.5, along * columns - 0.5, inside

    def _row_values(self, row: Indices, column: Indices) -> Float:
        """Values (n,) of pixels; beyond the first and the last row the mean of it at a pole, else the row itself."""
        rows = len(self.values)
        found: Float = self.values[np.clip(row, 0, rows - 1), column].astype(np.float64)
        for beyond, edge, latitude in ((-1, 0, self.latitude_edges_rad[0]), (rows, -1, self.latitude_edges_rad[1])):
            if abs(abs(latitude) - 0.5 * math.pi) < _POLE_RAD:
                found = np.where(row == beyond, self.values[edge].mean(dtype=np.float64), found)
        return found


def fitted_to_mesh(albedo: Albedo, *, vertices: int, faces: Faces, kept: Mask) -> Albedo:
    """Fit an albedo to the facets that a mesh keeps of those that it was made from. ``faces`` (m, 3); ``kept`` (k,)."""
    if isinstance(albedo, FacetAlbedo):
        count = len(albedo.values)
        require(count == len(kept), f"albedo by facet needs {len(kept)} values, one for each facet, got {count}")
        return albedo if kept.all() else FacetAlbedo(albedo.values[kept])
    if isinstance(albedo, VertexAlbedo):
        count = len(albedo.values)
        require(count == vertices, f"albedo by vertex needs {vertices} values, one for each vertex, got {count}")
        return VertexAlbedo(albedo.values, faces)
    return albedo


def hash_with_albedo(surface_sha256: str, albedo: Albedo | None) -> str:
    """Combine the hashes of a surface and its albedo."""
    if albedo is None:
        return surface_sha256
    return hashlib.sha256(f"{surface_sha256} with albedo {albedo.sha256}".encode()).hexdigest()


def _check_values(values: ArrayLike, dimensions: int) -> Float:
    array = np.array(as_floats(values, (), "values"), order="C")
    shape = "(n,)" if dimensions == 1 else "(rows, columns)"
    require(array.ndim == dimensions and array.size > 0, f"albedo values must have shape {shape}, got {array.shape}")
    require(bool(np.isfinite(array).all() and array.min() >= 0.0), "albedo values must be finite and >= 0")
    return array


def _hash(kind: str, *arrays: Float) -> str:
    return hashlib.sha256(kind.encode() + b"".join(array.tobytes() for array in arrays)).hexdigest()


def _neighbors(place: Float, count: int) -> tuple[Indices, Float]:
    """Index (n,) of the sample at or before each position, -1 before the first, and the weight of the next.

    Samples lie at 0 to count - 1, and the edges, half a step beyond, at -0.5 and count - 0.5.
    """
    before = np.clip(np.floor(place), -1, count - 1).astype(np.int64)
    start = np.maximum(before, -0.5)
    stop = np.minimum(before + 1, count - 0.5)
    return before, (place - start) / (stop - start)
