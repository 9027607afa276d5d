"""Decimation of meshes, and the distances between two surfaces of one body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.shapes.defects import Defects, defects_of
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.surface import Surface

_MIN_FACETS = 4  # a tetrahedron
_MAX_SAMPLES = 20_000  # vertices of each mesh; their largest distance approximates the largest of all
_CANDIDATES = 24  # facets nearest by centroid among which the nearest by distance is searched
_HASTES = (7, 6, 5, 8)
"""Aggressiveness of fast-simplification (7 is its default): a surface torn at one can stay whole at another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Deviation:
    """Distances between two surfaces of one body."""

    rms_km: float  # rms_km, max_km: of the vertices of each surface from the other; the larger one is Hausdorff's
    max_km: float
    volume_change: float  # volume of the second / volume of the first, minus 1


def decimate_mesh(mesh: TriangleMesh, facets: int) -> TriangleMesh:
    """Merge edges of a mesh, least harm first, until ``facets`` facets are left.

    The work is done by the package fast-simplification (MIT license), which wraps the C++ code
    Fast-Quadric-Mesh-Simplification. A convex body loses volume, for the new vertices lie on the old surface.
    """
    require(
        _MIN_FACETS <= facets < len(mesh.faces),
        f"facets must be in [{_MIN_FACETS}, {len(mesh.faces) - 1}] for {mesh.name!r}, got {facets}",
    )
    before = defects_of(Surface(vertices=mesh.vertices_km, faces=mesh.faces))
    if not _is_closed(before):
        raise InputError(f"{mesh.name!r} is not closed ({before.text()}): repair it first")
    import fast_simplification

    for haste in _HASTES:
        vertices, faces = fast_simplification.simplify(
            mesh.vertices_km.copy(), mesh.faces.copy(), target_count=facets, agg=haste
        )
        surface = Surface(vertices=np.asarray(vertices, dtype=np.float64), faces=np.asarray(faces, dtype=np.int64))
        after = defects_of(surface)
        if _is_closed(after) and len(surface.faces) <= facets:
            return TriangleMesh(surface.vertices, surface.faces, mesh.name)
    raise InputError(
        f"{mesh.name!r} does not survive the reduction to {facets} facets ({after.text()}): ask for another number"
    )


def _is_closed(found: Defects) -> bool:
    return not (found.boundary_edges or found.inconsistent_edges)


def deviation(first: TriangleMesh, second: TriangleMesh, *, samples: int = _MAX_SAMPLES) -> Deviation:
    """Compare two meshes of one body by the distances of their vertices from the other surface."""
    require(samples >= 1, f"samples must be >= 1, got {samples}")
    distances = np.concatenate(
        [
            surface_distances(there, _spread(here.vertices_km[np.unique(here.faces)], samples))
            for here, there in ((first, second), (second, first))
        ]
    )
    return Deviation(
        rms_km=float(np.sqrt(np.mean(distances**2))),
        max_km=float(distances.max()),
        volume_change=second.volume_km3 / first.volume_km3 - 1.0,
    )


def surface_distances(mesh: TriangleMesh, points_body_km: Float) -> Float:
    """Distances of points from the surface of a mesh.

    ``points_body_km`` (n, 3); returns (n,) km.

    The nearest of the 24 facets with the nearest centroids: exact for facets of similar size, never too small.
    """
    centroids = mesh.vertices_km[mesh.faces].mean(axis=1)
    count = min(_CANDIDATES, len(mesh.faces))
    _, nearest = cKDTree(centroids).query(points_body_km, k=count)
    nearest = nearest.reshape(len(points_body_km), count)
    best = np.full(len(points_body_km), np.inf)
    for k in range(count):
        corners = mesh.vertices_km[mesh.faces[nearest[:, k]]]
        np.minimum(best, _triangle_distances(points_body_km, corners, mesh.normals[nearest[:, k]]), out=best)
    return best


def _spread(points: Float, samples: int) -> Float:
    return points[np.unique(np.linspace(0, len(points) - 1, min(samples, len(points))).astype(np.int64))]


def _triangle_distances(points: Float, corners: Float, normals: Float) -> Float:
    """Distances (n,) of points (n, 3) from one triangle each (n, 3, 3): over its face, else from the nearest side."""
    best = np.full(len(points), np.inf)
    inside = np.ones(len(points), dtype=bool)
    for k in range(3):
        start, side = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        offset = points - start
        along = np.einsum("ij,ij->i", offset, side) / np.einsum("ij,ij->i", side, side)
        np.minimum(best, np.linalg.norm(offset - np.clip(along, 0.0, 1.0)[:, None] * side, axis=1), out=best)
        inside &= np.einsum("ij,ij->i", np.cross(side, offset), normals) >= 0.0
    height = np.abs(np.einsum("ij,ij->i", points - corners[:, 0], normals))
    return np.where(inside, height, best)
