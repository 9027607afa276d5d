"""Footprint of a body on the detector: the pixels that its light can reach, and the cells that sample them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.sampling import PSF_REACH_SIGMA, AxisCells, Tile, finite_rows, span
from giantlike.ray_tracing.spread import Spread

_BOUND_MARGIN = 0.02
"""Margin around the convex hull of the body, relative to its extent: hull points lie up to 1 % inside the surface, and
a hull of points before the distortion is only nearly one after it."""
_RAYS_PER_TILE, _ROWS_PER_TILE = 32_768, 8
"""Size of a tile in rays, and least number of its rows: larger tiles leave the caches, smaller ones share less work."""
_TANGENTS_RAD = (np.arange(32) + 0.5) * (2.0 * np.pi / 32)
"""Directions of the tangents that bound a hull, rad; none of them along a row or column. Their number only sets how
tight the tiles are."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FocalPlane(Value):
    """Camera model, size of the detector and point spread function.

    Parameters
    ----------
    model : CameraModel
    columns, rows : int, px; size of the detector
    psf : GaussianPsf, optional; None records without blur beyond the pixel itself

    Raises
    ------
    InputError
        A size is not positive.
    """

    model: CameraModel
    columns: int
    rows: int
    psf: GaussianPsf | None = None

    def __post_init__(self) -> None:
        require(self.columns > 0 and self.rows > 0, f"columns and rows must be > 0, got {self.columns} and {self.rows}")
        Value.__post_init__(self)

    @property
    def psf_sigma_px(self) -> float:
        """Standard deviation of the point spread function, px; 0 without one."""
        return 0.0 if self.psf is None else self.psf.sigma_px

    @property
    def halo_px(self) -> int:
        """Distance in whole pixels over which the point spread function carries light."""
        return math.ceil(PSF_REACH_SIGMA * self.psf_sigma_px)

    def contains(self, points_px: Float) -> Mask:
        """Return True (...) for points (..., 2), px, on the detector; False for NaN."""
        size = np.array([self.columns, self.rows])
        return np.asarray(np.all((points_px >= -0.5) & (points_px <= size - 0.5), axis=-1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisibleBox(Value):
    """Part of the image that a body can touch."""

    low_px: Float  # low_px, high_px: (2,); corners, cut at the edges of the detector and the margin that is sampled
    high_px: Float
    extent_px: float  # narrow side of the whole body
    outline_px: Float | None  # (k, 2); their hull, widened by ``pad_px``, holds the body; None if partly imaged
    pad_px: float

    def cells(self, per_px: int) -> tuple[AxisCells, AxisCells]:
        """Columns and rows of cells that cover the box, ``per_px`` along each side of a pixel."""
        x, y = (AxisCells.covering(float(self.low_px[i]), float(self.high_px[i]), per_px) for i in range(2))
        return x, y


@dataclass(frozen=True, kw_only=True, eq=False)  # without slots, which keep no cached property
class Footprint(Value):
    """Cells over the part of a focal plane that a body can touch, and the pixels that their light reaches."""

    plane: FocalPlane
    cells: tuple[AxisCells, AxisCells]  # along x and y
    tiles: tuple[Tile, ...]  # those parts of the cells that can meet the body
    corner_px: NDArray[np.int64]  # first pixel (x, y)
    size_px: tuple[int, int]  # width and height

    @cached_property
    def spread(self) -> tuple[Spread, Spread]:
        """Fractions of the light of columns and rows of cells on columns and rows of pixels."""
        parts = zip(self.cells, self.corner_px.tolist(), self.size_px, strict=True)
        across, down = (cells.spread(first, count, self.plane.psf_sigma_px) for cells, first, count in parts)
        return across, down

    def count_rays(self, tile: Tile, rays: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
        """Number of rays, cells (n,) of a tile, on each of its pixels, and the row of the footprint where they are."""
        ends = (tile.left, tile.right), (tile.start, tile.stop)
        x, y = (
            np.clip((cells.first + np.arange(*end)) // cells.per_px - int(corner), -1, size)
            for cells, end, corner, size in zip(self.cells, ends, self.corner_px, self.size_px, strict=True)
        )
        x, y, first = x + 1, y - y[0], int(y[0])  # with a pixel to either side for rays outside the footprint
        width, height = self.size_px[0] + 2, int(y[-1]) + 1
        counts = np.bincount((x[:, None] + width * y).reshape(-1).take(rays), minlength=width * height)
        inside = slice(max(-first, 0), self.size_px[1] - first)
        return max(first, 0), counts.reshape(height, width)[inside, 1:-1]


def footprint_of(body: Body, plane: FocalPlane, options: RenderOptions) -> Footprint | Failure:
    """Lay cells over the part of a focal plane, and the margin around it, that light of a body can reach."""
    size = np.array([plane.columns, plane.rows])
    box = visible_box(body, plane, options.margin_px + plane.halo_px)
    if isinstance(box, Failure):
        return box
    x, y = box.cells(max(options.rays_per_pixel_side, math.ceil(options.min_rays_across / box.extent_px)))
    first = np.maximum(np.floor(box.low_px + 0.5).astype(np.int64) - plane.halo_px, -options.margin_px)
    last = np.minimum(np.ceil(box.high_px - 0.5) + plane.halo_px, size - 1 + options.margin_px).astype(np.int64)
    width, height = (int(n) for n in last - first + 1)
    return Footprint(plane=plane, cells=(x, y), tiles=_tiles(x, y, box), corner_px=first, size_px=(width, height))


def _tiles(x: AxisCells, y: AxisCells, box: VisibleBox) -> tuple[Tile, ...]:
    """Strips of rows, each as wide as the outline of the body within it; strips that miss the body are left out."""
    step = max(_RAYS_PER_TILE // x.count, _ROWS_PER_TILE)
    starts = np.arange(0, y.count, step)
    stops = np.minimum(starts + step, y.count)
    left, right = np.zeros(starts.size, np.int64), np.full(starts.size, x.count)
    if box.outline_px is not None:
        ends_px = _extent(box.outline_px, box.pad_px, y.edges_px[starts], y.edges_px[stops])
        low, high = ((end_px + 0.5) * x.per_px - x.first for end_px in ends_px)
        left = np.clip(np.floor(low), 0, x.count).astype(np.int64)
        right = np.clip(np.ceil(high), 0, x.count).astype(np.int64)
    tiles = zip(starts.tolist(), stops.tolist(), left.tolist(), right.tolist(), strict=True)
    return tuple(Tile(*tile) for tile in tiles if tile[2] < tile[3])


def _extent(outline_px: Float, pad_px: float, low_px: Float, high_px: Float) -> tuple[Float, Float]:
    """Smallest and largest x (n,) of a hull between two heights (n,), by tangents ``pad_px`` outside it."""
    toward = np.stack([np.cos(_TANGENTS_RAD), np.sin(_TANGENTS_RAD)], axis=-1)
    support = (outline_px @ toward.T).max(axis=0) + pad_px
    room = support - np.minimum(low_px[:, None] * toward[:, 1], high_px[:, None] * toward[:, 1])
    reach = room / toward[:, 0]
    rightward = toward[:, 0] > 0.0
    return reach[:, ~rightward].max(axis=1), reach[:, rightward].min(axis=1)


def visible_box(body: Body, plane: FocalPlane, reach_px: int) -> VisibleBox | Failure:
    """Part of a focal plane, widened by ``reach_px``, that the body can touch."""
    if body.tracer.encloses(body.camera_body_km):
        return Failure(Reason.DEGENERATE_GEOMETRY, "the camera lies inside the body: check position and units")
    hull_px = body.hull_px(plane.model)
    box = span(hull_px)
    if box is None:
        return Failure(Reason.OUT_OF_FRAME, "the body lies behind the camera or where its model has no image")
    low, high = box
    size = np.array([plane.columns, plane.rows], dtype=np.float64)
    plane_low, plane_high = np.array([-0.5, -0.5]) - reach_px, size - 0.5 + reach_px
    outline_px, pad_px = None, _BOUND_MARGIN * float(np.max(high - low))
    if finite_rows(hull_px).all():
        outline_px = hull_px
        low, high = low - pad_px, high + pad_px
    else:  # the model images only part of the body: the rest may be anywhere on the detector
        low, high = plane_low, plane_high
    if np.any(low >= plane_high) or np.any(high <= plane_low):
        x, y = (0.5 * (low + high)).tolist()
        place = f"the body lies around pixel ({x:.0f}, {y:.0f})"
        return Failure(Reason.OUT_OF_FRAME, f"{place}, outside the frame of {plane.columns} x {plane.rows} px")
    return VisibleBox(
        low_px=np.maximum(low, plane_low),
        high_px=np.minimum(high, plane_high),
        extent_px=float(np.min(high - low)),
        outline_px=outline_px,
        pad_px=pad_px,
    )
