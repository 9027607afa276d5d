"""Shading: the light of traced rays, under a reflectance law, gathered on pixels into a template."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing.footprint import Footprint
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.sampling import Tile, spread_over
from giantlike.ray_tracing.trace import TracedRays, View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Template(Value):
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
        Projection of the origin of the shape, in the distorted image.
    photocenter_px : (2,) float64, px
        Centroid of the light before PSF and pixels, so that it holds for a body inside one pixel too.
    lit_fraction : float
        Part of the rays on the body that end on lit surface.
    rendered_from_camera : Rotation
        Takes camera axes to those that the body was rendered in: no turn, unless it was recentered.
    """

    brightness: Float
    coverage: Float
    corner_px: NDArray[np.int64]
    center_px: Float
    photocenter_px: Float
    lit_fraction: float
    rendered_from_camera: Rotation = field(default_factory=Rotation.identity)

    def placed(self, columns: int, rows: int) -> Float:
        """Return the brightness in a whole frame.

        Parameters
        ----------
        columns, rows : int, px
            Size of the frame.

        Returns
        -------
        (rows, columns) float64
            0 outside the template; what lies outside the frame is cut off.
        """
        x, y = self.corner_px.tolist()
        return PixelBox(x=0, y=0, width=columns, height=rows).cut(self.brightness, (x, y))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShadedTile(Value):
    """Light and coverage of a tile of cells.

    Parameters
    ----------
    tile : Tile
    light : (w, rows) float64
        By pixel columns of the template and rows of cells; blurred along x.
    by_column : (columns,) float64
        Brightness summed over the rows, for each column of cells of the tile.
    by_row : (rows,) float64
    cover : (height, columns) int64
        Number of hits on the template's pixels, from row ``first_row`` on.
    first_row : int
    hits, lit : int
        Number of rays that meet the body, and of those that see the Sun too.
    """

    tile: Tile
    light: Float
    by_column: Float
    by_row: Float
    cover: NDArray[np.int64]
    first_row: int
    hits: int
    lit: int


def shade_tile(footprint: Footprint, tile: Tile, traced: TracedRays, law: Reflectance) -> ShadedTile:
    """Light of the cells of a tile under a reflectance law, on the pixel columns of the template.

    Parameters
    ----------
    footprint : Footprint
    tile : Tile
    traced : TracedRays
        One ray for each cell of the tile, column after column.
    law : Reflectance

    Returns
    -------
    ShadedTile
    """
    brightness = np.zeros((footprint.cells[0].count, tile.rows))
    inside = brightness[tile.left : tile.right]
    inside[:] = traced.brightness(law).reshape(inside.shape)
    first_row, cover = footprint.counted(tile, traced.sight.rays)
    return ShadedTile(
        tile=tile,
        light=spread_over(footprint.spread[0], brightness),
        by_column=inside.sum(axis=1),
        by_row=inside.sum(axis=0),
        cover=cover,
        first_row=first_row,
        hits=int(traced.sight.rays.size),
        lit=traced.lit,
    )


def gathered(view: View, footprint: Footprint, tiles: Iterable[ShadedTile]) -> Template | Failure:
    """Template of tiles, added up in their order.

    Parameters
    ----------
    view : View
    footprint : Footprint
    tiles : iterable of ShadedTile

    Returns
    -------
    Template or Failure
        A body seen in the dark gives a black template with a NaN photocenter; ``NO_SIGNAL`` where neighbors hide it,
        ``OUT_OF_FRAME`` where no ray meets it.
    """
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
        brightness=spread_over(footprint.spread[1], light),
        coverage=counts / footprint.cells[0].per_px ** 2,
        corner_px=footprint.corner_px,
        center_px=view.body.center_px(footprint.plane.model),
        photocenter_px=photocenter_px,
        lit_fraction=n_lit / n_hit,
    )


def unless_dark(template: Template | Failure) -> Template | Failure:
    """Return the template, or a failure ``NOT_LIT`` for one without any lit surface."""
    if isinstance(template, Template) and template.lit_fraction == 0.0:
        return Failure(Reason.NOT_LIT, "no part of the body that the camera sees is lit by the Sun")
    return template
