"""Images in blocks of pixels: sums over them, and masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, Scalar

_FEW = 8  # pixels along a block up to which columns are added one by one, several times as fast as sums over each block


def block_sums(image: NDArray[Scalar], size: int) -> Float:
    """Sums (h // size, w // size) over square blocks of an image (h, w); an incomplete block at the end is left out."""
    rows, columns = (length // size for length in image.shape)
    strips = image[: rows * size, : columns * size].reshape(rows, size, columns * size).sum(axis=1, dtype=np.float64)
    if size > _FEW:
        return np.asarray(strips.reshape(rows, columns, size).sum(axis=2))
    sums: Float = strips[:, ::size].copy()
    for column in range(1, size):
        sums += strips[:, column::size]
    return sums


def whole_blocks(mask: Mask, size: int) -> Mask:
    """Return True for blocks, as of :func:`block_sums`, of nothing but True in a mask (h, w)."""
    rows, columns = (length // size for length in mask.shape)
    if mask.all():
        return np.ones((rows, columns), bool)
    strips = mask[: rows * size, : columns * size].reshape(rows, size, columns * size).all(axis=1)
    return np.asarray(strips.reshape(rows, columns, size).all(axis=2))
