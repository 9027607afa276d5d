"""Light of a row of cells on a row of pixels: compiled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spread(Value):
    """Fractions of the light of cells, side by side, that fall on pixels."""

    shares: Float  # (k, w); of a cell on w pixels, in k kinds that follow each other over and over
    first: NDArray[np.int64]  # (n,); first of these pixels, for each of n cells; light on other pixels is lost
    count_px: int  # number of pixels

    def apply(self, light: Float) -> Float:
        """Light (count_px, m) on the pixels, from the light of the cells (n, m)."""
        return _spread(self.shares, self.first, self.count_px, np.ascontiguousarray(light, np.float64))

    def matrix(self) -> Float:
        """Shares (count_px, n) of each cell on each pixel."""
        return self.apply(np.eye(len(self.first)))


@compiled
def _spread(shares: Float, first: NDArray[np.int64], count: int, light: Float) -> Float:
    """Sum the light of cells, as in :class:`Spread`."""
    result = np.zeros((count, light.shape[1]))
    kinds, width = shares.shape
    for cell in range(len(first)):
        from_cell = light[cell]
        for step in range(max(0, -first[cell]), min(width, count - first[cell])):
            share, line = shares[cell % kinds, step], result[first[cell] + step]
            for column in range(light.shape[1]):
                line[column] += share * from_cell[column]
    return result
