"""Rays from the camera to a body and on to the Sun: everything of a render but the reflectance law and the PSF."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.embree import Float32, dot, rows_of
from giantlike.ray_tracing.neighbors import Neighbor
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.sampling import RayGrid
from giantlike.ray_tracing.sun import disk_directions
from giantlike.ray_tracing.tracer import Indices, Mask, Sight
from giantlike.ray_tracing.window import Tile, Window
from giantlike.shapes import TriangleMesh

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A body before a camera, the Sun and its neighbors: what there is to trace.

    Parameters
    ----------
    body : Body
    model : CameraModel
    window : Window
    camera_body_km : (3,) float64, km, body axes
        Where the camera is.
    sun_body : (4,) float64, unitless, body axes
        Unit vector to the Sun and a zero: see ``Sight``.
    neighbors : tuple of Neighbor
    options : RenderOptions
    """

    body: Body
    model: CameraModel
    window: Window
    camera_body_km: Float
    sun_body: Float
    neighbors: tuple[Neighbor, ...]
    options: RenderOptions

    def ray_grid(self) -> RayGrid:
        """Directions of the rays through the cells, body axes."""
        rotation = self.body.camera_from_body.as_matrix().T
        return RayGrid(self.model, *self.window.cells, rotation, self.options.jitter_seed)


@dataclass(frozen=True, slots=True, eq=False)
class Sunlight:
    """Where one point of the Sun shines on what is seen.

    Parameters
    ----------
    seen : (k,) int64
        Numbers in the arrays of a ``Sight``.
    cos_incidence : (k,) float32
    phase_rad : (k,) float64, rad
    """

    seen: Indices
    cos_incidence: Float32
    phase_rad: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TracedTile:
    """A tile of cells, traced.

    Parameters
    ----------
    tile : Tile
    sight : Sight
        Ray numbers count the cells of the tile, column after column.
    directions : (n, 4) float64, unitless, body axes
        Of all rays of the tile.
    light : tuple of Sunlight
        One for each point of the Sun that rays are bounced to.
    albedo : (k,) float64, optional
        Relative albedo at what is seen; None where it is 1 throughout.
    """

    tile: Tile
    sight: Sight
    directions: Float
    light: tuple[Sunlight, ...]
    albedo: Float | None

    @property
    def lit(self) -> int:
        """Number of rays that see some of the Sun."""
        if len(self.light) == 1:
            return int(self.light[0].seen.size)
        return int(np.unique(np.concatenate([light.seen for light in self.light])).size)


def trace_tile(view: View, grid: RayGrid, tile: Tile) -> TracedTile:
    """Send the rays of a tile to the body and on to the Sun."""
    body, camera_km = view.body, view.camera_body_km
    directions = grid.tile(tile.start, tile.stop, tile.left, tile.right)
    sight = body.tracer.sight(camera_km, directions)
    for neighbor in view.neighbors:
        if neighbor.hides:
            before = neighbor.hidden(camera_km, directions.take(sight.rays, axis=0), sight.points_km)
            sight = sight.only(~before)
    light = sunlight(view, tile, sight, directions)
    return TracedTile(tile=tile, sight=sight, directions=directions, light=light, albedo=_albedo(body, sight))


def sunlight(view: View, tile: Tile, sight: Sight, directions: Float) -> tuple[Sunlight, ...]:
    """Bounce what is seen along the ``directions`` (n, 4) of a tile to the points of the Sun."""
    options = view.options
    suns = [view.sun_body]
    if options.sun_radius_rad > 0.0:
        random = np.random.default_rng([options.sun_seed, tile.start])
        first, turn = random.uniform(size=(2, sight.rays.size))
        suns = disk_directions(view.sun_body, options.sun_radius_rad, options.sun_samples, first, turn)
    return tuple(_sunlight(view, sight, directions, sun) for sun in suns)


def _sunlight(view: View, sight: Sight, directions: Float, sun: Float) -> Sunlight:
    """Which points see a point of the Sun, towards (4,) or (k, 4)."""
    cos_incidence = dot(sight.normals, sun.astype(np.float32))
    seen = np.flatnonzero(cos_incidence > 0.0)
    toward = sun if sun.ndim == 1 else sun.take(seen, axis=0)
    if view.options.shadows and seen.size:
        clear = np.flatnonzero(~_dark(view, sight, seen, toward))
        seen, toward = seen.take(clear), toward if sun.ndim == 1 else toward.take(clear, axis=0)
    cos_phase = -dot(directions.take(sight.rays.take(seen), axis=0), toward)
    return Sunlight(seen, cos_incidence.take(seen), np.arccos(np.clip(cos_phase, -1.0, 1.0)))


def _dark(view: View, sight: Sight, seen: Indices, toward: Float) -> Mask:
    """Whether anything stands between some of what is seen and a point of the Sun."""
    points = rows_of(sight.points_km, seen)
    dark = view.body.tracer.dark(points, rows_of(sight.normals, seen), toward)
    for neighbor in view.neighbors:
        if neighbor.shades:
            dark |= neighbor.dark(points, toward)
    return dark


def _albedo(body: Body, sight: Sight) -> Float | None:
    """Relative albedo (k,) of what is seen."""
    shape = body.shape
    if shape.albedo is None:
        return None
    points, facets = sight.points_km[:, :3].astype(np.float64), sight.facets.astype(np.int64)
    weights = shape.barycentric(points, facets) if isinstance(shape, TriangleMesh) else None
    return shape.albedo.at(points, facets, weights)


def in_order(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Results of a function for all items, in their order, on some threads: the same for any number of them."""
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, items)
