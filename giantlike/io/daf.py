"""Check of a DAF file, the container of SPK, CK and binary PCK kernels, before CSPICE opens it.

A damaged pointer can end the process. Records have 1024 bytes, 128 words: the file record, comments, and a list of
summary records, each with the number of its successor and up to 25 descriptors of arrays, with addresses of words.
"""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from giantlike._system.reading import check

# Layout of a DAF file, bytes and words: NAIF, "DAF Required Reading", sections on file and summary records.
_RECORD_BYTES, _WORD_BYTES = 1024, 8
_SIZES_AT, _POINTERS_AT, _FORMAT_AT = 8, 76, 88  # bytes, in the file record
_BYTE_ORDER = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}
_SUMMARY_SIZES = {b"DAF/SPK ": (2, 6), b"DAF/CK  ": (2, 6), b"DAF/PCK ": (2, 5)}
_MOST_REALS, _MOST_INTEGERS, _MOST_WORDS = 124, 250, 125  # of a summary
_HEAD_WORDS = 3  # of a summary record: the next one, the previous one, the number of summaries
_MOST_CALLS = 300  # of CSPICE for a file that is tried: about 0.1 ms each
_MOST_EPOCHS = 9  # of a segment; damage of its counts shows at any


def require_whole_daf(path: Path) -> None:
    """Check identity, length and summaries of a DAF file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_RECORD_BYTES)
        if len(head) < _RECORD_BYTES:
            raise ValueError(f"the SPICE kernel is truncated: {_RECORD_BYTES} bytes are needed, got {len(head)}")
        order = _BYTE_ORDER.get(head[_FORMAT_AT : _FORMAT_AT + 8])
        if order is None:  # of a machine of the past: CSPICE refuses it
            return
        first, _, free = struct.unpack_from(order + "3i", head, _POINTERS_AT)
        if size < _WORD_BYTES * (free - 1):
            raise ValueError(f"the SPICE kernel is truncated: {_WORD_BYTES * (free - 1)} bytes are needed, got {size}")
        n_reals, n_integers = struct.unpack_from(order + "2i", head, _SIZES_AT)
        words = n_reals + (n_integers + 1) // 2
        known = _SUMMARY_SIZES.get(head[:8], (n_reals, n_integers))
        within = 0 <= n_reals <= _MOST_REALS and 2 <= n_integers <= _MOST_INTEGERS and words <= _MOST_WORDS
        if not within or known != (n_reals, n_integers):
            raise ValueError(f"summaries of {n_reals} reals and {n_integers} integers cannot be those of its kind")
        _check_summaries(file, first, order, (n_reals, n_integers), size)


def _check_summaries(file: BinaryIO, number: int, order: str, sizes: tuple[int, int], size: int) -> None:
    """Follow the list of summary records; every segment must lie inside the file."""
    n_reals, n_integers = sizes
    words, visited = n_reals + (n_integers + 1) // 2, 0
    while number != 0:
        visited += 1
        if not 1 <= number <= size // _RECORD_BYTES or visited > size // _RECORD_BYTES:
            raise ValueError(f"its list of segments goes on at record {number}, which it does not have")
        file.seek((number - 1) * _RECORD_BYTES)
        record = file.read(_RECORD_BYTES)
        after, _, count = np.frombuffer(record, order + "f8", _HEAD_WORDS)
        if not (0 <= after <= size and 0 <= count <= (_RECORD_BYTES // _WORD_BYTES - _HEAD_WORDS) // words):
            raise ValueError(f"record {number} cannot be a list of its segments")
        for k in range(int(count)):
            at = _WORD_BYTES * (_HEAD_WORDS + k * words + n_reals)
            start, end = np.frombuffer(record, order + "i4", n_integers, at)[-2:].tolist()
            check(1 <= start <= end <= size // _WORD_BYTES, f"a segment cannot lie in its words {start} to {end}")
        number = int(after)


def try_segments(path: Path) -> None:
    """Ask CSPICE for a value of the segments of a kernel that is loaded, in a process that may end at it."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    with path.open("rb") as file:
        kind = file.read(8)
    ask = {b"DAF/SPK ": _state, b"DAF/CK  ": _pointing, b"DAF/PCK ": _orientation}.get(kind)
    if ask is None:
        return
    handle, summaries = spiceypy.dafopr(str(path)), []
    spiceypy.dafbfs(handle)
    while spiceypy.daffna():
        summaries.append(np.array(spiceypy.dafgs()))
    steps = max(1, len(summaries) // _MOST_CALLS)
    epochs = int(np.clip(_MOST_CALLS // max(len(summaries), 1), 1, _MOST_EPOCHS))
    for summary in summaries[::steps]:
        reals, integers = spiceypy.dafus(summary, *_SUMMARY_SIZES[kind])
        for time in np.linspace(reals[0], reals[1], epochs + 2)[1:-1] if np.isfinite(reals).all() else ():
            with contextlib.suppress(SpiceyError, spiceypy.NotFoundError):  # it ends in an error, not in a crash
                ask(spiceypy, handle, summary, integers, float(time))


def _state(spice: Any, handle: int, summary: Any, integers: Any, time: float) -> None:
    spice.spkpvn(handle, summary[:5], time)


def _pointing(spice: Any, handle: int, summary: Any, integers: Any, time: float) -> None:
    spice.ckgp(int(integers[0]), time, 0.0, spice.frmnam(int(integers[1])))


def _orientation(spice: Any, handle: int, summary: Any, integers: Any, time: float) -> None:
    spice.tipbod("J2000", int(integers[0]), time)
