"""Noise of the pixels of an image, by the image: step of its numbers, and noise of its dark parts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask

_LEAST_VALUES = 16
"""Different values that a common step needs: fewer have one by chance, 16 once in 30,000 images."""
_SAMPLE = 16_384
"""Pixels that are looked at for the step, about; all steps between values of the sky occur among so many."""
_STEP_TOLERANCE = 0.05
"""Largest distance of a difference of two values from a multiple of the step, in steps.

Numbers of 16 bits times a scale, in single precision, are rounded by 0.004 steps at most.
"""
_STEP_PRECISION = 1e-5
"""Relative error of the step, by which it may miss differences of many steps."""
_BLOCK_PX = 16
"""Side, px, of the blocks that noise is measured in: small beside slopes of the sky, and one is known to 4.5 %."""
_BLOCKS = 4096
"""Blocks that are looked at: all of an image of 1024 x 1024 pixels."""
_DARKEST = 0.25
"""Share of the blocks, darkest first, that count as sky.

A body may cover up to three quarters of the frame, and stars less than half of these blocks: their median counts.
"""
_VARIED = 0.5
"""Least share of blocks whose pixels differ: with fewer, the dark was clipped or made without noise."""
_ROUNDING = 1e-12
"""Variance over squared level of a block of equal numbers, by rounding in single precision (6e-8 squared) and more."""


def value_step(pixels: NDArray[Any], mask: Mask | None = None) -> float:
    """Step between the numbers that an image holds, as a converter leaves it.

    Parameters
    ----------
    pixels : (rows, columns) real, DN
    mask : (rows, columns) bool, optional
        True where a pixel is bad.

    Returns
    -------
    float, DN
        Largest number of which all differences of pixels are multiples: 1, or the ``BSCALE`` of scaled numbers. Where
        there are too few values to tell, 1 for integers and 0 for floating point numbers, as for those without a step.

    Examples
    --------
    >>> counts = np.random.default_rng(1).integers(100, 200, (40, 40))
    >>> value_step(counts), value_step(16 * counts), round(value_step(1e-4 * counts), 12), value_step(np.sqrt(counts))
    (1.0, 16.0, 0.0001, 0.0)
    """
    every = max(pixels.size // _SAMPLE, 1) | 1  # odd, or only some columns would be looked at
    sample = pixels.ravel()[::every]
    if mask is not None:
        sample = sample[~mask.ravel()[::every]]
    whole = pixels.dtype.kind in "iub"
    values = np.unique(sample)
    if len(values) < _LEAST_VALUES:
        return 1.0 if whole else 0.0
    if whole:
        return float(np.gcd.reduce(np.diff(values.astype(np.int64))))
    return _common_step(np.diff(values.astype(np.float64)))


def _common_step(differences: Float) -> float:
    """Number of which all differences (n,) > 0 are multiples; 0 where there is none."""
    step = float(differences.min())
    for limit in (4.0, 64.0, np.inf):  # a difference of many steps needs a better known step
        near = differences[differences < limit * step]
        step = float(near.sum() / np.rint(near / step).sum())
    steps = differences / step
    misses = np.abs(steps - np.rint(steps)) > _STEP_TOLERANCE + _STEP_PRECISION * steps
    return 0.0 if bool(misses.any()) else step


def sky_noise(pixels: NDArray[Any], mask: Mask | None = None) -> float:
    """Standard deviation of the pixels in the dark parts of an image, about planes.

    Parameters
    ----------
    pixels : (rows, columns) real, DN
        Finite.
    mask : (rows, columns) bool, optional
        True where a pixel is bad. Blocks with such pixels count only where all have some.

    Returns
    -------
    float, DN
        0 where most of the image is equal pixels, as in a render without noise.
    """
    side = min(_BLOCK_PX, *pixels.shape)
    blocks = _blocks(pixels, side).astype(np.float64)
    if mask is not None and mask.any():
        clean = ~_blocks(mask, side).any(axis=1)
        blocks = blocks[clean] if clean.any() else blocks
    down, across = np.indices((side, side)).reshape(2, -1)
    basis = np.linalg.qr(np.stack([np.ones(side**2), down, across], axis=1))[0]
    away = blocks - (blocks @ basis) @ basis.T
    variances, levels = np.sum(away**2, axis=1) / max(side**2 - basis.shape[1], 1), blocks.mean(axis=1)
    varied = variances > _ROUNDING * levels**2
    if np.count_nonzero(varied) < _VARIED * len(varied):
        return 0.0
    darkest = np.argsort(levels[varied])[: max(int(_DARKEST * np.count_nonzero(varied)), 1)]
    return float(np.sqrt(np.median(variances[varied][darkest])))


def _blocks(pixels: NDArray[Any], side: int) -> NDArray[Any]:
    """Square blocks (n, side * side) of an image, evenly spread where there are too many."""
    rows, columns = (size // side for size in pixels.shape)
    kept = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    every = max(-(-rows * columns // _BLOCKS), 1)
    down, across = np.divmod(np.arange(0, rows * columns, every), columns)
    return kept[down, :, across, :].reshape(len(down), side * side)
