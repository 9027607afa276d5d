"""Where a rough trace of a body shows light all around, or none: a finer trace needs fewer rays there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from giantlike.core.arrays import Float, Indices, Mask
from giantlike.core.values import Value
from giantlike.ray_tracing.sampling import AxisCells


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Daylight(Value):
    """Light and dark parts of a body, from the rays of a rough trace of it.

    A ray that ends in full shadow is dark, and one that ends in full illumination need not be
    followed to the Sun. Isolated bright spots and shadows narrower than a rough cell are lost.
    """

    cells: tuple[AxisCells, AxisCells]  # columns and rows of the rough trace
    lit: Mask  # (columns, rows); cells whose ray ends on a point in sunlight
    center_px: Float  # center_px, traced_center_px: of the body, now and where it was traced roughly
    traced_center_px: Float
    scale: float  # ratio of the current size of the body to the size in the rough trace
    whole: bool = True  # False where rays were sent through a part of the cells: none is known to be dark

    def classify(self, cells: tuple[AxisCells, AxisCells]) -> tuple[Mask, Mask]:
        """Where a finer trace can do without rays. Returns ``dark``, ``lit`` (columns, rows)."""
        around, image = np.ones((3, 3), np.uint8), self.lit.astype(np.uint8)
        columns, rows = (self._numbers(axis, one) for axis, one in enumerate(cells))
        inside = (columns >= 0)[:, None] & (rows >= 0)
        dark, lit = (
            np.asarray(np.take(np.take(each, columns, axis=0), rows, axis=1) & inside)
            for each in ((cv2.dilate(image, around) == 0) & self.whole, cv2.erode(image, around) == 1)
        )
        return dark, lit

    def _numbers(self, axis: int, fine: AxisCells) -> Indices:
        """Numbers of the rough cells in which fine ones lie, -1 beyond them."""
        rough = self.cells[axis]
        places_px = self.traced_center_px[axis] + (fine.centers_px - self.center_px[axis]) / self.scale
        numbers = np.floor((places_px + 0.5) * rough.per_px).astype(np.int64) - rough.first
        return np.where((numbers >= 0) & (numbers < rough.count), numbers, -1)
