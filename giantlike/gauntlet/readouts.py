"""Damage of the values that a detector gives: on the way out, in memory, or on the way down.

Each function makes a :data:`~giantlike.gauntlet.plan.Readout`: (pixels DN, random numbers) to pixels.
"""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float
from giantlike.gauntlet.plan import Readout

WORD_BITS = 14
"""Bits of a pixel, the width of most converters."""
_BLOCK_PX = 16
"""Side of the blocks in which images are compressed and sent, px."""
_LARGEST_BYTE = 255.0
_NAT = 0.5
"""Exponent of the table that turns values into bytes of equal noise: a square root."""


def hot_columns(columns: tuple[int, ...], extra_dn: float) -> Readout:
    """Columns with charge that they always have, below a random row."""

    def add(pixels: Float, rng: np.random.Generator) -> Float:
        result = pixels.copy()
        for column in columns:
            first = int(rng.integers(0, max(len(pixels) // 2, 1)))
            charge = extra_dn * rng.uniform(0.5, 1.5)
            result[first:, column] += np.round(rng.poisson(charge, size=len(pixels) - first))
        return result

    return add


def missing_lines(bands: tuple[tuple[int, int], ...]) -> Readout:
    """Lines that were not received: zero."""

    def drop(pixels: Float, rng: np.random.Generator) -> Float:
        result = pixels.copy()
        for first, number in bands:
            result[first : first + number] = 0.0
        return result

    return drop


def missing_blocks(share: float) -> Readout:
    """Compressed blocks that were not received: zero."""

    def drop(pixels: Float, rng: np.random.Generator) -> Float:
        rows, columns = (-(-size // _BLOCK_PX) for size in pixels.shape)
        lost = rng.uniform(size=(rows, columns)) < share
        blocks = np.kron(lost, np.ones((_BLOCK_PX, _BLOCK_PX))) > 0
        return np.where(blocks[: pixels.shape[0], : pixels.shape[1]], 0.0, pixels)

    return drop


def zero_mask(pixels: Float) -> Float:
    """Pixels that were not received, (rows, columns) bool: exactly zero."""
    return np.asarray(pixels == 0.0)


def bit_flips(share: float) -> Readout:
    """Bit flips in memory, at any bit of a word."""

    def flip(pixels: Float, rng: np.random.Generator) -> Float:
        words = np.clip(pixels, 0.0, 2.0**WORD_BITS - 1.0).astype(np.int64)
        hit = rng.uniform(size=words.shape) < share
        words[hit] ^= 1 << rng.integers(0, WORD_BITS, size=int(hit.sum()))
        return words.astype(float)

    return flip


def shifted_rows(first: int, shift_px: int) -> Readout:
    """All rows from one on are moved along columns: clock pulses were lost."""

    def shift(pixels: Float, rng: np.random.Generator) -> Float:
        result = pixels.copy()
        result[first:] = np.roll(pixels[first:], shift_px, axis=1)
        return result

    return shift


def jittered_rows(sigma_px: float) -> Readout:
    """Each row is shifted along columns by a few random pixels: scan jitter."""

    def shake(pixels: Float, rng: np.random.Generator) -> Float:
        steps = np.round(sigma_px * rng.normal(size=len(pixels))).astype(int)
        return np.stack([np.roll(row, step) for row, step in zip(pixels, steps, strict=True)])

    return shake


def reverse_columns(pixels: Float, rng: np.random.Generator) -> Float:
    """Columns in the wrong order."""
    return np.ascontiguousarray(pixels[:, ::-1])


def reverse_rows(pixels: Float, rng: np.random.Generator) -> Float:
    """Rows in the wrong order."""
    return np.ascontiguousarray(pixels[::-1])


def eight_bits(full_dn: float, *, square_root: bool = False) -> Readout:
    """Values put on bytes, evenly or by a table of square roots."""

    def put(pixels: Float, rng: np.random.Generator) -> Float:
        share = np.clip(pixels / full_dn, 0.0, 1.0)
        return np.round(_LARGEST_BYTE * (share**_NAT if square_root else share))

    return put
