"""Noise of the pixels of an image, by the image: step of its numbers, noise of its sky, and its growth with light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from giantlike.core.arrays import Float, Mask

UNKNOWN_READ_NOISE_E = 5.0
"""Read noise, electrons, of a detector that declares none: the gain follows where an image does not show it."""

_LEAST_VALUES = 16  # different values that a common step needs: fewer have one by chance, 16 once in 30,000 images
_SAMPLE = 16_384  # approximate number of pixels for the step: enough to contain all steps of the sky
_STEP_TOLERANCE = 0.05
"""Largest distance of a difference of two values from a multiple of the step, in steps.

Numbers of 16 bits times a scale, in single precision, are rounded by 0.004 steps at most.
"""
_STEP_PRECISION = 1e-5  # relative error of the step, by which it may miss differences of many steps
_BLOCK_PX = 16  # side of blocks for noise: small beside gradients of the sky; one gives it to 4.5 %
_BLOCKS = 4096  # maximum number of sampled blocks: all of an image of 1024 x 1024 pixels
_DARKEST = 0.25
"""Fraction of the blocks, darkest first, treated as sky.

A body may cover up to three quarters of the frame, and stars less than half of these blocks: their median counts.
"""
_VARIED = 0.5  # least fraction of blocks of the sky whose pixels differ: with fewer, it was clipped or rendered
_SMOOTHEST = 0.1
"""Quantile of the variances of bright blocks that is treated as noise: structure of a body only adds to it. The same
quantile of chi-squared is divided out, so that blocks with noise alone give its variance."""
_MIN_BRIGHT_BLOCKS = 16  # bright blocks from which on noise is measured: the quantile of as many is known to 5 %
_BRIGHT, _BRIGHT_SIGMAS = 0.25, 10.0
"""Minimum signal of a bright block, relative to the brightest ones (quantile 0.99) and to the noise of a pixel of the
sky: beyond both, it shows a body, not a gradient of the sky."""
_SILENT = 1e-3  # noise of floating point numbers whose sky has none, over their range: as of a good exposure
_ROUNDING = 1e-12  # variance over squared level of a block of equal numbers: single precision rounds by 6e-8


def value_step(pixels: NDArray[Any], mask: Mask | None = None) -> float:
    """Step between the numbers that an image holds, as a converter leaves it.

    >>> counts = np.random.default_rng(1).integers(100, 200, (40, 40))
    >>> value_step(counts), value_step(16 * counts), round(value_step(1e-4 * counts), 12), value_step(np.sqrt(counts))
    (1.0, 16.0, 0.0001, 0.0)
    """
    every = max(pixels.size // _SAMPLE, 1) | 1  # odd, or only some columns would be sampled
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


@dataclass(frozen=True, slots=True, kw_only=True)
class EightBitValues:
    """Values of an 8-bit JPEG or PNG file, gray or the luminance of its colors; they may be coded for display."""

    step_dn: float = 1.0  # of quantization, variance ``step_dn**2 / 12``: 1, less for a mean of channels

    @property
    def full_scale_dn(self) -> float:
        """Largest value, DN."""
        return 255.0


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatedNoise:
    """Noise of an image whose detector is not declared, as its own pixels show it."""

    read_noise_dn: float  # standard deviation of a pixel without signal, quantization not included
    gain_e_per_dn: float  # ratio of the signal to the variance that it adds
    # the read noise was measured in the sky. False where the sky is constant, as in clipped images: it is then the
    # standard deviation of quantization, or 5 steps where the signal has no noise either
    in_sky: bool
    # the gain was measured in the smoothest bright parts. False where too few pixels are bright, or where their noise
    # is lower than the noise of the sky: the read noise is then assumed to be ``UNKNOWN_READ_NOISE_E`` electrons
    in_light: bool

    def __str__(self) -> str:
        sky = "of the sky" if self.in_sky else "of quantization"
        light = "by bright pixels" if self.in_light else f"for {UNKNOWN_READ_NOISE_E:g} e of read noise"
        return f"read noise {self.read_noise_dn:.3g} DN {sky}, gain {self.gain_e_per_dn:.3g} e/DN {light}"


@dataclass(frozen=True, slots=True)
class _NoiseBlocks:
    """Variances about planes and mean levels of square blocks of an image, and which of them are of the sky."""

    variances: Float
    levels: Float
    largest: Float
    sky: Mask
    freedom: int

    @classmethod
    def from_pixels(cls, pixels: NDArray[Any], mask: Mask | None) -> _NoiseBlocks:
        """Blocks of the good pixels of an image."""
        side = min(_BLOCK_PX, *pixels.shape)
        blocks = _blocks(pixels, side).astype(np.float64)
        if mask is not None and mask.any():
            clean = ~_blocks(mask, side).any(axis=1)
            blocks = blocks[clean] if clean.any() else blocks
        down, across = np.indices((side, side)).reshape(2, -1)
        basis = np.linalg.qr(np.stack([np.ones(side**2), down, across], axis=1))[0]
        away = blocks - (blocks @ basis) @ basis.T
        freedom = max(side**2 - basis.shape[1], 1)
        levels = blocks.mean(axis=1)
        variances = np.sum(away**2, axis=1) / freedom
        variances[variances <= _ROUNDING * levels**2] = 0.0
        sky = np.zeros(len(levels), dtype=bool)
        sky[np.argsort(levels, kind="stable")[: max(int(_DARKEST * len(levels)), 1)]] = True
        return cls(variances, levels, blocks.max(axis=1), sky, freedom)

    @property
    def sky_variance(self) -> float:
        """Variance of the pixels of the sky; 0 where most of it is constant."""
        variances = self.variances[self.sky]
        varied = variances[variances > 0.0]
        return float(np.median(varied)) if len(varied) >= _VARIED * len(variances) else 0.0

    def variance_per_light(self) -> float | None:
        """Growth of the variance with the signal in the smoothest bright blocks; None where that is not to be seen."""
        above, dark = self.levels - float(np.median(self.levels[self.sky])), self.sky_variance
        bright = above > max(_BRIGHT * float(np.quantile(above, 0.99)), _BRIGHT_SIGMAS * math.sqrt(dark))
        bright &= (self.largest < self.largest.max()) & (self.variances > 0.0)  # neither saturated nor blurred
        if np.count_nonzero(bright) < _MIN_BRIGHT_BLOCKS:
            return None
        least = float(gammaincinv(0.5 * self.freedom, _SMOOTHEST)) / (
            0.5 * self.freedom
        )  # of chi-squared, over its mean
        smooth = self.variances[bright] / least
        slope = float(np.quantile((smooth - dark) / above[bright], _SMOOTHEST))
        return slope if slope > 0.0 else None


def sky_noise(pixels: NDArray[Any], mask: Mask | None = None) -> float:
    """Standard deviation, DN, of the pixels of the sky about planes; 0 where most of them are equal."""
    return math.sqrt(_NoiseBlocks.from_pixels(pixels, mask).sky_variance)


def estimate_noise(pixels: NDArray[Any], mask: Mask | None = None, *, step_dn: float) -> EstimatedNoise:
    """Estimate read noise and gain from an image alone.

    Read noise is the residual of the darkest blocks about planes, no smaller than quantization (``step^2 / 12``), which
    is subtracted. The variance per signal is from the tenth of the bright blocks with the smallest variance for their
    signal: an upper bound where nothing is smooth, and at the brightest block at least the variance of the sky.
    """
    blocks, quantization = _NoiseBlocks.from_pixels(pixels, mask), step_dn**2 / 12.0
    dark, slope = blocks.sky_variance, blocks.variance_per_light()
    reach = float(blocks.levels.max() - blocks.levels.min())
    if dark > 0.0 or (slope is not None and step_dn > 0.0):
        read = math.sqrt(max(dark - quantization, quantization))
    else:
        read = UNKNOWN_READ_NOISE_E * step_dn if step_dn > 0.0 else _SILENT * reach
    if slope is not None:
        gain = 1.0 / max(slope, (read**2 + quantization) / reach)
    else:
        gain = UNKNOWN_READ_NOISE_E / read if read > 0.0 else 1.0
    return EstimatedNoise(read_noise_dn=read, gain_e_per_dn=gain, in_sky=dark > 0.0, in_light=slope is not None)


def _blocks(pixels: NDArray[Any], side: int) -> NDArray[Any]:
    """Square blocks (n, side * side) of an image, evenly spread where there are too many."""
    rows, columns = (size // side for size in pixels.shape)
    kept = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    every = max(-(-rows * columns // _BLOCKS), 1)
    down, across = np.divmod(np.arange(0, rows * columns, every), columns)
    return kept[down, :, across, :].reshape(len(down), side * side)
