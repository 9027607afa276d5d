"""Rows and columns of a detector that gave no signal, found in the image: optics draw no line that sharp."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.processing.detection.frame_lines import FrameLines

_DARK = 0.5
"""Signal relative to the darker neighbor below which a pixel may be dead: a point spread function of 0.7 px fills even
a black line of one pixel to this level."""
_LEAST_SIGMAS = 16.0
"""Minimum signal of neighbors, in standard deviations of the noise without light, for testing a pixel between them."""
_LEAST_LENGTH, _LEAST_SHARE = 8, 0.9
"""Minimum number of pixels of a dead line between bright neighbors, and the minimum fraction of them that are dark."""


def dead_lines(frame: FrameLines, *, noise_dn: float) -> Mask | None:
    """Find rows and columns without signal by their neighbors on both sides, in front of something bright.

    Returns a mask of whole lines (rows, columns), None without any. Two side by side are not found, nor are lines that
    no bright body crosses: these do no harm.
    """
    rows, columns = (_dead_rows(image.light_dn, image.largest_dn, noise_dn) for image in (frame, frame.transpose()))
    return whole_lines(frame.light_dn.shape, rows, columns)


def whole_lines(shape: tuple[int, ...], rows: np.ndarray, columns: np.ndarray) -> Mask | None:
    """Mask (rows, columns), True on the given rows (k,) and columns (m,); None where there are none."""
    if not rows.size and not columns.size:
        return None
    result = np.zeros(shape, dtype=bool)
    result[rows] = True
    result[:, columns] = True
    return result


def _dead_rows(image: Float, largest: Float, noise_dn: float) -> np.ndarray:
    """Numbers of rows without signal, by the pixels and the largest of each row."""
    if len(image) < 3:
        return np.zeros(0, dtype=np.int64)
    beside = np.minimum(largest[:-2], largest[2:])
    suspects = 1 + np.flatnonzero((beside > _LEAST_SIGMAS * noise_dn) & (largest[1:-1] < _DARK * beside))
    dead = []
    for row in suspects:
        before, here, after = image[row - 1 : row + 2]
        darker = np.minimum(before, after)
        lit = darker > _LEAST_SIGMAS * noise_dn
        if lit.sum() >= _LEAST_LENGTH and np.mean(here[lit] < _DARK * darker[lit]) >= _LEAST_SHARE:
            dead.append(int(row))
    return np.array(dead, dtype=np.int64)
