"""Renders: bodies become templates by single-bounce ray tracing through the real camera model and its PSF."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, unit
from giantlike.core.deprecation import renamed_keyword
from giantlike.core.detector import GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body, suns_of
from giantlike.ray_tracing.footprint import FocalPlane, Footprint, footprint_of
from giantlike.ray_tracing.neighbors import Neighbor, neighbors_of
from giantlike.ray_tracing.options import DEFAULT_OPTIONS, RenderOptions
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.sampling import RayGrid, Tile
from giantlike.ray_tracing.trace import TracedRays, View, in_order, trace_rays, view_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Template(Value):
    """A rendered body, cut out to the pixels that its light reaches.

    Parameters
    ----------
    brightness : (h, w) float64; mean over the pixel, with the PSF; 1 is seen and lit along the normal
    coverage : (h, w) float64; fraction of each pixel that the body covers, lit or not, before the PSF
    corner_px : (2,) int64, px; image pixel (x, y) of element [0, 0]; negative when the template reaches over the frame
    center_px : (2,) float64, px; projection of the origin of the shape, in the distorted image
    photocenter_px : (2,) float64, px; centroid of the light before PSF and pixels, also inside one pixel
    lit_fraction : float; part of the rays on the body that end on lit surface
    rendered_from_camera : Rotation; from camera axes to the rendered ones; identity, unless recentered
    """

    brightness: Float
    coverage: Float
    corner_px: NDArray[np.int64]
    center_px: Float
    photocenter_px: Float
    lit_fraction: float
    rendered_from_camera: Rotation = field(default_factory=Rotation.identity)

    def placed(self, columns: int, rows: int) -> Float:
        """Return the brightness (rows, columns) in a whole frame, 0 outside the template."""
        x, y = self.corner_px.tolist()
        return PixelBox(x=0, y=0, width=columns, height=rows).cut(self.brightness, (x, y))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneRender(Value):
    """Several bodies, rendered."""

    columns: int  # columns, rows: size of the frame
    rows: int
    # one for each body, in the order they were given: its visible part, with the shadows of the others. A body that is
    # seen but wholly in shadow is a black template with a NaN photocenter, not a failure. Failures: ``OUT_OF_FRAME``,
    # ``NO_SIGNAL`` for a body behind others, and ``DEGENERATE_GEOMETRY`` for one around the camera, which hides nothing
    templates: tuple[Template | Failure, ...]

    @property
    def brightness(self) -> Float:
        """Sum of all bodies in the whole frame (rows, columns), computed at each access, relative as in a template."""
        return self.weighted(np.ones(len(self.templates)))

    def weighted(self, weights: ArrayLike) -> Float:
        """Return the sum (rows, columns) of all bodies, each times its own weight: irradiance, say, or albedo."""
        factors = as_floats(weights, (len(self.templates),), "weights")
        frame = np.zeros((self.rows, self.columns))
        for factor, template in zip(factors, self.templates, strict=True):
            if isinstance(template, Template):
                frame += factor * template.placed(self.columns, self.rows)
        return frame

    def coverage(self, number: int) -> Float:
        """Fraction (rows, columns) of each pixel of the frame that body ``number`` covers, others before it cut out."""
        template = self.templates[number]
        if isinstance(template, Failure):
            return np.zeros((self.rows, self.columns))
        return replace(template, brightness=template.coverage).placed(self.columns, self.rows)


@renamed_keyword("recentre", "recenter", until="0.3")
def render(
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None = None,
    columns: int,
    rows: int,
    options: RenderOptions = DEFAULT_OPTIONS,
    recenter: bool = False,
) -> Template | Failure:
    """Render a body as the camera sees it.

    Parameters
    ----------
    body : Body
    model : CameraModel
    sun_direction_camera : (3,), unitless, camera axes; unit vector from body to Sun
    psf : GaussianPsf, optional; None renders without blur beyond the pixel itself
    columns, rows : int, px; size of the detector; the template is cut at its edges plus ``options.margin_px``
    options : RenderOptions
    recenter : bool
        Where no light of the body can fall on the frame, rotate the camera until its middle points at the body and
        render that; ``Template.rendered_from_camera`` is the rotation, and pixels belong to the rotated camera.

    Returns
    -------
    Template or Failure
        ``OUT_OF_FRAME`` when no light can fall on the (widened) frame, ``NOT_LIT`` when nothing seen there is lit,
        ``DEGENERATE_GEOMETRY`` when the camera lies inside the body.

    Raises
    ------
    InputError
        A size is not positive or the direction is not a unit vector.

    Notes
    -----
    Only the box of image points around the body is sampled, in cells aligned with the pixels; the light of each
    cell is spread over the pixels exactly, cell, PSF and pixel together, so that flux and photocenter hold for
    bodies far smaller than a pixel as well.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Template
       Matching", steps 1-6 of the single-bounce ray tracer; step 1a is ``recenter``.
    """
    sun = as_finite(sun_direction_camera, (3,), "sun_direction_camera")
    plane = FocalPlane(model=model, columns=columns, rows=rows, psf=psf)
    template = unless_dark(render_body(body, plane, sun, options))
    if not (recenter and isinstance(template, Failure) and template.reason is Reason.OUT_OF_FRAME):
        return template
    middle = model.unproject([0.5 * (columns - 1), 0.5 * (rows - 1)])
    turn = shortest_turn(unit(body.position_camera_km), middle)
    template = unless_dark(render_body(body.turned(turn), plane, rotate(turn, sun), options))
    return replace(template, rendered_from_camera=turn) if isinstance(template, Template) else template


def render_scene(
    bodies: Sequence[Body],
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None = None,
    columns: int,
    rows: int,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> SceneRender:
    """Render bodies that hide and shade each other, as :func:`~giantlike.ray_tracing.render`.

    ``sun_direction_camera`` (3,) or (n, 3), unit vector to the Sun, for all bodies or for each. Light that one body
    casts on another is left out.
    """
    plane = FocalPlane(model=model, columns=columns, rows=rows, psf=psf)
    bodies = [body.seen_by(model) for body in bodies]
    templates = tuple(
        render_body(body, plane, sun, options, tuple(neighbors_of(bodies, number, sun, options.sun_radius_rad)))
        for number, (body, sun) in enumerate(zip(bodies, suns_of(bodies, sun_direction_camera), strict=True))
    )
    return SceneRender(columns=columns, rows=rows, templates=templates)


def render_body(
    body: Body,
    plane: FocalPlane,
    sun_direction_camera: ArrayLike,
    options: RenderOptions,
    neighbors: tuple[Neighbor, ...] = (),
) -> Template | Failure:
    """Render a body among neighbors; one that is seen in shadow is a black template with a NaN photocenter."""
    view = view_of(body, plane.model, sun_direction_camera, options, neighbors)
    footprint = footprint_of(view.body, plane, options)
    if isinstance(footprint, Failure):
        return footprint
    grid, law = ray_grid(view, footprint), view.body.reflectance

    def trace_and_shade(tile: Tile) -> ShadedTile:
        traced = trace_rays(view, grid.directions(tile), stratum=tile.start)
        return shade_tile(footprint, tile, traced, law)

    return gather_tiles(view, footprint, in_order(trace_and_shade, footprint.tiles, options.threads))


def ray_grid(view: View, footprint: Footprint) -> RayGrid:
    """Directions of the rays through the cells of a footprint, body axes."""
    rotation = view.body.camera_from_body.as_matrix().T
    return RayGrid(footprint.plane.model, *footprint.cells, rotation, view.options.jitter_seed)


def shortest_turn(start: Float, stop: Float) -> Rotation:
    """Smallest rotation that takes unit vector ``start`` (3,) to ``stop`` (3,)."""
    axis = np.cross(start, stop)
    sine, cosine = float(np.linalg.norm(axis)), float(start @ stop)
    if sine < 1e-12:  # parallel or opposite to rounding: any axis across
        axis = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
    return Rotation.from_rotvec(math.atan2(sine, cosine) * unit(axis))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShadedTile(Value):
    """Light and coverage of a tile of cells."""

    tile: Tile
    light: Float  # (w, rows); by pixel columns of the template and rows of cells; blurred along x
    by_column: Float  # (columns,); brightness summed over the rows, for each column of cells of the tile
    by_row: Float  # (rows,)
    cover: NDArray[np.int64]  # (height, columns); number of hits on the template's pixels, from row ``first_row`` on
    first_row: int
    hits: int  # hits, lit: number of rays that meet the body, and of those that see the Sun too
    lit: int


def shade_tile(footprint: Footprint, tile: Tile, traced: TracedRays, law: Reflectance) -> ShadedTile:
    """Light of the cells of a tile under a reflectance law, on the pixel columns of the template."""
    brightness = np.zeros((footprint.cells[0].count, tile.rows))
    inside = brightness[tile.left : tile.right]
    inside[:] = traced.brightness(law).reshape(inside.shape)
    first_row, cover = footprint.count_rays(tile, traced.sight.rays)
    return ShadedTile(
        tile=tile,
        light=footprint.spread[0].apply(brightness),
        by_column=inside.sum(axis=1),
        by_row=inside.sum(axis=0),
        cover=cover,
        first_row=first_row,
        hits=int(traced.sight.rays.size),
        lit=traced.lit,
    )


def gather_tiles(view: View, footprint: Footprint, tiles: Iterable[ShadedTile]) -> Template | Failure:
    """Template of tiles, added up in their order."""
    x, y = (cells.centers_px for cells in footprint.cells)
    width, height = footprint.size_px
    light, counts = np.zeros((y.size, width)), np.zeros((height, width), np.int64)
    by_column, by_row = np.zeros(x.size), np.zeros(y.size)
    n_hit = n_lit = 0
    for part in tiles:
        rows = slice(part.tile.start, part.tile.stop)
        light[rows] = part.light.T
        counts[part.first_row : part.first_row + len(part.cover)] += part.cover
        by_column[part.tile.left : part.tile.right] += part.by_column
        by_row[rows] = part.by_row
        n_hit, n_lit = n_hit + part.hits, n_lit + part.lit
    if n_hit == 0 and view.neighbors:
        return Failure(Reason.NO_SIGNAL, "no ray of the frame meets the body, or other bodies stand before it")
    if n_hit == 0:
        return Failure(Reason.OUT_OF_FRAME, "no ray of the frame meets the body, though its bounds touch the frame")
    with np.errstate(invalid="ignore"):
        photocenter_px = np.array([by_column @ x, by_row @ y]) / by_row.sum()
    return Template(
        brightness=footprint.spread[1].apply(light),
        coverage=counts / footprint.cells[0].per_px ** 2,
        corner_px=footprint.corner_px,
        center_px=view.body.center_px(footprint.plane.model),
        photocenter_px=photocenter_px,
        lit_fraction=n_lit / n_hit,
    )


def unless_dark(template: Template | Failure) -> Template | Failure:
    """Return the template, or a failure: ``NOT_LIT`` without any lit surface, ``OUT_OF_FRAME`` without any light."""
    if isinstance(template, Template) and template.lit_fraction == 0.0:
        return Failure(Reason.NOT_LIT, "no part of the body that the camera sees is lit by the Sun")
    if isinstance(template, Template) and not template.brightness.any():
        return Failure(Reason.OUT_OF_FRAME, "no light of the body falls on the frame")
    return template
