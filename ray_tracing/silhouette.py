"""Where the outline of a body lies in the image: on its silhouette edges, or by rays beside and on the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, frozen, require
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.outline import EdgeOutline, projected_normals
from giantlike.ray_tracing.sampling import Interval, finite_rows, span
from giantlike.ray_tracing.tracer import Hits
from giantlike.shapes import Ellipsoid, TriangleMesh, limb

Mask = NDArray[np.bool_]

_NODES = 13
_SCAN_STEP_PX = 0.5
_SCAN_STEPS = (64, 512)
_SCAN_BLOCK = 32
_HALVINGS = 20
_SAME_EDGE_PX, _SAME_EDGE = 1e-3, 1e-6  # float32 rays and the bisection are nearer to the edge than this
_TANGENT_PX = 0.5
_BOUND_MARGIN = 0.02  # of the body's extent: a hull is a hull before distortion
_SHRINK, _MAX_SHRINKS = 0.7, 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Silhouette:
    """Outermost points of a body along directions in the image.

    Parameters
    ----------
    angles_rad : (k,) float64, rad
        Directions, from +x (columns) towards +y (rows).
    center_px : (2,) float64, px
        Where the directions start.
    valid : (k,) bool
        False where the direction meets no edge that the camera can image; the other arrays hold NaN (False) there.
    points_px : (k, 2) float64, px
        Limb points in the distorted image.
    points_camera_km : (k, 3) float64, km, camera axes
        The same points on the surface, from the camera.
    normals_px : (k, 2) float64, unitless
        Outward unit normals of the outline in the image, taken over one pixel of it.
    points_by_position : (k, 2, 3) float64, px/km
        Derivative of ``points_px`` with respect to the body's position in camera axes, for fixed directions and a
        fixed ``center_px``. On a mesh that of the edge at hand: it jumps from edge to edge.
    cos_incidence : (k,) float64
        Cosine of the angle from surface normal to Sun.
    lit : (k,) bool
        The Sun is over the horizon there, and nothing in the way.
    """

    angles_rad: Float
    center_px: Float
    valid: Mask
    points_px: Float
    points_camera_km: Float
    normals_px: Float
    points_by_position: Float
    cos_incidence: Float
    lit: Mask


def trace_silhouette(
    body: Body,
    model: CameraModel,
    angles_rad: ArrayLike,
    *,
    sun_direction_camera: ArrayLike,
    center_px: ArrayLike | None = None,
) -> Silhouette:
    """Find the outermost point of a body's outline along each direction in the distorted image.

    Parameters
    ----------
    body : Body
    model : CameraModel
    angles_rad : (k,), rad
        Directions in the image, from +x towards +y.
    sun_direction_camera : (3,), unitless, camera axes
        Unit vector from body to Sun.
    center_px : (2,), px, optional
        Start of the directions; None takes the projection of the body's origin.

    Returns
    -------
    Silhouette

    Raises
    ------
    InputError
        An angle is not finite, a shape is wrong, or the Sun direction is not a unit vector.

    Notes
    -----
    The outline of a mesh is the outermost of its silhouette edges, cut in float64: exact at any range. That of
    an ellipsoid, and of a mesh that the camera images in part, is scanned by rays from the hull inward, every half
    pixel or less (at most 512 steps), bisected, and moved on to the limb in closed form or to the nearest silhouette
    edge; here a gap narrower than a step behind an overhang can go unseen. To first order a limb point moves along its
    normal by ``normal @ model.project_jacobian(point) @ dposition`` when the camera-to-body vector changes by
    ``dposition``.
    """
    angles = as_floats(angles_rad, (), "angles_rad")
    usable = angles.ndim == 1 and bool(np.isfinite(angles).all())
    require(usable, f"angles_rad must be finite and of shape (k,), got {angles.shape}")
    sun_body = sun_in_body(body, sun_direction_camera)
    center = body.center_px(model) if center_px is None else as_finite(center_px, (2,), "center_px")
    edge = _edge(body, model, center, angles)
    points_camera_km = body.to_camera(edge.hits.points_km) + body.position_camera_km
    points_px = model.project(points_camera_km)
    valid = finite_rows(points_px)
    grazing_px = projected_normals(model, points_camera_km, body.to_camera(edge.normals))
    normals_px = np.where(np.isfinite(edge.chords_px), edge.chords_px, grazing_px)
    points_camera_km[~valid] = normals_px[~valid] = np.nan
    return Silhouette(
        angles_rad=frozen(angles.copy()),
        center_px=center,
        valid=frozen(valid),
        points_px=frozen(points_px),
        points_camera_km=frozen(points_camera_km),
        normals_px=frozen(normals_px),
        points_by_position=frozen(_by_position(model, points_camera_km, grazing_px, angles)),
        cos_incidence=frozen(np.where(valid, edge.hits.normals @ sun_body, np.nan)),
        lit=frozen(valid & ~body.tracer.shadowed(edge.hits, sun_body)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """Where lines leave a body, NaN where they do not.

    ``hits`` (k,) are the points with the surface that faces the camera there, ``normals`` (k, 3), body axes, those
    square to the ray, and ``chords_px`` (k, 2) the normals over one pixel of the outline, NaN for those of the surface.
    """

    hits: Hits
    normals: Float
    chords_px: Float


def _edge(body: Body, model: CameraModel, center_px: Float, angles_rad: Float) -> _Edge:
    """The outermost point of a body on each line."""
    if isinstance(body.shape, TriangleMesh):
        return _mesh_edge(body, body.shape, model, center_px, angles_rad)
    _, directions = _outer_edge(body, model, center_px, angles_rad)
    hits = body.tracer.intersect(body.camera_body_km, directions)
    found = np.flatnonzero(hits.hit)
    if isinstance(body.shape, Ellipsoid) and found.size:
        exact = limb(body.shape, body.camera_body_km, directions[found])
        hits.points_km[found], hits.normals[found] = exact.points_body_km, exact.normals
    return _Edge(hits, hits.normals, np.full((angles_rad.size, 2), np.nan))


def _mesh_edge(body: Body, mesh: TriangleMesh, model: CameraModel, center_px: Float, angles_rad: Float) -> _Edge:
    """The same from silhouette edges, and from rays where the camera has no image of all of them."""
    outline = EdgeOutline.of(body, mesh, model)
    if outline.complete:
        exact = outline.outermost(center_px, angles_rad)
        count = angles_rad.size
        hits = Hits(np.zeros(count, bool), np.full((count, 3), np.nan), exact.facets, np.full((count, 3), np.nan))
    else:
        edge_px, directions = _outer_edge(body, model, center_px, angles_rad)
        near_px = _SAME_EDGE_PX + _SAME_EDGE * edge_px
        exact = outline.outermost(center_px, angles_rad, within_px=(edge_px - near_px, edge_px + near_px))
        hits = body.tracer.intersect(body.camera_body_km, directions)
    normals = hits.normals.copy()
    found = exact.facets >= 0
    hits.hit[found], hits.facets[found] = True, exact.facets[found]
    hits.points_km[found] = body.to_body(exact.points_camera_km[found] - body.position_camera_km)
    hits.normals[found] = mesh.normals[exact.facets[found]]
    normals[found] = body.to_body(exact.normals_camera[found])
    return _Edge(hits, normals, _chord_normals(outline, center_px, angles_rad, exact.radii_px))


def _by_position(model: CameraModel, points_camera_km: Float, normals_px: Float, angles_rad: Float) -> Float:
    """Derivative (k, 2, 3) of outline points along fixed lines: the outline moves along its normals."""
    steps = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    outward = np.einsum("ki,kij->kj", normals_px, model.project_jacobian(points_camera_km))
    slant = np.einsum("ki,ki->k", normals_px, steps)
    result: Float = steps[:, :, None] * (outward / np.where(slant == 0.0, np.nan, slant)[:, None])[:, None, :]
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Straight stretches in the distorted image, from ``start_px`` to ``stop_px`` (k,) from the centre outward.

    ``values`` (k, nodes, 3) are unit directions in body axes at Chebyshev nodes along each; where the model has no
    direction for part of a stretch they are NaN.
    """

    start_px: Float
    stop_px: Float
    values: Float

    @classmethod
    def through(
        cls, body: Body, model: CameraModel, center_px: Float, angles_rad: Float, start: Float, stop: Float
    ) -> _Lines:
        nodes = start[:, None] + (stop - start)[:, None] * _UNIT_INTERVAL.nodes
        steps = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
        values = body.to_body(model.unproject(center_px + nodes[..., None] * steps[:, None, :]))
        return cls(start, stop, values)

    def at(self, radii_px: Float) -> Float:
        """Directions (k, 3) at one radius (k,) on each line."""
        basis = _UNIT_INTERVAL.basis((radii_px - self.start_px) / (self.stop_px - self.start_px))
        result: Float = np.einsum("kn,knx->kx", basis, self.values)
        return result

    def at_fractions(self, fractions: Float) -> Float:
        """Directions (k, m, 3) at fractions (m,) of every line."""
        result: Float = _UNIT_INTERVAL.basis(fractions) @ self.values
        return result

    def some(self, which: NDArray[np.int64]) -> _Lines:
        """The lines with the given numbers."""
        return _Lines(self.start_px[which], self.stop_px[which], self.values[which])


_UNIT_INTERVAL = Interval(0.0, 1.0, _NODES)


def _outer_edge(body: Body, model: CameraModel, center_px: Float, angles_rad: Float) -> tuple[Float, Float]:
    """Radius (k,), px, and direction (k, 3), body axes, of the last point on the body; NaN where there is none."""
    edge_px = np.full(angles_rad.shape, np.nan)
    directions = np.full((*angles_rad.shape, 3), np.nan)
    reach_px = _reach_px(body, model, center_px, angles_rad)
    if reach_px is None or angles_rad.size == 0:
        return edge_px, directions
    zero = np.zeros_like(reach_px)
    for _ in range(_MAX_SHRINKS):
        lines = _Lines.through(body, model, center_px, angles_rad, zero, reach_px)
        open_ended = ~np.isfinite(lines.values).all(axis=(1, 2))
        if not open_ended.any():
            break
        reach_px = np.where(open_ended, _SHRINK * reach_px, reach_px)
    inner_px, outer_px = _scan(body, lines)
    found = np.flatnonzero(np.isfinite(inner_px))
    lines = lines.some(found)
    edge_px[found] = _bisected(body, lines, inner_px[found], outer_px[found])
    directions[found] = lines.at(edge_px[found])
    return edge_px, directions


def _reach_px(body: Body, model: CameraModel, center_px: Float, angles_rad: Float) -> Float | None:
    """How far out (k,), px, the body can reach along each line; None when the camera cannot image it at all."""
    hull_px = body.hull_px(model)
    box = span(hull_px)
    if box is None or not np.isfinite(center_px).all():
        return None
    complete = finite_rows(hull_px)
    offsets = hull_px[complete] - center_px
    support: Float = np.max(
        np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1) @ offsets.T, axis=1, initial=0.0
    )
    margin = _BOUND_MARGIN * float(np.max(box[1] - box[0]))
    beyond = 0.0 if complete.all() else model.focal_length_px
    reach_px: Float = support + margin + beyond
    return reach_px


def _meets(body: Body, directions: Float) -> Mask:
    """Whether rays (..., 3) from the camera meet the body."""
    met = body.tracer.occluded(body.camera_body_km, directions.reshape(-1, 3))
    return met.reshape(directions.shape[:-1])


def _scan(body: Body, lines: _Lines) -> tuple[Float, Float]:
    """Radii (k,), px, of the outermost hit on each line and of the miss next to it; NaN without such a pair."""
    longest_px = float(np.max(lines.stop_px))
    count = int(np.clip(np.ceil(longest_px / _SCAN_STEP_PX), *_SCAN_STEPS))
    fractions = np.linspace(0.0, 1.0, count + 1)
    last = np.full(lines.stop_px.shape, -1)
    active = np.arange(last.size)
    for stop in range(count + 1, 0, -_SCAN_BLOCK):
        block = fractions[max(stop - _SCAN_BLOCK, 0) : stop]
        met = _meets(body, lines.some(active).at_fractions(block))
        hit = met.any(axis=1)
        last[active[hit]] = stop - 1 - np.argmax(met[hit, ::-1], axis=1)
        active = active[~hit]
        if not active.size:
            break
    found = (last >= 0) & (last < count)  # a hit at the very end has no miss beyond it
    inner = np.where(found, fractions[last], np.nan) * lines.stop_px
    outer = np.where(found, fractions[np.minimum(last + 1, count)], np.nan) * lines.stop_px
    return inner, outer


def _bisected(body: Body, lines: _Lines, inner_px: Float, outer_px: Float) -> Float:
    """Halve the intervals from a hit to a miss; return the radii (k,), px, of the last hits."""
    inner, outer = inner_px.copy(), outer_px.copy()
    for _ in range(_HALVINGS):
        middle = 0.5 * (inner + outer)
        met = _meets(body, lines.at(middle))
        inner, outer = np.where(met, middle, inner), np.where(met, outer, middle)
    return inner


def _chord_normals(outline: EdgeOutline, center_px: Float, angles_rad: Float, edge_px: Float) -> Float:
    """Outward normals (k, 2) of the chords between outline points half a pixel to either side.

    NaN where the outline breaks off within that pixel: its edge is then not found near ``edge_px``.
    """
    normals = np.full((edge_px.size, 2), np.nan)
    known = np.flatnonzero(edge_px > 0.0)
    radius = np.tile(edge_px[known], 2)
    turn = np.minimum(_TANGENT_PX / radius, 0.05)
    angles = np.tile(angles_rad[known], 2) + np.repeat([-1.0, 1.0], known.size) * turn
    ends = outline.outermost(center_px, angles).radii_px
    ends[~(np.abs(ends - radius) < 4.0 * turn * radius)] = np.nan
    points = ends[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    tangents = points[known.size :] - points[: known.size]
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    normals[known] = np.stack([tangents[:, 1], -tangents[:, 0]], axis=-1) / np.where(lengths > 0.0, lengths, np.nan)
    return normals
