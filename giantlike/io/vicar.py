"""VICAR images: the label, its binary prefixes and headers, and the pixels.

Source: The VICAR file format, JPL Multimission Image Processing Laboratory (file layout, label grammar).
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check, reads
from giantlike.core.arrays import Mask
from giantlike.io.decoded import DecodedImage, HeaderValue
from giantlike.io.label_times import label_epoch, label_exposure_s
from giantlike.io.raw_image import RawLayout, label_count, read_raw

_LABEL_SIZE = re.compile(rb"LBLSIZE\s*=\s*(\d+)")
_KEY = re.compile(r"\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*")
_BARE = re.compile(r"[^\s']+")  # a value without quotes
_LIST_ENTRY = re.compile(r"'((?:[^']|'')*+)'|([^,\s']+)")
_IN_LIST = re.compile(r"[')]")  # what ends a list, or begins a string in which a parenthesis does not
_INTEGER = re.compile(r"[+-]?\d+")
_INTEGER_SAMPLES = {"BYTE": "u1", "HALF": "i2", "WORD": "i2", "FULL": "i4", "LONG": "i4"}
_REAL_BYTES = {"REAL": 4, "DOUB": 8}
_SYSTEM = "SYSTEM"
_RESAMPLED = "GEOM"  # part of the names of the programs of VICAR that resample images: GEOMA, LGEOM, MGEOM


@dataclass(frozen=True, slots=True)
class LabelItem:
    """One ``KEY=VALUE`` of a VICAR label and the group it stands in: ``SYSTEM``, a property or a task."""

    group: str
    key: str
    value: HeaderValue


@reads("a VICAR image")
def decode_vicar(path: Path, data: bytes) -> DecodedImage:
    """Decode a VICAR file.

    Label items become header items under their own name; a name that occurs in more than one group is written
    ``GROUP.NAME`` (the property or the history task, ``TASK``, ``TASK[2]``, ...); system items always keep their own
    name. Lists are joined by commas.

    Pixels that never reached the ground are zero in the file, and are masked: where the label counts ``MISSING_LINES``,
    the zeros of rows that are at least half zero; where it names a ``CUT_OUT_WINDOW``, rows and columns of nothing but
    zeros; where its history names a program that resampled the image (``GEOMA`` and others of that name), zeros that
    are joined to the edge of the frame.
    """
    match = _LABEL_SIZE.match(data)
    size = int(match[1]) if match else 0
    check(0 < size <= len(data), f"the file is truncated: its VICAR label needs {size} bytes, got {len(data)}")
    label_bytes = size
    system = _system_items(_parse_label(_text(data[:label_bytes])))
    layout = _layout(system, label_bytes)
    pixels = read_raw(data, layout)
    items = _parse_label(_text(data[:label_bytes]) + b" " + _end_label(data, system, layout))
    names = {item.key: item.value for item in reversed(items)}
    exposure_s = label_exposure_s(names, {})
    return DecodedImage(
        pixels=pixels,
        format="vicar",
        mask=_never_received(pixels, names) | _outside_of_old_frame(pixels, items),
        epoch=label_epoch(names, exposure_s),
        exposure_s=exposure_s,
        header=_header(items),
    )


def _parse_label(label: bytes) -> list[LabelItem]:
    """Items of a VICAR label, in order; every character is looked at once."""
    text = label.decode("latin-1").rstrip()
    items: list[LabelItem] = []
    group, position, tasks = _SYSTEM, 0, Counter[str]()
    while position < len(text):
        match = _KEY.match(text, position)
        end = -1 if match is None else _value_end(text, match.end())
        if match is None or end < 0:
            raise ValueError(f"the VICAR label is damaged near {text[position : position + 40].strip()!r}")
        key, value, position = match[1], _value(text[match.end() : end]), end
        if key == "PROPERTY":
            group = str(value)
        elif key == "TASK":
            tasks[str(value)] += 1
            group = str(value) if tasks[str(value)] == 1 else f"{value}[{tasks[str(value)]}]"
        elif key != "LBLSIZE" or group == _SYSTEM:
            items.append(LabelItem(group, key, value))
    return items


def _value_end(text: str, start: int) -> int:
    """End of the value that begins at a place of a label; -1 where it has none."""
    if text.startswith("'", start):
        return _string_end(text, start)
    if not text.startswith("(", start):
        bare = _BARE.match(text, start)
        return -1 if bare is None else bare.end()
    position = start
    while found := _IN_LIST.search(text, position):
        if found[0] == ")":
            return found.end()
        position = _string_end(text, found.start())
        if position < 0:
            break
    return -1


def _string_end(text: str, start: int) -> int:
    """End of a string in quotes, in which two quotes stand for one; -1 where it is not closed."""
    quote = text.find("'", start + 1)
    while quote >= 0 and text.startswith("'", quote + 1):
        quote = text.find("'", quote + 2)
    return quote + 1 if quote >= 0 else -1


def _header(items: list[LabelItem]) -> dict[str, HeaderValue]:
    """Header items of label items, a name that is used in several groups with its group in front."""
    uses = Counter(item.key for item in items)
    header: dict[str, HeaderValue] = {}
    for item in items:
        plain = uses[item.key] == 1 or item.group == _SYSTEM
        header.setdefault(item.key if plain else f"{item.group}.{item.key}", item.value)
    return header


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


def _system_items(items: list[LabelItem]) -> dict[str, HeaderValue]:
    """System items by name; NBB and NLB may stand behind the first task, as Galileo's labels have it."""
    system: dict[str, HeaderValue] = {}
    for item in items:
        if item.group == _SYSTEM or item.key in {"NBB", "NLB"}:
            system.setdefault(item.key, item.value)
    for key in ("FORMAT", "RECSIZE", "NL", "NS"):
        check(key in system, f"the VICAR label has no {key}")
    return system


def _layout(system: dict[str, HeaderValue], label_bytes: int) -> RawLayout:
    record = label_count(system, "RECSIZE", 0)
    bands, organization = label_count(system, "NB", 1), system.get("ORG", "BSQ")
    if bands != 1 or organization not in {"BSQ", "BIL"}:
        raise ValueError(f"only VICAR images of one band are read, got NB={bands}, ORG={organization!r}")
    layout = RawLayout(
        offset_bytes=label_bytes + label_count(system, "NLB", 0) * record,
        rows=label_count(system, "NL", 0),
        columns=label_count(system, "NS", 0),
        prefix_bytes=label_count(system, "NBB", 0),
        sample=_sample(system),
    )
    if record != layout.row_bytes:
        raise ValueError(
            f"the VICAR label contradicts itself: RECSIZE={record}, but NBB={layout.prefix_bytes} and "
            f"{layout.columns} samples of {system['FORMAT']!r} make {layout.row_bytes}"
        )
    return layout


def _sample(system: dict[str, HeaderValue]) -> str:
    """Sample type as :class:`RawLayout` has it; labels older than INTFMT and REALFMT are of the VAX."""
    kind, integers, reals = system["FORMAT"], system.get("INTFMT", "LOW"), system.get("REALFMT", "VAX")
    if kind in _INTEGER_SAMPLES:
        orders = {"LOW": "<", "HIGH": ">"}
        check(integers in orders, f"VICAR INTFMT must be HIGH or LOW, got {integers!r}")
        return orders[str(integers)] + _INTEGER_SAMPLES[str(kind)]
    if kind in _REAL_BYTES:
        starts = {"IEEE": ">f", "RIEEE": "<f", "VAX": "vax"}
        check(reals in starts, f"VICAR REALFMT must be IEEE, RIEEE or VAX, got {reals!r}")
        return starts[str(reals)] + str(_REAL_BYTES[str(kind)])
    known = ", ".join([*_INTEGER_SAMPLES, *_REAL_BYTES])
    raise ValueError(f"VICAR FORMAT {kind!r} is not read; formats are {known}")


def _end_label(data: bytes, system: dict[str, HeaderValue], layout: RawLayout) -> bytes:
    """Part of the label that follows the image, empty where there is none."""
    if system.get("EOL", 0) != 1:
        return b""
    start = layout.end_bytes
    match = _LABEL_SIZE.match(data, start)
    if match is None or start + int(match[1]) > len(data):
        raise ValueError("the file is truncated: the end of its VICAR label, behind the image, is missing")
    return _text(data[match.end() : start + int(match[1])])


def _text(label: bytes) -> bytes:
    """Label up to its terminating zero byte."""
    return label.partition(b"\0")[0]


def _never_received(pixels: NDArray[Any], label: dict[str, HeaderValue]) -> Mask:
    """Mask (rows, columns) of pixels that the label declares missing."""
    empty = np.asarray(pixels == 0)
    missing = label.get("MISSING_LINES")
    mask = np.zeros_like(empty)
    if type(missing) is int and missing > 0:
        mask |= empty & (empty.mean(axis=1, keepdims=True) >= 0.5)
    if "CUT_OUT_WINDOW" in label:
        mask |= empty.all(axis=1, keepdims=True) | empty.all(axis=0, keepdims=True)
    return mask


def _outside_of_old_frame(pixels: NDArray[Any], items: list[LabelItem]) -> Mask:
    """Mask (rows, columns) of zeros joined to the edge of a frame that was resampled."""
    empty = np.asarray(pixels == 0)
    if not any(_RESAMPLED in item.group for item in items):
        return np.zeros_like(empty)
    ringed = np.pad(empty, 1, constant_values=True).astype(np.uint8)
    _, labels = cv2.connectedComponents(ringed, connectivity=4)
    outside: Mask = labels[1:-1, 1:-1] == labels[0, 0]
    return outside
