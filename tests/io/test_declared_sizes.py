"""A header that declares far more than its file can hold is refused before memory or time is taken."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
from astropy.io import fits
from pyarrow import parquet

from giantlike._system.reading import toml_table
from giantlike.catalogs.readers import build_catalog
from giantlike.core.errors import DataError
from giantlike.io.image_files import read_image_file
from tests.catalogs import test_catalog_readers as catalog_files
from tests.io.test_long_texts import little_time

LITTLE_BYTES = 50_000_000  # of Python's memory, that refusing a file may take


@contextmanager
def refused(match: str) -> Iterator[None]:
    """Context manager: its block raises a DataError of this text, within little time and memory."""
    tracemalloc.start()
    try:
        with little_time(), pytest.raises(DataError, match=match):
            yield
        assert tracemalloc.get_traced_memory()[1] < LITTLE_BYTES
    finally:
        tracemalloc.stop()


def _png(columns: int, rows: int) -> bytes:
    """PNG file of zeros, 8 bits, gray, whose rows are compressed to a thousandth."""
    packer, packed = zlib.compressobj(1), b""
    for _ in range(rows):
        packed += packer.compress(bytes(columns + 1))
    packed += packer.flush()
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)), (b"IDAT", packed), (b"IEND", b"")]
    parts = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_a_picture_of_gigabytes_in_a_small_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(_png(20_000, 20_000))
    assert path.stat().st_size < 4_000_000
    with refused("declares 400 MB"):
        read_image_file(path)
    path.write_bytes(_png(3000, 2000))  # an image of the dark sky packs as well, and is read
    assert read_image_file(path).pixels.shape == (2000, 3000)


@pytest.mark.parametrize("suffix", [".jpg", ".tiff"])
def test_sizes_of_other_pictures_are_refused_too(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    content = bytearray(cv2.imencode(suffix, np.zeros((40, 50, 3), np.uint8))[1].tobytes())
    if suffix == ".jpg":
        frame = content.index(b"\xff\xc0")
        struct.pack_into(">HH", content, frame + 5, 30_000, 30_000)
    else:
        start = struct.unpack_from("<I", content, 4)[0]
        for k in range(struct.unpack_from("<H", content, start)[0]):
            tag, kind = struct.unpack_from("<HH", content, start + 2 + 12 * k)
            if tag in (256, 257):
                struct.pack_into("<I" if kind == 4 else "<H", content, start + 2 + 12 * k + 8, 30_000)
    path.write_bytes(content)
    with refused("declares"):
        read_image_file(path)


def _many_axes(path: Path) -> None:
    cards = [
        "SIMPLE  =                    T",
        "BITPIX  =                    8",
        "NAXIS   =            999999999",
        "END",
    ]
    path.write_bytes("".join(card.ljust(80) for card in cards).encode().ljust(2880))


def _many_rows(path: Path) -> None:
    fits.BinTableHDU.from_columns([fits.Column("ra", "D", array=np.zeros(2))]).writeto(path)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"NAXIS2  =                    2", b"NAXIS2  =            999999999"))


@pytest.mark.parametrize("write", [_many_axes, _many_rows])
def test_a_catalog_in_fits_of_more_axes_or_rows_than_it_holds_is_refused(
    write: Callable[[Path], None], tmp_path: Path
) -> None:
    path = tmp_path / "g.fits"
    write(path)
    with refused("999999999|truncated"):
        build_catalog([path], "gaia", name="hostile")


def test_a_catalog_in_parquet_of_one_number_a_billion_times_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "g.parquet"
    schema, column = pa.schema([("ra", pa.float64())]), pa.array(np.zeros(5_000_000))
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(8):
            writer.write_table(pa.Table.from_arrays([column], schema=schema))
    assert path.stat().st_size < 1_000_000
    with refused("declares 320 MB"):
        build_catalog([path], "gaia", name="hostile")


def test_a_column_of_texts_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "g.parquet"
    catalog_files._write_parquet(path)
    table = parquet.read_table(path)
    texts = pa.array(["x"] * table.num_rows)
    parquet.write_table(table.set_column(table.column_names.index("ra"), "ra", texts), path)
    with refused("must hold numbers"):
        build_catalog([path], "gaia", name="hostile")


def _votable(path: Path, old: str, new: str) -> None:
    catalog_files._write_votable(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_votable_whose_data_are_elsewhere_is_refused_and_nothing_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import urllib.request

    def opened(*_: object, **__: object) -> None:
        pytest.fail("the address in the file was requested")

    monkeypatch.setattr(urllib.request, "urlopen", opened)
    path, secret = tmp_path / "g.vot", tmp_path / "secret"
    secret.write_bytes(bytes(64))
    catalog_files._write_votable(path)
    text = path.read_text()
    data = text[text.index("<DATA>") : text.index("</DATA>") + len("</DATA>")]
    for address in (secret.as_uri(), "http://127.0.0.1:9/x"):
        stream = f'<DATA><BINARY><STREAM href="{address}"/></BINARY></DATA>'
        path.write_text(text.replace(data, stream))
        with refused("its data are at"):
            build_catalog([path], "gaia", name="hostile")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("<FIELD ", '<FIELD arraysize="99999x9999" ', "cells of"),
        ("<TABLE", '<TABLE nrows="99999999999"', "declares"),
        ("<RESOURCE", "<RESOURCE>" * 3000 + "<RESOURCE", "nested"),
    ],
)
def test_a_votable_that_declares_more_than_it_holds_is_refused(old: str, new: str, match: str, tmp_path: Path) -> None:
    path = tmp_path / "g.vot"
    _votable(path, old, new)
    with refused(match):
        build_catalog([path], "gaia", name="hostile")


@pytest.mark.parametrize("key", ["a" + ".a" * 20_000, '"a"' + " . 'b'" * 10_000, "x" + ".y" * 64])
def test_a_dotted_key_of_toml_with_thousands_of_parts_is_refused(key: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    for text in (f"b = 1\n{key} = 1\n", f"b = 1\n[{key}]\n"):
        path.write_text(text)
        with refused("line 2: a key has more than 64 parts"):
            toml_table(path, "file")
    path.write_text('a.b.c."d.e" = "1.2.3"\n# ' + "." * 200 + "\n" + "x" * 9000 + " = 1\n")
    assert toml_table(path, "file")["a"] == {"b": {"c": {"d.e": "1.2.3"}}}
