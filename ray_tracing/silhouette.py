"""Silhouette of a body: points of its outline in the image, their normals and light, without a ray for the outline.

The outline comes from silhouette edges, which every ray that grazes a mesh meets, and limb ellipses, intersected by
lines in float64: exact at any range. Where the camera images only part of it, part of the body may lie beyond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Indices, Mask, as_finite, as_floats, require, unit
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.sampling import finite_rows
from giantlike.ray_tracing.tracer import Hits
from giantlike.shapes import Ellipsoid, TriangleMesh
from giantlike.shapes.limbs import crossings, largest_of_each, limb_ellipse, silhouette_edges

_TANGENT_PX = 0.5  # px to either side over which a normal is taken: one pixel of the outline
_FAR_FOCAL_LENGTHS = 10.0  # 84 deg off the axis of a pinhole camera
_HALVINGS = 40  # of that distance, to find the end of the image: 1e-8 px where the focal length is a thousand
_BEYOND = np.linspace(0.02, 1.0, 12)  # positions between outline and the end of the image, as fractions
_TURN = 2.0 * np.pi  # rad
_NEWTON_STEPS = 4  # at most, from the chord, with quadratic convergence: distortion hardly bends a single edge
_STILL = 1e-7  # of the length of an edge: the step after such a one is shorter than rounding
_ELLIPSE_CORNERS = 720  # chords of an ellipse to start from: half a degree
_ACROSS = 1e-12  # of the length of an edge: with less of it across a line the edge lies along the line, to rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Silhouette(Value):
    """Outermost points of a body along directions in the image.

    Parameters
    ----------
    angles_rad : (k,) float64, rad; directions, from +x (columns) towards +y (rows)
    center_px : (2,) float64, px; start of the directions
    valid : (k,) bool; False where no edge is met that the camera can image; other arrays are NaN or False there
    points_px : (k, 2) float64, px; limb points in the distorted image
    points_camera_km : (k, 3) float64, km, camera axes; the same points on the surface, from the camera
    normals_px : (k, 2) float64, unitless; outward unit normals of the outline in the image, taken over one pixel of it
    points_by_position : (k, 2, 3) float64, px/km
        Derivative of ``points_px`` with respect to the body's position in camera axes, for fixed directions and a
        fixed ``center_px``. On a mesh, of the current edge: it jumps from edge to edge.
    cos_incidence : (k,) float64; cosine of the angle from surface normal to Sun
    lit : (k,) bool; the Sun is over the horizon there, and nothing in the way
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
    angles_rad : (k,), rad; directions in the image, from +x towards +y
    sun_direction_camera : (3,), unitless, camera axes; unit vector from body to Sun
    center_px : (2,), px, optional; start of the directions; None takes the projection of the body's origin

    Raises
    ------
    InputError
        An angle is not finite, a shape is wrong, or the Sun direction is not a unit vector.

    Notes
    -----
    The outline of a mesh is the outermost of its silhouette edges and of an ellipsoid an ellipse, cut by the
    lines in float64: exact at any range. Only where the camera model images part of the outline are rays shot along
    the line, to see that the body does not go on beyond; edges that it images in part are left out. To first order a
    limb point moves along its normal by ``normal @ model.project_jacobian(point) @ dposition`` when the
    camera-to-body vector changes by ``dposition``.
    """
    angles = as_floats(angles_rad, (), "angles_rad")
    usable = angles.ndim == 1 and bool(np.isfinite(angles).all())
    require(usable, f"angles_rad must be finite and of shape (k,), got {angles.shape}")
    sun_body = sun_in_body(body, sun_direction_camera)
    center = body.center_px(model) if center_px is None else as_finite(center_px, (2,), "center_px")
    body = body.seen_by(model)
    outline, edge, points_camera_km = _edge(body, model, center, angles)
    points_px = model.project(points_camera_km)
    valid = finite_rows(points_px)
    grazing_px = projected_normals(model, points_camera_km, edge.normals_camera)
    normals_px = grazing_px
    if isinstance(outline, EdgeOutline):
        chords_px = _chord_normals(outline, center, angles, np.where(valid, edge.radii_px, np.nan))
        normals_px = np.where(np.isfinite(chords_px), chords_px, grazing_px)
    hits = _hits(body, valid, points_camera_km, edge)
    return Silhouette(
        angles_rad=angles.copy(),
        center_px=center,
        valid=valid,
        points_px=points_px,
        points_camera_km=points_camera_km,
        normals_px=normals_px,
        points_by_position=_by_position(model, points_camera_km, grazing_px, angles),
        cos_incidence=np.where(valid, hits.normals @ sun_body, np.nan),
        lit=valid & ~body.tracer.is_shadowed(hits, sun_body),
    )


def outline_points_px(body: Body, model: CameraModel, angles_rad: ArrayLike) -> Float:
    """Outermost points of a body's outline, as :func:`trace_silhouette` finds them, without their normals and light.

    ``angles_rad`` (k,), directions from the projection of the body's origin, from +x towards +y; returns (k, 2), NaN
    where the direction meets no edge that the camera can image.
    """
    angles = as_floats(angles_rad, (), "angles_rad")
    _, _, points_camera_km = _edge(body.seen_by(model), model, body.center_px(model), angles)
    return model.project(points_camera_km)


def lit_outline(
    body: Body, model: CameraModel, angles_rad: ArrayLike, *, sun_direction_camera: ArrayLike
) -> tuple[Float, Mask]:
    """Outermost points of a body's outline that the camera can image, and where the Sun shines on them.

    ``angles_rad`` (k,), directions from the projection of the body's origin, from +x towards +y;
    ``sun_direction_camera``: unit vector from body to Sun; returns ``points_px`` (n, 2) and ``lit`` (n,).
    """
    angles, body = as_floats(angles_rad, (), "angles_rad"), body.seen_by(model)
    _, edge, points_camera_km = _edge(body, model, body.center_px(model), angles)
    points_px = model.project(points_camera_km)
    valid = finite_rows(points_px)
    hits = _hits(body, valid, points_camera_km, edge)
    dark = body.tracer.is_shadowed(hits, sun_in_body(body, sun_direction_camera))
    return points_px[valid], ~dark[valid]


def _edge(
    body: Body, model: CameraModel, center_px: Float, angles_rad: Float
) -> tuple[EdgeOutline | EllipseOutline, Crossings, Float]:
    """Outline of a body, its outermost crossings, and these in space (k, 3), km: NaN where more of it lies beyond."""
    outline = outline_of(body, model)
    edge = outline.outermost(center_px, angles_rad)
    if outline.complete:
        return outline, edge, edge.points_camera_km
    covered = _is_covered(body, model, center_px, angles_rad, edge.radii_px)
    return outline, edge, np.where(covered[:, None], np.nan, edge.points_camera_km)


def _hits(body: Body, valid: Mask, points_camera_km: Float, edge: Crossings) -> Hits:
    """The surface that faces the camera at outline points."""
    points = body.to_body(points_camera_km - body.position_camera_km)
    normals = body.to_body(edge.normals_camera)
    if isinstance(body.shape, TriangleMesh):
        normals[valid] = body.shape.normals[edge.facets[valid]]
    normals[~valid] = np.nan
    return Hits(valid, points, edge.facets, normals)


def _is_covered(body: Body, model: CameraModel, center_px: Float, angles_rad: Float, radii_px: Float) -> Mask:
    """Return True for lines (k,) that meet the body again beyond ``radii_px``, up to the end of the camera model."""
    steps = _steps(angles_rad)
    near, far = radii_px, radii_px + _FAR_FOCAL_LENGTHS * model.focal_length_px
    last = far.copy()
    for _ in range(_HALVINGS):
        imaged = finite_rows(model.unproject(center_px + last[:, None] * steps))
        near, far = np.where(imaged, last, near), np.where(imaged, far, last)
        last = np.where(near >= far, far, 0.5 * (near + far))
    places = radii_px[:, None] + (near - radii_px)[:, None] * _BEYOND
    rays = body.to_body(model.unproject(center_px + places[..., None] * steps[:, None, :]))
    met = body.tracer.is_occluded(body.camera_body_km, rays.reshape(-1, 3))
    return np.asarray(np.any(met.reshape(-1, _BEYOND.size), axis=1))


def _by_position(model: CameraModel, points_camera_km: Float, normals_px: Float, angles_rad: Float) -> Float:
    """Derivative (k, 2, 3) of outline points along fixed lines: the outline moves along its normals."""
    steps = _steps(angles_rad)
    outward = np.einsum("ki,kij->kj", normals_px, model.project_jacobian(points_camera_km))
    slant = np.einsum("ki,ki->k", normals_px, steps)
    return np.asarray(steps[:, :, None] * (outward / np.where(slant == 0.0, np.nan, slant)[:, None])[:, None, :])


def _chord_normals(outline: EdgeOutline, center_px: Float, angles_rad: Float, edge_px: Float) -> Float:
    """Outward normals (k, 2) of chords over a pixel of the outline; NaN where the outline breaks off there."""
    normals = np.full((edge_px.size, 2), np.nan)
    known = np.flatnonzero(edge_px > 0.0)
    radius = np.tile(edge_px[known], 2)
    turn = np.minimum(_TANGENT_PX / radius, 0.05)
    angles = np.tile(angles_rad[known], 2) + np.repeat([-1.0, 1.0], known.size) * turn
    ends = outline.outermost(center_px, angles).radii_px
    ends = np.where(np.abs(ends - radius) < 4.0 * turn * radius, ends, np.nan)
    points = ends[:, None] * _steps(angles)
    tangents = points[known.size :] - points[: known.size]
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    normals[known] = np.stack([tangents[:, 1], -tangents[:, 0]], axis=-1) / np.where(lengths > 0.0, lengths, np.nan)
    return normals


@dataclass(frozen=True, slots=True, eq=False)
class Crossings(Value):
    """Outermost intersections of lines in the image with a shape."""

    radii_px: Float  # (k,); from the start of each line; NaN where it meets no edge, as all that follows
    points_camera_km: Float  # (k, 3); on the shape
    normals_camera: Float  # (k, 3); outward, across the ray: of the ellipsoid, or of camera and edge
    facets: Indices  # (k,); facet at the edge that faces the camera, 0 on an ellipsoid; -1 for none


@dataclass(frozen=True, slots=True, eq=False)
class EdgeOutline(Value):
    """Silhouette edges of a mesh in the image."""

    model: CameraModel
    starts_km: Float  # starts_km, stops_km: (e, 3), camera axes; ends of the edges that the model images
    stops_km: Float
    starts_px: Float  # (e, 2)
    stops_px: Float  # (e, 2)
    facets: Indices  # (e,)
    complete: bool  # the model images all edges, so that the outermost one along a line is the outline

    @classmethod
    def from_mesh(cls, body: Body, mesh: TriangleMesh, model: CameraModel) -> EdgeOutline:
        """Return the silhouette edges of ``mesh``, the shape of ``body``."""
        edges, facets = silhouette_edges(mesh, body.camera_body_km)
        vertices, corner = np.unique(edges, return_inverse=True)
        points = body.to_camera(mesh.vertices_km[vertices]) + body.position_camera_km
        pixels = model.project(points)
        start, stop = corner.reshape(-1, 2).T
        imaged = finite_rows(pixels)
        keep = imaged[start] & imaged[stop]
        start, stop = start[keep], stop[keep]
        return cls(
            model,
            points[start],
            points[stop],
            pixels[start],
            pixels[stop],
            facets[keep],
            bool(keep.all() and keep.size),
        )

    def outermost(self, center_px: Float, angles_rad: Float) -> Crossings:
        """Return the last crossing of each line from ``center_px`` (2,) at ``angles_rad`` (k,) with an imaged edge."""
        which, line = crossings(self.starts_px - center_px, self.stops_px - center_px, angles_rad)
        steps = _steps(angles_rad)[line]
        fraction, slanted = self._cut(which, center_px, steps)
        which, line, steps, fraction = which[slanted], line[slanted], steps[slanted], fraction[slanted]
        edges = self.stops_km[which] - self.starts_km[which]
        points = self.starts_km[which] + fraction[:, None] * edges
        radii = np.einsum("pi,pi->p", self.model.project(points) - center_px, steps)
        best = largest_of_each(line, radii, angles_rad.size)
        found = best >= 0
        best = best[found]
        normals = unit(np.cross(points[best], edges[best]))
        in_image = projected_normals(self.model, points[best], normals)
        normals *= np.sign(np.einsum("pi,pi->p", in_image, steps[best]))[:, None]
        return _crossings(found, radii[best], points[best], normals, self.facets[which[best]])

    def _cut(self, which: Indices, center_px: Float, steps: Float) -> tuple[Float, Mask]:
        """Fractions (p,) along edges at which they cross lines, and True (p,) for edges that do so at an angle.

        Without distortion an edge crosses a plane; Newton steps do the rest.
        """
        starts, stops = self.starts_km[which], self.stops_km[which]
        begin, end = _aside(self.starts_px[which] - center_px, steps), _aside(self.stops_px[which] - center_px, steps)
        ahead = (starts[:, 2] > 0.0) & (stops[:, 2] > 0.0)
        begin, end = begin * np.where(ahead, starts[:, 2], 1.0), end * np.where(ahead, stops[:, 2], 1.0)
        slanted = np.abs(begin - end) > _ACROSS * np.abs(begin + end)
        fraction = np.clip(begin / np.where(slanted, begin - end, 1.0), 0.0, 1.0)
        edges = stops - starts
        for _ in range(_NEWTON_STEPS):
            points = starts + fraction[:, None] * edges
            value = _aside(self.model.project(points) - center_px, steps)
            slope = _aside(np.einsum("pij,pj->pi", self.model.project_jacobian(points), edges), steps)
            slope = np.where(slope == 0.0, np.inf, slope)
            before, fraction = fraction, np.clip(fraction - value / slope, 0.0, 1.0)
            if np.allclose(fraction, before, rtol=0.0, atol=_STILL):
                break
        return fraction, slanted


@dataclass(frozen=True, slots=True, eq=False)
class EllipseOutline(Value):
    """The limb of an ellipsoid in the image: ``middle_km + cos(t) first_km + sin(t) second_km``."""

    model: CameraModel
    middle_km: Float  # middle_km, first_km, second_km: in camera axes
    first_km: Float
    second_km: Float
    center_km: Float  # in camera axes; center of the ellipsoid
    shape_matrix: Float  # (3, 3) 1/km^2, camera axes; points of the surface about that center have ``x.A.x == 1``
    corners_px: Float  # (c, 2); points of the limb at even steps of t, NaN where the model has no image
    complete: bool  # the model images all of them

    @classmethod
    def from_ellipsoid(cls, body: Body, ellipsoid: Ellipsoid, model: CameraModel) -> EllipseOutline:
        """Return the limb of ``ellipsoid``, the shape of ``body``; without corners when the camera is inside."""
        middle, first, second = (body.to_camera(vector) for vector in limb_ellipse(ellipsoid, body.camera_body_km))
        middle = middle + body.position_camera_km
        turn = _TURN * np.arange(_ELLIPSE_CORNERS) / _ELLIPSE_CORNERS
        corners = middle + np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        pixels = model.project(corners)
        rotation = body.camera_from_body.as_matrix()
        matrix = (rotation / ellipsoid.radii_km**2) @ rotation.T
        complete = bool(finite_rows(pixels).all())
        return cls(model, middle, first, second, body.position_camera_km, matrix, pixels, complete)

    def outermost(self, center_px: Float, angles_rad: Float) -> Crossings:
        """Return the last crossing of each line from ``center_px`` (2,) at ``angles_rad`` (k,) with the imaged limb."""
        start = np.flatnonzero(finite_rows(self.corners_px) & finite_rows(np.roll(self.corners_px, -1, axis=0)))
        stop = (start + 1) % _ELLIPSE_CORNERS
        which, line = crossings(self.corners_px[start] - center_px, self.corners_px[stop] - center_px, angles_rad)
        steps = _steps(angles_rad)[line]
        begin, end = (_aside(self.corners_px[corner[which]] - center_px, steps) for corner in (start, stop))
        turn = start[which] + begin / np.where(begin == end, np.inf, begin - end)
        turn *= _TURN / _ELLIPSE_CORNERS
        for _ in range(_NEWTON_STEPS):
            points, along = self._at(turn)
            value = _aside(self.model.project(points) - center_px, steps)
            slope = _aside(np.einsum("pij,pj->pi", self.model.project_jacobian(points), along), steps)
            turn = turn - value / np.where(slope == 0.0, np.inf, slope)
        points, _ = self._at(turn)
        radii = np.einsum("pi,pi->p", self.model.project(points) - center_px, steps)
        best = largest_of_each(line, radii, angles_rad.size)
        found = best >= 0
        points = points[best[found]]
        normals = unit((points - self.center_km) @ self.shape_matrix)
        return _crossings(found, radii[best[found]], points, normals, np.zeros(len(points), dtype=np.int64))

    def _at(self, turn: Float) -> tuple[Float, Float]:
        """Points (p, 3) of the limb, km, and their derivative."""
        cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
        points = self.middle_km + cosine * self.first_km + sine * self.second_km
        return points, cosine * self.second_km - sine * self.first_km


def outline_of(body: Body, model: CameraModel) -> EdgeOutline | EllipseOutline:
    """Return the outline of a body."""
    if isinstance(body.shape, TriangleMesh):
        return EdgeOutline.from_mesh(body, body.shape, model)
    if isinstance(body.shape, Ellipsoid):
        return EllipseOutline.from_ellipsoid(body, body.shape, model)
    raise InputError(f"an outline needs a TriangleMesh or an Ellipsoid, got a {type(body.shape).__name__}")


def _crossings(found: Mask, radii: Float, points: Float, normals: Float, facets: Indices) -> Crossings:
    """Crossings (k,) from values of those that were ``found``."""
    all_radii, all_facets = np.full(found.size, np.nan), np.full(found.size, -1)
    all_points, all_normals = np.full((2, found.size, 3), np.nan)
    all_radii[found], all_facets[found] = radii, facets
    all_points[found], all_normals[found] = points, normals
    return Crossings(all_radii, all_points, all_normals, all_facets)


def _steps(angles_rad: Float) -> Float:
    """Unit vectors (k, 2) in the image."""
    return np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)


def projected_normals(model: CameraModel, points_camera_km: Float, normals_camera: Float) -> Float:
    """Unit normals (k, 2) in the image of a surface seen edge-on at points (k, 3)."""
    jacobian = model.project_jacobian(points_camera_km)
    gram = jacobian @ np.swapaxes(jacobian, -1, -2)
    sideways = (jacobian @ normals_camera[..., None])[..., 0]
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    x = gram[:, 1, 1] * sideways[:, 0] - gram[:, 0, 1] * sideways[:, 1]
    y = gram[:, 0, 0] * sideways[:, 1] - gram[:, 0, 1] * sideways[:, 0]
    normal = np.stack([x, y], axis=-1) / determinant[:, None]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(length > 0.0, length, np.nan))


def _aside(offsets_px: Float, steps: Float) -> Float:
    """Distances (p,), px, of offsets (p, 2) from lines along ``steps`` (p, 2)."""
    return np.asarray(offsets_px[:, 0] * steps[:, 1] - offsets_px[:, 1] * steps[:, 0])
