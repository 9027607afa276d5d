"""VICAR images: the label, its binary prefixes and headers, and the pixels.

References
----------
.. [1] The VICAR file format, JPL Multimission Image Processing Laboratory (file layout, label grammar).
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.errors import DataError
from giantlike.io.decoded import DecodedImage, HeaderValue
from giantlike.io.label_times import label_epoch, label_exposure_s
from giantlike.io.raw_image import RawLayout, read_raw

_LABEL_SIZE = re.compile(rb"LBLSIZE\s*=\s*(\d+)")
_ITEM = re.compile(r"\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*('(?:[^']|'')*'|\((?:'(?:[^']|'')*'|[^)'])*\)|[^\s']+)")
_LIST_ENTRY = re.compile(r"'((?:[^']|'')*)'|([^,\s]+)")
_INTEGER = re.compile(r"[+-]?\d+")
_INTEGER_SAMPLES = {"BYTE": "u1", "HALF": "i2", "WORD": "i2", "FULL": "i4", "LONG": "i4"}
_REAL_BYTES = {"REAL": 4, "DOUB": 8}
_SYSTEM = "SYSTEM"


@dataclass(frozen=True, slots=True)
class LabelItem:
    """One ``KEY=VALUE`` of a VICAR label and the group it stands in: ``SYSTEM``, a property or a task."""

    group: str
    key: str
    value: HeaderValue


def decode_vicar(path: Path, data: bytes) -> DecodedImage:
    """Decode a VICAR file.

    Label items become header items under their own name; a name that occurs in more than one group is
    written ``GROUP.NAME``, where the group is the property or the history task (``TASK``, ``TASK[2]``, ...);
    system items always keep their own name. Lists are joined by commas. Epoch and exposure:
    :func:`~giantlike.io.label_times.label_epoch` and :func:`~giantlike.io.label_times.label_exposure_s`.

    What never reached the ground is in the file as zeros, and is masked: where the label counts
    ``MISSING_LINES``, the zeros of rows that are at least half zero; where it names a ``CUT_OUT_WINDOW``, rows
    and columns of nothing but zeros.

    Raises
    ------
    DataError
        The label is damaged, the file is truncated, or the image is of a kind that is not read: complex
        pixels, more than one band, pixel-interleaved.
    """
    label_bytes = _label_size(path, data)
    system = _system_items(path, parse_label(path, _text(data[:label_bytes])))
    layout = _layout(path, system, label_bytes)
    pixels = read_raw(path, data, layout)
    items = parse_label(path, _text(data[:label_bytes]) + b" " + _end_label(path, data, system, layout))
    header = label_header(items)
    names = {item.key: item.value for item in reversed(items)}
    exposure_s = label_exposure_s(names, {})
    return DecodedImage(
        pixels=pixels,
        format="vicar",
        mask=_never_received(pixels, names),
        epoch=label_epoch(names, exposure_s),
        exposure_s=exposure_s,
        header=header,
    )


def parse_label(path: Path, label: bytes) -> list[LabelItem]:
    """Items of a VICAR label, in order.

    Raises
    ------
    DataError
        Something in the label is no ``KEY=VALUE``.
    """
    text = label.decode("latin-1").rstrip()
    items: list[LabelItem] = []
    group, position, tasks = _SYSTEM, 0, Counter[str]()
    while position < len(text):
        match = _ITEM.match(text, position)
        if match is None:
            raise DataError(path, f"the VICAR label is damaged near {text[position : position + 40].strip()!r}")
        position = match.end()
        key, value = match[1], _value(match[2])
        if key == "PROPERTY":
            group = str(value)
        elif key == "TASK":
            tasks[str(value)] += 1
            group = str(value) if tasks[str(value)] == 1 else f"{value}[{tasks[str(value)]}]"
        elif key != "LBLSIZE" or group == _SYSTEM:
            items.append(LabelItem(group, key, value))
    return items


def label_header(items: list[LabelItem]) -> dict[str, HeaderValue]:
    """Header items of label items, a name that is used in several groups with its group in front."""
    uses = Counter(item.key for item in items)
    header: dict[str, HeaderValue] = {}
    for item in items:
        plain = uses[item.key] == 1 or item.group == _SYSTEM
        header.setdefault(item.key if plain else f"{item.group}.{item.key}", item.value)
    return header


def _label_size(path: Path, data: bytes) -> int:
    match = _LABEL_SIZE.match(data)
    size = int(match[1]) if match else 0
    if not 0 < size <= len(data):
        raise DataError(path, f"the file is truncated: its VICAR label needs {size} bytes, got {len(data)}")
    return size


def _value(text: str) -> HeaderValue:
    if text.startswith("'"):
        return text[1:-1].replace("''", "'")
    if text.startswith("("):
        entries = (m[1].replace("''", "'") if m[1] is not None else m[2] for m in _LIST_ENTRY.finditer(text[1:-1]))
        return ",".join(entries)
    if _INTEGER.fullmatch(text):
        return int(text)
    try:
        return float(text.replace("D", "E").replace("d", "e"))
    except ValueError:
        return text


def _system_items(path: Path, items: list[LabelItem]) -> dict[str, HeaderValue]:
    """System items by name; NBB and NLB may stand behind the first task, as Galileo's labels have it."""
    system: dict[str, HeaderValue] = {}
    for item in items:
        if item.group == _SYSTEM or item.key in {"NBB", "NLB"}:
            system.setdefault(item.key, item.value)
    for key in ("FORMAT", "RECSIZE", "NL", "NS"):
        if key not in system:
            raise DataError(path, f"the VICAR label has no {key}")
    return system


def _layout(path: Path, system: dict[str, HeaderValue], label_bytes: int) -> RawLayout:
    def count(key: str, default: int) -> int:
        value = system.get(key, default)
        if type(value) is not int or value < 0:
            raise DataError(path, f"the VICAR label has {key}={value!r}: a count is needed")
        return value

    rows, columns, record = count("NL", 0), count("NS", 0), count("RECSIZE", 0)
    prefix, header_records = count("NBB", 0), count("NLB", 0)
    organization = system.get("ORG", "BSQ")
    if count("NB", 1) != 1 or organization not in {"BSQ", "BIL"}:
        raise DataError(
            path, f"only VICAR images of one band are read, got NB={system.get('NB', 1)}, ORG={organization!r}"
        )
    sample = _sample(path, system)
    if record != prefix + columns * int(sample[-1]):
        raise DataError(
            path,
            f"the VICAR label contradicts itself: RECSIZE={record}, but NBB={prefix} and {columns} samples of "
            f"{system['FORMAT']!r} make {prefix + columns * int(sample[-1])}",
        )
    return RawLayout(
        offset_bytes=label_bytes + header_records * record,
        rows=rows,
        columns=columns,
        prefix_bytes=prefix,
        sample=sample,
    )


def _sample(path: Path, system: dict[str, HeaderValue]) -> str:
    """Sample type as :class:`RawLayout` has it; labels older than INTFMT and REALFMT are of the VAX."""
    kind, integers, reals = system["FORMAT"], system.get("INTFMT", "LOW"), system.get("REALFMT", "VAX")
    if kind in _INTEGER_SAMPLES:
        orders = {"LOW": "<", "HIGH": ">"}
        if integers not in orders:
            raise DataError(path, f"VICAR INTFMT must be HIGH or LOW, got {integers!r}")
        return orders[str(integers)] + _INTEGER_SAMPLES[str(kind)]
    if kind in _REAL_BYTES:
        starts = {"IEEE": ">f", "RIEEE": "<f", "VAX": "vax"}
        if reals not in starts:
            raise DataError(path, f"VICAR REALFMT must be IEEE, RIEEE or VAX, got {reals!r}")
        return starts[str(reals)] + str(_REAL_BYTES[str(kind)])
    known = ", ".join([*_INTEGER_SAMPLES, *_REAL_BYTES])
    raise DataError(path, f"VICAR FORMAT {kind!r} is not read; formats are {known}")


def _end_label(path: Path, data: bytes, system: dict[str, HeaderValue], layout: RawLayout) -> bytes:
    """The part of the label that stands behind the image, empty when there is none."""
    if system.get("EOL", 0) != 1:
        return b""
    start = layout.offset_bytes + layout.rows * (layout.prefix_bytes + layout.columns * int(layout.sample[-1]))
    match = _LABEL_SIZE.match(data, start)
    if match is None or start + int(match[1]) > len(data):
        raise DataError(path, "the file is truncated: the end of its VICAR label, behind the image, is missing")
    return _text(data[match.end() : start + int(match[1])])


def _text(label: bytes) -> bytes:
    """A label without what stands behind its terminating zero byte."""
    return label.partition(b"\0")[0]


def _never_received(pixels: NDArray[Any], label: dict[str, HeaderValue]) -> NDArray[np.bool_]:
    empty = np.asarray(pixels == 0)
    missing = label.get("MISSING_LINES")
    mask = np.zeros_like(empty)
    if type(missing) is int and missing > 0:
        mask |= empty & (empty.mean(axis=1, keepdims=True) >= 0.5)
    if "CUT_OUT_WINDOW" in label:
        mask |= empty.all(axis=1, keepdims=True) | empty.all(axis=0, keepdims=True)
    return mask
