"""Render a body into a template: single-bounce ray tracing through the real camera model and its PSF."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, frozen, require
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.neighbours import Neighbour
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.sampling import spread_over
from giantlike.ray_tracing.trace import Strip, View, strips
from giantlike.ray_tracing.window import Window, window_around


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
    template = rendered(
        body, model, sun_direction_camera=sun_direction_camera, psf=psf, columns=columns, rows=rows, options=options
    )
    if isinstance(template, Template) and template.lit_fraction == 0.0:
        return Failure(Reason.NOT_LIT, "no part of the body that the camera sees is lit by the Sun")
    return template


def rendered(
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None,
    columns: int,
    rows: int,
    options: RenderOptions,
    neighbours: tuple[Neighbour, ...] = (),
) -> Template | Failure:
    """Render a body among neighbours; one that is seen in the dark is a black template with a NaN photocentre.

    Parameters, failures and errors are those of :func:`render`; ``NO_SIGNAL`` means hidden by neighbours.
    """
    require(columns > 0 and rows > 0, f"columns and rows must be > 0, got {columns} and {rows}")
    sun_body = sun_in_body(body, sun_direction_camera)
    sigma_px = 0.0 if psf is None else psf.sigma_px
    window = window_around(body, model, sigma_px=sigma_px, columns=columns, rows=rows, options=options)
    if isinstance(window, Failure):
        return window
    view = View(body=body, model=model, cells=window.cells, sun_body=sun_body, neighbours=neighbours, options=options)
    return _gathered(view, window, strips(view), body.reflectance)


def _gathered(view: View, window: Window, traced: Iterable[Strip], law: Reflectance) -> Template | Failure:
    """Shade strips and gather their light on the pixels."""
    x, y = (cells.centers_px for cells in window.cells)
    light, cover = (np.empty((y.size, window.blurred[0].shape[0])) for _ in range(2))
    by_column, by_row = np.zeros(x.size), np.zeros(y.size)
    n_hit = n_lit = 0
    for strip in traced:
        part = slice(strip.start, strip.stop)
        brightness = _shaded(strip, law, x.size)
        hit = np.zeros(brightness.shape)
        hit.flat[strip.sight.rays] = 1.0
        light[part] = spread_over(window.blurred[0], brightness.T).T
        cover[part] = spread_over(window.sharp[0], hit.T).T
        by_column += brightness.sum(axis=0)
        by_row[part] = brightness.sum(axis=1)
        n_hit, n_lit = n_hit + strip.sight.rays.size, n_lit + strip.lit
    if n_hit == 0 and view.neighbours:
        return Failure(Reason.NO_SIGNAL, "no ray of the frame meets the body, or other bodies stand before it")
    if n_hit == 0:
        return Failure(Reason.OUT_OF_FRAME, "no ray of the frame meets the body, though its bounds touch the frame")
    with np.errstate(invalid="ignore"):
        photocenter_px = np.array([by_column @ x, by_row @ y]) / by_row.sum()
    return Template(
        brightness=frozen(spread_over(window.blurred[1], light)),
        coverage=frozen(np.minimum(spread_over(window.sharp[1], cover), 1.0)),
        corner_px=frozen(window.corner_px),
        center_px=view.body.center_px(view.model),
        photocenter_px=photocenter_px,
        lit_fraction=n_lit / n_hit,
    )


def _shaded(strip: Strip, law: Reflectance, columns: int) -> Float:
    """Brightness (rows, columns) of the cells of a strip."""
    brightness = np.zeros((strip.stop - strip.start, columns))
    sight = strip.sight
    for light in strip.light:
        value = law(light.cos_incidence, sight.cos_emission[light.seen], light.phase_rad)
        if strip.albedo is not None:
            value = value * strip.albedo[light.seen]
        brightness.flat[sight.rays[light.seen]] += value / len(strip.light)
    return brightness
