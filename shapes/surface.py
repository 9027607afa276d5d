"""Surfaces as files hold them: vertices not yet merged, facets not yet dropped, reversed or checked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.values import Value
from giantlike.shapes.albedo import FacetAlbedo, VertexAlbedo
from giantlike.shapes.mesh import Faces


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface(Value):
    """Vertices and triangles that may be broken in any way, to be looked at or repaired."""

    vertices: Float  # (n, 3); body axes, in the unit of the file or in km, as the function that returns it says
    faces: Faces  # (m, 3); corners of each triangle, from 0; may point at vertices that do not exist
    in_km: bool = False  # True if the vertices are known to be in km
    albedo: VertexAlbedo | FacetAlbedo | None = None  # relative albedo, where the file has one

    def __post_init__(self) -> None:
        for name, array in (("vertices", self.vertices), ("faces", self.faces)):
            require(array.ndim == 2 and array.shape[1] == 3, f"{name} must have shape (n, 3), got {array.shape}")
        if self.albedo is not None:
            by, needed = (
                ("vertex", len(self.vertices)) if isinstance(self.albedo, VertexAlbedo) else ("facet", len(self.faces))
            )
            have = len(self.albedo.values)
            require(have == needed, f"albedo by {by} must have {needed} values, got {have}")
        Value.__post_init__(self)

    def kept(self, vertices: Mask, faces: Mask) -> Surface:
        """Return the surface of some of the vertices and facets, renumbered. ``vertices`` (n,); ``faces`` (m,)."""
        number = np.cumsum(vertices) - 1
        chosen = vertices if isinstance(self.albedo, VertexAlbedo) else faces
        albedo = None if self.albedo is None else type(self.albedo)(self.albedo.values[chosen])
        return Surface(
            vertices=self.vertices[vertices], faces=number[self.faces[faces]], in_km=self.in_km, albedo=albedo
        )

    def merge_vertices(self, distance: float = 0.0) -> Surface:
        """Merge vertices to the first of each cluster; all faces must be valid."""
        names = coincident_names(self.vertices) if distance == 0.0 else close_names(self.vertices, distance)
        first = names == np.arange(len(names))
        if first.all():
            return self
        return replace(self, faces=names[self.faces]).kept(first, np.ones(len(self.faces), dtype=bool))

    @property
    def finite_vertices(self) -> Mask:
        """Mask (n,) of the vertices with three finite coordinates."""
        return np.asarray(np.isfinite(np.abs(self.vertices).max(axis=1)))

    @property
    def valid_faces(self) -> Mask:
        """Mask (m,) of the facets with three vertices that exist and are finite."""
        valid: Mask = (self.faces.min(axis=1) >= 0) & (self.faces.max(axis=1) < len(self.vertices))
        finite = self.finite_vertices
        if not finite.all():
            for corner in range(3):
                valid[valid] = finite[self.faces[valid, corner]]
        return valid


def split_polygons(corners: Faces) -> Faces:
    """Split quadrilaterals (m, 4), or triangles with -1 in the last column, into triangles (k, 3), in order."""
    if corners.shape[1] == 3:
        return corners
    pairs = np.stack([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]], axis=1)
    wanted = np.stack([np.ones(len(corners), dtype=bool), corners[:, 3] != -1], axis=1)
    return np.asarray(pairs[wanted])


def coincident_names(vertices: Float) -> Faces:
    """Number (n,) of the first vertex with equal coordinates, for each vertex (n, 3); NaN equals nothing."""
    order = np.lexsort(vertices.T)  # stable: the first of equals stays first
    ordered = vertices[order]
    new = np.ones(len(vertices), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    names = np.empty(len(vertices), dtype=np.int64)
    names[order] = order[np.maximum.accumulate(np.where(new, np.arange(len(vertices)), 0))]
    return names


def close_names(vertices: Float, distance: float) -> Faces:
    """Number of the first vertex that a chain of short steps reaches, for each vertex."""
    pairs = cKDTree(vertices).query_pairs(distance, output_type="ndarray")
    labels = connected_labels(len(vertices), pairs[:, 0], pairs[:, 1])
    first = np.full(labels.max(initial=-1) + 1, len(vertices))
    np.minimum.at(first, labels, np.arange(len(vertices)))
    return np.asarray(first[labels])


def connected_labels(count: int, first: Faces, second: Faces) -> Faces:
    """Label the connected components of a graph. ``first``, ``second`` (p,); returns (count,)."""
    graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
