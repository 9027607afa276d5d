"""Intel Embree through embreex, called directly: the only module that depends on its peculiarities.

Rays are float32, of any strides; ``tnear`` is 0; shapes are not checked by Embree and an occlusion query has no
useful output but its answer (0 = blocked, -1 = clear).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeTriangles
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.errors import InputError

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Number = TypeVar("Number", np.float32, np.float64)

_ADDED_ROWS = 256  # rows added at a time, see moved
_BLAS_ROWS = 2048  # rows of four in a product: few enough that BLAS does not start its own threads


class EmbreeSurface:
    """Triangles in an Embree scene; the BVH is built here, so that queries may come from several threads."""

    def __init__(self, vertices: Float, faces: NDArray[np.int64]) -> None:
        self._scene = EmbreeScene(robust=True)
        triangles = (np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))
        self._triangles = EmbreeTriangles(self._scene, *triangles)
        self._run: Callable[..., Any] = self._scene.run
        self.first_hit(np.zeros((1, 3), np.float32), np.array([[0.0, 0.0, 1.0]], np.float32))

    def first_hit(self, origins: Float32, directions: Float32) -> tuple[Int32, Float32]:
        """Facet (n,), -1 for none, and distance (n,) in units of the direction's length, of rays (n, 3)."""
        if len(_check_rays(origins, directions)) == 0:
            return np.zeros(0, np.int32), np.zeros(0, np.float32)
        answer = self._run(origins, directions, query="INTERSECT", output=True)
        return answer["primID"], answer["tfar"]

    def first_hit_inside(self, origins: Float32, directions: Float32) -> tuple[Int32, Float32, Float32]:
        """Return :meth:`first_hit` and the least barycentric weight (n,) of each hit: 0 on an edge of its facet."""
        if len(_check_rays(origins, directions)) == 0:
            return np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros(0, np.float32)
        answer = self._run(origins, directions, query="INTERSECT", output=True)
        second, third = answer["u"], answer["v"]
        return answer["primID"], answer["tfar"], np.minimum(np.minimum(second, third), 1.0 - second - third)

    def is_occluded(self, origins: Float32, directions: Float32) -> Mask:
        """Return True (n,) where anything lies on a ray (n, 3), however far."""
        if len(_check_rays(origins, directions)) == 0:
            return np.zeros(0, bool)
        return np.asarray(self._run(origins, directions, query="OCCLUDED") == 0)


def pad_vectors(vectors: NDArray[np.floating]) -> Float32:
    """Vectors (n, 3) as float32 (n, 4), the fourth column 0: their rows move as one item of 16 bytes."""
    result = np.zeros((len(vectors), 4), np.float32)
    for axis in range(3):
        result[:, axis] = vectors[:, axis]
    return result


def rows_of(vectors: Float32, numbers: NDArray[np.integer]) -> Float32:
    """Rows (k, 4) of vectors (n, 4) from :func:`pad_vectors`; four times as fast as taking rows of three."""
    return vectors.view(np.complex128)[:, 0].take(numbers).view(np.float32).reshape(-1, 4)


def dot(vectors: NDArray[Number], others: NDArray[Number]) -> NDArray[Number]:
    """Scalar products (n,) of vectors (n, 4) with one other (4,) or as many (n, 4), fourth columns 0."""
    if others.ndim == 2:
        vectors, others = vectors * others, np.ones(4, vectors.dtype)
    products = np.empty(len(vectors), vectors.dtype)
    whole = len(vectors) // _BLAS_ROWS * _BLAS_ROWS
    np.matmul(vectors[:whole].reshape(-1, _BLAS_ROWS, 4), others, out=products[:whole].reshape(-1, _BLAS_ROWS))
    np.matmul(vectors[whole:], others, out=products[whole:])
    return products


def shift_points(points: Float, offset: Float) -> Float:
    """Points (n, 4) plus an offset (3,), in place and back; some hundred rows at a time: rows of four are slow."""
    whole = len(points) // _ADDED_ROWS * _ADDED_ROWS
    step = np.append(offset, 0.0)
    points[:whole].reshape(-1, 4 * _ADDED_ROWS)[:] += np.tile(step, _ADDED_ROWS)
    points[whole:] += step
    return points


def _check_rays(origins: Float32, directions: Float32) -> Float32:
    for rays in (origins, directions):
        if rays.dtype != np.float32 or rays.shape != (len(origins), 3):
            raise InputError(f"Embree needs float32 origins and directions (n, 3), got {rays.dtype} {rays.shape}")
    return origins
