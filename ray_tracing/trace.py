"""Rays from the camera to a body and on to the Sun: everything of a render but the reflectance law and the PSF."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.neighbours import Neighbour
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.sampling import Cells, RayGrid
from giantlike.ray_tracing.sun import disc_directions
from giantlike.ray_tracing.tracer import Indices, Mask, Real, Sight
from giantlike.shapes import TriangleMesh

_RAYS_PER_CHUNK = 40_000  # fits a cache and keeps whole frames cheap in memory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A body before a camera, the Sun and its neighbours: what there is to trace.

    Parameters
    ----------
    body : Body
    model : CameraModel
    cells : (Cells, Cells)
        Along x and y of the image.
    sun_body : (3,) float64, unitless, body axes
    neighbours : tuple of Neighbour
    options : RenderOptions
    """

    body: Body
    model: CameraModel
    cells: tuple[Cells, Cells]
    sun_body: Float
    neighbours: tuple[Neighbour, ...]
    options: RenderOptions


@dataclass(frozen=True, slots=True, eq=False)
class Sunlight:
    """Where one point of the Sun shines on what is seen.

    Parameters
    ----------
    seen : (k,) int64
        Numbers in the arrays of a ``Sight``.
    cos_incidence : (k,) float
    phase_rad : (k,) float64, rad
    """

    seen: Indices
    cos_incidence: Real
    phase_rad: Real


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strip:
    """Some rows of cells, traced.

    Parameters
    ----------
    start, stop : int
        Rows of cells, from the first one of the view.
    sight : Sight
        Ray numbers count the cells of the strip, row after row.
    light : tuple of Sunlight
        One for each point of the Sun that rays are bounced to.
    albedo : (k,) float64, optional
        Relative albedo at what is seen; None where it is 1 throughout.
    """

    start: int
    stop: int
    sight: Sight
    light: tuple[Sunlight, ...]
    albedo: Float | None

    @property
    def lit(self) -> int:
        """Number of rays that see some of the Sun."""
        if len(self.light) == 1:
            return int(self.light[0].seen.size)
        return int(np.unique(np.concatenate([light.seen for light in self.light])).size)


def strips(view: View) -> Iterator[Strip]:
    """Trace a view, some rows of cells at a time."""
    x, y = view.cells
    seed = view.options.jitter_seed
    random = None if seed is None else np.random.default_rng(seed)
    grid = RayGrid(view.model, x, y, view.body.camera_from_body.as_matrix().T, random)
    step = max(_RAYS_PER_CHUNK // x.count, 1)
    for start in range(0, y.count, step):
        stop = min(start + step, y.count)
        yield _strip(view, start, stop, grid.rows(start, stop))


def _strip(view: View, start: int, stop: int, directions: Float) -> Strip:
    body = view.body
    camera = body.camera_body_km
    sight = body.tracer.sight(camera, directions)
    for neighbour in view.neighbours:
        if neighbour.hides:
            sight = sight.only(~neighbour.hidden(camera, sight.points_km))
    suns = _suns(view, start, sight.rays.size)
    light = tuple(_sunlight(view, sight, directions, sun) for sun in suns)
    return Strip(start=start, stop=stop, sight=sight, light=light, albedo=_albedo(body, sight))


def _suns(view: View, start: int, count: int) -> list[Float]:
    """Directions, (3,) or (count, 3), to the points of the Sun that rays are bounced to."""
    options = view.options
    if options.sun_radius_rad == 0.0:
        return [view.sun_body]
    first, turn = np.random.default_rng([options.sun_seed, start]).uniform(size=(2, count))
    return disc_directions(view.sun_body, options.sun_radius_rad, options.sun_samples, first, turn)


def _sunlight(view: View, sight: Sight, directions: Float, sun: Float) -> Sunlight:
    """Which points see a point of the Sun, towards (3,) or (k, 3)."""
    cos_incidence = _dot(sight.normals, sun)
    seen = np.flatnonzero(cos_incidence > 0.0)
    toward = sun if sun.ndim == 1 else sun[seen]
    if view.options.shadows and seen.size:
        clear = ~_dark(view, sight, seen, toward)
        seen, toward = seen[clear], toward if sun.ndim == 1 else toward[clear]
    cos_phase = -_dot(directions[sight.rays[seen]], toward)
    return Sunlight(seen, cos_incidence[seen], np.arccos(np.clip(cos_phase, -1.0, 1.0)))


def _dark(view: View, sight: Sight, seen: Indices, toward: Float) -> Mask:
    """Whether anything stands between some of what is seen and a point of the Sun."""
    points = sight.points_km[seen]
    dark = view.body.tracer.dark(points, sight.normals[seen], toward)
    for neighbour in view.neighbours:
        if neighbour.shades:
            dark |= neighbour.dark(points, toward)
    return dark


def _dot(vectors: Real, other: Real) -> Real:
    """Scalar products (k,) of vectors (k, 3) with one (3,) or as many (k, 3)."""
    return vectors @ other if other.ndim == 1 else np.einsum("ij,ij->i", vectors, other)


def _albedo(body: Body, sight: Sight) -> Float | None:
    """Relative albedo (k,) of what is seen."""
    shape = body.shape
    if shape.albedo is None:
        return None
    points = sight.points_km.astype(np.float64)
    weights = shape.barycentric(points, sight.facets) if isinstance(shape, TriangleMesh) else None
    return shape.albedo.at(points, sight.facets, weights)
