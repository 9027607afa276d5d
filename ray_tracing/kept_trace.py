"""A trace that is kept, so that another law, PSF or Sun costs only what it changes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import require
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.options import DEFAULT_OPTIONS, RenderOptions
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.render import viewed
from giantlike.ray_tracing.shade import Template, gathered, shade_tile, unless_dark
from giantlike.ray_tracing.trace import TracedTile, View, in_order, sunlight, trace_tile
from giantlike.ray_tracing.window import Tile, window_around


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """A body traced in one pose, ready to be shaded; from :func:`trace_body`.

    Each ``with_`` method returns a new trace whose :meth:`template` equals, to the last bit, that of a
    :func:`~giantlike.ray_tracing.render` with that one thing changed.

    Parameters
    ----------
    view : View
        What was traced.
    size_px : (int, int), px
        Columns and rows of the frame.
    """

    view: View
    size_px: tuple[int, int]
    tiles: tuple[TracedTile, ...] = field(repr=False)

    def template(self) -> Template | Failure:
        """Shade the rays and gather them on pixels; fails as ``render`` does."""
        view = self.view
        return unless_dark(gathered(view, (shade_tile(view, tile, view.body.reflectance) for tile in self.tiles)))

    def with_reflectance(self, reflectance: Reflectance) -> Trace:
        """Return the same rays under another law; costs nothing until it is shaded."""
        body = replace(self.view.body, reflectance=reflectance)
        return replace(self, view=replace(self.view, body=body))

    def with_psf(self, psf: GaussianPsf | None) -> Trace:
        """Return the same rays under another point spread function.

        Raises
        ------
        InputError
            The frame cuts the body, and this PSF would carry light in from elsewhere: trace it anew.
        """
        view = self.view
        columns, rows = self.size_px
        sigma_px = 0.0 if psf is None else psf.sigma_px
        window = window_around(
            view.body, view.model, sigma_px=sigma_px, columns=columns, rows=rows, options=view.options
        )
        same = not isinstance(window, Failure) and window.cells == view.window.cells
        require(same, f"a psf of {sigma_px:g} px needs other rays where the frame cuts the body: trace it anew")
        return self if isinstance(window, Failure) else replace(self, view=replace(view, window=window))

    def with_sun(self, sun_direction_camera: ArrayLike) -> Trace:
        """Return the same hits under another Sun, a unit vector (3,) in camera axes; traces shadow rays only.

        Raises
        ------
        InputError
            The direction is not a unit vector.
        """
        sun_body = np.append(sun_in_body(self.view.body, sun_direction_camera), 0.0)
        view = replace(self.view, sun_body=sun_body)

        def relit(traced: TracedTile) -> TracedTile:
            return replace(traced, light=sunlight(view, traced.tile, traced.sight, traced.directions))

        return replace(self, view=view, tiles=tuple(in_order(relit, self.tiles, view.options.threads)))


def trace_body(
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None = None,
    columns: int,
    rows: int,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> Trace | Failure:
    """Trace a body once, to shade it many times.

    Parameters and errors are those of :func:`~giantlike.ray_tracing.render`; the trace keeps some 100 bytes for each
    ray.

    Returns
    -------
    Trace or Failure
        ``OUT_OF_FRAME`` when no light can fall on the (widened) frame, ``DEGENERATE_GEOMETRY`` when the camera lies
        inside the body.
    """
    view = viewed(body, model, sun_direction_camera, psf, (columns, rows), options)
    if isinstance(view, Failure):
        return view
    grid = view.ray_grid()

    def traced(tile: Tile) -> TracedTile:
        return trace_tile(view, grid, tile)

    return Trace(view=view, size_px=(columns, rows), tiles=tuple(in_order(traced, view.window.tiles, options.threads)))
