"""First hits of many rays in few pixels, without a search for each: the facets of a mesh are drawn into the pixels.

Along a limb some ten thousand facets stand before a hundred thousand rays. To draw a facet into the few rays that it
can meet costs a fraction of what the search of each ray through a tree of boxes does, and rays that meet one facet
together share its light.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.drawing_loops import drawn, met, shared
from giantlike.ray_tracing.embree import Int32
from giantlike.ray_tracing.facet_patches import Patches
from giantlike.ray_tracing.tracer import Indices, MeshTracer, Sight
from giantlike.shapes import TriangleMesh

_MOST_FACETS = 3.0
"""Facets to a ray up to which they are drawn: one takes some 100 ns, a ray of Embree 300 and more."""
_CROWD = 4.0
"""Facets drawn for each pixel over those that a pixel holds face-on; along limbs of rocks it is 5."""
_SMALL_PX = 3.0
"""Length up to which a facet is lit or dark as a whole, px; on longer ones each pixel asks for itself. In 48 draws of
rocks of 300 px errors are 0.0057 px with this, with half of it and with 0, by 1, 1.7 and 1.9 times as many rays."""
_LONG_PX = 5.0
"""Length from which it is asked whether the image bends the sides of a facet: that goes with its square."""
_BENT_PX = 0.01
"""Distance of the middle of a side of a facet from a straight line, above which facets are not drawn."""
_SCALES, _ROOM = 100, 1.2
"""Places at which the scale of the image is asked for, all over the body, and room for larger ones in between."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelRays(Value):
    """Rays of some pixels.

    Parameters
    ----------
    pixels : (p, 2) int64, px
        Columns and rows.
    sides : (p,) int64
        Rays along the sides of each.
    patterns_px : (s, s, s, 2) float64, px
        For each number of rays along a side their places by row and column, from the middle of the pixel.
    """

    pixels: NDArray[np.int64]
    sides: Indices
    patterns_px: Float

    @property
    def starts(self) -> Indices:
        """First ray of each pixel, and the number of rays (p + 1,)."""
        return np.concatenate([[0], np.cumsum(self.sides**2)])

    def places_px(self, rays: Indices, numbers: Indices) -> Float:
        """Return the places (k, 2) of some rays (k,), px, which are those of pixels with these numbers (k,)."""
        side, place = self.sides[numbers], rays - self.starts[numbers]
        return np.asarray(self.pixels[numbers] + self.patterns_px[side - 1, place // side, place % side])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnSight(Value):
    """Surface seen along the rays of pixels, by one ray of those that are alike.

    Parameters
    ----------
    sight : Sight
        Of the chosen rays, in their order.
    directions : (k, 4) float64, body axes
        Of the chosen rays: unit vectors and zeros.
    group : (r,) int32
        Number among the chosen of the one that stands for each ray; -1 for rays that meet nothing.
    """

    sight: Sight
    directions: Float
    group: Int32


def drawn_sight(body: Body, model: CameraModel, rays: PixelRays) -> DrawnSight | None:
    """Find what the rays of pixels meet, by drawing facets.

    Parameters
    ----------
    body : Body
        As seen by the model.
    model : CameraModel
    rays : PixelRays

    Returns
    -------
    DrawnSight or None
        None where rays are to be traced: the body is no closed mesh, the camera does not image all of it there or bends
        the sides of its facets, or so many facets lie there that drawing them takes longer.
    """
    tracer = body.tracer
    if (
        not isinstance(body.shape, TriangleMesh)
        or body.shape.border_vertices.size
        or not isinstance(tracer, MeshTracer)
    ):
        return None
    starts, count = rays.starts, len(body.shape.faces)
    scale = model.focal_length_px / float(np.linalg.norm(body.position_camera_km))
    held = count / (body.shape.area_km2 * scale**2)
    if min(_CROWD * held * len(rays.pixels), 0.5 * count) > _MOST_FACETS * starts[-1]:
        return None
    corner_px, number = _numbered(rays.pixels)
    kept = _patches_near(body, model, tracer.patches, number >= 0, corner_px)
    camera_km = body.camera_body_km
    facets = tracer.patches.facing(camera_km, kept)
    if facets.size == 0 or facets.size > _MOST_FACETS * starts[-1]:
        return None
    vertices_km, corners = tracer.corners_of(facets)
    from_camera_km = vertices_km - camera_km
    in_camera_km = body.to_camera(from_camera_km)
    places_px = model.project(in_camera_km)
    if not (np.isfinite(places_px).all() and in_camera_km[:, 2].min() > 0.0):
        return None
    nearness = 1.0 / in_camera_km[:, 2]
    found, lengths_px = drawn(places_px, nearness, corners, number, corner_px, rays.sides, starts, rays.patterns_px)
    long = lengths_px > _LONG_PX
    if long.any() and _bent_px(model, in_camera_km, places_px, corners[long]) > _BENT_PX:
        return None
    small_px = _SMALL_PX if body.shape.albedo is None else 0.0
    group, chosen, pixels = shared(found, starts, lengths_px <= small_px)
    which = found[chosen]
    points_km, directions = met(from_camera_km, places_px, nearness, corners[which], rays.places_px(chosen, pixels))
    points_km[:, :3] += camera_km
    sight = tracer.seen(facets[which], points_km.astype(np.float32), directions.astype(np.float32))
    return DrawnSight(sight=sight, directions=directions, group=group)


def _numbered(pixels: NDArray[np.int64]) -> tuple[Indices, Int32]:
    """Corner (2,) of the box around pixels (p, 2), and their numbers in it (h, w), -1 where there is none."""
    corner = pixels.min(axis=0)
    x, y = (pixels - corner).T
    number = np.full((int(y.max()) + 1, int(x.max()) + 1), -1, np.int32)
    number[y, x] = np.arange(len(x))
    return corner, number


def _patches_near(body: Body, model: CameraModel, patches: Patches, wanted: Mask, corner_px: Indices) -> Indices:
    """Patches (q,) that may be seen in the pixels ``wanted`` (h, w); those that the model does not image among them."""
    centers_km = body.to_camera(patches.centers_km) + body.position_camera_km
    places_px = model.project(centers_km) - corner_px
    some = centers_km[:: max(len(centers_km) // _SCALES, 1)]
    scale = np.sqrt(np.square(model.project_jacobian(some)).sum(axis=(1, 2)))
    reach_px = _ROOM * float(np.nanmax(scale, initial=0.0)) * patches.radii_km + 1.0
    unknown = ~np.isfinite(places_px).all(axis=1)
    places_px[unknown], reach_px[unknown] = 0.0, np.inf
    sums = cv2.integral(wanted.astype(np.uint8))
    size = wanted.shape[::-1]
    (left, top), (right, bottom) = (
        np.clip(np.rint(places_px + sign * reach_px[:, None]) + more, 0, size).astype(np.int64).T
        for sign, more in ((-1.0, 0), (1.0, 1))
    )
    return np.flatnonzero(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0)


def _bent_px(model: CameraModel, points_km: Float, places_px: Float, corners: Int32) -> float:
    """Largest distance, px, of the middle of a side of facets (k, 3) from the straight line between its ends."""
    starts, stops = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    along = places_px[stops] - places_px[starts]
    middle = model.project(0.5 * (points_km[starts] + points_km[stops])) - places_px[starts]
    aside = along[:, 0] * middle[:, 1] - along[:, 1] * middle[:, 0]
    return float(np.max(np.abs(aside) / np.maximum(np.linalg.norm(along, axis=1), 1e-300)))
