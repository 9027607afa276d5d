"""Hot rows and columns of a detector, found in the image as lines sharper than the point spread function."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from giantlike.core.arrays import Float, Mask
from giantlike.processing.detection.dead_lines import whole_lines
from giantlike.processing.detection.frame_lines import FrameLines

_REACH = 3  # number of lines on either side whose median predicts a line: it follows gradients and edges of the signal
_LEAST_SIGMAS = 2.0
"""Minimum excess of a hot line over its neighbors, in standard deviations of the noise without light: a smaller one is
hidden by the noise of each pixel, and all lines of a detector differ a little."""
_SHARE = 0.7
"""Minimum fraction of the pixels of a hot part with at least half of its excess: 84 % of them reach it with noise of
half of the excess, none of a line with a few bright stars."""
_BLEED = 0.2
"""Maximum excess of the lines next to a hot one over those one farther, relative to its own: a PSF of 0.5 px gives 0.3.
Smear below a bright body (Hayabusa2, 20151203_000006) has equally narrow peaks, of 0.8."""
_WIDEST = 2  # hot lines side by side, at most: optics of 0.6 px and more spread a line over three
_LEAST_LENGTH = 16  # minimum pixels of half a line: with fewer, the median is too noisy
_MOST = 0.1  # share of all lines beyond which they are a pattern of the image, not defects


def hot_lines(frame: FrameLines, *, noise_dn: float) -> Mask | None:
    """Find rows and columns that are brighter than their neighbors over the first or the second half of the frame.

    Returns a mask of whole lines (rows, columns), None without any. More than two adjacent hot lines are not found, nor
    are lines that are hot over less than half of half a frame.
    """
    rows, columns = (_hot_rows(image, noise_dn) for image in (frame, frame.transpose()))
    return whole_lines(frame.light_dn.shape, rows, columns)


def _hot_rows(frame: FrameLines, noise_dn: float) -> np.ndarray:
    """Numbers of hot rows; none where they are too many."""
    image, middle = frame.light_dn, frame.light_dn.shape[1] // 2
    halves = (image[:, :middle], image[:, middle:])
    first, second = (_hot_in(half, mean, noise_dn) for half, mean in zip(halves, frame.means_dn, strict=True))
    hot = np.union1d(first, second)
    return hot if hot.size <= _MOST * len(image) else hot[:0]


def _hot_in(image: Float, mean: Float, noise_dn: float) -> np.ndarray:
    """Numbers of rows that are hot over most of a part of an image, whose rows have these means."""
    none = np.zeros(0, dtype=np.int64)
    if len(image) < 2 * _REACH + 1 or image.shape[1] < _LEAST_LENGTH:
        return none
    least = _LEAST_SIGMAS * noise_dn
    brighter = (mean - median_filter(mean, 2 * _REACH + 1))[_REACH:-_REACH]
    level = {int(row): _excess_dn(image, int(row)) for row in _REACH + np.flatnonzero(brighter > _SHARE * least)}
    hot = [row for row, excess in level.items() if excess >= least]
    groups = np.split(hot, 1 + np.flatnonzero(np.diff(hot) > 1)) if hot else []
    found = [group for group in groups if len(group) <= _WIDEST and _is_sharp(image, group, level)]
    return np.concatenate(found).astype(np.int64) if found else none


def _is_sharp(image: Float, group: np.ndarray, level: dict[int, float]) -> bool:
    """True if the rows next to a group exceed those one farther by no more than a fraction of its excess."""
    first, last = int(group[0]), int(group[-1])
    near, far = (image[first - step] + image[last + step] for step in (1, 2))
    return float(np.median(near - far)) < 2.0 * _BLEED * min(level[int(row)] for row in group)


def _excess_dn(image: Float, row: int) -> float:
    """Median excess of a row over its neighbors; 0 where only some of its pixels have it."""
    around = image[max(row - _REACH, 0) : row + _REACH + 1]
    over = image[row] - np.median(around, axis=0)
    excess = float(np.median(over))
    return excess if float(np.mean(over > 0.5 * excess)) >= _SHARE else 0.0
