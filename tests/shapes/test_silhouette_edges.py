"""Silhouette edges, found by way of bounds on how the surface bends, are those that a look at every edge finds."""

import numpy as np
import pytest

from giantlike.core.arrays import Float
from giantlike.shapes import TriangleMesh, irregular_body
from giantlike.shapes.limbs import silhouette_edges

SMOOTH = irregular_body(1, facets=2000)
ROUGHNESS = 1.0 + 0.05 * np.random.default_rng(1).normal(size=len(SMOOTH.vertices_km))
ROUGH = TriangleMesh(SMOOTH.vertices_km * ROUGHNESS[:, None], SMOOTH.faces, "rough")
OPEN = TriangleMesh(ROUGH.vertices_km, ROUGH.faces[100:], "open")


def by_every_edge(mesh: TriangleMesh, camera_km: Float) -> set[tuple[int, int]]:
    """Edges between facets that face the camera and others that do not, and those of one facet."""
    front = mesh.normals @ camera_km > mesh.plane_offsets_km
    sides: dict[tuple[int, int], list[bool]] = {}
    for face, facing in zip(mesh.faces.tolist(), front.tolist(), strict=True):
        for corner in range(3):
            ends = sorted((face[corner], face[(corner + 1) % 3]))
            sides.setdefault((ends[0], ends[1]), []).append(facing)
    return {edge for edge, facing in sides.items() if len(facing) == 1 or len(set(facing)) == 2}


@pytest.mark.parametrize("mesh", [SMOOTH, ROUGH, OPEN], ids=lambda mesh: mesh.name)
@pytest.mark.parametrize("radii", [1.5, 20.0, 1e6])
def test_silhouette_edges_are_those_that_a_look_at_every_edge_finds(mesh: TriangleMesh, radii: float) -> None:
    toward = np.random.default_rng(int(radii)).normal(size=3)
    camera_km = radii * mesh.circumscribing_radius_km * toward / np.linalg.norm(toward)
    edges, facets = silhouette_edges(mesh, camera_km)
    assert {(int(a), int(b)) for a, b in edges} == by_every_edge(mesh, camera_km)
    assert all(set(edge) <= set(mesh.faces[facet]) for edge, facet in zip(edges, facets, strict=True))
