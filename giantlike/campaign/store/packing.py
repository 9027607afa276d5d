"""Records as bytes: lists of numbers become arrays, the rest is JSON, all of it compressed."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from giantlike.campaign.store.database import Row
from giantlike.campaign.store.record_values import PlainRecord
from giantlike.campaign.store.records import ImageRecord
from giantlike.core.errors import DataError

Record = TypeVar("Record", bound=ImageRecord)

_FEWEST_NUMBERS = 16  # numbers from which a list is kept as an array, whose description is longer than 15
_KEY = "$array"
_LEVEL = 1  # of zlib: higher levels gain 1 % on positions of stars and take four times as long
_NESTED = (dict, list, PlainRecord)
_DTYPES = {"b": np.dtype("bool"), "i": np.dtype("<i8"), "f": np.dtype("<f8")}


@dataclass(frozen=True, slots=True)
class PackedRecord(Generic[Record]):
    """A record as workers hand it over: they pack it, and the process that writes the run folder need not unpack it."""

    light: Record  # without its lists of points
    row: Row  # as it is stored

    @classmethod
    def from_record(cls, record: Record) -> PackedRecord[Record]:
        """Pack a record."""
        light = record.light()
        points = None if record.is_light else pack(record.__dict__)
        return cls(light, Row(light.model_dump_json(), points))


def pack(values: dict[str, Any]) -> bytes:
    """Bytes of nested plain values; numbers come back to the bit."""
    arrays: list[np.ndarray] = []
    head = json.dumps(_strip_arrays(values, arrays)).encode()
    parts = [struct.pack("<I", len(head)), head]
    for array in arrays:
        parts += [array.dtype.kind.encode(), struct.pack(f"<B{array.ndim}I", array.ndim, *array.shape), array.tobytes()]
    return zlib.compress(b"".join(parts), _LEVEL)


def unpack(data: bytes, *, arrays: bool = False) -> Any:
    """Values of :func:`pack`."""
    try:
        content = zlib.decompress(data)
        (length,) = struct.unpack_from("<I", content)
        at, kept = 4 + length, list[Any]()
        while at < len(content):
            dtype, n_axes = _DTYPES[chr(content[at])], content[at + 1]
            shape = struct.unpack_from(f"<{n_axes}I", content, at + 2)
            count, at = int(np.prod(shape)), at + 2 + 4 * n_axes
            array = np.frombuffer(content, dtype, count, at).reshape(shape)
            kept.append(array if arrays else array.tolist())
            at += count * dtype.itemsize

        def fill(value: dict[str, Any]) -> Any:
            return kept[value[_KEY]] if value.keys() == {_KEY} else value

        return json.loads(content[4 : 4 + length], object_hook=fill)
    except (zlib.error, struct.error, KeyError, IndexError) as error:
        raise ValueError(f"damaged: {error}") from error


def points_of(record: ImageRecord, data: bytes | None, path: Path) -> dict[str, Any]:
    """Lists of points that a record was kept with, long ones as arrays."""
    if data is None:
        return {}
    try:
        full = unpack(data, arrays=True)
        return {name: full[name] for name in record.points_of if name in full}
    except (ValueError, KeyError, TypeError) as error:
        raise make_damage_error(path, ValueError(f"points of {record.file}: {error}")) from error


def make_damage_error(path: Path, error: ValueError) -> DataError:
    """Error of results that hold a damaged record."""
    return DataError(path, f"holds a damaged record: {' '.join(str(error).split())[:200]}")


def _strip_arrays(value: Any, arrays: list[np.ndarray]) -> Any:
    """Plain value, without records, with its long lists of numbers moved to ``arrays``."""
    if isinstance(value, PlainRecord):
        value = value.__dict__
    if isinstance(value, dict):
        return {
            key: _strip_arrays(inner, arrays) if isinstance(inner, _NESTED) else inner for key, inner in value.items()
        }
    if not isinstance(value, list):
        return value
    array = _array(value)
    if array is None:
        return [_strip_arrays(inner, arrays) if isinstance(inner, _NESTED) else inner for inner in value]
    arrays.append(array)
    return {_KEY: len(arrays) - 1}


def _array(value: list[Any]) -> np.ndarray | None:
    """Array of a long list of numbers of one type, or of lists of equal length of them; None of anything else."""
    first = value[0] if value else None
    rows = value if isinstance(first, list) else [value]
    if not rows[0] or len(rows) * len(rows[0]) < _FEWEST_NUMBERS or {len(row) for row in rows} != {len(rows[0])}:
        return None
    types = set(map(type, chain.from_iterable(rows)))
    if len(types) != 1 or next(iter(types)) not in (float, int, bool):
        return None
    array = np.array(value)
    return array.astype(_DTYPES[array.dtype.kind]) if array.dtype.kind in _DTYPES else None
