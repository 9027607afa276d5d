"""Check of the directories of a DAS file, the container of a DSK, before CSPICE opens it.

CSPICE trusts the pointers of a DAS file: a damaged one can end the whole process instead of giving an error. The file
is made of records of 1024 bytes: the file record, reserved and comment records, then directories, each of which
describes the clusters of records that follow it and points to the next directory.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

# Layout of a DAS file, bytes and words from 0: NAIF, "DAS Required Reading", sections on file and directory records.
_RECORD_BYTES = 1024
_COUNTS_AT, _FORMAT_AT = 68, 84  # bytes, in the file record
_BYTE_ORDER = {b"LTL-IEEE": "<i4", b"BIG-IEEE": ">i4"}
_RANGES_AT, _TYPE_AT, _CLUSTERS_AT = 2, 8, 9  # words, in a directory
_WORDS_PER_RECORD = np.array([1024, 128, 256])  # characters, reals, integers


def require_whole_das(path: Path) -> None:
    """Check identity, length and directories of a DAS file."""
    records = path.stat().st_size // _RECORD_BYTES
    with path.open("rb") as file:
        head = file.read(_RECORD_BYTES)
        order = _BYTE_ORDER.get(head[_FORMAT_AT : _FORMAT_AT + 8])
        if not head.startswith(b"DAS/DSK") or len(head) < _RECORD_BYTES or order is None:
            raise ValueError("needed a SPICE DSK, the first bytes are not those of one")
        counts = np.frombuffer(head, order, 4, _COUNTS_AT).astype(np.int64)
        reserved, reserved_characters, comments, comment_characters = counts.tolist()
        if counts.min() < 0 or max(reserved_characters, comment_characters) > records * _RECORD_BYTES:
            raise ValueError("the counts of its file record cannot be true")
        number, before, last_words = 1 + reserved + comments, 0, np.zeros(3, dtype=np.int64)
        while number > 0:
            directory = _record(file, number, records, order)
            after = int(directory[1])
            last_words = _check_directory(directory, number, before, records, last_words)
            before, number = number + 1, after - 1


def _record(file: BinaryIO, number: int, records: int, order: str) -> NDArray[np.int64]:
    """Words (256,) of a record."""
    if number >= records:
        raise ValueError(f"its directory should be record {number + 1}, but it has {records}: is it cut short?")
    file.seek(number * _RECORD_BYTES)
    return np.frombuffer(file.read(_RECORD_BYTES), order).astype(np.int64)


def _check_directory(
    directory: NDArray[np.int64], number: int, before: int, records: int, last_words: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Last address (3,) of each type after a directory, record ``number`` from 0, whose predecessor is ``before``."""
    backward, after = directory[:2].tolist()
    ranges = directory[_RANGES_AT:_TYPE_AT].reshape(3, 2)
    kind, of_type, used = int(directory[_TYPE_AT]), np.zeros(3, dtype=np.int64), 0
    for place, cluster in enumerate(directory[_CLUSTERS_AT:].tolist()):
        if cluster == 0:
            break
        if place > 0:
            kind = (kind + (0 if cluster > 0 else -2)) % 3 + 1
        if not 1 <= kind <= 3:
            break
        of_type[kind - 1] += abs(cluster)
        used += abs(cluster)
    words = np.where(ranges[:, 1] > 0, ranges[:, 1] - ranges[:, 0] + 1, 0)
    starts_well = (ranges[:, 1] == 0) | (ranges[:, 0] == last_words + 1)
    fits = (words >= 0) & (words <= of_type * _WORDS_PER_RECORD) & (words > (of_type - 1) * _WORDS_PER_RECORD)
    fits |= (of_type == 0) & (words == 0)
    end = number + used + 1
    linked = backward == before and (after <= 0 or after == end + 1)
    if not (linked and starts_well.all() and fits.all() and end <= records):
        raise ValueError(f"its directory in record {number + 1} does not describe what follows: is it cut short?")
    return np.maximum(last_words, ranges[:, 1])
