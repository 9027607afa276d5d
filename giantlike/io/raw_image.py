"""Rows of pixels cut out of a file of fixed-length records, as VICAR and PDS3 store them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class RawLayout:
    """Where the pixels of an image lie in a file.

    Parameters
    ----------
    offset_bytes : int
        First byte of the first row's record.
    rows, columns : int
    prefix_bytes, suffix_bytes : int
        Bytes before and after the pixels of each row.
    sample : str
        ``u``, ``i`` or ``f`` with byte order and size as numpy writes them (``>i2``), or ``vax4``, ``vax8``
        for the F and D floating formats of the VAX.
    """

    offset_bytes: int
    rows: int
    columns: int
    prefix_bytes: int = 0
    suffix_bytes: int = 0
    sample: str = "u1"


def read_raw(path: Path, data: bytes, layout: RawLayout) -> NDArray[Any]:
    """Pixels (rows, columns) of a raw image.

    Raises
    ------
    DataError
        The size makes no sense, or the file ends before the last row.
    """
    if layout.rows < 1 or layout.columns < 1 or min(layout.prefix_bytes, layout.suffix_bytes, layout.offset_bytes) < 0:
        raise DataError(path, f"the label gives no usable image size: {layout.rows} rows, {layout.columns} columns")
    size = int(layout.sample[-1])
    row_bytes = layout.prefix_bytes + layout.columns * size + layout.suffix_bytes
    end = layout.offset_bytes + layout.rows * row_bytes
    if end > len(data):
        complete = max(0, len(data) - layout.offset_bytes) // row_bytes
        raise DataError(
            path,
            f"the file is truncated: {end} bytes needed for {layout.rows} rows, "
            f"got {len(data)} ({complete} complete rows)",
        )
    records = np.frombuffer(data, np.uint8, layout.rows * row_bytes, layout.offset_bytes).reshape(
        layout.rows, row_bytes
    )
    pixels = np.ascontiguousarray(records[:, layout.prefix_bytes : layout.prefix_bytes + layout.columns * size])
    if layout.sample.startswith("vax"):
        return vax_floats(pixels.reshape(layout.rows, layout.columns, size))
    return pixels.view(np.dtype(layout.sample))


def vax_floats(stored: NDArray[np.uint8]) -> Float:
    """Values (...) of VAX F or D floating numbers, given as their bytes (..., 4) or (..., 8).

    Both are sign, 8 exponent bits of excess 128 and a fraction with a hidden leading bit in [0.5, 1), stored
    as little-endian 16-bit words with the most significant word first. The reserved operand (sign set,
    exponent zero) is NaN.
    """
    words = np.ascontiguousarray(stored).view("<u2").astype(np.int64)
    exponent = (words[..., 0] >> 7) & 0xFF
    negative = words[..., 0] >= 0x8000
    fraction = ((words[..., 0] & 0x7F) | 0x80).astype(np.float64)
    bits = 8
    for word in np.moveaxis(words[..., 1:], -1, 0):
        fraction = fraction * 65536.0 + word
        bits += 16
    values = np.where(negative, -1.0, 1.0) * np.ldexp(fraction, exponent - 128 - bits)
    return np.where(exponent > 0, values, np.where(negative, np.nan, 0.0))
