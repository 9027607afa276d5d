"""Levels of detail: meshes of one body, of which a camera sees the coarsest that looks like the finest."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.shapes.albedo import Albedo, FacetAlbedo, VertexAlbedo
from giantlike.shapes.base import PlacedEllipsoid
from giantlike.shapes.decimate import decimate_mesh
from giantlike.shapes.mesh import TriangleMesh

_SAME_BODY = 0.1  # of the mean radius: coarse meshes lose volume; a body in other units differs by a factor of 1000
_FEWEST_FACETS = 1000  # of the coarsest level
_STEP = 4  # a facet of the next level is twice as long


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class LevelsOfDetail(Value):
    """One body as meshes of several resolutions; all quantities but ray intersections come from the finest."""

    meshes: tuple[TriangleMesh, ...]  # from the coarsest to the finest
    facet_px: float = 0.5  # largest size of the facets in an image; see the notes of :func:`levels_of_detail`
    facet_sizes_km: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "meshes", tuple(self.meshes))
        require(len(self.meshes) > 0, "levels of detail need at least one mesh")
        require(0.0 < self.facet_px < math.inf, f"facet_px must be > 0, got {self.facet_px}")
        sizes = tuple(facet_size_km(mesh) for mesh in self.meshes)
        finer = all(coarse > fine for coarse, fine in pairwise(sizes))
        require(finer, f"the meshes must come from coarse to fine, got facets of {[f'{s:.3g}' for s in sizes]} km")
        radius = self.mean_radius_km
        for mesh in self.meshes:
            require(
                abs(mesh.mean_radius_km - radius) <= _SAME_BODY * radius,
                f"{mesh!r} has a mean radius of {mesh.mean_radius_km:.4g} km and the finest mesh {radius:.4g} km: "
                "are they the same body, in the same units?",
            )
        self._keep(facet_sizes_km=sizes)

    @property
    def finest(self) -> TriangleMesh:
        """The finest mesh."""
        return self.meshes[-1]

    @property
    def name(self) -> str:
        """Name of the finest mesh."""
        return self.finest.name

    @property
    def sha256(self) -> str:
        """Hash of the hashes of the meshes and of the size of facets."""
        parts = [mesh.sha256 for mesh in self.meshes]
        return hashlib.sha256(" ".join(["levels", *parts, repr(self.facet_px)]).encode()).hexdigest()

    @property
    def circumscribing_radius_km(self) -> float:
        """Circumscribing radius of the largest mesh, km: coarse ones can reach beyond the finest."""
        return max(mesh.circumscribing_radius_km for mesh in self.meshes)

    @property
    def mean_radius_km(self) -> float:
        """Mean radius of the finest mesh, km."""
        return self.finest.mean_radius_km

    @property
    def best_fit_ellipsoid(self) -> PlacedEllipsoid:
        """Best-fit ellipsoid of the finest mesh."""
        return self.finest.best_fit_ellipsoid

    @property
    def albedo(self) -> Albedo | None:
        """Relative albedo of the finest mesh; each level has its own."""
        return self.finest.albedo

    def for_scale(self, km_per_px: float) -> TriangleMesh:
        """Return the coarsest mesh with facets of at most ``facet_px`` pixels, else the finest."""
        fine_enough = (size <= self.facet_px * km_per_px for size in self.facet_sizes_km)
        return next((mesh for mesh, fine in zip(self.meshes, fine_enough, strict=True) if fine), self.finest)


def levels_of_detail(
    mesh: TriangleMesh,
    *,
    facets: Sequence[int] | None = None,
    facet_px: float = 0.5,
    simplify: Callable[[TriangleMesh, int], TriangleMesh] = decimate_mesh,
) -> LevelsOfDetail:
    """Make coarser meshes of a body.

    Facets of half a pixel make no difference in the outline: over a facet of length l a surface of radius R bends by
    l^2 / 8 R, for 0.5 px on a disk of 300 px 0.0002 px. Only relief smaller than a facet is lost.
    """
    require(
        not isinstance(mesh.albedo, FacetAlbedo | VertexAlbedo),
        "levels of detail take albedo from an AlbedoMap, not by facet or vertex",
    )
    counts = _quarters(len(mesh.faces)) if facets is None else sorted(facets, reverse=True)
    levels = [mesh]
    for count in counts:
        coarser = _simplify(levels[-1], count, simplify)
        if coarser is None:
            coarser = _simplify(mesh, count, simplify) if facets is None else simplify(mesh, count)
        if coarser is not None:
            levels.append(coarser.with_albedo(mesh.albedo))
    return LevelsOfDetail(meshes=tuple(reversed(levels)), facet_px=facet_px)


def _simplify(
    mesh: TriangleMesh, facets: int, simplify: Callable[[TriangleMesh, int], TriangleMesh]
) -> TriangleMesh | None:
    """The mesh with fewer facets; None where its surface would break."""
    try:
        return simplify(mesh, facets)
    except InputError:
        return None


def facet_size_km(mesh: TriangleMesh) -> float:
    """Size of the facets of a mesh."""
    mean_area_km2 = float(np.sum(mesh.areas_km2**2)) / mesh.area_km2
    return math.sqrt(4.0 / math.sqrt(3.0) * mean_area_km2)


def _quarters(facets: int) -> list[int]:
    counts = []
    while facets // _STEP >= _FEWEST_FACETS:
        facets //= _STEP
        counts.append(facets)
    return counts
