"""Plain OBJ files, vertices and triangles alone, read straight into arrays in half the time of a general parser."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from giantlike.shapes.surface import Surface

_BLANKS, _DIGITS = b" \t\r\n", b"0123456789"
_VERTEX_BYTES, _FACET_BYTES = b"v+-.eE" + _DIGITS + _BLANKS, b"f" + _DIGITS + _BLANKS
_WORDS = 4  # of a row: its letter and three numbers


def read_plain_obj(content: bytes) -> Surface | None:
    """Read an OBJ of comments, then rows ``v x y z``, then rows ``f i j k``.

    Returns None for a file with anything else, which trimesh can read or refuse.
    """
    while content.startswith(b"#"):
        content = content[content.find(b"\n") + 1 :] if b"\n" in content else b""
    end = content.find(b"\nf") + 1
    vertices = _rows(content[:end], b"v", _VERTEX_BYTES, np.float64)
    faces = _rows(content[end:], b"f", _FACET_BYTES, np.int64)
    if vertices is None or faces is None:
        return None
    return Surface(vertices=vertices.astype(np.float64), faces=faces.astype(np.int64) - 1)


def _rows(text: bytes, letter: bytes, allowed: bytes, dtype: type[np.number]) -> NDArray[np.number] | None:
    """Numbers (n, 3) of rows that all are the letter and three numbers; None if one is not."""
    if not text or text.translate(None, allowed):
        return None
    codes = np.frombuffer(text, dtype=np.uint8)
    word = codes > ord(" ")  # of the allowed codes, blanks are those up to the space
    starts = np.flatnonzero(word[1:] & ~word[:-1]) + 1
    starts = starts if not word[0] else np.append(0, starts)
    letters = codes == letter[0]
    if starts.size % _WORDS or np.count_nonzero(letters) * _WORDS != starts.size or not letters[starts[::_WORDS]].all():
        return None
    rows = np.searchsorted(np.flatnonzero(codes == ord("\n")), starts)  # the line of each word
    if (rows.reshape(-1, _WORDS) != rows[::_WORDS, None]).any() or (np.diff(rows[::_WORDS]) < 1).any():
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy's word for a number that is none
        try:
            values: NDArray[np.number] = np.fromstring(text.replace(letter, b" ").decode("ascii"), dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return values.reshape(-1, 3) if values.size * _WORDS == 3 * starts.size else None
