"""Facets at the silhouette of a mesh, and their edges: compiled, facet by facet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.compiled import compiled

Indices = NDArray[np.int64]
Float32 = NDArray[np.float32]


@compiled
def near_silhouette(
    camera_body_km: Float,
    normals: Float,
    offsets_km: Float,
    rough_normals: Float32,
    rough_offsets_km: Float32,
    rough_limits_km: Float32,
) -> tuple[Indices, Mask]:
    """Find facets seen nearly edge-on.

    Parameters
    ----------
    camera_body_km : (3,) float64, km, body
    normals, offsets_km : (m, 3), (m,) float64
        Planes of the facets.
    rough_normals, rough_offsets_km : (3, m), (m,) float32
        The same in single precision.
    rough_limits_km : (m,) float32, km
        Height of the camera over a facet beyond which its neighbors face it alike.

    Returns
    -------
    near : (k,) int64
        Facets with the camera within these heights.
    front : (k,) bool
        Those that face the camera.
    """
    near, front, count = np.empty(len(offsets_km), np.int64), np.empty(len(offsets_km), np.bool_), 0
    x, y, z = np.float32(camera_body_km[0]), np.float32(camera_body_km[1]), np.float32(camera_body_km[2])
    for facet in range(len(offsets_km)):
        height = x * rough_normals[0, facet] + y * rough_normals[1, facet] + z * rough_normals[2, facet]
        if abs(height - rough_offsets_km[facet]) <= rough_limits_km[facet]:
            along = 0.0
            for axis in range(3):
                along += normals[facet, axis] * camera_body_km[axis]
            near[count], front[count] = facet, along > offsets_km[facet]
            count += 1
    return near[:count].copy(), front[:count].copy()


@compiled
def edges_between(
    faces: Indices, near: Indices, front: Mask, border_vertices: Indices, vertex_count: int
) -> tuple[Indices, Indices, Mask]:
    """List the edges of some facets whose two vertices lie on a border or on facets of either side.

    Parameters
    ----------
    faces : (m, 3) int64
        Vertices of all facets.
    near, front : (k,) int64, (k,) bool
        The facets, and those that face the camera.
    border_vertices : (b,) int64
    vertex_count : int

    Returns
    -------
    edges : (e, 2) int64
        Vertices, the smaller number first; an edge comes once for each of its facets.
    facets : (e,) int64
        Those that face the camera first.
    front : (e,) bool
    """
    sides = np.zeros(vertex_count, np.uint8)
    for i in range(len(near)):
        for corner in range(3):
            sides[faces[near[i], corner]] |= 1 if front[i] else 2
    for vertex in border_vertices:
        sides[vertex] = 3
    edges, facets, facing = np.empty((3 * len(near), 2), np.int64), np.empty(3 * len(near), np.int64), 0
    count = 0
    for side in (True, False):
        for i in range(len(near)):
            if front[i] != side:
                continue
            for corner in range(3):
                one, other = faces[near[i], corner], faces[near[i], (corner + 1) % 3]
                if sides[one] == 3 and sides[other] == 3:
                    edges[count, 0], edges[count, 1], facets[count] = min(one, other), max(one, other), near[i]
                    count += 1
        facing = count if side else facing
    return edges[:count].copy(), facets[:count].copy(), np.arange(count) < facing
