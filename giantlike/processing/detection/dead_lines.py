"""Rows and columns of a detector that gave no signal, found in the image: optics draw no line that sharp."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.processing.detection.frame_lines import FrameLines

_DARK = 0.5  # over the darker neighbor, of a pixel that may be dead: a PSF of 0.7 px fills a black line to it
_LEAST_SIGMAS = 16.0  # least signal of neighbors, in sigmas of the noise without light, of a tested pixel
_LEAST_LENGTH, _LEAST_SHARE = 8, 0.9  # fewest pixels between bright ones; least fraction of dark ones


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
