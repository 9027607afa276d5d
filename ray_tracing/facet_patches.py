"""Facets of a mesh in patches of neighbors, so that those in a part of an image are found without a look at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.compiled import compiled
from giantlike.core.values import Value
from giantlike.ray_tracing.embree import Float32, Int32

Indices = NDArray[np.int64]

_FACETS = 64
"""Facets of a patch, six or so to a side. With 128 a sixth more facets along a band are looked at, with 32 a seventh
less, but finding the patches then takes as long."""
_CURVE_BITS = 10
"""Steps along each axis, as powers of two, of the curve that puts facets in order."""


@dataclass(frozen=True, slots=True, eq=False)
class Patches(Value):
    """Facets of a mesh in groups of neighbors.

    Parameters
    ----------
    facets : (m,) int32
        Patch by patch.
    planes : (m, 4) float32
        Their outward normals and the distances of their planes from the origin, km.
    starts : (p + 1,) int64
        Where each patch begins among these.
    centers_km : (p, 3) float64, km, body axes
    radii_km : (p,) float64, km
        Of spheres about these that hold the patches.
    """

    facets: Int32
    planes: Float32
    starts: Indices
    centers_km: Float
    radii_km: Float

    @classmethod
    def of(cls, vertices_km: Float, faces: Indices, normals: Float, offsets_km: Float) -> Patches:
        """Group facets along a curve that fills space: neighbors on it are neighbors on the surface.

        Parameters
        ----------
        vertices_km : (n, 3) float64, km, body axes
        faces : (m, 3) int64
        normals, offsets_km : (m, 3), (m,) float64
            Planes of the facets.

        Returns
        -------
        Patches
        """
        middles = np.stack([vertices_km[:, axis][faces].mean(axis=1) for axis in range(3)], axis=-1)
        facets = np.argsort(_along_curve(middles), kind="stable")
        first = np.arange(0, len(faces), _FACETS)
        starts = np.append(first, len(faces))
        count = np.diff(starts)
        centers = np.add.reduceat(middles[facets], first, axis=0) / count[:, None]
        around, square = np.repeat(centers, count, axis=0), np.zeros(len(faces))
        for corner in range(3):
            apart = vertices_km[faces[facets, corner]] - around
            np.maximum(square, np.einsum("ij,ij->i", apart, apart), out=square)
        planes = np.empty((len(faces), 4), np.float32)
        planes[:, :3], planes[:, 3] = normals[facets], offsets_km[facets]
        return cls(facets.astype(np.int32), planes, starts, centers, np.sqrt(np.maximum.reduceat(square, first)))

    def facing(self, camera_body_km: Float, patches: Indices) -> Int32:
        """Return the facets (k,) of some patches (q,) that face the camera, good to where rounding sees them edge-on.

        Parameters
        ----------
        camera_body_km : (3,) float64, km, body axes
        patches : (q,) int64

        Returns
        -------
        (k,) int32
        """
        return _facing(np.array(camera_body_km), self.planes, self.facets, self.starts, patches)


def _along_curve(points: Float) -> Indices:
    """Numbers (n,) of points (n, 3) along a curve that fills their box: bits of their coordinates by turns."""
    low, extent = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-300)
    place = ((points - low) / extent * (2**_CURVE_BITS - 1)).astype(np.int64)
    number = np.zeros(len(points), np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            number |= ((place[:, axis] >> bit) & 1) << (3 * bit + axis)
    return number


@compiled
def _facing(camera_body_km: Float, planes: Float32, facets: Int32, starts: Indices, patches: Indices) -> Int32:
    """List the facets of some patches that face a camera."""
    most = 0
    for patch in patches:
        most += starts[patch + 1] - starts[patch]
    found, count = np.empty(most, np.int32), 0
    x, y, z = np.float32(camera_body_km[0]), np.float32(camera_body_km[1]), np.float32(camera_body_km[2])
    for patch in patches:
        for at in range(starts[patch], starts[patch + 1]):
            found[count] = facets[at]
            if x * planes[at, 0] + y * planes[at, 1] + z * planes[at, 2] > planes[at, 3]:
                count += 1
    return found[:count].copy()


@compiled
def corners_of(faces: Indices, facets: Int32, vertex_count: int) -> tuple[Indices, Int32]:
    """List the vertices of some facets, each once.

    Parameters
    ----------
    faces : (m, 3) int64
    facets : (k,) int32
    vertex_count : int

    Returns
    -------
    vertices : (n,) int64
    corners : (k, 3) int32
        Numbers of the corners of each facet among these.
    """
    number = np.full(vertex_count, -1, np.int32)
    vertices, corners, count = np.empty(3 * len(facets), np.int64), np.empty((len(facets), 3), np.int32), 0
    for i in range(len(facets)):
        for corner in range(3):
            vertex = faces[facets[i], corner]
            if number[vertex] < 0:
                number[vertex] = count
                vertices[count] = vertex
                count += 1
            corners[i, corner] = number[vertex]
    return vertices[:count].copy(), corners
