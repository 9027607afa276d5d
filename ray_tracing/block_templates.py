"""Templates of a body under several laws from few rays: one to a block of pixels, and more where light is uneven."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Indices
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.cached_trace import trace_body
from giantlike.ray_tracing.footprint import FocalPlane, footprint_of, visible_box
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.refined import RefinedTrace, refine_trace
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.render import Template, unless_dark
from giantlike.ray_tracing.sampling import AxisCells
from giantlike.ray_tracing.spread import Spread

_UNEVEN = 0.3
"""As in ``refined``. Error of a photocenter at 300 px: blocks of 2 px leave 0.020 px with 0.3 and 0.024 px with 0.1,
0.029 px are left by a ray to every pixel and 0.075 px by one to every block (nine rocks)."""
_CELL_VARIANCE = 1.0 / 12.0
"""Variance of light that is even over a cell, in squares of its side: a ray says only in which cell the light is, so
that the point spread function is taken to be as much narrower."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockedPlane(Value):
    """A focal plane, and the same in blocks of its pixels."""

    plane: FocalPlane
    model: CameraModel  # of images whose pixels are the blocks
    size_px: int  # pixels along the side of a block; 2 at least


def block_templates(
    body: Body,
    blocked: BlockedPlane,
    laws: tuple[Reflectance, ...],
    *,
    sun_direction_camera: Float,
    options: RenderOptions,
) -> tuple[Template, ...] | Failure:
    """Render a body under several laws, with one ray to a block where its light is even; the Sun as a unit vector."""
    plane, size, rays = blocked.plane, blocked.size_px, options.rays_per_pixel_side
    trace = trace_body(
        body,
        blocked.model,
        sun_direction_camera=sun_direction_camera,
        columns=-(-plane.columns // size),
        rows=-(-plane.rows // size),
        options=RenderOptions(
            rays_per_pixel_side=rays,
            min_rays_across=1,
            shadows=options.shadows,
            margin_px=-(-(options.margin_px + plane.halo_px) // size),
            threads=options.threads,
        ),
    )
    if isinstance(trace, Failure):
        whole = footprint_of(body, plane, options)  # says it of the pixels
        return whole if isinstance(whole, Failure) else trace
    templates = _on_pixels(_Rays(refine_trace(trace, size, uneven=_UNEVEN)), plane, laws, options.margin_px)
    if isinstance(templates, Failure) and _cut(body, plane, options.margin_px + plane.halo_px):
        return Failure(Reason.OUT_OF_FRAME, "no light of the body falls on the frame, which cuts the body")
    return templates


def _cut(body: Body, plane: FocalPlane, reach_px: int) -> bool:
    """Return True if a body reaches beyond a plane that is widened by ``reach_px``."""
    seen, whole = (visible_box(body, plane, reach) for reach in (reach_px, reach_px + plane.columns + plane.rows))
    if isinstance(seen, Failure) or isinstance(whole, Failure):
        return False
    return bool((seen.low_px > whole.low_px).any() or (seen.high_px < whole.high_px).any())


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Rays through blocks of pixels and their parts, and values of them on the grid of the parts."""

    traced: RefinedTrace

    @property
    def grid(self) -> tuple[AxisCells, AxisCells]:
        """Columns and rows of the grid, in pixels and not in blocks of them."""
        size = self.traced.factor
        x, y = (AxisCells(size * each.first, size * each.count, each.per_px) for each in self.traced.cells)
        return x, y

    def light(self, law: Reflectance) -> Float:
        """Brightness (columns, rows) under a law."""
        return self._on_grid(self.traced.cell_brightness(law), self.traced.part_brightness(law))

    @property
    def met(self) -> Float:
        """Share (columns, rows) of the rays that meet the body."""
        return self._map_shares([rays.sight.rays for rays in self.traced.trace.tiles], self.traced.rays.sight.rays)

    @property
    def lit(self) -> Float:
        """Share (columns, rows) of the rays that end on a point in sunlight."""
        tiles = [rays.sight.rays.take(rays.light[0].seen) for rays in self.traced.trace.tiles]
        parts = self.traced.rays
        return self._map_shares(tiles, parts.sight.rays.take(parts.light[0].seen))

    def _map_shares(self, rays: list[Indices], of_parts: Indices) -> Float:
        """Share (columns, rows) of rays of some numbers: of whole cells, tile by tile, and of parts."""
        traced, (x, y) = self.traced, self.traced.cells
        whole, parts = np.zeros((x.count, y.count)), np.zeros(len(traced.rays.directions))
        for tile, numbers in zip(traced.trace.footprint.tiles, rays, strict=True):
            marks = np.zeros((tile.right - tile.left) * tile.rows)
            marks[numbers] = 1.0
            whole[tile.left : tile.right, tile.start : tile.stop] = marks.reshape(-1, tile.rows)
        parts[of_parts] = 1.0
        return self._on_grid(whole, parts)

    def _on_grid(self, whole: Float, parts: Float) -> Float:
        """Values (columns, rows) of whole cells, repeated, and of the parts (n,) of the others."""
        values = whole.repeat(self.traced.factor, axis=0).repeat(self.traced.factor, axis=1)
        values[self.traced.part_places] = parts
        return values


def _on_pixels(
    rays: _Rays, plane: FocalPlane, laws: tuple[Reflectance, ...], margin_px: int
) -> tuple[Template, ...] | Failure:
    """Shade rays under some laws, and spread their light over the pixels."""
    x, y = rays.grid
    sizes, variance = (plane.columns, plane.rows), plane.psf_sigma_px**2 - _CELL_VARIANCE / x.per_px**2
    pixels = [_pixels_of(cells, plane.halo_px, margin_px, count) for cells, count in zip((x, y), sizes, strict=True)]
    across, down = (
        cells.spread(*part, math.sqrt(max(variance, 0.0))) for cells, part in zip((x, y), pixels, strict=True)
    )
    across_sharp, down_sharp = (cells.spread(*part, 0.0) for cells, part in zip((x, y), pixels, strict=True))
    met = rays.met
    coverage, lit_fraction = _spread(met, across_sharp, down_sharp), float(rays.lit.sum() / max(met.sum(), 1.0))
    templates = []
    for law in laws:
        light = rays.light(law)
        by_column, by_row = light.sum(axis=1), light.sum(axis=0)
        with np.errstate(invalid="ignore"):
            photocenter_px = np.array([by_column @ x.centers_px, by_row @ y.centers_px]) / by_row.sum()
        template = Template(
            brightness=_spread(light, across, down),
            coverage=coverage,
            corner_px=np.array([first for first, _ in pixels], dtype=np.int64),
            center_px=rays.traced.trace.body.center_px(plane.model),
            photocenter_px=photocenter_px,
            lit_fraction=lit_fraction,
        )
        seen = unless_dark(template)
        if isinstance(seen, Failure):
            return seen
        templates.append(seen)
    return tuple(templates)


def _pixels_of(cells: AxisCells, halo_px: int, margin_px: int, count: int) -> tuple[int, int]:
    """First pixel that cells light, and number of these, within a frame of ``count`` and its margin."""
    first = max(cells.first // cells.per_px - halo_px, -margin_px)
    last = min((cells.first + cells.count - 1) // cells.per_px + halo_px, count - 1 + margin_px)
    return first, max(last - first + 1, 1)


def _spread(values: Float, across: Spread, down: Spread) -> Float:
    """Values (h, w) on pixels of values (columns, rows) on cells."""
    return down.apply(across.apply(values).T)
