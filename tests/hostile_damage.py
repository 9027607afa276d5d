"""Damage to files as disks, links, editors and tools do it: cuts, flips, swapped blocks, other numbers, encodings."""

from __future__ import annotations

import gzip
import io
import re
import zipfile
import zlib
from collections.abc import Callable

import numpy as np

_NUMBERS = (
    "1e999", "-1", "0", "nan", "99999999999999999999", "1" * 5000, "inf", "-0.0", "1e-320", "0x7f", "2147483648",
    "4294967295", "9223372036854775807", "1e308", "-32769", "1_0", "١", "1,5", "", "''", "T", "null",
)  # fmt: skip
_NESTS = ("[" * 3000, "{" * 3000, "(" * 3000, "a." * 3000, "<a>" * 3000, "'" * 101, "- " * 3000)
_TEXTS = ("\x00", "\ufeff", "é", "\ud7ff", "\u2028", "'", '"', "\\", "%s", "{}", "\x1b[2J", "../../../", "#", "--")
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eEdD][+-]?\d+)?")
_KEYWORD = re.compile(rb"[A-Za-z^][A-Za-z0-9_^/-]{1,30}[ \t]*[=:][ \t]*([^\s,;/]+)")
_BLOCKS = (2, 4, 16, 80, 512, 2880)  # bytes: integers, a card and a block of FITS, a sector of a disk
_MOST_BYTES = 4_000_000  # of a damaged file: it is repeated up to 50 times

Damage = Callable[[bytearray, np.random.Generator], bytes]


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """Content damaged in one to three ways."""
    for _ in range(int(random.integers(1, 4))):
        content = _damages[int(random.integers(len(_damages)))](bytearray(content), random)[:_MOST_BYTES]
    return content


def _flipped(content: bytearray, random: np.random.Generator) -> bytes:
    for place in random.integers(max(len(content), 1), size=int(random.integers(1, 9)) if content else 0):
        content[place] ^= 1 << int(random.integers(8))
    return bytes(content)


def _overwritten(content: bytearray, random: np.random.Generator) -> bytes:
    start = int(random.integers(max(len(content), 1)))
    value = (b"\x00", b"\xff", b"\x7f", b"\x80", random.bytes(1))[int(random.integers(5))]
    length = int(random.integers(1, 9))
    content[start : start + length] = value * min(length, len(content) - start)
    return bytes(content)


def _other_integer(content: bytearray, random: np.random.Generator) -> bytes:
    """A binary integer of 2, 4 or 8 bytes at a multiple of its length becomes one at the edge of its range."""
    length = (2, 4, 8)[int(random.integers(3))]
    if len(content) < length:
        return bytes(content)
    start = int(random.integers(len(content) // length)) * length
    bits = 8 * length
    value = (0, 1, 2 ** (bits - 1) - 1, 2 ** (bits - 1), 2**bits - 1, 2 ** (bits // 2))[int(random.integers(6))]
    content[start : start + length] = value.to_bytes(length, ("big", "little")[int(random.integers(2))])
    return bytes(content)


def _cut(content: bytearray, random: np.random.Generator) -> bytes:
    return bytes(content[: int(random.integers(len(content) + 1))])


def _beheaded(content: bytearray, random: np.random.Generator) -> bytes:
    return bytes(content[int(random.integers(len(content) + 1)) :])


def _removed(content: bytearray, random: np.random.Generator) -> bytes:
    start = int(random.integers(max(len(content), 1)))
    del content[start : start + int(random.integers(1, 200))]
    return bytes(content)


def _repeated(content: bytearray, random: np.random.Generator) -> bytes:
    start, length = int(random.integers(max(len(content), 1))), int(random.integers(1, 200))
    content[start:start] = content[start : start + length] * int(random.integers(1, 50))
    return bytes(content)


def _twice(content: bytearray, random: np.random.Generator) -> bytes:
    return bytes(content) * 2


def _other_number(content: bytearray, random: np.random.Generator) -> bytes:
    return _replaced(content, [(match.start(), match.end()) for match in _NUMBER.finditer(content)], random)


def _other_value(content: bytearray, random: np.random.Generator) -> bytes:
    """The value of a keyword, as of a label or a header, becomes another."""
    return _replaced(content, [match.span(1) for match in _KEYWORD.finditer(content)], random)


def _replaced(content: bytearray, places: list[tuple[int, int]], random: np.random.Generator) -> bytes:
    """Content with a number at one of the places: as it is, or with spaces so that the length of the file stays."""
    if not places:
        return _flipped(content, random)
    start, end = places[int(random.integers(len(places)))]
    number = _NUMBERS[int(random.integers(len(_NUMBERS)))].encode()
    if random.integers(2) and len(number) <= 20:
        end = max(end, start + len(number))
        number = number.rjust(min(end, len(content)) - start)
    content[start:end] = number
    return bytes(content)


def _nested(content: bytearray, random: np.random.Generator) -> bytes:
    return _with(content, _NESTS[int(random.integers(len(_NESTS)))].encode(), random)


def _strange_text(content: bytearray, random: np.random.Generator) -> bytes:
    return _with(content, _TEXTS[int(random.integers(len(_TEXTS)))].encode(), random)


def _with(content: bytearray, text: bytes, random: np.random.Generator) -> bytes:
    place = int(random.integers(len(content) + 1))
    content[place:place] = text
    return bytes(content)


def _swapped_lines(content: bytearray, random: np.random.Generator) -> bytes:
    lines = bytes(content).split(b"\n")
    first, second = random.integers(len(lines), size=2)
    lines[first], lines[second] = lines[second], lines[first]
    return b"\n".join(lines)


def _swapped_blocks(content: bytearray, random: np.random.Generator) -> bytes:
    length = _BLOCKS[int(random.integers(len(_BLOCKS)))]
    n_blocks = len(content) // length
    if n_blocks < 2:
        return bytes(content[::-1])
    first, second = (int(k) * length for k in random.integers(n_blocks, size=2))
    one, other = content[first : first + length], content[second : second + length]
    content[first : first + length], content[second : second + length] = other, one
    return bytes(content)


def _other_encoding(content: bytearray, random: np.random.Generator) -> bytes:
    """The text in UTF-16, with a byte order mark, or with bytes that are no UTF-8."""
    text = bytes(content).decode("latin-1")
    which = int(random.integers(4))
    if which == 3:
        return _with(content, b"\xc3\x28\xff", random)
    return text.encode(("utf-16", "utf-8-sig", "utf-8")[which])


def _other_line_ends(content: bytearray, random: np.random.Generator) -> bytes:
    ends = (b"\n", b"\r\n", b"\r", b"", b"\x0b", b"\n\n")
    pieces = re.split(rb"\r?\n", bytes(content))
    mixed = int(random.integers(2))
    end = ends[int(random.integers(len(ends)))]
    return b"".join(piece + (ends[int(random.integers(len(ends)))] if mixed else end) for piece in pieces)


def _inside(content: bytearray, random: np.random.Generator) -> bytes:
    """The damage within an archive or a compressed file, whose own sums are right."""
    try:
        if content.startswith(b"\x1f\x8b"):
            return gzip.compress(mutated(gzip.decompress(bytes(content)), random), compresslevel=1)
        if content.startswith(b"PK"):
            return _inside_zip(bytes(content), random)
    except (OSError, EOFError, zlib.error, zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError):
        pass  # damaged already
    return _other_number(content, random)


def _inside_zip(content: bytes, random: np.random.Generator) -> bytes:
    output = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(output, "w") as other:
        names = archive.namelist()
        chosen = names[int(random.integers(len(names)))] if names else ""
        for name in names:
            member = archive.read(name)
            other.writestr(name, mutated(member, random) if name == chosen else member)
    return output.getvalue()


_damages: tuple[Damage, ...] = (
    _flipped, _overwritten, _other_integer, _cut, _beheaded, _removed, _repeated, _twice, _other_number, _other_number,
    _other_value, _other_value, _nested, _strange_text, _swapped_lines, _swapped_blocks, _other_encoding,
    _other_line_ends, _inside, _inside,
)  # fmt: skip
