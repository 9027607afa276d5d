"""Largest values and means of the rows and columns of a frame, found in the pass that takes off its bias."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameLines(Value):
    """A frame without its bias, and maxima and means of its rows and columns."""

    light_dn: Float  # (rows, columns)
    largest_dn: Float  # (rows,); of each row
    means_dn: Float  # (2, rows); of the first and the second half of each row
    across_largest_dn: Float  # (columns,)
    across_means_dn: Float  # (2, columns); as above, for columns

    @classmethod
    def from_frame(cls, pixels: NDArray[Any], bias_dn: float) -> FrameLines:
        """Take the bias off a frame."""
        rows, columns = pixels.shape
        light, native = np.empty(pixels.shape), pixels.dtype.newbyteorder("=")
        largest, across_largest = np.full(rows, -np.inf), np.full(columns, -np.inf)
        sums, across_sums = np.zeros((2, rows)), np.zeros((2, columns))
        lines = largest, sums, across_largest, across_sums
        _add(np.ascontiguousarray(pixels, dtype=native), float(bias_dn), light, *lines)
        halves, across_halves = ([size // 2, size - size // 2] for size in (columns, rows))
        return cls(
            light_dn=light,
            largest_dn=largest,
            means_dn=sums / np.maximum(halves, 1)[:, None],
            across_largest_dn=across_largest,
            across_means_dn=across_sums / np.maximum(across_halves, 1)[:, None],
        )

    def transpose(self) -> FrameLines:
        """The same frame with its columns as rows."""
        return replace(
            self,
            light_dn=self.light_dn.T,
            largest_dn=self.across_largest_dn,
            means_dn=self.across_means_dn,
            across_largest_dn=self.largest_dn,
            across_means_dn=self.means_dn,
        )


@compiled
def _add(
    pixels: NDArray[Any],
    bias_dn: float,
    light: Float,
    largest: Float,
    sums: Float,
    across_largest: Float,
    across_sums: Float,
) -> None:
    """Fill in the signal, and maxima and sums of rows and columns, in place of zeros and minus infinities."""
    rows, columns = pixels.shape
    for row in range(rows):
        line, column_sums = light[row], across_sums[0 if row < rows // 2 else 1]
        for column in range(columns):
            value = np.float64(pixels[row, column]) - bias_dn
            line[column] = value
            column_sums[column] += value
            across_largest[column] = value if value > across_largest[column] else across_largest[column]
        for half in range(2):
            first, last = (0, columns // 2) if half == 0 else (columns // 2, columns)
            a = b = c = d = 0.0  # four sums side by side: each addition waits for the one before
            p = q = r = s = largest[row]
            whole = last - (last - first) % 4
            for column in range(first, whole, 4):
                a, b, c, d = a + line[column], b + line[column + 1], c + line[column + 2], d + line[column + 3]
                p = line[column] if line[column] > p else p
                q = line[column + 1] if line[column + 1] > q else q
                r = line[column + 2] if line[column + 2] > r else r
                s = line[column + 3] if line[column + 3] > s else s
            for column in range(whole, last):
                a, p = a + line[column], max(p, line[column])
            sums[half, row], largest[row] = a + b + c + d, max(p, q, r, s)
