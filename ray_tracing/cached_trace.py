"""A cached trace: another reflectance law, point spread function or Sun recomputes only the steps it affects."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.daylight import Daylight
from giantlike.ray_tracing.footprint import FocalPlane, Footprint, footprint_of
from giantlike.ray_tracing.options import DEFAULT_OPTIONS, RenderOptions
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.render import Template, gather_tiles, ray_grid, shade_tile, unless_dark
from giantlike.ray_tracing.sampling import AxisCells, Tile
from giantlike.ray_tracing.trace import TracedRays, View, in_order, sunlight, trace_rays, view_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace(Value):
    """A body traced in one pose, ready to be shaded; from :func:`trace_body`.

    Each ``with_`` method returns a new trace whose :meth:`template` equals, to the last bit, that of a
    :func:`~giantlike.ray_tracing.render` with that one thing changed.
    """

    view: View  # body, Sun and options of the trace
    footprint: Footprint  # pixels and cells of the trace
    size_px: tuple[int, int]  # columns and rows of the frame
    tiles: tuple[TracedRays, ...] = field(repr=False)  # rays of each tile of the footprint

    @property
    def body(self) -> Body:
        """The body as it was traced."""
        return self.view.body

    @property
    def lit(self) -> int:
        """Number of rays that end on a point in sunlight."""
        return sum(traced.lit for traced in self.tiles)

    def template(self) -> Template | Failure:
        """Shade the rays and gather them on pixels. The result is as :func:`~giantlike.ray_tracing.render`."""
        law, footprint = self.body.reflectance, self.footprint
        pairs = zip(footprint.tiles, self.tiles, strict=True)
        shaded = (shade_tile(footprint, tile, traced, law) for tile, traced in pairs)
        return unless_dark(gather_tiles(self.view, footprint, shaded))

    @property
    def cells(self) -> tuple[AxisCells, AxisCells]:
        """Columns and rows of the cells."""
        return self.footprint.cells

    def cell_brightness(self, law: Reflectance) -> Float:
        """Shade the rays and leave them as they are. Returns (columns, rows), 0 where nothing is lit."""
        x, y = self.footprint.cells
        brightness = np.zeros((x.count, y.count))
        for tile, traced in zip(self.footprint.tiles, self.tiles, strict=True):
            part = brightness[tile.left : tile.right, tile.start : tile.stop]
            part[:] = traced.brightness(law).reshape(part.shape)
        return brightness

    @property
    def lit_cells(self) -> Mask:
        """True for cells (columns, rows) whose ray ends on a point in sunlight."""
        x, y = self.footprint.cells
        lit = np.zeros((x.count, y.count), bool)
        for tile, traced in zip(self.footprint.tiles, self.tiles, strict=True):
            part = np.zeros(len(traced.directions), bool)
            for light in traced.light:
                part[traced.sight.rays.take(light.seen)] = True
            within = lit[tile.left : tile.right, tile.start : tile.stop]
            within[:] = part.reshape(within.shape)
        return lit

    def one_to_a_pixel(self) -> Trace:
        """Return the trace with the ray in the middle of each pixel alone; the others meet nothing."""
        (x, y), step = self.footprint.cells, self.footprint.cells[0].per_px
        (left, _), (top, _) = x.middles, y.middles

        def kept(tile: Tile, traced: TracedRays) -> TracedRays:
            columns, rows = np.divmod(traced.sight.rays, tile.rows)
            middle = ((columns + (tile.left - left)) % step == 0) & ((rows + (tile.start - top)) % step == 0)
            return traced.only(middle)

        return replace(self, tiles=tuple(map(kept, self.footprint.tiles, self.tiles)))

    def at_middles(self) -> tuple[Float, tuple[int, int]]:
        """Shade the rays in the middles of pixels, and spread their light over no others.

        Returns ``brightness`` (height, width), 0 where nothing is lit; ``corner_px`` (int, int), column and row of the
        first of them.
        """
        (x, y), step = self.footprint.cells, self.footprint.cells[0].per_px
        (left, column), (top, row) = x.middles, y.middles
        brightness = self.cell_brightness(self.body.reflectance)[left::step, top::step].T
        return brightness, (column, row)

    def with_reflectance(self, reflectance: Reflectance) -> Trace:
        """Return the same rays under another law; costs nothing until it is shaded."""
        return replace(self, view=replace(self.view, body=replace(self.body, reflectance=reflectance)))

    def with_psf(self, psf: GaussianPsf | None) -> Trace:
        """Return the same rays under another point spread function."""
        plane = replace(self.footprint.plane, psf=psf)
        footprint = footprint_of(self.body, plane, self.view.options)
        same = not isinstance(footprint, Failure) and footprint.cells == self.footprint.cells
        require(
            same, f"a psf of {plane.psf_sigma_px:g} px needs other rays where the frame cuts the body: trace it anew"
        )
        return self if isinstance(footprint, Failure) else replace(self, footprint=footprint)

    def with_sun(self, sun_direction_camera: ArrayLike) -> Trace:
        """Return the same hits under another Sun, a unit vector from the body; only shadow rays are traced."""
        view = replace(self.view, sun_body=np.append(sun_in_body(self.body, sun_direction_camera), 0.0))

        def relit(pair: tuple[Tile, TracedRays]) -> TracedRays:
            tile, traced = pair
            return replace(traced, light=sunlight(view, traced.sight, traced.directions, stratum=tile.start))

        pairs = zip(self.footprint.tiles, self.tiles, strict=True)
        return replace(self, view=view, tiles=tuple(in_order(relit, pairs, view.options.threads)))

    def with_shadows(self, daylight: Daylight | None = None) -> Trace:
        """Return the same hits with the shadows that the body casts on itself; only shadow rays are traced."""
        view = replace(self.view, options=replace(self.view.options, shadows=True))
        lit = None if daylight is None else daylight.classify(self.footprint.cells)[1]

        def relit(pair: tuple[Tile, TracedRays]) -> TracedRays:
            tile, traced = pair
            known = None if lit is None else lit[tile.left : tile.right, tile.start : tile.stop].ravel()
            light = sunlight(view, traced.sight, traced.directions, stratum=tile.start, lit=known)
            return replace(traced, light=light)

        pairs = zip(self.footprint.tiles, self.tiles, strict=True)
        return replace(self, view=view, tiles=tuple(in_order(relit, pairs, view.options.threads)))

    def daylight(self) -> Daylight:
        """Where the body is lit, by the rays in the middles of pixels; for other traces of it, turned a little."""
        light, (column, row) = self.at_middles()
        cells = AxisCells(column, light.shape[1], 1), AxisCells(row, light.shape[0], 1)
        center_px = self.body.center_px(self.footprint.plane.model)
        return Daylight(cells=cells, lit=light.T > 0.0, center_px=center_px, traced_center_px=center_px, scale=1.0)


def trace_body(
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None = None,
    columns: int,
    rows: int,
    options: RenderOptions = DEFAULT_OPTIONS,
    wanted: Mask | None = None,
    daylight: Daylight | None = None,
) -> Trace | Failure:
    """Trace a body once, to shade it many times; the Sun as a unit vector; ``wanted`` (rows, columns)."""
    plane = FocalPlane(model=model, columns=columns, rows=rows, psf=psf)
    require(
        wanted is None or wanted.shape == (rows, columns),
        f"wanted must have the shape of the frame, {(rows, columns)}, got {None if wanted is None else wanted.shape}",
    )
    view = view_of(body, model, sun_direction_camera, options)
    footprint = footprint_of(view.body, plane, options)
    if isinstance(footprint, Failure):
        return footprint
    grid = ray_grid(view, footprint)

    inside = None if wanted is None else _cells_within(wanted, footprint)
    dark, lit = (None, None) if daylight is None else daylight.classify(footprint.cells)

    def trace_tile(tile: Tile) -> TracedRays:
        directions, part = grid.directions(tile), (slice(tile.left, tile.right), slice(tile.start, tile.stop))
        sent = np.ones((tile.right - tile.left, tile.rows), bool) if inside is None else inside[part].copy()
        if dark is not None:
            sent &= ~dark[part]
        known = None if lit is None else lit[part].ravel()
        if sent.all():
            return trace_rays(view, directions, stratum=tile.start, lit=known)
        numbers = np.flatnonzero(sent)
        known = None if known is None else known.take(numbers)
        rays = trace_rays(view, directions.take(numbers, axis=0), stratum=tile.start, lit=known)
        return rays.among(numbers, directions)

    tiles = tuple(in_order(trace_tile, footprint.tiles, options.threads))
    return Trace(view=view, footprint=footprint, size_px=(columns, rows), tiles=tiles)


def _cells_within(pixels: Mask, footprint: Footprint) -> Mask:
    """Cells (columns, rows) of a footprint that lie in the pixels (rows, columns) marked."""
    inside = []
    for cells, count in zip(footprint.cells, pixels.shape[::-1], strict=True):
        numbers = (cells.first + np.arange(cells.count)) // cells.per_px
        inside.append((np.clip(numbers, 0, count - 1), (numbers >= 0) & (numbers < count)))
    (columns, across), (rows, down) = inside
    return np.asarray(pixels[np.ix_(rows, columns)].T & across[:, None] & down)
