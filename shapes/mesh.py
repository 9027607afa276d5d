"""Triangle meshes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Indices, as_floats, frozen, require
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.shapes.albedo import Albedo, AlbedoMap, fitted_to_mesh, hash_with_albedo
from giantlike.shapes.base import Ellipsoid, PlacedEllipsoid

Faces = NDArray[np.int64]
Float32 = NDArray[np.float32]

FLAT = 1e-20
"""Ratio of the area of a facet to the square of the body's extent, below which the area counts as zero: rounding of
float64."""
_BEND_ROUNDING = 1e-6  # of unit vectors: float32 rounds products of them by a third of that
_OPEN = 0.2  # sum of area vectors over area: above it a surface counts as a sheet, which has no inside


@dataclass(frozen=True, eq=False)
class TriangleMesh(Value):
    """A body as a surface of triangles, in body axes.

    Facets without area are dropped, and all facets are reversed when the volume they enclose comes
    out negative, so that normals point outward; a sheet that encloses nothing stays as it is. Derived arrays are
    computed once, at first use.

    Parameters
    ----------
    vertices_km : (n, 3) float64, km, body
    faces : (m, 3) int64; indices of the corners of each facet, from 0, counter-clockwise seen from outside
    name : str
    sha256 : str; hash of the file, by default of the arrays; that of the albedo is mixed in
    albedo : Albedo, optional; relative albedo, by facet or vertex in the order given here

    Attributes
    ----------
    areas_km2 : (m,) float64, km^2; areas of the facets
    normals : (m, 3) float64, unitless, body; outward unit normals of the facets

    Raises
    ------
    InputError
        No facet with area, an index out of range, a vertex that is not finite, or an albedo with another number
        of values.
    """

    vertices_km: Float
    faces: Faces
    name: str = "mesh"
    sha256: str = ""
    albedo: Albedo | None = None
    areas_km2: Float = field(init=False, repr=False)
    normals: Float = field(init=False, repr=False)
    _surface_sha256: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        vertices, faces = _check_arrays(self.vertices_km, self.faces)
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        vectors = np.cross(b - a, c - a) / 2.0
        areas = np.linalg.norm(vectors, axis=1)
        closed = float(np.linalg.norm(vectors.sum(axis=0))) < _OPEN * float(areas.sum())
        if closed and _signed_volume(vertices, faces) < 0.0:
            faces, vectors = np.ascontiguousarray(faces[:, ::-1]), -vectors
        extent = float(np.max(np.ptp(vertices, axis=0)))
        keep = areas > FLAT * extent**2
        require(bool(keep.any()), f"mesh {self.name!r}: no facet has any area")
        if not keep.all():
            faces, vectors, areas = faces[keep], vectors[keep], areas[keep]
        surface = self.sha256 or hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest()
        albedo = self.albedo
        if albedo is not None:
            albedo = fitted_to_mesh(albedo, vertices=len(vertices), faces=faces, kept=keep)
        self._keep(
            vertices_km=vertices,
            faces=faces,
            sha256=hash_with_albedo(surface, albedo),
            albedo=albedo,
            areas_km2=areas,
            normals=vectors / areas[:, None],
            _surface_sha256=surface,
        )

    def __reduce__(self) -> tuple[type[TriangleMesh], tuple[Float, Faces, str, str, Albedo | None]]:
        return type(self), (self.vertices_km, self.faces, self.name, self._surface_sha256, self.albedo)

    def __repr__(self) -> str:
        return f"TriangleMesh({self.name!r}, {len(self.vertices_km)} vertices, {len(self.faces)} facets)"

    @cached_property
    def area_km2(self) -> float:
        """Area of the whole surface, km^2."""
        return float(self.areas_km2.sum())

    @cached_property
    def circumscribing_radius_km(self) -> float:
        """Largest distance of a vertex in use from the origin, km."""
        used = self.vertices_km[np.unique(self.faces)]
        return float(np.sqrt(np.einsum("ij,ij->i", used, used).max()))

    @cached_property
    def volume_km3(self) -> float:
        """Volume enclosed, km^3."""
        return _signed_volume(self.vertices_km, self.faces)

    @property
    def mean_radius_km(self) -> float:
        """Radius of the sphere of the same volume, km."""
        return float(np.cbrt(3.0 * self.volume_km3 / (4.0 * np.pi)))

    @property
    def center_of_figure_km(self) -> Float:
        """Centroid (3,) of the volume, km, body axes."""
        return self._moments[0].copy()

    @property
    def openness(self) -> float:
        """Length of the sum of all area vectors over the area: 0 for a closed surface, 1 for a flat sheet."""
        return float(np.linalg.norm(self.areas_km2 @ self.normals) / self.area_km2)

    @cached_property
    def plane_offsets_km(self) -> Float:
        """Signed distances (m,) of the planes of the facets from the origin, km."""
        return frozen(np.einsum("ij,ij->i", self.normals, self.vertices_km[self.faces[:, 0]]))

    @cached_property
    def border_vertices(self) -> Indices:
        """Vertices (b,) on edges that the facets of the two sides do not share: none on a closed surface.

        Each vertex sums numbers, drawn for its neighbors, over the edges that leave it minus those that arrive; where
        every edge runs both ways, this is zero.
        """
        draws = np.random.default_rng(0).integers(1, 2**32, size=len(self.vertices_km)).astype(np.float64)
        total = np.zeros(len(draws))
        for corner in range(3):
            leave, arrive = self.faces[:, corner], self.faces[:, (corner + 1) % 3]
            total += np.bincount(leave, weights=draws[arrive], minlength=draws.size)
            total -= np.bincount(arrive, weights=draws[leave], minlength=draws.size)
        return np.flatnonzero(total)

    @cached_property
    def bends(self) -> tuple[Float32, Float32, Float32]:
        """Normals (3, m) and plane offsets (m,), km, in single precision, and the bends (m,) of the surface.

        A bend bounds how much the normals of the facets at the corners of a facet differ from its own, as a length: by
        way of the mean normal at each corner, with a margin for rounding. It is infinite at borders.
        """
        count = len(self.vertices_km)
        sums = np.zeros((count, 3))
        for corner in range(3):
            at = self.faces[:, corner]
            for axis in range(3):
                sums[:, axis] += np.bincount(at, weights=self.normals[:, axis], minlength=count)
        means = sums / np.maximum(np.bincount(self.faces.ravel(), minlength=count), 1)[:, None]
        apart = np.stack([np.linalg.norm(self.normals - means[at], axis=1) for at in self.faces.T], axis=1)
        largest = np.zeros(count)
        np.maximum.at(largest, self.faces.ravel(), apart.ravel())
        largest[self.border_vertices] = np.inf
        bends = (apart + largest[self.faces]).max(axis=1) + _BEND_ROUNDING
        normals = np.ascontiguousarray(self.normals.T, dtype=np.float32)
        return normals, self.plane_offsets_km.astype(np.float32), bends.astype(np.float32)

    @cached_property
    def best_fit_ellipsoid(self) -> PlacedEllipsoid:
        """The ellipsoid with the same centroid and second moments of volume, longest axis first."""
        center, second = self._moments
        eigenvalues, axes = np.linalg.eigh(second)
        axes = axes[:, ::-1]
        axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), range(3)])  # the sign of an eigenvector is arbitrary
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        radii = np.sqrt(5.0 * eigenvalues[::-1])
        return PlacedEllipsoid(
            ellipsoid=Ellipsoid(radii_km=radii, name=f"{self.name} (best-fit ellipsoid)"),
            center_body_km=center,
            body_from_axes=Rotation.from_matrix(axes),
        )

    def barycentric(self, points_body_km: ArrayLike, facets: Indices) -> Float:
        """Barycentric coordinates (n, 3), which sum to 1, of points (n, 3), km, body axes, on their facets (n,)."""
        points = as_floats(points_body_km, (3,), "points_body_km")
        a, b, c = (self.vertices_km[self.faces[facets, corner]] for corner in range(3))
        twice = 2.0 * self.areas_km2[facets]
        normals = self.normals[facets]
        at_b = np.einsum("ij,ij->i", np.cross(points - a, c - a), normals) / twice
        at_c = np.einsum("ij,ij->i", np.cross(b - a, points - a), normals) / twice
        return np.stack([1.0 - at_b - at_c, at_b, at_c], axis=-1)

    def with_albedo(self, albedo: Albedo | None) -> TriangleMesh:
        """Return the same surface with another relative albedo, which has a value for each facet or vertex."""
        return TriangleMesh(self.vertices_km, self.faces, self.name, self._surface_sha256, albedo)

    def translated(self, offset_body_km: ArrayLike) -> TriangleMesh:
        """Return the mesh with an offset (3,), km, added to its vertices, with a new hash; the albedo moves with it."""
        offset = as_floats(offset_body_km, (3,), "offset_body_km")
        albedo = self.albedo.translated(offset) if isinstance(self.albedo, AlbedoMap) else self.albedo
        return TriangleMesh(self.vertices_km + offset, self.faces, self.name, albedo=albedo)

    @cached_property
    def _moments(self) -> tuple[Float, Float]:
        """Centroid (3,) and covariance (3, 3) of the volume, from tetrahedra with their apex at the origin."""
        a, b, c = (self.vertices_km[self.faces[:, i]] for i in range(3))
        weights = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        total = weights.sum()
        corners = a + b + c
        center = weights @ corners / (4.0 * total)
        second = sum(np.einsum("i,ij,ik->jk", weights, p, p) for p in (a, b, c, corners)) / (20.0 * total)
        return center, second - np.outer(center, center)


def _check_arrays(vertices_km: ArrayLike, faces: ArrayLike) -> tuple[Float, Faces]:
    """Copies of vertices (n, 3) and faces (m, 3) that are safe to hand to a ray tracer."""
    vertices = np.array(as_floats(vertices_km, (3,), "vertices_km"), order="C")
    indices = np.asarray(faces)
    require(indices.size > 0, "a mesh needs at least one facet, got none")
    require(vertices.ndim == 2 and vertices.size > 0, f"vertices_km must have shape (n, 3), got {vertices.shape}")
    if indices.ndim != 2 or indices.shape[1] != 3 or not np.issubdtype(indices.dtype, np.integer):
        raise InputError(f"faces must be integers of shape (m, 3), got {indices.dtype} of shape {indices.shape}")
    bad = ~np.isfinite(vertices).all(axis=1)
    require(not bad.any(), f"{int(bad.sum())} vertices are not finite, the first is number {int(bad.argmax())}")
    low, high = int(indices.min()), int(indices.max())
    require(
        low >= 0 and high < len(vertices),
        f"faces use vertex indices {low} to {high}, but there are {len(vertices)} vertices, numbered from 0",
    )
    return vertices, np.array(indices, dtype=np.int64, order="C")


def _signed_volume(vertices_km: Float, faces: Faces) -> float:
    """Volume by the divergence theorem, km^3; apex at the mean vertex, so that an offset body loses no digits."""
    a, b, c = (vertices_km[faces[:, i]] - vertices_km.mean(axis=0) for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
