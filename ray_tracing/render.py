"""Render a body into a template: single-bounce ray tracing through the real camera model and its PSF."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.neighbors import Neighbor
from giantlike.ray_tracing.options import DEFAULT_OPTIONS, RenderOptions
from giantlike.ray_tracing.shade import ShadedTile, Template, gathered, shade_tile, unless_dark
from giantlike.ray_tracing.trace import View, in_order, trace_tile
from giantlike.ray_tracing.window import Tile, window_around


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
    sun_direction_camera : (3,), unitless, camera axes
        Unit vector from body to Sun.
    psf : GaussianPsf, optional
        None renders without blur beyond the pixel itself.
    columns, rows : int, px
        Size of the detector; the template is cut at its edges plus ``options.margin_px``.
    options : RenderOptions
    recenter : bool
        Where no light of the body can fall on the frame, turn the camera until its middle looks at the body and render
        that; ``Template.rendered_from_camera`` is the turn, and pixels are those of the turned camera.

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
    template = unless_dark(
        rendered(body, model, sun_direction_camera=sun, psf=psf, columns=columns, rows=rows, options=options)
    )
    if not (recenter and isinstance(template, Failure) and template.reason is Reason.OUT_OF_FRAME):
        return template
    middle = model.unproject([0.5 * (columns - 1), 0.5 * (rows - 1)])
    turn = shortest_turn(unit(body.position_camera_km), middle)
    turned, sun = body.turned(turn), turn.apply(sun)
    template = render(turned, model, sun_direction_camera=sun, psf=psf, columns=columns, rows=rows, options=options)
    return replace(template, rendered_from_camera=turn) if isinstance(template, Template) else template


def rendered(
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None,
    columns: int,
    rows: int,
    options: RenderOptions,
    neighbors: tuple[Neighbor, ...] = (),
) -> Template | Failure:
    """Render a body among neighbors; one that is seen in the dark is a black template with a NaN photocenter.

    Parameters, failures and errors are those of :func:`render`; ``NO_SIGNAL`` means hidden by neighbors.
    """
    view = viewed(body, model, sun_direction_camera, psf, (columns, rows), options, neighbors)
    if isinstance(view, Failure):
        return view
    grid, law = view.ray_grid(), body.reflectance

    def shaded(tile: Tile) -> ShadedTile:
        return shade_tile(view, trace_tile(view, grid, tile), law)

    return gathered(view, in_order(shaded, view.window.tiles, options.threads))


def shortest_turn(start: Float, stop: Float) -> Rotation:
    """The rotation about one axis across both that takes unit vector ``start`` (3,) to ``stop`` (3,)."""
    axis = np.cross(start, stop)
    sine, cosine = float(np.linalg.norm(axis)), float(start @ stop)
    if sine < 1e-12:  # straight ahead or behind: any axis across
        axis = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
    return Rotation.from_rotvec(math.atan2(sine, cosine) * unit(axis))


def viewed(
    body: Body,
    model: CameraModel,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None,
    size_px: tuple[int, int],
    options: RenderOptions,
    neighbors: tuple[Neighbor, ...] = (),
) -> View | Failure:
    """Lay a window over a body in a frame of ``size_px`` (columns, rows); failures are those of :func:`render`."""
    columns, rows = size_px
    require(columns > 0 and rows > 0, f"columns and rows must be > 0, got {columns} and {rows}")
    body = body.seen_by(model)
    sun_body = sun_in_body(body, sun_direction_camera)
    sigma_px = 0.0 if psf is None else psf.sigma_px
    window = window_around(body, model, sigma_px=sigma_px, columns=columns, rows=rows, options=options)
    if isinstance(window, Failure):
        return window
    return View(
        body=body,
        model=model,
        window=window,
        camera_body_km=body.camera_body_km,
        sun_body=np.append(sun_body, 0.0),
        neighbors=neighbors,
        options=options,
    )
