"""Outline of a shape in the image without rays: silhouette edges and limb ellipses, intersected by lines in float64.

Every ray that grazes a mesh meets a silhouette edge, and beyond the outermost one along a line there is only sky; the
limb of an ellipsoid is an ellipse. Both are exact at any range. Where the camera model images only part of the outline,
part of the body may still lie beyond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, unit
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.sampling import finite_rows
from giantlike.ray_tracing.tracer import Indices
from giantlike.shapes import Ellipsoid, TriangleMesh
from giantlike.shapes.limbs import crossings, largest_of_each, limb_ellipse, silhouette_edges

_TURN = 2.0 * np.pi  # rad
_NEWTON_STEPS = 4  # from the chord, with quadratic convergence: distortion hardly bends a single edge
_ELLIPSE_CORNERS = 720  # chords of an ellipse to start from: half a degree
_ACROSS = 1e-12  # of the length of an edge: with less of it across a line the edge lies along the line, to rounding


@dataclass(frozen=True, slots=True, eq=False)
class Crossings(Value):
    """Outermost intersections of lines in the image with a shape.

    Parameters
    ----------
    radii_px : (k,) float64, px
        From the start of each line; NaN where it meets no edge, as all that follows.
    points_camera_km : (k, 3) float64, km, camera axes
        On the shape.
    normals_camera : (k, 3) float64, unitless, camera axes
        Outward and square to the ray: of an ellipsoid, or of the plane through the camera and the edge of a mesh.
    facets : (k,) int64
        Facet at the edge that faces the camera, 0 on an ellipsoid; -1 for none.
    """

    radii_px: Float
    points_camera_km: Float
    normals_camera: Float
    facets: Indices


@dataclass(frozen=True, slots=True, eq=False)
class EdgeOutline(Value):
    """Silhouette edges of a mesh in the image.

    Parameters
    ----------
    model : CameraModel
    starts_km, stops_km : (e, 3) float64, km, camera axes
        Ends of the edges that the model images.
    starts_px, stops_px : (e, 2) float64, px
    facets : (e,) int64
    complete : bool
        The model images all edges, so that the outermost one along a line is the outline.
    """

    model: CameraModel
    starts_km: Float
    stops_km: Float
    starts_px: Float
    stops_px: Float
    facets: Indices
    complete: bool

    @classmethod
    def of(cls, body: Body, mesh: TriangleMesh, model: CameraModel) -> EdgeOutline:
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

        Without distortion the crossing is that of an edge and a plane; Newton steps do the rest.
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
            fraction = np.clip(fraction - value / slope, 0.0, 1.0)
        return fraction, slanted


@dataclass(frozen=True, slots=True, eq=False)
class EllipseOutline(Value):
    """The limb of an ellipsoid in the image: ``middle_km + cos(t) first_km + sin(t) second_km``.

    Parameters
    ----------
    model : CameraModel
    middle_km, first_km, second_km : (3,) float64, km, camera axes
    center_km : (3,) float64, km, camera axes
        Center of the ellipsoid.
    shape_matrix : (3, 3) float64, 1/km^2, camera axes
        Points of the surface about that center have ``x.A.x == 1``.
    corners_px : (c, 2) float64, px
        Points of the limb at even steps of t, NaN where the model has no image.
    complete : bool
        The model images all of them.
    """

    model: CameraModel
    middle_km: Float
    first_km: Float
    second_km: Float
    center_km: Float
    shape_matrix: Float
    corners_px: Float
    complete: bool

    @classmethod
    def of(cls, body: Body, ellipsoid: Ellipsoid, model: CameraModel) -> EllipseOutline:
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
    """Return the outline of a body.

    Parameters
    ----------
    body : Body
    model : CameraModel

    Returns
    -------
    EdgeOutline or EllipseOutline

    Raises
    ------
    InputError
        The shape is neither a mesh nor an ellipsoid.
    """
    if isinstance(body.shape, TriangleMesh):
        return EdgeOutline.of(body, body.shape, model)
    if isinstance(body.shape, Ellipsoid):
        return EllipseOutline.of(body, body.shape, model)
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
    """Unit normals in the image of a surface seen edge-on.

    Parameters
    ----------
    model : CameraModel
    points_camera_km : (k, 3) float64, km, camera axes
    normals_camera : (k, 3) float64, unitless, camera axes

    Returns
    -------
    (k, 2) float64, unitless
        A displacement along one is seen as a displacement along the normal of the surface.
    """
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
