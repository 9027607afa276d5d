"""Files of built catalogs, mapped into memory when they are opened.

Form of a catalog file (``.stars``), little endian throughout:

========  ==================================================================================
bytes     content
========  ==================================================================================
0-7       ``GLSTARS`` and a zero byte
8-15      unsigned 64-bit length of the header
16-       header: JSON, UTF-8
then      the columns one after the other, each at the next multiple of 64 bytes
========  ==================================================================================

Keys of the header: ``format`` (2), ``name``, ``band``, ``version`` (text for provenance), ``count`` (stars),
``zones`` (how the sky is cut, see :mod:`giantlike.catalogs.cells`), ``slow_margin_rad``, ``sources`` (list of names
with sha256), ``sha256`` (of everything after the header), ``size`` (of the whole file), ``constants`` (columns in
which all stars are equal, with their value; null stands for NaN) and ``columns`` (name, dtype, shape and offset from
the start of the file).

The columns are as in :class:`~giantlike.catalogs.StarTable`, angles, epochs and ids in 64 bit, the others in single
precision, in the order of :class:`~giantlike.catalogs.cells.SkyIndex`, and the index itself: ``directions``,
``rank``, ``starts``, ``fast_margin_rad``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from giantlike._system.atomic import replacing
from giantlike._system.reading import check, reads
from giantlike.catalogs.catalog import Column, MemoryCatalog
from giantlike.catalogs.cells import CELLS, ZONES, SkyIndex
from giantlike.catalogs.table import COLUMN_TYPES
from giantlike.core.errors import DataError

SUFFIX = ".stars"
FORMAT = 2  # version of the format above; raise it when that changes
_MAGIC = b"GLSTARS\0"
_START = 16  # bytes before the header: magic and length
_ALIGN = 64  # bytes: the widest SIMD registers, and the usual line of a processor's cache
_NOT_YET = 10**15  # placeholder for offsets while the length of the header is found: as many digits as any offset
_DOUBLE = ("ra_deg", "dec_deg", "epoch_jyear")
_DTYPES: Mapping[str, str] = MappingProxyType(
    {name: "<f8" if name in _DOUBLE else "<f4" for name in COLUMN_TYPES}
    | {"ids": "<i8", "is_double": "|b1"}
    | {"directions": "<f4", "rank": "<i4", "starts": "<i8", "fast_margin_rad": "<f8"}
)
_INDEX = ("directions", "rank", "starts", "fast_margin_rad")
_REMEDY = "build the catalog again with `giantlike catalog build`"


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One of the files that a catalog was made of."""

    name: str  # its name, without folders
    sha256: str


class StoredColumn(TypedDict):
    """Column of a catalog file: name, numpy type, shape, and offset from the start of the file, bytes."""

    name: str
    dtype: str
    shape: list[int]
    offset: int


class CatalogHeader(TypedDict):
    """Header of a catalog file; see :mod:`giantlike.catalogs.stored` for the keys."""

    format: int
    name: str
    band: str
    version: str
    count: int
    zones: int
    slow_margin_rad: float
    sources: list[dict[str, str]]
    sha256: str
    size: int
    constants: dict[str, float | bool | None]
    columns: list[StoredColumn]


@reads("a star catalog")
def is_catalog_file(path: Path) -> bool:
    """Return True if a file begins as a built catalog does."""
    with path.open("rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


def save_catalog(catalog: MemoryCatalog, path: str | Path, *, sources: Sequence[Source] = ()) -> None:
    """Write a catalog into one file, whole or not at all."""
    arrays, constants = _pack_columns(catalog)
    header: CatalogHeader = {
        "format": FORMAT, "name": catalog.name, "band": catalog.band, "version": catalog.version,
        "count": len(catalog), "zones": ZONES, "slow_margin_rad": catalog.index.slow_margin_rad,
        "sources": [{"name": source.name, "sha256": source.sha256} for source in sources],
        "sha256": "0" * 64, "size": _NOT_YET, "constants": constants,
        "columns": [
            {"name": name, "dtype": _DTYPES[name], "shape": list(array.shape), "offset": _NOT_YET}
            for name, array in arrays.items()
        ],
    }  # fmt: skip
    start = _round_up(_START + len(json.dumps(header)))
    offset = start
    for entry, array in zip(header["columns"], arrays.values(), strict=True):
        entry["offset"] = offset
        offset = _round_up(offset + array.nbytes)
    header["size"] = offset
    digest = hashlib.sha256()
    for block in _blocks(arrays):
        digest.update(block)
    header["sha256"] = digest.hexdigest()
    text = json.dumps(header).encode().ljust(start - _START)
    with replacing(path) as part, part.open("wb") as stream:
        stream.write(_MAGIC + len(text).to_bytes(8, "little") + text)
        for block in _blocks(arrays):
            stream.write(block)


def open_catalog(path: str | Path) -> MemoryCatalog:
    """Open a built catalog; its columns stay in the file until a cone reads them."""
    header, raw = _open_file(Path(path))
    arrays = _arrays(Path(path), header, raw)
    columns: dict[str, Column] = {name: arrays[name] for name in COLUMN_TYPES if name in arrays}
    for name, value in header["constants"].items():
        columns[name] = np.nan if value is None else value
    texts = [header["name"], header["band"], header["version"]]
    numbers = [header["slow_margin_rad"], *(value for value in header["constants"].values() if value is not None)]
    if not all(isinstance(text, str) for text in texts) or not all(isinstance(n, int | float) for n in numbers):
        raise DataError(path, f"has a damaged header (a name or a number of another type); {_REMEDY}")
    index = SkyIndex(
        directions=arrays["directions"],
        rank=arrays["rank"],
        starts=arrays["starts"],
        slow_margin_rad=float(header["slow_margin_rad"]),
        fast_margin_rad=arrays["fast_margin_rad"],
    )
    return MemoryCatalog.of_columns(columns, index, name=header["name"], band=header["band"], version=header["version"])


def catalog_header(path: str | Path, *, check: bool = False) -> CatalogHeader:
    """Return the header of a built catalog."""
    header, raw = _open_file(Path(path))
    if check:
        start = _START + int.from_bytes(raw[8:_START].tobytes(), "little")
        found = hashlib.sha256(raw[start:].data).hexdigest()
        if found != header["sha256"]:
            raise DataError(path, f"is damaged: sha256 is {found}, the header says {header['sha256']}; {_REMEDY}")
    return header


def _pack_columns(catalog: MemoryCatalog) -> tuple[dict[str, NDArray[Any]], dict[str, float | bool | None]]:
    """Columns as arrays of the types of the file, and those whose values are all equal."""
    arrays: dict[str, NDArray[Any]] = {}
    constants: dict[str, float | bool | None] = {}
    for name, column in catalog.columns.items():
        values = np.asarray(column, dtype=_DTYPES[name])
        first = values.flat[0] if values.size else np.zeros(1, values.dtype)[0]
        same = name != "ids" and bool(np.all((values == first) | ((values != values) & (first != first))))
        if same:
            constants[name] = None if first != first else first.item()
        else:
            arrays[name] = values
    for name in _INDEX:
        arrays[name] = np.asarray(getattr(catalog.index, name), dtype=_DTYPES[name])
    return arrays, constants


def _blocks(arrays: Mapping[str, NDArray[Any]]) -> list[bytes | memoryview]:
    blocks: list[bytes | memoryview] = []
    for array in arrays.values():
        blocks.append(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        blocks.append(bytes(_round_up(array.nbytes) - array.nbytes))
    return blocks


def _open_file(path: Path) -> tuple[CatalogHeader, NDArray[np.uint8]]:
    """Header, checked for the keys that the reader relies on, and all bytes of the file."""
    if not is_catalog_file(path):
        raise DataError(path, f"is not a built star catalog (it does not begin with GLSTARS); {_REMEDY}")
    size = path.stat().st_size
    raw = np.memmap(path, dtype=np.uint8, mode="r")
    length = int.from_bytes(raw[8:_START].tobytes(), "little") if size >= _START else size
    if _START + length > size:
        raise DataError(path, f"is cut off within its header, after {size} bytes; {_REMEDY}")
    try:
        header = json.loads(raw[_START : _START + length].tobytes())
        check(isinstance(header, dict), "no table of keys")
        missing = [key for key in CatalogHeader.__annotations__ if key not in header]
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"has a damaged header ({error}); {_REMEDY}") from error
    if missing:
        raise DataError(path, f"has a damaged header (no {missing[0]}); {_REMEDY}")
    if header["format"] != FORMAT or header["zones"] != ZONES:
        raise DataError(path, f"is of format {header['format']}, this version reads format {FORMAT}; {_REMEDY}")
    if size != header["size"]:
        raise DataError(path, f"has {size} bytes where its header says {header['size']}; {_REMEDY}")
    return cast(CatalogHeader, header), np.asarray(raw)


def _arrays(path: Path, header: CatalogHeader, raw: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Columns and index by name, checked against each other."""
    arrays: dict[str, NDArray[Any]] = {}
    try:
        count = int(header["count"])
        for entry in header["columns"]:
            name, shape, offset = entry["name"], tuple(entry["shape"]), int(entry["offset"])
            dtype = np.dtype(_DTYPES[name])
            stop = offset + int(np.prod(shape)) * dtype.itemsize
            check(entry["dtype"] == _DTYPES[name] and 0 <= offset <= stop <= raw.size, f"column {name}")
            arrays[name] = raw[offset:stop].view(dtype).reshape(shape)
        missing = (set(COLUMN_TYPES) | set(_INDEX)) - set(arrays) - set(header["constants"])
        if missing:
            raise ValueError(f"no column {sorted(missing)[0]}")
        shapes = {name: (count,) for name in arrays if name not in _INDEX} | {
            "directions": (3, count),
            "rank": (count,),
        }
        wrong = [name for name, shape in shapes.items() if arrays[name].shape != shape]
        starts = arrays["starts"]
        if (
            wrong
            or starts.shape != (CELLS + 1,)
            or arrays["fast_margin_rad"].ndim != 1
            or starts[0] != 0
            or starts[-1] + arrays["fast_margin_rad"].size != count
            or (np.diff(starts) < 0).any()
        ):
            raise ValueError(f"the lengths of {wrong or 'the index'} do not fit {count} stars")
    except (ValueError, LookupError, TypeError, OverflowError) as error:
        raise DataError(path, f"has a damaged header ({error}); {_REMEDY}") from error
    return arrays


def _round_up(offset: int) -> int:
    return -(-offset // _ALIGN) * _ALIGN
