"""Intel Embree through embreex, called directly: the one module that knows its traps.

Rays are float32; ``tnear`` is 0; shapes are not checked by Embree and an occlusion query has no useful
output but its answer (0 = blocked, -1 = clear).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeTriangles
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from giantlike.core.arrays import Float, require

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]


class EmbreeSurface:
    """Triangles in an Embree scene; the BVH is built here, so that queries may come from several threads.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int64
        Checked by whoever made the mesh: Embree reads out of bounds without a word.
    """

    def __init__(self, vertices: Float, faces: NDArray[np.int64]) -> None:
        self._scene = EmbreeScene(robust=True)
        triangles = (np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))
        self._triangles = EmbreeTriangles(self._scene, *triangles)
        self._run: Callable[..., Any] = self._scene.run
        self.first_hit(np.zeros((1, 3), np.float32), np.array([[0.0, 0.0, 1.0]], np.float32))

    def first_hit(self, origins: Float32, directions: Float32) -> tuple[Int32, Float32]:
        """Facet (n,), -1 for none, and distance (n,) in units of the direction's length, of rays (n, 3)."""
        if len(_checked(origins, directions)) == 0:
            return np.zeros(0, np.int32), np.zeros(0, np.float32)
        answer = self._run(origins, directions, query="INTERSECT", output=True)
        return answer["primID"], answer["tfar"]

    def occluded(self, origins: Float32, directions: Float32) -> NDArray[np.bool_]:
        """Whether anything lies on each ray (n, 3), however far."""
        if len(_checked(origins, directions)) == 0:
            return np.zeros(0, bool)
        blocked: NDArray[np.bool_] = self._run(origins, directions, query="OCCLUDED") == 0
        return blocked


def _checked(origins: Float32, directions: Float32) -> Float32:
    for name, rays in (("origins", origins), ("directions", directions)):
        require(
            rays.dtype == np.float32 and rays.ndim == 2 and rays.shape == (len(origins), 3) and rays.flags.c_contiguous,
            f"Embree needs contiguous float32 {name} (n, 3), got {rays.dtype} {rays.shape}",
        )
    return origins
