"""Render a body into a template: single-bounce ray tracing through the real camera model and its PSF."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, unit
from giantlike.core.detector import GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.footprint import FocalPlane, Footprint, footprint_of
from giantlike.ray_tracing.neighbors import Neighbor
from giantlike.ray_tracing.options import DEFAULT_OPTIONS, RenderOptions
from giantlike.ray_tracing.sampling import RayGrid, Tile
from giantlike.ray_tracing.shade import ShadedTile, Template, gathered, shade_tile, unless_dark
from giantlike.ray_tracing.trace import View, in_order, trace_rays, view_of


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
    plane = FocalPlane(model=model, columns=columns, rows=rows, psf=psf)
    template = unless_dark(rendered(body, plane, sun, options))
    if not (recenter and isinstance(template, Failure) and template.reason is Reason.OUT_OF_FRAME):
        return template
    middle = model.unproject([0.5 * (columns - 1), 0.5 * (rows - 1)])
    turn = shortest_turn(unit(body.position_camera_km), middle)
    template = unless_dark(rendered(body.turned(turn), plane, rotate(turn, sun), options))
    return replace(template, rendered_from_camera=turn) if isinstance(template, Template) else template


def rendered(
    body: Body,
    plane: FocalPlane,
    sun_direction_camera: ArrayLike,
    options: RenderOptions,
    neighbors: tuple[Neighbor, ...] = (),
) -> Template | Failure:
    """Render a body among neighbors; one that is seen in the dark is a black template with a NaN photocenter.

    Parameters
    ----------
    body : Body
    plane : FocalPlane
    sun_direction_camera : (3,), unitless, camera axes
    options : RenderOptions
    neighbors : tuple of Neighbor

    Returns
    -------
    Template or Failure
        Failures are those of :func:`render`; ``NO_SIGNAL`` means hidden by neighbors.
    """
    view = view_of(body, plane.model, sun_direction_camera, options, neighbors)
    footprint = footprint_of(view.body, plane, options)
    if isinstance(footprint, Failure):
        return footprint
    grid, law = ray_grid(view, footprint), view.body.reflectance

    def shaded(tile: Tile) -> ShadedTile:
        traced = trace_rays(view, grid.directions(tile), stratum=tile.start)
        return shade_tile(footprint, tile, traced, law)

    return gathered(view, footprint, in_order(shaded, footprint.tiles, options.threads))


def ray_grid(view: View, footprint: Footprint) -> RayGrid:
    """Directions of the rays through the cells of a footprint, body axes.

    Parameters
    ----------
    view : View
    footprint : Footprint

    Returns
    -------
    RayGrid
    """
    rotation = view.body.camera_from_body.as_matrix().T
    return RayGrid(footprint.plane.model, *footprint.cells, rotation, view.options.jitter_seed)


def shortest_turn(start: Float, stop: Float) -> Rotation:
    """Smallest rotation that takes unit vector ``start`` (3,) to ``stop`` (3,)."""
    axis = np.cross(start, stop)
    sine, cosine = float(np.linalg.norm(axis)), float(start @ stop)
    if sine < 1e-12:  # parallel or opposite to rounding: any axis across
        axis = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
    return Rotation.from_rotvec(math.atan2(sine, cosine) * unit(axis))
