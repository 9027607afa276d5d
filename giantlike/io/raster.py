"""PNG, TIFF and JPEG images through OpenCV, at their full depth, and checks that they are whole.

OpenCV fills the missing part of a truncated file with zeros or gray without an error, so each format is
checked here first: PNG by its chunks and their checksums, JPEG by its markers, TIFF by its strip table.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check, check_declared_bytes, reads
from giantlike.core.pixel_noise import EightBitValues
from giantlike.io.decoded import DecodedImage

LUMINANCE_BGR = (0.114, 0.587, 0.299)
"""Weights of blue, green and red in the luminance of a color image (ITU-R BT.601, the luma that JPEG stores)."""

_JPEG_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
# Tags of the TIFF 6.0 specification (Adobe, 1992): Orientation, PhotometricInterpretation; offsets and byte counts of
# strips, of tiles; struct codes of the unsigned integer types by their number (16 and 18 are BigTIFF's).
_ORIENTATION, _PHOTOMETRIC = 274, 262
_COLUMNS, _ROWS, _BITS, _CHANNELS = 256, 257, 258, 277  # the last two are 1 where they are left out
_OFFSETS, _COUNTS = (273, 324), (279, 325)  # of strips, of tiles
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}  # by color type; a palette may have an alpha channel
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of headers with the size of the image
_TIFF_UNSIGNED = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}


@dataclass(frozen=True, slots=True)
class _TiffTag:
    """Unsigned integers of a TIFF tag and the byte of the file at which they begin."""

    values: tuple[int, ...]
    offset: int


@reads("a PNG, TIFF or JPEG image")
def decode_raster(path: Path, data: bytes, kind: str) -> DecodedImage:
    """Decode a PNG, TIFF (its first page) or JPEG file.

    Gray images, and color images whose channels are equal, keep their type; others become luminance, float32, with
    :data:`LUMINANCE_BGR`. An alpha channel is dropped, a palette resolved, a scale in which white is zero inverted.
    Rows and columns are as stored: orientation tags are ignored.
    """
    if kind == "tiff":
        return DecodedImage(pixels=_decode_tiff(data), format=kind)
    (_require_whole_png if kind == "png" else _require_whole_jpeg)(data)
    stored = _decode(data)
    pixels = _gray(stored)
    return DecodedImage(pixels=pixels, format=kind, eight_bit=_eight_bit(stored, pixels))


def _decode(data: bytes) -> NDArray[Any]:
    import cv2

    log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(log_level)
    if pixels is None:
        raise ValueError("OpenCV does not decode it: a variant that is not supported")
    return pixels


def _eight_bit(stored: NDArray[Any], gray: NDArray[Any]) -> EightBitValues | None:
    """Step of 8-bit channels as stored and of their gray image, which is floating point where it is a luminance."""
    if stored.dtype != np.uint8:
        return None
    return EightBitValues(step_dn=1.0 if gray.dtype == np.uint8 else math.hypot(*LUMINANCE_BGR))


def _gray(pixels: NDArray[Any]) -> NDArray[Any]:
    """Gray image (rows, columns) of one in OpenCV's order of channels (gray, gray-alpha, BGR or BGRA)."""
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] < 3:
        return pixels[:, :, 0]
    has_nan = pixels.dtype.kind == "f"
    if all(np.array_equal(pixels[:, :, 0], pixels[:, :, k], equal_nan=has_nan) for k in (1, 2)):
        return pixels[:, :, 0]
    return (pixels[:, :, :3].astype(np.float32) @ np.array(LUMINANCE_BGR, dtype=np.float32)).astype(np.float32)


def _check_size(data: bytes, columns: int, rows: int, channels: int, bits: int) -> None:
    """Refuse an image that takes far more memory than a file of its size can hold, before it is decoded."""
    luminance_bytes = 4 * (channels + 1) if channels >= 3 else 0  # of the conversion to gray, single precision
    check_declared_bytes(columns * rows * (channels * (-(-bits // 8)) + luminance_bytes), len(data))


def _require_whole_png(data: bytes) -> None:
    position = 8
    if len(data) >= 26 and data[12:16] == b"IHDR":
        columns, rows, bits, color = struct.unpack_from(">IIBB", data, 16)
        _check_size(data, columns, rows, _PNG_CHANNELS.get(color, 4), bits)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data):
            break
        name = data[position + 4 : position + 8]
        if zlib.crc32(data[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ValueError(f"the checksum of the PNG chunk {name!r} at byte {position} is wrong")
        if name == b"IEND":
            return
        position = end
    raise ValueError(f"the PNG file is truncated: it ends at byte {len(data)} without its end mark")


def _require_whole_jpeg(data: bytes) -> None:
    position = 2
    while position + 4 <= len(data):
        check(data[position] == 0xFF, f"there is no JPEG marker at byte {position}")
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
            continue
        if marker == 0xD9:
            return
        if marker in _JPEG_FRAMES and position + 10 <= len(data):
            bits, rows, columns, channels = struct.unpack_from(">BHHB", data, position + 4)
            _check_size(data, columns, rows, channels, bits)
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xDA:
            found = _JPEG_MARKER_IN_SCAN.search(data, position)
            position = len(data) if found is None else found.end() - 2
            if data[position + 1 : position + 2] == b"\xd9":
                return
    raise ValueError(f"the JPEG file is truncated: it ends at byte {len(data)} without its end mark")


def _decode_tiff(data: bytes) -> NDArray[Any]:
    """Decode a TIFF; OpenCV obeys its orientation tag, which is therefore made neutral first."""
    tags = _whole_tiff_tags(data)
    orientation = tags.get(_ORIENTATION)
    if orientation is not None and orientation.values != (1,):
        neutral = (1).to_bytes(2, "little" if data[:2] == b"II" else "big")
        data = data[: orientation.offset] + neutral + data[orientation.offset + 2 :]
    pixels = _gray(_decode(data))
    white_is_zero = _PHOTOMETRIC in tags and tags[_PHOTOMETRIC].values == (0,)
    if white_is_zero and pixels.dtype.kind == "u" and pixels.dtype.itemsize > 1:  # OpenCV inverts 8 bits itself
        pixels = np.iinfo(pixels.dtype).max - pixels
    return pixels


def _whole_tiff_tags(data: bytes) -> dict[int, _TiffTag]:
    """Tags of the first page, after a check that all its pixels are in the file."""
    try:
        tags = _first_tiff_directory(data)
    except struct.error as error:
        raise ValueError("the TIFF file is truncated: its directory of tags lies outside the file") from error
    offsets, counts = ([tags[tag].values for tag in pair if tag in tags] for pair in (_OFFSETS, _COUNTS))
    if len(offsets) != 1 or len(counts) != 1 or len(offsets[0]) != len(counts[0]):
        raise ValueError("the first page of the TIFF file has no table of strips or tiles")
    end = max(offset + count for offset, count in zip(offsets[0], counts[0], strict=True))
    check(end <= len(data), f"the TIFF file is truncated: its pixels reach to byte {end}, got {len(data)}")
    columns, rows = (tags[tag].values[0] if tag in tags and tags[tag].values else 0 for tag in (_COLUMNS, _ROWS))
    channels, bits = (max(tags[tag].values, default=1) if tag in tags else 1 for tag in (_CHANNELS, _BITS))
    _check_size(data, columns, rows, channels, bits)
    return tags


def _first_tiff_directory(data: bytes) -> dict[int, _TiffTag]:
    """Unsigned integer tags of the first page of a classic or big TIFF."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    word, word_bytes, entry_count = ("Q", 8, "Q") if big else ("I", 4, "H")
    directory = struct.unpack_from(order + word, data, 8 if big else 4)[0]
    entries = struct.unpack_from(order + entry_count, data, directory)[0]
    first, entry_bytes = directory + struct.calcsize(order + entry_count), 4 + 2 * word_bytes
    tags: dict[int, _TiffTag] = {}
    for k in range(entries):
        tag, kind, count = struct.unpack_from(order + "HH" + word, data, first + k * entry_bytes)
        if kind not in _TIFF_UNSIGNED:
            continue
        offset = first + k * entry_bytes + 4 + word_bytes
        if count * struct.calcsize("=" + _TIFF_UNSIGNED[kind]) > word_bytes:
            offset = struct.unpack_from(order + word, data, offset)[0]
        tags[tag] = _TiffTag(struct.unpack_from(f"{order}{count}{_TIFF_UNSIGNED[kind]}", data, offset), offset)
    return tags
