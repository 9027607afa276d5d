"""Facets at the silhouette of a mesh, and their edges: compiled, facet by facet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Indices, Mask

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

    ``normals`` (m, 3), ``offsets_km`` (m,); ``rough_normals`` (3, m), ``rough_offsets_km`` (m,), the same in single
    precision; ``rough_limits_km`` (m,); returns ``near`` (k,) and ``front`` (k,).
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

    ``faces`` (m, 3); ``near`` (k,), ``front`` (k,); ``border_vertices`` (b,); returns ``edges`` (e, 2), ``facets`` (e,)
    and ``front`` (e,).
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
