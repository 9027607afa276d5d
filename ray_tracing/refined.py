"""A traced body with more rays where its light is uneven: along the limb, the terminator, shadows and rims."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from giantlike.core.arrays import Float, Indices, Mask, unit
from giantlike.core.values import Value
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.sampling import AxisCells
from giantlike.ray_tracing.trace import TracedRays, trace_rays

UNEVEN = 0.1  # range of the light of neighboring cells relative to the brightest, from which a cell is refined


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedTrace(Value):
    """A trace whose uneven cells are split into ``factor`` by ``factor``, one ray each; from :func:`refine_trace`."""

    trace: Trace  # of all cells
    factor: int
    columns: Indices  # columns, rows: (n,); cells that are split
    rows: Indices
    rays: TracedRays = field(repr=False)  # of their parts, column after column in each cell

    @property
    def cells(self) -> tuple[AxisCells, AxisCells]:
        """Columns and rows of all cells."""
        return self.trace.cells

    @property
    def part_cells(self) -> tuple[AxisCells, AxisCells]:
        """Columns and rows of the parts of all cells."""
        x, y = (
            AxisCells(self.factor * cells.first, self.factor * cells.count, self.factor * cells.per_px)
            for cells in self.trace.cells
        )
        return x, y

    @property
    def part_places(self) -> tuple[Indices, Indices]:
        """Columns and rows (k,) of the parts that were traced, counted as in ``part_cells``."""
        size = self.factor
        across = np.arange(size).repeat(size)
        columns = (size * self.columns[:, None] + across).ravel()
        rows = (size * self.rows[:, None] + np.tile(np.arange(size), size)).ravel()
        return columns, rows

    @property
    def lit(self) -> int:
        """Number of rays that end on a point in sunlight."""
        return self.trace.lit + self.rays.lit

    def cell_brightness(self, law: Reflectance) -> Float:
        """Shade the rays of whole cells and leave them as they are, (columns, rows), 0 in those that are split."""
        whole = self.trace.cell_brightness(law)
        whole[self.columns, self.rows] = 0.0
        return whole

    def part_brightness(self, law: Reflectance) -> Float:
        """Shade the rays of parts."""
        return self.rays.brightness(law)


def refine_trace(trace: Trace, factor: int, *, uneven: float = UNEVEN) -> RefinedTrace:
    """Split the cells of a trace where light differs by ``uneven`` of the brightest, and trace the parts.

    Parts of a cell that is lit, as all around it are, are taken to be lit.
    """
    columns, rows = np.nonzero(_uneven(trace.cell_brightness(trace.body.reflectance), uneven))
    (x, y), model = trace.cells, trace.footprint.plane.model
    centers = np.stack([x.centers_px[columns], y.centers_px[rows]], axis=-1)
    axes = [model.unproject(centers), *np.moveaxis(model.unproject_jacobian(centers), -1, 0)]
    middle, by_x, by_y = (trace.body.to_body(axis) for axis in axes)
    steps = ((np.arange(factor) + 0.5) / factor - 0.5) / x.per_px
    directions = np.zeros((columns.size, factor, factor, 4))
    directions[..., :3] = unit(
        middle[:, None, None] + steps[:, None, None] * by_x[:, None, None] + steps[None, :, None] * by_y[:, None, None]
    )
    lit = cv2.erode(trace.lit_cells.astype(np.uint8), np.ones((3, 3), np.uint8))[columns, rows] == 1
    rays = trace_rays(trace.view, directions.reshape(-1, 4), lit=lit.repeat(factor**2))
    return RefinedTrace(trace=trace, factor=factor, columns=columns, rows=rows, rays=rays)


def _uneven(light: Float, limit: float) -> Mask:
    """Return True for cells that differ from those around, or that have such neighbors."""
    around, image = np.ones((3, 3), np.uint8), light.astype(np.float32)
    return np.asarray(cv2.dilate(image, around) - cv2.erode(image, around) > limit * float(image.max()))
