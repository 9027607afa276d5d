"""PDS3 labels, attached to an image or in a separate file (or of ISIS cubes), and the raw images they describe.

Source: Planetary Data System Standards Reference, version 3.8, JPL D-7669 (label syntax, pointers, IMAGE objects).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from giantlike._system.reading import check, reads
from giantlike.io.decoded import DecodedImage, HeaderValue
from giantlike.io.label_statements import statements
from giantlike.io.label_times import label_epoch, label_exposure_s
from giantlike.io.raw_image import RawLayout, label_count, read_raw

LABEL_START = re.compile(rb"\s*(PDS_VERSION_ID|CCSD3ZF|NJPL1I|ODL_VERSION_ID)\b")
"""First word of a PDS3 label, or of its SFDU wrapper."""

_END = re.compile(r"^[^\S\n]*(?:END|End)[^\S\n]*$", re.MULTILINE)
_POINTER = re.compile(
    r"\(?\s*+(?:[\"'](?P<file>[^\"']+)[\"'])?\s*+,?\s*+(?P<start>\d+)?\s*+(?P<bytes><\s*+BYTES\s*+>)?\s*+\)?"
)
_INTEGER = re.compile(r"[+-]?\d+")
_REAL = re.compile(r"[+-]?(\d+\.\d*|\.\d+|\d+)([eE][+-]?\d+)?")
_DEEPEST, _LONGEST_NAME = 20, 100  # objects within objects, where missions have 4, and characters of the name of one
_BIG, _LITTLE = ("MSB_", "SUN_", "MAC_"), ("LSB_", "PC_", "VAX_")


@dataclass(frozen=True, slots=True)
class Pds3Label:
    """A parsed PDS3 label."""

    values: dict[str, HeaderValue]  # items by name; those inside an object or group as ``OBJECT.NAME``
    raw: dict[str, str]  # the values as written, pointers (``^IMAGE``) among them
    units: dict[str, str]  # the unit of an item, where the label states one


@dataclass(frozen=True, slots=True)
class ImagePointer:
    """Location of the image that a label describes."""

    file: str | None  # name of the file; None for the file of the label itself
    offset_bytes: int  # first byte of the image, from 0


@reads("a PDS3 label")
def parse_pds3(path: Path, data: bytes) -> Pds3Label:
    """Parse the PDS3 label that a file begins with."""
    text = data.decode("latin-1")
    end = _END.search(text)
    if end is None:
        raise ValueError("it has no END statement")
    label = Pds3Label({}, {}, {})
    nesting: list[str] = []
    for key, value, unit in statements(text[: end.start()]):
        opened_or_closed = key.upper()
        if opened_or_closed in {"END_OBJECT", "END_GROUP"}:
            del nesting[-1:]
            continue
        if opened_or_closed in {"OBJECT", "GROUP"}:
            nesting.append(value)
            small = len(nesting) <= _DEEPEST and len(value) <= _LONGEST_NAME
            check(
                small,
                f"its objects are nested more than {_DEEPEST} deep, or have names over {_LONGEST_NAME} characters",
            )
            continue
        name = ".".join([*nesting, key])
        label.raw.setdefault(name, value if unit is None else f"{value} <{unit}>")
        if not key.startswith("^"):
            label.values.setdefault(name, _plain(value))
            if unit is not None:
                label.units.setdefault(name, unit)
    return label


@reads("a PDS3 label of an image")
def image_pointer(path: Path, label: Pds3Label) -> ImagePointer:
    """Location of the image that a label describes."""
    text = label.raw.get("^IMAGE")
    if text is None:
        raise ValueError("it has no ^IMAGE pointer")
    match = _POINTER.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"the pointer ^IMAGE = {text!r} is not understood")
    start = int(match["start"] or 1)
    if match["bytes"] is not None or start == 1:
        return ImagePointer(match["file"], start - 1)
    record = label.values.get("RECORD_BYTES")
    if type(record) is not int or start < 1:
        raise ValueError(f"the pointer ^IMAGE = {text!r} counts records, but RECORD_BYTES is {record!r}")
    return ImagePointer(match["file"], (start - 1) * record)


@reads("a PDS3 image")
def decode_pds3(path: Path, data: bytes, label: Pds3Label, offset_bytes: int) -> DecodedImage:
    """Decode the raw image that a PDS3 label describes."""
    layout = raw_layout(label, offset_bytes)
    values = label.values
    exposure_s = label_exposure_s(values, label.units)
    return DecodedImage(
        pixels=read_raw(data, layout),
        format="pds3",
        epoch=label_epoch(values, exposure_s),
        exposure_s=exposure_s,
        header=dict(values),
    )


def raw_layout(label: Pds3Label, offset_bytes: int) -> RawLayout:
    """Position and type of the samples of the image that a label describes."""
    values = label.values
    encoding = str(values.get("IMAGE.ENCODING_TYPE", "N/A"))
    if label_count(values, "IMAGE.BANDS", 1) != 1 or encoding not in {"N/A", "NONE"}:
        raise ValueError(f"only uncompressed PDS3 images of one band are read, got ENCODING_TYPE {encoding!r}")
    return RawLayout(
        offset_bytes=offset_bytes,
        rows=label_count(values, "IMAGE.LINES", 0),
        columns=label_count(values, "IMAGE.LINE_SAMPLES", 0),
        prefix_bytes=label_count(values, "IMAGE.LINE_PREFIX_BYTES", 0),
        suffix_bytes=label_count(values, "IMAGE.LINE_SUFFIX_BYTES", 0),
        sample=_sample(str(values.get("IMAGE.SAMPLE_TYPE")), label_count(values, "IMAGE.SAMPLE_BITS", 8)),
    )


def _plain(text: str) -> HeaderValue:
    if text[0] in "\"'":
        return " ".join(text[1:-1].split())
    if text[0] in "({":
        return ",".join(entry.strip().strip("\"'") for entry in text[1:-1].split(","))
    if _INTEGER.fullmatch(text):
        return int(text)
    return float(text) if _REAL.fullmatch(text) else text


def _sample(sample_type: str, bits: int) -> str:
    """Sample type as :class:`RawLayout` has it; names without a byte order are most significant byte first."""
    prefix = next((p for p in (*_BIG, *_LITTLE, "IEEE_") if sample_type.startswith(p)), "")
    kinds = {"UNSIGNED_INTEGER": "u", "INTEGER": "i", "REAL": "f", "FLOAT": "f"}
    kind, size = kinds.get(sample_type.removeprefix(prefix)), bits // 8
    if kind is None or bits not in {8, 16, 32, 64} or (kind == "f" and size < 4):
        raise ValueError(f"PDS3 samples of type {sample_type!r} with {bits} bits are not read")
    if kind == "f" and prefix == "VAX_":
        return f"vax{size}"
    return f"{'<' if prefix in _LITTLE else '>'}{kind}{size}"
