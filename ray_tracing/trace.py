"""Rays from the camera to a body and on to the Sun: everything of a render but the reflectance law and the PSF."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Indices, Mask, unit
from giantlike.core.values import Value
from giantlike.ray_tracing.air import Air
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.embree import Float32, dot, rows_of
from giantlike.ray_tracing.neighbors import Neighbor
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.tracer import Sight
from giantlike.shapes import Shape, TriangleMesh

_GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))  # spreads points evenly over a disk, for any number

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View(Value):
    """A body before a camera, the Sun and its neighbors: everything that rays meet."""

    body: Body
    sun_body: Float  # (4,); unit vector to the Sun and a zero: see ``Sight``
    neighbors: tuple[Neighbor, ...]
    options: RenderOptions


def view_of(
    body: Body,
    model: CameraModel,
    sun_direction_camera: ArrayLike,
    options: RenderOptions,
    neighbors: tuple[Neighbor, ...] = (),
) -> View:
    """View of a body through a camera model. ``sun_direction_camera``: unit vector from body to Sun."""
    body = body.seen_by(model)
    sun_body = np.append(sun_in_body(body, sun_direction_camera), 0.0)
    return View(body=body, sun_body=sun_body, neighbors=neighbors, options=options)


@dataclass(frozen=True, slots=True, eq=False)
class Sunlight(Value):
    """Points of the surface, or of the air over it, on which one point of the Sun shines."""

    seen: Indices  # (k,); numbers in the arrays of a ``Sight``
    cos_incidence: Float32  # (k,)
    phase_rad: Float  # (k,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TracedRays(Value):
    """Rays of a camera, traced to the body and on to the Sun."""

    sight: Sight  # surface met by the rays
    directions: Float  # (n, 4), body axes; of all rays
    light: tuple[Sunlight, ...]  # one for each point of the Sun that rays are bounced to
    albedo: Float | None  # (k,); relative albedo at the points of ``sight``; None where it is 1 throughout
    air: Air | None = None  # over the surface

    @property
    def lit(self) -> int:
        """Number of rays that end on a point in sunlight."""
        if len(self.light) == 1:
            return int(self.light[0].seen.size)
        return int(np.unique(np.concatenate([light.seen for light in self.light])).size)

    def among(self, numbers: Indices, directions: Float) -> TracedRays:
        """Return these rays as some of more. ``numbers`` (n,); ``directions`` (m, 4), body axes, of all of them."""
        return replace(self, sight=replace(self.sight, rays=numbers.take(self.sight.rays)), directions=directions)

    def only(self, keep: Mask) -> TracedRays:
        """Return these rays with the hits for which ``keep`` (k,) is True; the others meet nothing."""
        numbers = np.cumsum(keep) - 1

        def kept(light: Sunlight) -> Sunlight:
            which = np.flatnonzero(keep.take(light.seen))
            seen = numbers.take(light.seen.take(which))
            return Sunlight(seen, light.cos_incidence.take(which), light.phase_rad.take(which))

        albedo = None if self.albedo is None else self.albedo[keep]
        return replace(self, sight=self.sight.only(keep), light=tuple(map(kept, self.light)), albedo=albedo)

    def brightness(self, law: Reflectance) -> Float:
        """Brightness (n,) of all rays under a reflectance law; 0 for those that meet nothing lit."""
        brightness = np.zeros(len(self.directions))
        for light in self.light:
            angles = light.cos_incidence, self.sight.cos_emission.take(light.seen), light.phase_rad
            value = law(*angles) if self.air is None else self.air.brightness(law, *angles)
            if self.albedo is not None:
                value = value * self.albedo.take(light.seen)
            rays = self.sight.rays.take(light.seen)
            if len(self.light) == 1:
                brightness[rays] = value  # in half of the time
            else:
                brightness[rays] += value / len(self.light)
        return brightness


def trace_rays(view: View, directions: Float, *, stratum: int = 0, lit: Mask | None = None) -> TracedRays:
    """Send rays ``directions`` (n, 4), body axes, unit vectors and zeros, to the body and on to the Sun."""
    body = view.body
    camera_km = body.camera_body_km
    sight = body.tracer.sight(camera_km, directions)
    for neighbor in view.neighbors:
        if neighbor.hides:
            before = neighbor.hidden(camera_km, directions.take(sight.rays, axis=0), sight.points_km)
            sight = sight.only(~before)
    albedo = None
    if body.shape.albedo is not None:
        albedo = surface_albedo(body.shape, sight.points_km[:, :3].astype(np.float64), sight.facets.astype(np.int64))
    light = sunlight(view, sight, directions, stratum=stratum, lit=lit)
    return TracedRays(sight=sight, directions=directions, light=light, albedo=albedo, air=body.air)


def sunlight(
    view: View, sight: Sight, directions: Float, *, stratum: int, lit: Mask | None = None
) -> tuple[Sunlight, ...]:
    """Send rays from the surface seen along ``directions`` (n, 4) to the points of the Sun, none if ``lit`` (n,)."""
    options = view.options
    suns = [view.sun_body]
    if options.sun_radius_rad > 0.0:
        random = np.random.default_rng([options.sun_seed, stratum])
        first, turn = random.uniform(size=(2, sight.rays.size))
        suns = disk_directions(view.sun_body, options.sun_radius_rad, options.sun_samples, first, turn)
    return tuple(_sunlight(view, sight, directions, sun, lit) for sun in suns)


def _sunlight(view: View, sight: Sight, directions: Float, sun: Float, lit: Mask | None) -> Sunlight:
    """Points of a sight that see a point of the Sun, towards (4,) or (k, 4)."""
    cos_incidence = dot(sight.normals, sun.astype(np.float32))
    air = view.body.air
    seen = np.flatnonzero(cos_incidence > (0.0 if air is None else air.least_cosine))
    toward = sun if sun.ndim == 1 else sun.take(seen, axis=0)
    if view.options.shadows and seen.size:
        clear = np.flatnonzero(_clear(view, sight, seen, toward, lit))
        seen, toward = seen.take(clear), toward if sun.ndim == 1 else toward.take(clear, axis=0)
    cos_phase = -dot(directions.take(sight.rays.take(seen), axis=0), toward)
    return Sunlight(seen, cos_incidence.take(seen), np.arccos(np.clip(cos_phase, -1.0, 1.0)))


def _clear(view: View, sight: Sight, seen: Indices, toward: Float, lit: Mask | None) -> Mask:
    """True where nothing stands between a point seen and a point of the Sun; known of points of rays ``lit`` (n,)."""
    if lit is None:
        return ~_dark(view, sight, seen, toward)
    clear = lit.take(sight.rays.take(seen))
    unsure = np.flatnonzero(~clear)
    clear[unsure] = ~_dark(view, sight, seen.take(unsure), toward if toward.ndim == 1 else toward.take(unsure, axis=0))
    return clear


def _dark(view: View, sight: Sight, seen: Indices, toward: Float) -> Mask:
    """True where a body stands between a point seen and a point of the Sun."""
    points = rows_of(sight.points_km, seen)
    dark = view.body.tracer.dark(points, rows_of(sight.normals, seen), toward)
    for neighbor in view.neighbors:
        if neighbor.shades:
            dark |= neighbor.dark(points, toward)
    return dark


def surface_albedo(shape: Shape, points_km: Float, facets: NDArray[np.int64]) -> Float:
    """Relative albedo (k,) at points (k, 3), body axes, of a surface; 1 for a shape without albedo."""
    if shape.albedo is None:
        return np.ones(len(points_km))
    weights = shape.barycentric(points_km, facets) if isinstance(shape, TriangleMesh) else None
    return shape.albedo.at(points_km, facets, weights)


def disk_directions(sun: Float, radius_rad: float, samples: int, first: Float, turn: Float) -> list[Float]:
    """Directions to points of an evenly bright disk, for each of n rays, uniform if ``first`` and ``turn`` are.

    ``sun`` (4,): to the center, and a zero; ``first``, ``turn`` (n,) in [0, 1); returns an (n, 4) for each ring.
    """
    smallest = int(np.argmin(np.abs(sun[:3])))
    x_axis = unit(np.cross(sun[:3], np.eye(3)[smallest]))
    across, along = (np.append(axis, 0.0) for axis in (x_axis, np.cross(sun[:3], x_axis)))
    directions = []
    for ring in range(samples):
        cos_theta = 1.0 - (ring + first) / samples * (2.0 * math.sin(0.5 * radius_rad) ** 2)
        sin_theta = np.sqrt((1.0 - cos_theta) * (1.0 + cos_theta))
        angle = 2.0 * math.pi * turn + ring * _GOLDEN_ANGLE_RAD
        x, y = sin_theta * np.cos(angle), sin_theta * np.sin(angle)
        directions.append(x[:, None] * across + y[:, None] * along + cos_theta[:, None] * sun)
    return directions


def in_order(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Results of a function for all items, in their order, computed on threads: the same for any number of them."""
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, items)
