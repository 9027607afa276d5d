"""The limb of a shape, where rays from a camera graze it, and its derivatives with respect to the camera.

Pure geometry in body axes and float64. An ellipsoid has its limb in closed form; a mesh has it on silhouette edges,
those between a facet that faces the camera and one that does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Indices, Mask, as_finite, as_floats, require, unit
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.shapes.base import Ellipsoid, Shape
from giantlike.shapes.mesh import TriangleMesh

_ALONG_AXIS = 1e-12  # sine of an angle below which float64 does not tell two directions apart in a cross product


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Limb(Value):
    """Limb points of a shape and their derivatives with respect to the camera.

    Parameters
    ----------
    valid : (k,) bool; False where the half-plane of a direction meets no limb; the other arrays hold NaN there
    points_body_km : (k, 3) float64, km, body
    normals : (k, 3) float64, unitless, body
        Outward, and perpendicular to the ray from the camera: of the surface on an ellipsoid; on a mesh, whose facets
        meet in an edge there, of the plane through the edge and the camera.
    points_by_camera : (k, 3, 3) float64; derivative by the position of the camera, body axes
    normals_by_camera : (k, 3, 3) float64, 1/km; derivative of the normals
    """

    valid: Mask
    points_body_km: Float
    normals: Float
    points_by_camera: Float
    normals_by_camera: Float


def limb(shape: Shape, camera_body_km: ArrayLike, directions_body: ArrayLike) -> Limb:
    """Find the limb of a shape in given directions around the line of sight.

    Parameters
    ----------
    shape : Shape; an ``Ellipsoid`` or a ``TriangleMesh``
    camera_body_km : (3,), km, body; position of the camera, outside the shape
    directions_body : (k, 3), any length, body; each selects the half-plane with it from the line camera to origin

    Returns
    -------
    Limb
        In each half-plane the point that is seen farthest from the origin of the body.

    Raises
    ------
    InputError
        A value is not finite, the camera is inside the ellipsoid or at the origin, a direction lies along the line of
        sight, or the shape has no limb that could be found (a point).

    Notes
    -----
    Derivatives hold the direction fixed in body axes: the half-plane rotates about it as the camera moves.

    The outermost point of a half-plane is always seen: a point that hid it would reach farther out. So the silhouette
    edges of a mesh need no test of visibility here. The limb of a mesh moves along one edge and jumps to
    another where the half-plane passes a vertex (the point is continuous there, its derivative is not), where one part
    of the body comes out behind another, and where a facet turns edge-on (there only the depth jumps: the ray to the
    point is continuous). Derivatives are for the current edge.

    An ellipsoid x.D.x = 1 has its limb in the polar plane x.D.C = 1 of the camera C. With all lengths divided
    by the semi-axes it becomes the unit sphere, planes through the origin stay such planes, and the limb is
    ``c / q + sqrt(1 - 1/q) u`` with q = c.c and u the unit vector of the direction perpendicular to c.
    """
    camera = as_finite(camera_body_km, (3,), "camera_body_km")
    directions = as_floats(directions_body, (3,), "directions_body")
    usable = directions.ndim == 2 and bool(np.isfinite(directions).all())
    require(usable, f"directions_body must be finite and of shape (k, 3), got {directions.shape}")
    require(bool(np.any(camera != 0.0)), "camera_body_km must not be the origin of the body")
    across = np.linalg.norm(np.cross(directions, unit(camera)), axis=1)
    along = np.flatnonzero(across <= _ALONG_AXIS * np.linalg.norm(directions, axis=1))
    require(along.size == 0, f"directions {along[:5].tolist()} lie along the line of sight")
    if isinstance(shape, Ellipsoid):
        return _ellipsoid_limb(shape, camera, directions)
    if isinstance(shape, TriangleMesh):
        return _mesh_limb(shape, camera, directions)
    raise InputError(f"the limb is known for an Ellipsoid and a TriangleMesh, not for {type(shape).__name__}")


def silhouette_edges(mesh: TriangleMesh, camera_body_km: Float) -> tuple[Indices, Indices]:
    """Edges of a mesh that can be its outline. Returns ``edges`` (e, 2) and ``facets`` (e,)."""
    # A facet of an outline faces the camera C where n . (C - vertex) > 0, and a neighbor with a normal no farther away
    # than the bend does not, so that |n . (C - vertex)| is at most the bend times the distance.
    normals, offsets_km, bends = mesh.bends
    farthest_km = np.float32(np.linalg.norm(camera_body_km) + mesh.circumscribing_radius_km)
    near, front = near_silhouette(
        np.array(camera_body_km), mesh.normals, mesh.plane_offsets_km, normals, offsets_km, farthest_km * bends
    )
    edges, facets, front = edges_between(mesh.faces, near, front, mesh.border_vertices, len(mesh.vertices_km))
    _, sample, which = np.unique(
        edges[:, 0] * len(mesh.vertices_km) + edges[:, 1], return_index=True, return_inverse=True
    )
    meeting = np.bincount(which, minlength=sample.size)
    facing = np.bincount(which, weights=front, minlength=sample.size)
    outline = sample[(meeting == 1) | ((facing > 0) & (facing < meeting))]
    return edges[outline], facets[outline]


def limb_ellipse(ellipsoid: Ellipsoid, camera_body_km: Float) -> tuple[Float, Float, Float]:
    """Limb of an ellipsoid, body axes, km: ``middle + cos(t) first + sin(t) second``; NaN when the camera is inside."""
    radii = ellipsoid.radii_km
    camera = camera_body_km / radii
    square = float(camera @ camera)
    height = np.sqrt(1.0 - 1.0 / square) if square > 1.0 else np.nan
    first, second = _square_to(camera)
    return radii * camera / square, radii * height * first, radii * height * second


def crossings(starts: Float, stops: Float, angles_rad: Float) -> tuple[Indices, Indices]:
    """Find the crossings (p,) of segments (e, 2) in a plane with half-lines (k,) from its origin, by direction."""
    turn = 2.0 * np.pi
    order = np.argsort(angles_rad % turn, kind="stable")
    angles = (angles_rad % turn)[order]
    angles = np.concatenate([angles, angles + turn])
    begin, end = (np.arctan2(points[:, 1], points[:, 0]) % turn for points in (starts, stops))
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    around = high - low > np.pi  # the short way leads over zero
    low, high = np.where(around, high, low), np.where(around, low + turn, high)
    first, last = np.searchsorted(angles, low, side="left"), np.searchsorted(angles, high, side="right")
    count = np.maximum(last - first, 0)
    segments = np.repeat(np.arange(len(starts)), count)
    within = np.arange(segments.size) - np.repeat(np.cumsum(count) - count, count)
    lines: Indices = order[(first[segments] + within) % max(order.size, 1)]
    return segments, lines


def largest_of_each(groups: Indices, values: Float, count: int) -> Indices:
    """Index (count,) of the largest value (p,) in each group, -1 for an empty group."""
    order = np.lexsort([values, groups])
    best = np.full(count, -1, dtype=np.int64)
    best[groups[order]] = order  # the last one written stays
    return best


def _ellipsoid_limb(ellipsoid: Ellipsoid, camera_km: Float, directions: Float) -> Limb:
    radii = ellipsoid.radii_km
    camera, toward = camera_km / radii, unit(directions) / radii
    square = float(camera @ camera)
    require(square > 1.0, f"the camera must be outside the ellipsoid, got {camera_km.tolist()} km")
    along = toward @ camera / square
    sideways = toward - along[:, None] * camera
    sideways -= (sideways @ camera / square)[:, None] * camera  # once more, against rounding
    length = np.linalg.norm(sideways, axis=1)
    outward = sideways / length[:, None]
    height = np.sqrt(1.0 - 1.0 / square)
    points = camera / square + height * outward
    by_camera = np.eye(3) / square - 2.0 * np.outer(camera, camera) / square**2
    turning = 2.0 * np.einsum("k,i,j->kij", along, camera, camera) / square
    turning -= along[:, None, None] * np.eye(3) + np.einsum("i,kj->kij", camera, toward) / square
    across = (np.eye(3) - np.einsum("ki,kj->kij", outward, outward)) / length[:, None, None]
    by_camera = by_camera + np.einsum("ki,j->kij", outward, camera) / (square**2 * height) + height * across @ turning
    points_by_camera = by_camera * (radii[:, None] / radii)
    steepness = points / radii
    normals = unit(steepness)
    return Limb(
        valid=np.ones(len(points), dtype=bool),
        points_body_km=points * radii,
        normals=normals,
        points_by_camera=points_by_camera,
        normals_by_camera=_unit_derivative(steepness, points_by_camera / radii[:, None] ** 2),
    )


def _mesh_limb(mesh: TriangleMesh, camera_km: Float, directions: Float) -> Limb:
    axis = -unit(camera_km)
    plane = _square_to(axis)
    edges, _ = silhouette_edges(mesh, camera_km)
    starts, stops = (mesh.vertices_km[edges[:, end]] for end in range(2))
    across = directions @ plane.T
    which, line = crossings(starts @ plane.T, stops @ plane.T, np.arctan2(across[:, 1], across[:, 0]))
    start, edge = starts[which], stops[which] - starts[which]
    cut = np.cross(unit(camera_km), unit(directions)[line])  # normals of the half-planes
    slope = np.einsum("ij,ij->i", cut, edge)
    slanted = np.abs(slope) > _ALONG_AXIS * np.linalg.norm(edge, axis=1)  # edges in the half-plane end at others
    line, start, edge, slope = line[slanted], start[slanted], edge[slanted], slope[slanted]
    fraction = np.clip(-np.einsum("ij,ij->i", cut[slanted], start) / slope, 0.0, 1.0)
    points = start + fraction[:, None] * edge
    rays = points - camera_km
    sideways = np.einsum("ij,ij->i", points @ plane.T, unit(across)[line])
    best = largest_of_each(line, np.arctan2(sideways, rays @ axis), len(directions))
    valid = best >= 0
    chosen = best[valid]
    points, rays, edge, slope = points[chosen], rays[chosen], edge[chosen], slope[chosen]
    slide = -np.cross(unit(directions)[valid], points) / (slope * np.linalg.norm(camera_km))[:, None]
    by_camera = np.einsum("ki,kj->kij", edge, slide)
    normal = np.cross(rays, edge)
    outward = np.sign(np.einsum("ij,ij->i", normal @ plane.T, across[valid]))[:, None]
    edge, normal = outward * edge, outward * normal
    turning = np.cross(np.swapaxes(by_camera - np.eye(3), 1, 2), edge[:, None, :])
    return Limb(
        valid=valid,
        points_body_km=_spread(points, valid),
        normals=_spread(unit(normal), valid),
        points_by_camera=_spread(by_camera, valid),
        normals_by_camera=_spread(_unit_derivative(normal, np.swapaxes(turning, 1, 2)), valid),
    )


def _square_to(axis: Float) -> Float:
    """Two unit vectors (2, 3) perpendicular to an axis (3,) and to each other."""
    x, y, z = axis.tolist()
    size = [abs(x), abs(y), abs(z)]
    rights = ([0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0])  # products with the axes of coordinates
    a, b, c = rights[size.index(min(size))]
    length = math.hypot(a, b, c) or 1.0
    a, b, c = a / length, b / length, c / length
    down = [y * c - z * b, z * a - x * c, x * b - y * a]
    length = math.hypot(*down) or 1.0
    return np.array([[a, b, c], [part / length for part in down]])


def _unit_derivative(vectors: Float, derivative: Float) -> Float:
    """Derivative (k, 3, 3) of the unit vectors along ``vectors`` (k, 3) that have a ``derivative`` (k, 3, 3)."""
    length = np.linalg.norm(vectors, axis=1)[:, None, None]
    directions = unit(vectors)
    across = np.eye(3) - np.einsum("ki,kj->kij", directions, directions)
    return np.asarray(across @ derivative / length)


def _spread(rows: Float, valid: Mask) -> Float:
    """Rows (v, ...) put where ``valid`` (k,) is true, NaN elsewhere."""
    result = np.full((valid.size, *rows.shape[1:]), np.nan)
    result[valid] = rows
    return result


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
    """Find facets seen nearly edge-on: ``near`` (k,) and whether they are in ``front`` (k,).

    ``rough_normals`` (3, m), ``rough_offsets_km`` (m,): the normals and offsets in single precision.
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

    Returns ``edges`` (e, 2), ``facets`` (e,) and ``front`` (e,).
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
