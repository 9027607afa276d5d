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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Box:
    """Corners (2,), px, of the part of the image to sample, and the narrow side of the whole body, px."""

    low_px: Float
    high_px: Float
    extent_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window:
    """Cells along x and y, how their light and their cover fall on the template's pixels, and its corner pixel."""

    cells: tuple[Cells, Cells]
    blurred: tuple[csr_matrix[np.float64], csr_matrix[np.float64]]
    sharp: tuple[csr_matrix[np.float64], csr_matrix[np.float64]]
    corner_px: NDArray[np.int64]


def window_around(
    body: Body, model: CameraModel, *, sigma_px: float, columns: int, rows: int, options: RenderOptions
) -> Window | Failure:
    """Lay a window over what the frame (columns x rows, and the margin around it) can catch of a body's light.

    Returns
    -------
    Window or Failure
        ``OUT_OF_FRAME`` when nothing of it can fall there.
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
    return Window(
        cells=(x, y),
        blurred=(x.spread(int(first[0]), int(count[0]), sigma_px), y.spread(int(first[1]), int(count[1]), sigma_px)),
        sharp=(x.spread(int(first[0]), int(count[0]), 0.0), y.spread(int(first[1]), int(count[1]), 0.0)),
        corner_px=first,
    )


def sampled_box(body: Body, model: CameraModel, size: Float, reach_px: int) -> Box | Failure:
    """The part of a frame of ``size`` (2,) px, widened by ``reach_px``, that the body can touch."""
    hull_px = body.hull_px(model)
    box = span(hull_px)
    if box is None:
        return Failure(Reason.OUT_OF_FRAME, "the body lies behind the camera or where its model has no image")
    low, high = box
    frame_low, frame_high = np.array([-0.5, -0.5]) - reach_px, size - 0.5 + reach_px
    if finite_rows(hull_px).all():
        pad = _BOUND_MARGIN * float(np.max(high - low))
        low, high = low - pad, high + pad
    else:  # part of the body lies where the model has no image: any part of the frame may hold the rest
        low, high = frame_low, frame_high
    if np.any(low >= frame_high) or np.any(high <= frame_low):
        x, y = (0.5 * (low + high)).tolist()
        place = f"the body lies around pixel ({x:.0f}, {y:.0f})"
        return Failure(Reason.OUT_OF_FRAME, f"{place}, outside the frame of {size[0]:.0f} x {size[1]:.0f} px")
    extent_px = float(np.min(high - low))
    return Box(low_px=np.maximum(low, frame_low), high_px=np.minimum(high, frame_high), extent_px=extent_px)
