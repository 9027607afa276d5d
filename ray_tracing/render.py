"""Render a body into a template: single-bounce ray tracing through the real camera model and its PSF."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, frozen, require
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.sampling import PSF_REACH_SIGMA, Cells, RayGrid, finite_rows, span, spread_over

_RAYS_PER_CHUNK = 40_000  # fits a cache and keeps whole frames cheap in memory
_BOUND_MARGIN = 0.02  # of the body's extent: a hull is a hull before distortion


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """How finely and how far to render.

    Parameters
    ----------
    rays_per_pixel_side : int
        Rays along each side of a pixel: 2 means 4 rays a pixel.
    min_rays_across : int
        Rays across the narrow side of the body's outline, at least: a body smaller than a few pixels is
        sampled more finely than ``rays_per_pixel_side``.
    shadows : bool
        Whether the body casts shadows on itself.
    margin_px : int, px
        How far over the edges of the detector the template may reach: the search range of a correlation.
    jitter_seed : int, optional
        Send each ray through a random place of its cell instead of the centre, so that a simulated truth and a
        template do not share their sampling.
    """

    rays_per_pixel_side: int = 2
    min_rays_across: int = 256
    shadows: bool = True
    margin_px: int = 0
    jitter_seed: int | None = None

    def __post_init__(self) -> None:
        require(
            1 <= self.rays_per_pixel_side <= 32,
            f"rays_per_pixel_side must be in [1, 32], got {self.rays_per_pixel_side}",
        )
        require(1 <= self.min_rays_across <= 1024, f"min_rays_across must be in [1, 1024], got {self.min_rays_across}")
        require(0 <= self.margin_px <= 4096, f"margin_px must be in [0, 4096], got {self.margin_px}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Template:
    """A rendered body, cut out to the pixels that its light reaches.

    Parameters
    ----------
    brightness : (h, w) float64
        Mean over the pixel, relative: 1 is a surface seen and lit along its normal. The PSF is in it.
    coverage : (h, w) float64
        Fraction of each pixel that the body covers, lit or not, before the PSF.
    corner_px : (2,) int64, px
        Image pixel (x, y) of element [0, 0]; negative when the template reaches over the frame.
    center_px : (2,) float64, px
        Where the origin of the shape projects, in the distorted image.
    photocenter_px : (2,) float64, px
        Centroid of the light before PSF and pixels, so that it holds for a body inside one pixel too.
    lit_fraction : float
        Part of the rays on the body that end on lit surface.
    """

    brightness: Float
    coverage: Float
    corner_px: NDArray[np.int64]
    center_px: Float
    photocenter_px: Float
    lit_fraction: float

    def placed(self, columns: int, rows: int) -> Float:
        """The brightness in a whole frame (rows, columns), zero elsewhere; what lies outside is cut off."""
        frame = np.zeros((rows, columns))
        height, width = self.brightness.shape
        x, y = (int(v) for v in self.corner_px)
        x0, x1, y0, y1 = max(x, 0), min(x + width, columns), max(y, 0), min(y + height, rows)
        if x0 < x1 and y0 < y1:
            frame[y0:y1, x0:x1] = self.brightness[y0 - y : y1 - y, x0 - x : x1 - x]
        return frame


def render(
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None = None,
    columns: int,
    rows: int,
    options: RenderOptions = RenderOptions(),
) -> Template | Failure:
    """Render a body as the camera sees it.

    Parameters
    ----------
    body : Body
    model : CameraModel
    sun_direction_camera : (3,), unitless, camera axes
        Unit vector from body to Sun.
    psf : GaussianPsf, optional
        None renders without blur beyond the pixel itself.
    columns, rows : int, px
        Size of the detector; the template is cut at its edges plus ``options.margin_px``.
    options : RenderOptions

    Returns
    -------
    Template or Failure
        ``OUT_OF_FRAME`` when no light can fall on the (widened) frame, ``NOT_LIT`` when nothing seen there is lit.

    Raises
    ------
    InputError
        A size is not positive or the direction is not a unit vector.

    Notes
    -----
    Only the box of image points around the body is sampled, in cells aligned with the pixels; the light of each
    cell is spread over the pixels exactly, cell, PSF and pixel together, so that flux and photocentre hold for
    bodies far smaller than a pixel as well.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Template
       Matching", steps 1-6 of the single-bounce ray tracer.
    """
    require(columns > 0 and rows > 0, f"columns and rows must be > 0, got {columns} and {rows}")
    sun_body = sun_in_body(body, sun_direction_camera)
    sigma_px = 0.0 if psf is None else psf.sigma_px
    size = np.array([columns, rows], dtype=np.float64)
    box = _sampled_box(body, model, size, options.margin_px + _halo_px(sigma_px))
    if isinstance(box, Failure):
        return box
    window = _window(box, size, sigma_px, options)
    return _traced(body, model, window, sun_body, options)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Box:
    """Corners (2,), px, of the part of the image to sample, and the narrow side of the whole body, px."""

    low_px: Float
    high_px: Float
    extent_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    """Cells along x and y, how their light and their cover fall on the template's pixels, and its corner pixel."""

    cells: tuple[Cells, Cells]
    blurred: tuple[csr_matrix[np.float64], csr_matrix[np.float64]]
    sharp: tuple[csr_matrix[np.float64], csr_matrix[np.float64]]
    corner_px: NDArray[np.int64]


def _halo_px(sigma_px: float) -> int:
    """How far the PSF carries light, whole pixels."""
    return math.ceil(PSF_REACH_SIGMA * sigma_px)


def _sampled_box(body: Body, model: CameraModel, size: Float, reach_px: int) -> _Box | Failure:
    """The part of the frame, widened by ``reach_px``, that the body can touch."""
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
    return _Box(low_px=np.maximum(low, frame_low), high_px=np.minimum(high, frame_high), extent_px=extent_px)


def _window(box: _Box, size: Float, sigma_px: float, options: RenderOptions) -> _Window:
    """Lay cells over the box and pixels over the cells, plus what the PSF adds, minus what the frame cuts."""
    per_px = max(options.rays_per_pixel_side, math.ceil(options.min_rays_across / box.extent_px))
    halo, margin = _halo_px(sigma_px), options.margin_px
    first = np.maximum(np.floor(box.low_px + 0.5).astype(np.int64) - halo, -margin)
    last = np.minimum(np.ceil(box.high_px - 0.5) + halo, size - 1 + margin).astype(np.int64)
    count = last - first + 1
    x, y = (Cells.covering(float(box.low_px[i]), float(box.high_px[i]), per_px) for i in range(2))
    return _Window(
        cells=(x, y),
        blurred=(x.spread(int(first[0]), int(count[0]), sigma_px), y.spread(int(first[1]), int(count[1]), sigma_px)),
        sharp=(x.spread(int(first[0]), int(count[0]), 0.0), y.spread(int(first[1]), int(count[1]), 0.0)),
        corner_px=first,
    )


def _traced(
    body: Body, model: CameraModel, window: _Window, sun_body: Float, options: RenderOptions
) -> Template | Failure:
    """Trace all cells, some rows at a time, and gather their light on the pixels."""
    x, y = (cells.centers_px for cells in window.cells)
    random = None if options.jitter_seed is None else np.random.default_rng(options.jitter_seed)
    grid = RayGrid(model, *window.cells, body.camera_from_body.as_matrix().T, random)
    light, cover = (np.empty((y.size, window.blurred[0].shape[0])) for _ in range(2))
    by_column, by_row = np.zeros(x.size), np.zeros(y.size)
    n_hit = n_lit = 0
    step = max(_RAYS_PER_CHUNK // x.size, 1)
    for start in range(0, y.size, step):
        part = slice(start, min(start + step, y.size))
        shaded, hit, lit = _shaded(body, grid.rows(part.start, part.stop), sun_body, options.shadows)
        brightness, hit = shaded.reshape(-1, x.size), hit.reshape(-1, x.size)
        light[part] = spread_over(window.blurred[0], brightness.T).T
        cover[part] = spread_over(window.sharp[0], hit.T.astype(np.float64)).T
        by_column += brightness.sum(axis=0)
        by_row[part] = brightness.sum(axis=1)
        n_hit, n_lit = n_hit + int(hit.sum()), n_lit + lit
    if n_hit == 0:
        return Failure(Reason.OUT_OF_FRAME, "no ray of the frame meets the body, though its bounds touch the frame")
    if n_lit == 0:
        return Failure(Reason.NOT_LIT, "no part of the body that the camera sees is lit by the Sun")
    return Template(
        brightness=frozen(spread_over(window.blurred[1], light)),
        coverage=frozen(np.minimum(spread_over(window.sharp[1], cover), 1.0)),
        corner_px=frozen(window.corner_px),
        center_px=body.center_px(model),
        photocenter_px=np.array([by_column @ x, by_row @ y]) / by_row.sum(),
        lit_fraction=n_lit / n_hit,
    )


def _shaded(body: Body, directions_body: Float, sun_body: Float, shadows: bool) -> tuple[Float, NDArray[np.bool_], int]:
    """Brightness (n,), hit (n,) and number of lit rays, of rays (n, 3) from the camera."""
    lighting = body.tracer.lighting(body.camera_body_km, directions_body, sun_body, shadows=shadows)
    phase_rad = np.arccos(np.clip(-(directions_body[lighting.lit] @ sun_body), -1.0, 1.0))
    brightness = np.zeros(len(directions_body))
    brightness[lighting.lit] = body.reflectance(lighting.cos_incidence, lighting.cos_emission, phase_rad)
    return brightness, lighting.hit, int(lighting.lit.size)
