"""Intersection of rays and shapes in body axes: Embree for meshes, algebra for ellipsoids, float64 in the interface.

The origin of every ray is first moved up to the sphere around the body, in float64; only then does it become the
float32 that Embree takes. From a distant camera this is the difference between 1e-5 px and 1e-1 px.
"""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Float, Indices, Mask, as_floats, require, unit
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.ray_tracing.embree import EmbreeSurface, Float32, dot, pad_vectors, rows_of, shift_points
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh
from giantlike.shapes.generate import geodesic_directions

_INSIDE = -1e-9  # barycentric weights of points on an edge, rounded
_RINGS = (3e-7, 2e-6)  # of the radius, distances from the ray at which facets are searched; float32 resolves 6e-8
_TURNS = np.arange(8) * (np.pi / 4.0)  # rad, directions from the ray in which they are searched
_AROUND = np.concatenate([ring * np.column_stack([np.cos(_TURNS), np.sin(_TURNS)]) for ring in _RINGS])
_SPHERE_MARGIN = 1.0001  # radius of the sphere to which rays are moved, relative to the body's: margin for rounding
_HULL_FACETS = 500  # directions of the points of a hull: they lie at most 1 % of the extent inside it
_EDGE = 1e-5
"""Distance to an edge of a facet, across the ray and over the body radius, within which float64 chooses the facet."""
_SHADOW_OFFSET = 1e-6  # height over the surface at which a shadow ray starts, as a fraction of the body radius


@dataclass(frozen=True, slots=True, eq=False)
class Hits(Value):
    """First intersections of rays with a surface."""

    hit: Mask  # (n,)
    points_km: Float  # (n, 3), body axes; NaN where nothing was hit
    facets: Indices  # (n,); facet numbers, -1 where nothing was hit and 0 on an ellipsoid
    normals: Float  # (n, 3), body axes; outward, NaN where nothing was hit


@dataclass(frozen=True, slots=True, eq=False)
class Sight(Value):
    """Surface seen by a camera along the rays of an image: k of them meet the body.

    Vectors are float32 with a fourth column of zeros, so that their rows move fast: see ``embree.pad_vectors``.
    """

    rays: Indices  # (k,); numbers of those rays
    facets: NDArray[np.int32]  # (k,); facet numbers, 0 on an ellipsoid
    points_km: Float32  # (k, 4), body axes; good to 1e-6 of the body's radius
    normals: Float32  # (k, 4), body axes; outward
    cos_emission: Float32  # (k,); cosine of the angle from the normal to the camera

    def only(self, keep: Mask) -> Sight:
        """Return the part for which ``keep`` (k,) is True."""
        numbers = np.flatnonzero(keep)
        return Sight(
            self.rays.take(numbers),
            self.facets.take(numbers),
            rows_of(self.points_km, numbers),
            rows_of(self.normals, numbers),
            self.cos_emission.take(numbers),
        )


class MeshTracer:
    """Rays against a triangle mesh, by Embree; body axes, km. Rays that are NaN miss.

    It holds the arrays of the mesh and not the mesh, so that a cache can forget it.

    radius_km: radius of a sphere about the origin that contains the body.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self.radius_km = mesh.circumscribing_radius_km
        self._vertices_km, self._faces, self._normals = mesh.vertices_km, mesh.faces, mesh.normals
        self._offsets_km: Float = np.einsum("ij,ij->i", self._normals, self._vertices_km[self._faces[:, 0]])
        self._sizes_km: Float = np.sqrt(mesh.areas_km2)
        self._padded_normals = pad_vectors(self._normals)
        self._surface = EmbreeSurface(self._vertices_km, self._faces)
        self._shadow_offset_km = _SHADOW_OFFSET * self.radius_km

    @cached_property
    def hull_points_km(self) -> Float:
        """Points (k, 3), km, whose convex hull is the body's, to 1 % of its extent: its farthest vertices."""
        used = self._vertices_km[np.unique(self._faces)]
        extent = np.ptp(used, axis=0)
        scaled = used / np.where(extent > 0.0, extent, 1.0)  # a long body has its directions where it needs them
        directions, _ = geodesic_directions(_HULL_FACETS)
        return np.asarray(used[np.unique([np.argmax(scaled @ direction) for direction in directions])])

    def intersect(self, origins_body_km: ArrayLike, directions_body: ArrayLike) -> Hits:
        """First hits of rays: the facet from Embree and the point on it in float64.

        Near an edge, where float32 may choose the wrong one of two facets, float64 decides between those around.

        ``origins_body_km`` (3,) or (n, 3); ``directions_body`` (n, 3).
        """
        starts, directions = _approach(origins_body_km, directions_body, self.radius_km)
        found, rough, inside = self._surface.first_hit_inside(starts.astype(np.float32), directions.astype(np.float32))
        facets, distances = found.astype(np.int64), rough.astype(np.float64)
        hit = np.flatnonzero(facets >= 0)
        normal, start, direction = self._normals[facets[hit]], starts[hit], directions[hit]
        slope = np.einsum("ij,ij->i", normal, direction)
        height = self._offsets_km[facets[hit]] - np.einsum("ij,ij->i", normal, start)
        with np.errstate(divide="ignore", invalid="ignore"):
            exact = height / slope
            sure = inside[hit] * np.abs(slope) * self._sizes_km[facets[hit]] > _EDGE * self.radius_km
        distances[hit[sure]] = exact[sure]
        self._decide(hit[~sure], starts, directions, facets, distances)
        normals, points = np.full(starts.shape, np.nan), np.full(starts.shape, np.nan)
        normals[hit] = self._normals[facets[hit]]
        points[hit] = start + distances[hit, None] * direction
        return Hits(facets >= 0, points, facets, normals)

    def _decide(self, which: Indices, starts: Float, directions: Float, facets: Indices, distances: Float) -> None:
        """Write exact facets and distances for the rays ``which``; those that meet nothing keep the ones of float32."""
        exact = facet_distances(self._vertices_km[self._faces[facets[which]]], starts[which], directions[which])
        met = np.isfinite(exact)
        distances[which[met]] = exact[met]
        missed = which[~met]
        if missed.size:
            found, exact = facets_around(
                self._surface, self._vertices_km, self._faces, starts[missed], directions[missed], self.radius_km
            )
            met = np.isfinite(exact)
            facets[missed[met]], distances[missed[met]] = found[met], exact[met]

    def is_occluded(self, origins_body_km: ArrayLike, directions_body: ArrayLike) -> Mask:
        """Return True (n,) for rays, ``directions_body`` (n, 3) from one origin or n, that meet the mesh."""
        starts, directions = _approach(origins_body_km, directions_body, self.radius_km)
        return self._surface.is_occluded(starts.astype(np.float32), directions.astype(np.float32))

    def encloses(self, point_body_km: Float) -> bool:
        """Return True if a point (3,), km, lies inside the mesh: a ray outward from it meets the back of a facet."""
        if float(np.linalg.norm(point_body_km)) >= self.radius_km:
            return False
        outward = point_body_km if np.any(point_body_km) else np.array([1.0, 0.0, 0.0])
        return bool(self.intersect(point_body_km, outward[None]).normals[0] @ outward > 0.0)

    def is_shadowed(self, hits: Hits, sun_body: Float) -> Mask:
        """Return True (n,) for hits in shadow: none, facing away from the Sun, or with the body in the way."""
        dark = ~(hits.normals @ sun_body > 0.0)
        facing = np.flatnonzero(~dark)
        starts = hits.points_km[facing] + self._shadow_offset_km * hits.normals[facing]
        dark[facing] = self.is_occluded(starts, np.broadcast_to(sun_body, starts.shape))
        return dark

    def sight(self, origin_body_km: Float, directions_body: Float) -> Sight:
        """Trace the rays (n, 4), unit vectors and zeros, of an image; in float32 from the bounding sphere on."""
        reach = max(float(np.linalg.norm(origin_body_km)) - _SPHERE_MARGIN * self.radius_km, 0.0)
        directions = directions_body.astype(np.float32)
        starts = shift_points(reach * directions_body, origin_body_km).astype(np.float32)
        facets, distances = self._surface.first_hit(starts[:, :3], directions[:, :3])
        rays = np.flatnonzero(facets >= 0)
        facets, distances = facets.take(rays), distances.take(rays)
        normals, directions = rows_of(self._padded_normals, facets), rows_of(directions, rays)
        points = rows_of(starts, rays)
        for axis in range(3):
            points[:, axis] += distances * directions[:, axis]
        return Sight(rays, facets, points, normals, -dot(normals, directions))

    def dark(self, points_km: Float32, normals: Float32, to_sun: Float) -> Mask:
        """Return True for points (k, 4) of the mesh that face the Sun but lie in the shadow of the mesh."""
        starts = points_km + np.float32(self._shadow_offset_km) * normals
        directions = np.broadcast_to(to_sun.astype(np.float32), starts.shape)  # one in memory, where there is one
        return self._surface.is_occluded(starts[:, :3], directions[:, :3])


class EllipsoidTracer:
    """Rays against an ellipsoid about the origin, convex, in float64; methods are as in :class:`MeshTracer`."""

    def __init__(self, ellipsoid: Ellipsoid) -> None:
        self.radius_km = ellipsoid.circumscribing_radius_km
        self._radii_km = ellipsoid.radii_km

    @property
    def hull_points_km(self) -> Float:
        """Corners (k, 3) of a polyhedron around the ellipsoid, km."""
        return _around_unit_sphere() * self._radii_km

    def intersect(self, origins_body_km: ArrayLike, directions_body: ArrayLike) -> Hits:
        """First hits of rays that come from outside."""
        starts, directions = _approach(origins_body_km, directions_body, self.radius_km)
        near, _ = self._distances(starts, directions)
        hit = near > 0.0
        points = np.where(hit[:, None], starts + near[:, None] * directions, np.nan)
        normals = unit(points / self._radii_km**2)
        return Hits(hit, points, np.where(hit, 0, -1), normals)

    def is_occluded(self, origins_body_km: ArrayLike, directions_body: ArrayLike) -> Mask:
        """Return True for rays (n,) that meet the ellipsoid; one that starts on it and leads outward does not."""
        starts, directions = _approach(origins_body_km, directions_body, self.radius_km)
        _, far = self._distances(starts, directions)
        return np.asarray(far > 1e-9 * self.radius_km)

    def encloses(self, point_body_km: Float) -> bool:
        """Return True if a point (3,), km, lies inside the ellipsoid."""
        return bool(np.sum((point_body_km / self._radii_km) ** 2) < 1.0)

    def is_shadowed(self, hits: Hits, sun_body: Float) -> Mask:
        """Return True for hits (n,) that face away from the Sun."""
        return np.asarray(~(hits.normals @ sun_body > 0.0))

    def sight(self, origin_body_km: Float, directions_body: Float) -> Sight:
        """Trace the rays of an image: as :meth:`intersect`, axis by axis, without the values for rays that miss."""
        reach = max(float(np.linalg.norm(origin_body_km)) - _SPHERE_MARGIN * self.radius_km, 0.0)
        step = np.ascontiguousarray(directions_body[:, :3].T) / self._radii_km[:, None]
        start = (origin_body_km / self._radii_km)[:, None] + reach * step
        square = (step * step).sum(axis=0)
        middle = -(start * step).sum(axis=0) / square
        closest = start + middle * step
        with np.errstate(invalid="ignore"):
            near = middle - np.sqrt((1.0 - (closest * closest).sum(axis=0)) / square)
            rays = np.flatnonzero(near > 0.0)
        direction = step.take(rays, axis=1)
        place = start.take(rays, axis=1) + near.take(rays) * direction  # on the unit sphere
        normal = place / self._radii_km[:, None]
        normal /= np.sqrt((normal * normal).sum(axis=0))
        direction *= self._radii_km[:, None]
        cos_emission = -(normal * direction).sum(axis=0).astype(np.float32)
        points, normals = pad_vectors((place * self._radii_km[:, None]).T), pad_vectors(normal.T)
        return Sight(rays, np.zeros(rays.size, np.int32), points, normals, cos_emission)

    def dark(self, points_km: Float32, normals: Float32, to_sun: Float) -> Mask:
        """Return False for all points (k,): a convex body casts no shadow on itself."""
        return np.zeros(len(points_km), dtype=bool)

    def _distances(self, starts: Float, directions: Float) -> tuple[Float, Float]:
        """Distances (n,) along the rays to the near and the far side; NaN for a miss."""
        origin, step = starts / self._radii_km, directions / self._radii_km
        square = np.einsum("ij,ij->i", step, step)
        middle = -np.einsum("ij,ij->i", origin, step) / square
        closest = origin + middle[:, None] * step
        with np.errstate(invalid="ignore"):
            half = np.sqrt((1.0 - np.einsum("ij,ij->i", closest, closest)) / square)
        return middle - half, middle + half


@cache
def _around_unit_sphere() -> Float:
    """Corners (k, 3) of a polyhedron around the unit sphere."""
    directions, faces = geodesic_directions(_HULL_FACETS)
    return directions / float(np.linalg.norm(directions[faces].mean(axis=1), axis=1).min())


def _approach(origins_body_km: ArrayLike, directions_body: ArrayLike, radius_km: float) -> tuple[Float, Float]:
    """Rays moved forward to the sphere around the body: starts (n, 3), km, and unit directions (n, 3)."""
    directions = as_floats(directions_body, (3,), "directions_body")
    origins = as_floats(origins_body_km, (3,), "origins_body_km")
    require(
        directions.ndim == 2 and origins.shape in ((3,), directions.shape),
        f"needed directions (n, 3) and origins (3,) or (n, 3), got {directions.shape} and {origins.shape}",
    )
    directions = unit(directions)
    reach = np.maximum(np.linalg.norm(origins, axis=-1, keepdims=True) - _SPHERE_MARGIN * radius_km, 0.0)
    return origins + reach * directions, directions


Tracer: TypeAlias = MeshTracer | EllipsoidTracer  # a shape prepared for rays

_TRACERS: weakref.WeakKeyDictionary[TriangleMesh, MeshTracer] = weakref.WeakKeyDictionary()
_TRACERS_LOCK = threading.Lock()


def tracer_for(shape: Shape) -> Tracer:
    """Return the tracer of a shape; for a mesh it is built once and lives as long as the mesh object."""
    if isinstance(shape, Ellipsoid):
        return EllipsoidTracer(shape)
    if not isinstance(shape, TriangleMesh):
        raise InputError(f"rays need a TriangleMesh or an Ellipsoid, got a {type(shape).__name__}")
    with _TRACERS_LOCK:
        tracer = _TRACERS.get(shape)
        if tracer is None:
            tracer = _TRACERS[shape] = MeshTracer(shape)
        return tracer


def facet_distances(corners_km: Float, starts_km: Float, directions: Float) -> Float:
    """Distances (...) along rays (..., 3) to facets (..., 3, 3); infinite where missed.

    Source: Moller and Trumbore (1997), Fast, minimum storage ray-triangle intersection: the usual form of the test.
    """
    first = corners_km[..., 0, :]
    along, up, offset = corners_km[..., 1, :] - first, corners_km[..., 2, :] - first, starts_km - first
    p, q = np.cross(directions, up), np.cross(offset, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.sum(along * p, axis=-1)
        u, v = np.sum(offset * p, axis=-1) * scale, np.sum(directions * q, axis=-1) * scale
        distance = np.sum(up * q, axis=-1) * scale
        inside = (u >= _INSIDE) & (v >= _INSIDE) & (u + v <= 1.0 - _INSIDE) & (distance > 0.0)
    return np.where(inside, distance, np.inf)


def facets_around(
    surface: EmbreeSurface, vertices_km: Float, faces: Indices, starts_km: Float, directions: Float, radius_km: float
) -> tuple[Indices, Float]:
    """Facets (k,) near rays that these meet first, and distances, infinite where none nearby is met, in float64."""
    sideways = unit(np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)]))
    plane = np.stack([sideways, np.cross(directions, sideways)], axis=1)
    nearby = starts_km[:, None, :] + radius_km * np.einsum("rc,kcx->krx", _AROUND, plane)
    rays = np.broadcast_to(directions[:, None, :], nearby.shape)
    found, _ = surface.first_hit(
        np.ascontiguousarray(nearby.reshape(-1, 3), np.float32), np.ascontiguousarray(rays.reshape(-1, 3), np.float32)
    )
    facets = found.reshape(-1, len(_AROUND)).astype(np.int64)
    starts = np.broadcast_to(starts_km[:, None, :], rays.shape)
    distances = facet_distances(vertices_km[faces[facets]], starts, rays)
    distances[facets < 0] = np.inf
    best = np.arange(len(facets)), distances.argmin(axis=1)
    return facets[best], distances[best]
