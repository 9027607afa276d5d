"""Which part of the image a body can touch, and the cells that sample it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.sampling import PSF_REACH_SIGMA, Cells, finite_rows, span

_BOUND_MARGIN = 0.02  # of the body's extent: a hull is a hull before distortion
_RAYS_PER_TILE, _ROWS_PER_TILE = 32_768, 8  # more keep caches warmer, fewer share better among threads
_TANGENTS_RAD = (np.arange(32) + 0.5) * (2.0 * np.pi / 32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Box:
    """Corners (2,), px, of the part of the image to sample, and the narrow side of the whole body, px.

    ``outline_px`` (k, 2) are points whose hull, widened by ``pad_px``, holds the body; None where part of it has no
    image.
    """

    low_px: Float
    high_px: Float
    extent_px: float
    outline_px: Float | None
    pad_px: float


@dataclass(frozen=True, slots=True)
class Tile:
    """Cells in rows ``start`` to ``stop`` and columns ``left`` to ``right``, as numbers from the first of a window."""

    start: int
    stop: int
    left: int
    right: int

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.stop - self.start


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window:
    """Cells along x and y, the tiles of them that can meet the body, and the pixels they fall on.

    ``spread`` says how the light of columns and rows of cells falls on those of the template; ``corner_px`` (2,) is its
    first pixel and ``size_px`` its width and height.
    """

    cells: tuple[Cells, Cells]
    tiles: tuple[Tile, ...]
    spread: tuple[csr_matrix[np.float64], csr_matrix[np.float64]]
    corner_px: NDArray[np.int64]
    size_px: tuple[int, int]

    def counted(self, tile: Tile, rays: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
        """First of some rows of the template, and how many rays fall on each of their pixels (height, width).

        ``rays`` (n,) count the cells of the tile, column after column.
        """
        ends = (tile.left, tile.right), (tile.start, tile.stop)
        x, y = (
            np.clip((cells.first + np.arange(*end)) // cells.per_px - int(corner), -1, size)
            for cells, end, corner, size in zip(self.cells, ends, self.corner_px, self.size_px, strict=True)
        )
        x, y, first = x + 1, y - y[0], int(y[0])  # with a pixel to either side for what falls beside the template
        width, height = self.size_px[0] + 2, int(y[-1]) + 1
        counts = np.bincount((x[:, None] + width * y).reshape(-1).take(rays), minlength=width * height)
        inside = slice(max(-first, 0), self.size_px[1] - first)
        return max(first, 0), counts.reshape(height, width)[inside, 1:-1]


def window_around(
    body: Body, model: CameraModel, *, sigma_px: float, columns: int, rows: int, options: RenderOptions
) -> Window | Failure:
    """Lay a window over what the frame (columns x rows, and the margin around it) can catch of a body's light.

    Returns
    -------
    Window or Failure
        ``OUT_OF_FRAME`` when nothing of it can fall there, ``DEGENERATE_GEOMETRY`` for a camera inside the body.
    """
    size = np.array([columns, rows], dtype=np.float64)
    halo_px = math.ceil(PSF_REACH_SIGMA * sigma_px)  # how far the PSF carries light
    box = sampled_box(body, model, size, options.margin_px + halo_px)
    if isinstance(box, Failure):
        return box
    per_px = max(options.rays_per_pixel_side, math.ceil(options.min_rays_across / box.extent_px))
    first = np.maximum(np.floor(box.low_px + 0.5).astype(np.int64) - halo_px, -options.margin_px)
    last = np.minimum(np.ceil(box.high_px - 0.5) + halo_px, size - 1 + options.margin_px).astype(np.int64)
    count = last - first + 1
    x, y = (Cells.covering(float(box.low_px[i]), float(box.high_px[i]), per_px) for i in range(2))
    width, height = (int(n) for n in count)
    return Window(
        cells=(x, y),
        tiles=_tiles(x, y, box),
        spread=(x.spread(int(first[0]), width, sigma_px), y.spread(int(first[1]), height, sigma_px)),
        corner_px=first,
        size_px=(width, height),
    )


def _tiles(x: Cells, y: Cells, box: Box) -> tuple[Tile, ...]:
    """Strips of rows, each as wide as the outline of the body at its height; left out where there is none."""
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
    """Smallest and largest x (n,) that the hull of points reaches between heights ``low_px`` and ``high_px`` (n,).

    The hull is held by tangents in a few directions, each ``pad_px`` outside: never too narrow.
    """
    toward = np.stack([np.cos(_TANGENTS_RAD), np.sin(_TANGENTS_RAD)], axis=-1)
    support = (outline_px @ toward.T).max(axis=0) + pad_px
    room = support - np.minimum(low_px[:, None] * toward[:, 1], high_px[:, None] * toward[:, 1])
    reach = room / toward[:, 0]
    rightward = toward[:, 0] > 0.0
    return reach[:, ~rightward].max(axis=1), reach[:, rightward].min(axis=1)


def sampled_box(body: Body, model: CameraModel, size: Float, reach_px: int) -> Box | Failure:
    """The part of a frame of ``size`` (2,) px, widened by ``reach_px``, that the body can touch.

    Failures are ``OUT_OF_FRAME``, and ``DEGENERATE_GEOMETRY`` for a camera inside the body.
    """
    if body.tracer.encloses(body.camera_body_km):
        return Failure(Reason.DEGENERATE_GEOMETRY, "the camera lies inside the body: are position and units right?")
    hull_px = body.hull_px(model)
    box = span(hull_px)
    if box is None:
        return Failure(Reason.OUT_OF_FRAME, "the body lies behind the camera or where its model has no image")
    low, high = box
    frame_low, frame_high = np.array([-0.5, -0.5]) - reach_px, size - 0.5 + reach_px
    outline_px, pad_px = None, _BOUND_MARGIN * float(np.max(high - low))
    if finite_rows(hull_px).all():
        outline_px = hull_px
        low, high = low - pad_px, high + pad_px
    else:  # part of the body lies where the model has no image: any part of the frame may hold the rest
        low, high = frame_low, frame_high
    if np.any(low >= frame_high) or np.any(high <= frame_low):
        x, y = (0.5 * (low + high)).tolist()
        place = f"the body lies around pixel ({x:.0f}, {y:.0f})"
        return Failure(Reason.OUT_OF_FRAME, f"{place}, outside the frame of {size[0]:.0f} x {size[1]:.0f} px")
    extent_px = float(np.min(high - low))
    return Box(
        low_px=np.maximum(low, frame_low),
        high_px=np.minimum(high, frame_high),
        extent_px=extent_px,
        outline_px=outline_px,
        pad_px=pad_px,
    )
