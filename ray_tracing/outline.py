"""The outline of a mesh in the image from its silhouette edges: exact in float64, whatever the range.

Every ray that grazes a closed mesh meets a silhouette edge, and beyond the outermost one along a line there is only
sky. Where the camera model has no image of part of the outline, others must say which edge is the last one seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, unit
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.sampling import finite_rows
from giantlike.ray_tracing.tracer import Indices, Mask
from giantlike.shapes import TriangleMesh
from giantlike.shapes.limbs import crossings, largest_of_each, silhouette_edges

_NEWTON_STEPS = 4
_ACROSS = 1e-12  # of the length of an edge: less of it lies across the line


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Where lines in the image leave a mesh.

    Parameters
    ----------
    radii_px : (k,) float64, px
        From the start of each line; NaN where it meets no edge, as all that follows.
    points_camera_km : (k, 3) float64, km, camera axes
        On the edges.
    normals_camera : (k, 3) float64, unitless, camera axes
        Of the plane through edge and camera, outward.
    facets : (k,) int64
        Facet at the edge that faces the camera; -1 for none.
    """

    radii_px: Float
    points_camera_km: Float
    normals_camera: Float
    facets: Indices


@dataclass(frozen=True, slots=True, eq=False)
class EdgeOutline:
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
        """Silhouette edges of ``mesh``, the shape of ``body``."""
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

    def outermost(
        self, center_px: Float, angles_rad: Float, *, within_px: tuple[Float, Float] | None = None
    ) -> Crossings:
        """The last crossing of each line from ``center_px`` (2,) at ``angles_rad`` (k,).

        ``within_px`` gives radii (k,), (k,), px, between which it must lie, or be none.
        """
        which, line = crossings(self.starts_px - center_px, self.stops_px - center_px, angles_rad)
        steps = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)[line]
        fraction, slanted = self._cut(which, center_px, steps)
        which, line, steps, fraction = which[slanted], line[slanted], steps[slanted], fraction[slanted]
        edges = self.stops_km[which] - self.starts_km[which]
        points = self.starts_km[which] + fraction[:, None] * edges
        radii = np.einsum("pi,pi->p", self.model.project(points) - center_px, steps)
        if within_px is not None:
            low, high = within_px
            radii = np.where((radii >= low[line]) & (radii <= high[line]), radii, -np.inf)
        best = largest_of_each(line, radii, angles_rad.size)
        found = best >= 0
        found[found] = np.isfinite(radii[best[found]])
        best = np.where(found, best, 0) if radii.size else np.zeros(0, dtype=np.int64)
        return self._chosen(found, best, radii, points, edges, steps, which)

    def _cut(self, which: Indices, center_px: Float, steps: Float) -> tuple[Float, Mask]:
        """Fractions (p,) along edges at which they cross lines, and which edges do so at an angle.

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

    def _chosen(
        self, found: Mask, best: Indices, radii: Float, points: Float, edges: Float, steps: Float, which: Indices
    ) -> Crossings:
        count = found.size
        result = Crossings(
            np.full(count, np.nan), np.full((count, 3), np.nan), np.full((count, 3), np.nan), np.full(count, -1)
        )
        chosen = best[found]
        normals = unit(np.cross(points[chosen], edges[chosen]))
        in_image = projected_normals(self.model, points[chosen], normals)
        normals *= np.sign(np.einsum("pi,pi->p", in_image, steps[chosen]))[:, None]
        result.radii_px[found], result.points_camera_km[found] = radii[chosen], points[chosen]
        result.normals_camera[found], result.facets[found] = normals, self.facets[which[chosen]]
        return result


def projected_normals(model: CameraModel, points_camera_km: Float, normals_camera: Float) -> Float:
    """Unit normals (k, 2) in the image of a surface seen edge-on: they take image to surface displacements."""
    jacobian = model.project_jacobian(points_camera_km)
    gram = jacobian @ np.swapaxes(jacobian, -1, -2)
    sideways = (jacobian @ normals_camera[..., None])[..., 0]
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    x = gram[:, 1, 1] * sideways[:, 0] - gram[:, 0, 1] * sideways[:, 1]
    y = gram[:, 0, 0] * sideways[:, 1] - gram[:, 0, 1] * sideways[:, 0]
    normal = np.stack([x, y], axis=-1) / determinant[:, None]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    result: Float = normal / np.where(length > 0.0, length, np.nan)
    return result


def _aside(offsets_px: Float, steps: Float) -> Float:
    """Distances (p,), px, of offsets (p, 2) from lines along ``steps`` (p, 2)."""
    result: Float = offsets_px[:, 0] * steps[:, 1] - offsets_px[:, 1] * steps[:, 0]
    return result
