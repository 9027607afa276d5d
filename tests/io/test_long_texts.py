"""Texts of any length and nesting are read in a time proportional to it: none comes near a limit of CPU time."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import pytest

from giantlike.campaign.file.toml_file import lines_of_keys
from giantlike.catalogs.readers.tabular import text_table
from giantlike.core.errors import DataError
from giantlike.io.camera_ik import read_ik_camera
from giantlike.io.label_statements import statements
from giantlike.io.pds3 import image_pointer, parse_pds3
from giantlike.io.pds4 import data_file_of
from giantlike.io.raster import decode_raster
from giantlike.io.spice import _meta_kernel_paths
from giantlike.io.vicar import decode_vicar

LENGTH = 50_000  # bytes: a linear reader takes 0.1 s, a quadratic one 2e9 steps
CPU_S = 15.0  # that no text here may take; a hundred times what a linear reader needs
UNITS = (
    "'", "''", '"', "(", "((", "()", "{", "{}", "=", "A", "A=", "A=(", "A=('", "A=( ", "A = (B) ", "A=''", "A=\"", "^",
    " ", "\n", " \n", "\n ", "/*", "/* */", "<", "A=1<", "A=1 <B> ", "OBJECT=A\n", "END_OBJECT\n", "a,", "1 ", "+",
    "A+=", "\\begindata\n", "\\begintext\n", "$A", "#", "[", "]", "A=('a', ", "A=('('", "\xff",
)  # fmt: skip


@contextmanager
def little_time() -> Iterator[None]:
    """Context manager that fails where its block takes more than ``CPU_S`` of CPU time."""

    def late(_number: int, _frame: FrameType | None) -> None:
        pytest.fail(f"more than {CPU_S:g} s of CPU time for a text of {LENGTH} bytes")

    before = signal.signal(signal.SIGVTALRM, late)
    signal.setitimer(signal.ITIMER_VIRTUAL, CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def _vicar(path: Path, text: str) -> None:
    decode_vicar(path, f"LBLSIZE={LENGTH + 400:<10}FORMAT='BYTE' {text}".encode("latin-1").ljust(LENGTH + 400))


def _pds3(path: Path, text: str) -> None:
    parse_pds3(path, f"PDS_VERSION_ID = PDS3\n{text}\nEND\n".encode("latin-1"))


def _pointer(path: Path, text: str) -> None:
    label = parse_pds3(path, f'PDS_VERSION_ID = PDS3\n^IMAGE = ("a" {text} x)\nEND\n'.encode("latin-1"))
    image_pointer(path, label)


def _kernel(path: Path, text: str) -> None:
    path.write_text(f"KPL/IK\n\\begindata\nINS-1_FOCAL_LENGTH = 1\n{text}", encoding="latin-1")
    read_ik_camera(path, -1)


def _meta_kernel(path: Path, text: str) -> None:
    _meta_kernel_paths(path, f"\\begindata\nKERNELS_TO_LOAD = ( 'a' )\n{text}\n")


READERS: dict[str, Callable[[Path, str], object]] = {
    "vicar": _vicar,
    "pds3": _pds3,
    "pds3 pointer": _pointer,
    "instrument kernel": _kernel,
    "meta-kernel": _meta_kernel,
    "pds4": lambda path, text: data_file_of(path, f"<file_name>{text}x".encode("latin-1")),
    "toml": lambda path, text: lines_of_keys(f"[{text}x\n"),
    "ecsv": lambda path, text: text_table(f"#{text}\na,b\n1,2\n".encode("latin-1")),
    "jpeg": lambda path, text: decode_raster(
        path, b"\xff\xd8\xff\xda\x00\x02" + text.encode("latin-1") + b"\x00", "jpeg"
    ),
}


@pytest.mark.parametrize("reader", list(READERS))
def test_a_reader_takes_a_time_proportional_to_its_text(reader: str, tmp_path: Path) -> None:
    for unit in UNITS:
        text = (unit * (LENGTH // len(unit) + 1))[:LENGTH]
        for variant in (text, text[: LENGTH // 2] + "A=1 " + text[: LENGTH // 2]):
            with little_time(), suppress(DataError, ValueError):  # read or refused
                READERS[reader](tmp_path / "a.ti", variant)


def test_the_vicar_label_of_338_bytes_that_never_ended_is_refused(tmp_path: Path) -> None:
    label = b"LBLSIZE=338 FORMAT='BYTE' A=(" + b"''" * 30 + b"'"
    with little_time(), pytest.raises(DataError, match="damaged near"):
        decode_vicar(tmp_path / "a.vic", label.ljust(338))


def test_path_symbols_that_multiply_each_other_are_refused(tmp_path: Path) -> None:
    symbols = [f"S{k:02d}E" for k in range(40)]
    values = [f"${symbol}${symbol}" for symbol in symbols[1:]] + ["x"]
    lists = {"KERNELS_TO_LOAD": ["$S00E"], "PATH_SYMBOLS": symbols, "PATH_VALUES": values}
    text = "\n".join(f"{key} = ( {' '.join(repr(value) for value in items)} )" for key, items in lists.items())
    with pytest.raises(DataError, match="more than 1000 characters"):
        _meta_kernel_paths(tmp_path / "k.tm", f"\\begindata\n{text}\n")


def test_statements_of_a_label_are_those_of_the_language() -> None:
    text = (
        '/* a comment = 1 */ NAME = "two\nlines" ^IMAGE = ("A.IMG", 3 <BYTES>)\n OBJECT = IMAGE\n'
        "  A:B = 1.5 <m/s>\n C = {a, b} D=((1, 2), (3, 4))\n  END_OBJECT\n= 3 <\n E = 'x' /* not closed\n F = <\nG = 7"
    )
    assert list(statements(text)) == [
        ("NAME", '"two\nlines"', None),
        ("^IMAGE", '("A.IMG", 3 <BYTES>)', None),
        ("OBJECT", "IMAGE", None),
        ("A:B", "1.5", "m/s"),
        ("C", "{a, b}", None),
        ("D", "((1, 2), (3, 4))", None),
        ("END_OBJECT", "", None),
        ("E", "'x'", None),
        ("G", "7", None),
    ]
