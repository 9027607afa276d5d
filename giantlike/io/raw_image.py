"""Pixels of images stored in fixed-length records, as VICAR and PDS3 files have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.io.decoded import HeaderValue


@dataclass(frozen=True, slots=True, kw_only=True)
class RawLayout:
    """Position and type of the pixels of an image in a file."""

    offset_bytes: int  # first byte of the first row's record
    rows: int
    columns: int
    prefix_bytes: int = 0  # prefix_bytes, suffix_bytes: bytes before and after the pixels of each row
    suffix_bytes: int = 0
    sample: str = "u1"  # ``u``, ``i`` or ``f`` as numpy writes it (``>i2``), or VAX's ``vax4``, ``vax8``

    @property
    def sample_bytes(self) -> int:
        """Bytes of one pixel."""
        return int(self.sample[-1])

    @property
    def row_bytes(self) -> int:
        """Bytes of one record: prefix, pixels of a row and suffix."""
        return self.prefix_bytes + self.columns * self.sample_bytes + self.suffix_bytes

    @property
    def end_bytes(self) -> int:
        """First byte after the last row."""
        return self.offset_bytes + self.rows * self.row_bytes


def label_count(label: Mapping[str, HeaderValue], key: str, default: int) -> int:
    """Non-negative whole number of a label item."""
    value = label.get(key, default)
    if type(value) is not int or value < 0:
        raise ValueError(f"the label has {key} = {value!r}, where a number of bytes, rows or columns is needed")
    return value


def read_raw(data: bytes, layout: RawLayout) -> NDArray[Any]:
    """Pixels (rows, columns) of a raw image."""
    if layout.rows < 1 or layout.columns < 1:
        raise ValueError(f"the label gives no usable image size: {layout.rows} rows, {layout.columns} columns")
    if layout.end_bytes > len(data):
        complete = max(0, len(data) - layout.offset_bytes) // layout.row_bytes
        raise ValueError(
            f"the file is truncated: {layout.end_bytes} bytes are needed for {layout.rows} rows, "
            f"got {len(data)} ({complete} complete rows)"
        )
    stored = np.frombuffer(data, np.uint8, layout.rows * layout.row_bytes, layout.offset_bytes)
    first, size = layout.prefix_bytes, layout.columns * layout.sample_bytes
    pixels = np.ascontiguousarray(stored.reshape(layout.rows, layout.row_bytes)[:, first : first + size])
    if layout.sample.startswith("vax"):
        return vax_floats(pixels.reshape(layout.rows, layout.columns, layout.sample_bytes))
    return pixels.view(np.dtype(layout.sample))


def vax_floats(stored: NDArray[np.uint8]) -> Float:
    """Values (...) of the bytes (..., 4) or (..., 8) of VAX F or D floating numbers.

    Both are sign, 8 exponent bits of excess 128 and a fraction with a hidden leading bit in [0.5, 1), stored as
    little-endian 16-bit words, the most significant first. The reserved operand (sign set, exponent zero) is NaN.
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
