"""Defects of a surface: holes, double facets, facets without area, wrong winding, stray vertices."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.shapes.mesh import FLAT, Faces
from giantlike.shapes.surface import Surface, coincident_names, connected_labels


@dataclass(frozen=True, slots=True, kw_only=True)
class Defects:
    """Numbers of the defects of a surface, by kind; all zero is a clean closed surface.

    Coincident vertices are merged before anything that has to do with edges is counted: they are the normal state
    of an STL file. Edges belong to the facets that remain without invalid, degenerate and duplicate ones.
    """

    nonfinite_vertices: int  # vertices with a coordinate that is NaN or infinite
    unreferenced_vertices: int  # vertices that no facet uses
    invalid_facets: int  # facets with a vertex that does not exist or is not finite
    degenerate_facets: int  # facets without area
    duplicate_facets: int  # facets with the same corners as one before them, whichever way round
    boundary_edges: int  # edges of one facet only: the rims of holes
    holes: int  # connected rims
    nonmanifold_edges: int  # edges of more than two facets
    inconsistent_edges: int  # edges whose two facets are wound against each other

    def __bool__(self) -> bool:
        return any(getattr(self, field.name) for field in fields(self))

    @property
    def watertight(self) -> bool:
        """True if every edge belongs to exactly two facets."""
        return self.boundary_edges == 0 and self.nonmanifold_edges == 0

    def text(self) -> str:
        """List the kinds that are not zero. The result is empty for a clean surface."""
        counts = ((field.name.replace("_", " "), getattr(self, field.name)) for field in fields(self))
        return ", ".join(f"{count} {name}" for name, count in counts if count)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges(Value):
    """The edges of a surface, each once."""

    ends: Faces  # (e, 2); vertices, the smaller number first
    of_side: NDArray[np.int64]  # (3 m,); edge of each side; side k of facet i, from corner k on, is number 3 i + k
    forward: Mask  # (3 m,); True if a side runs from the smaller vertex number to the larger
    facets: NDArray[np.int64]  # (e,); number of facets at an edge

    @property
    def inconsistent(self) -> Mask:
        """Edges (e,) of two facets that run along them in the same direction."""
        along = np.bincount(self.of_side, weights=self.forward, minlength=len(self.ends))
        return np.asarray((self.facets == 2) & (along != 1))


def edges_of(faces: Faces) -> Edges:
    """Find the edges of facets."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    base = int(faces.max(initial=0)) + 1
    keys, of_side, facets = np.unique(low * base + high, return_inverse=True, return_counts=True)
    return Edges(
        ends=np.stack([keys // base, keys % base], axis=-1), of_side=of_side, forward=start < end, facets=facets
    )


def defects_of(surface: Surface) -> Defects:
    """Count the defects of a surface, as of ``read_surface``; invalid facets and open edges are accepted."""
    valid = surface.valid_faces
    names = coincident_names(surface.vertices)
    faces = names[surface.faces[valid]]
    flat = flat_facets(surface.vertices, faces)
    double = duplicate_facets(faces[~flat])
    edges = edges_of(faces[~flat][~double])
    rims = edges.ends[edges.facets == 1]
    in_range = surface.faces[(surface.faces >= 0) & (surface.faces < len(surface.vertices))]
    return Defects(
        nonfinite_vertices=int(np.sum(~surface.finite_vertices)),
        unreferenced_vertices=len(surface.vertices) - np.unique(in_range).size,
        invalid_facets=int(np.sum(~valid)),
        degenerate_facets=int(np.sum(flat)),
        duplicate_facets=int(np.sum(double)),
        boundary_edges=len(rims),
        holes=_pieces(rims),
        nonmanifold_edges=int(np.sum(edges.facets > 2)),
        inconsistent_edges=int(np.sum(edges.inconsistent)),
    )


def flat_facets(vertices: Float, faces: Faces) -> Mask:
    """Mask of the facets without area."""
    if faces.size == 0:
        return np.zeros(len(faces), dtype=bool)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        extent = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
        flat: Mask = ~(doubled / 2.0 > FLAT * np.square(extent))
    return flat


def duplicate_facets(faces: Faces) -> Mask:
    """Mask of the facets with the corners of one before them."""
    corners = np.sort(faces, axis=1)
    order = np.lexsort(corners.T)
    same = np.zeros(len(faces), dtype=bool)
    same[order[1:]] = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    return same


def _pieces(rims: Faces) -> int:
    """Number of connected pieces of edges (b, 2)."""
    ends, numbers = np.unique(rims, return_inverse=True)
    return int(connected_labels(ends.size, *numbers.reshape(-1, 2).T).max(initial=-1)) + 1
