"""Catalogs in lines of fixed columns: Hipparcos, its new reduction, and Tycho-2."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from giantlike.catalogs.readers.rows import ReadStars, stars_of
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.values import Value

Places = Mapping[str, tuple[int, int]]
"""First and last byte of each column, counted from 1, as the descriptions do."""
HIPPARCOS_EPOCH = 1991.25


@dataclass(frozen=True, slots=True, eq=False)
class Lines(Value):
    """Lines of a file as bytes (n, width), padded with blanks."""

    path: Path
    text: NDArray[np.bytes_]

    def words(self, place: tuple[int, int]) -> NDArray[np.bytes_]:
        """The text (n,) in some bytes, without blanks around it."""
        first, last = place
        field = np.ascontiguousarray(self.text[:, first - 1 : last]).view(f"S{last - first + 1}")[:, 0]
        return np.strings.strip(field)

    def numbers(self, place: tuple[int, int]) -> Float:
        """The numbers (n,) in some bytes, NaN where these are blank.

        Raises
        ------
        DataError
            Something else stands there.
        """
        words = self.words(place)
        words = np.where(words == b"", b"nan", words)
        try:
            return words.astype(np.float64)
        except ValueError:
            row = next(row for row, word in enumerate(words) if not _is_number(word))
            found = words[row].decode(errors="replace")
            raise DataError(
                self.path,
                f"line {row + 1}, bytes {place[0]}-{place[1]}: expected a number, got {found!r}; "
                "the file is damaged or of another format",
            ) from None

    def record(self, row: int) -> str:
        """How errors call a line."""
        return f"line {row + 1}"


def lines_of(path: Path, widths: tuple[int, ...], what: str) -> Lines:
    """Read a file, gzipped or not, whose longest line has one of some widths.

    Raises
    ------
    DataError
        The file cannot be read, is empty, or a line is longer than the first.
    """
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(path, f"cannot be read as {what}: {error}") from error
    lines = content.splitlines()
    width = len(lines[0]) if lines else 0
    if width not in widths:
        expected = " or ".join(str(number) for number in widths)
        raise DataError(path, f"line 1: expected {expected} bytes as {what} has, got {width}; check --format")
    for number, line in enumerate(lines, start=1):
        if len(line) > width:
            raise DataError(path, f"line {number}: expected {width} bytes as in line 1, got {len(line)}")
    text = b"".join([line.ljust(width) for line in lines])
    return Lines(path, np.frombuffer(text, dtype="S1").reshape(len(lines), width))


HIP_MAIN: Places = {
    "hip": (9, 14), "v": (42, 46), "ra_deg": (52, 63), "dec_deg": (65, 76), "parallax": (80, 86), "pm_ra": (88, 95),
    "pm_dec": (97, 104), "e_ra": (106, 111), "e_dec": (113, 118), "e_pm_ra": (127, 132), "e_pm_dec": (134, 139),
    "bv": (246, 251), "components": (344, 345), "flag": (347, 347),
}  # fmt: skip
HIP_NEW: Places = {
    "hip": (1, 6), "solution": (8, 10), "ra_rad": (16, 28), "dec_rad": (30, 42), "parallax": (44, 50),
    "pm_ra": (52, 59), "pm_dec": (61, 68), "e_ra": (70, 75), "e_dec": (77, 82), "e_pm_ra": (91, 96),
    "e_pm_dec": (98, 103), "hp": (130, 136), "bv": (153, 158),
}  # fmt: skip
_ONE_STAR = (1, 5)  # solution types of I/311 that are neither curved nor of several stars


def read_hipparcos(path: Path, *, max_magnitude: float | None = None) -> tuple[ReadStars, str]:
    """Read ``hip_main.dat`` (I/239) or ``hip2.dat`` (I/311), and say in which band.

    ``hip_main.dat`` has lines of 450 bytes, ICRS positions in degrees at J1991.25 and Johnson V; ``hip2.dat`` has 276
    bytes, radians and Hp. Identifiers are the negative Hipparcos numbers. 263 entries of ``hip_main.dat`` have no
    place and are left out. Stars are double that have several components or a curved or orbital solution.

    Raises
    ------
    DataError
        The file has other lines, or a column holds no number.

    References
    ----------
    .. [1] CDS ReadMe of I/239, The Hipparcos and Tycho Catalogs (ESA 1997): byte-by-byte description.
    .. [2] CDS ReadMe of I/311, Hipparcos, the New Reduction (van Leeuwen 2007): byte-by-byte description.
    """
    lines = lines_of(path, (450, 276), "Hipparcos")
    new = lines.text.shape[1] == 276
    places = HIP_NEW if new else HIP_MAIN
    column = {name: lines.numbers(place) for name, place in places.items() if name != "flag"}
    bv = column["bv"]
    columns = {
        "ids": -column["hip"].astype(np.int64),
        "ra_deg": np.degrees(column["ra_rad"]) if new else column["ra_deg"],
        "dec_deg": np.degrees(column["dec_rad"]) if new else column["dec_deg"],
        "pm_ra_mas_yr": column["pm_ra"],
        "pm_dec_mas_yr": column["pm_dec"],
        "parallax_mas": column["parallax"],
        "epoch_jyear": np.full(len(bv), HIPPARCOS_EPOCH),
        "magnitude": column["hp"] if new else column["v"],
        "color_bv": np.where(bv == 0.0, np.nan, bv) if new else bv,  # 0.000 stands for unknown in I/311
        "sigma_mas": rms(column["e_ra"], column["e_dec"]),
        "sigma_pm_mas_yr": rms(column["e_pm_ra"], column["e_pm_dec"]),
    }
    if new:
        columns["is_double"] = (~np.isin(column["solution"], _ONE_STAR)).astype(np.float64)
    else:
        flagged = lines.words(HIP_MAIN["flag"]) != b""
        columns["is_double"] = ((np.nan_to_num(column["components"]) > 1) | flagged).astype(np.float64)
    return stars_of(path, columns, record=lines.record, max_magnitude=max_magnitude), "Hp" if new else "V"


TYCHO: Places = {
    "tyc1": (1, 4), "tyc2": (6, 10), "tyc3": (12, 12), "mean_flag": (14, 14), "ra": (16, 27), "dec": (29, 40),
    "pm_ra": (42, 48), "pm_dec": (50, 56), "e_ra": (58, 60), "e_dec": (62, 64), "e_pm_ra": (66, 69),
    "e_pm_dec": (71, 74), "epoch_ra": (76, 82), "epoch_dec": (84, 90), "bt": (111, 116), "vt": (124, 129),
    "near": (137, 139), "seen_ra": (153, 164), "seen_dec": (166, 177), "seen_epoch_ra": (179, 182),
    "seen_epoch_dec": (184, 187), "e_seen_ra": (189, 193), "e_seen_dec": (195, 199), "solution": (201, 201),
}  # fmt: skip
TYCHO_SUPPLEMENT: Places = {
    "tyc1": (1, 4), "tyc2": (6, 10), "tyc3": (12, 12), "ra": (16, 27), "dec": (29, 40), "pm_ra": (42, 48),
    "pm_dec": (50, 56), "e_ra": (58, 62), "e_dec": (64, 68), "e_pm_ra": (70, 74), "e_pm_dec": (76, 80),
    "magnitude_flag": (82, 82), "bt": (84, 89), "vt": (97, 102), "near": (110, 112),
}  # fmt: skip
_TEXT = ("mean_flag", "solution", "magnitude_flag")
_USUAL_BT_VT = 0.8  # of stars of which one of the two is missing
_NEAR_TENTHS_ARCSEC = 50.0


def read_tycho2(path: Path, *, max_magnitude: float | None = None) -> tuple[ReadStars, str]:
    """Read ``tyc2.dat`` or a part of it, or ``suppl_1.dat`` (I/259); magnitudes are Johnson V.

    Lines have 206 bytes, those of the supplements 122. Positions are ICRS: mean ones at J2000, or where there is
    none (flag X) the one observed at about J1991.5; in the supplement J1991.25. The errors of mean positions, which
    are given at their mean epochs, are carried to J2000. Johnson magnitudes follow from Tycho's by
    ``V = VT - 0.090 (BT - VT)`` and ``B - V = 0.850 (BT - VT)`` (Note 7); where one of the two is missing, BT - VT is
    taken as 0.8; where the supplement has Hp, that stands for V. Identifiers are
    ``TYC1 * 1,000,000 + TYC2 * 10 + TYC3``. Stars are double that Tycho solved as such or whose next entry is within
    5 arcsec. The brightest stars are in the supplement only: give both files.

    Raises
    ------
    DataError
        The file has other lines, or a column holds no number.

    References
    ----------
    .. [1] CDS ReadMe of I/259, The Tycho-2 Catalog (Hog+ 2000): byte-by-byte descriptions and notes.
    """
    lines = lines_of(path, (206, 122, 115), "Tycho-2")
    main = lines.text.shape[1] == 206
    places = TYCHO if main else TYCHO_SUPPLEMENT
    column = {
        name: lines.numbers(place)
        for name, place in places.items()
        if name not in _TEXT and place[1] <= lines.text.shape[1]
    }
    columns: dict[str, Float | NDArray[np.int64]] = _mean_places(column) if main else _supplement_places(column)
    bt, vt = column["bt"], column["vt"]
    difference = np.where(np.isnan(bt - vt), _USUAL_BT_VT, bt - vt)
    vt_or_guess = np.where(np.isnan(vt), bt - _USUAL_BT_VT, vt)
    columns["magnitude"] = vt_or_guess - 0.090 * difference
    columns["color_bv"] = 0.850 * (bt - vt)
    double = np.nan_to_num(column["near"], nan=999.0) <= _NEAR_TENTHS_ARCSEC
    if main:
        double |= np.isin(lines.words(TYCHO["solution"]), (b"D", b"P")) | (lines.words(TYCHO["mean_flag"]) == b"P")
    else:
        has_hp = lines.words(TYCHO_SUPPLEMENT["magnitude_flag"]) == b"H"
        columns["magnitude"] = np.where(has_hp, vt, columns["magnitude"])
    columns["is_double"] = double.astype(np.float64)
    numbers = [np.nan_to_num(column[name]).astype(np.int64) for name in ("tyc1", "tyc2", "tyc3")]
    columns["ids"] = numbers[0] * 1_000_000 + numbers[1] * 10 + numbers[2]
    return stars_of(path, columns, record=lines.record, max_magnitude=max_magnitude), "V"


def _mean_places(column: Mapping[str, Float]) -> dict[str, Float | NDArray[np.int64]]:
    mean = np.isfinite(column["ra"])
    seen_epoch = 1990.0 + 0.5 * (column["seen_epoch_ra"] + column["seen_epoch_dec"])
    e_pm = [column["e_pm_ra"], column["e_pm_dec"]]
    at_2000 = [
        np.hypot(column[f"e_{axis}"], error * (2000.0 - column[f"epoch_{axis}"]))
        for axis, error in zip(("ra", "dec"), e_pm, strict=True)
    ]
    return {
        "ra_deg": np.where(mean, column["ra"], column["seen_ra"]),
        "dec_deg": np.where(mean, column["dec"], column["seen_dec"]),
        "epoch_jyear": np.where(mean, 2000.0, seen_epoch),
        "pm_ra_mas_yr": column["pm_ra"],
        "pm_dec_mas_yr": column["pm_dec"],
        "sigma_mas": np.where(mean, rms(*at_2000), rms(column["e_seen_ra"], column["e_seen_dec"])),
        "sigma_pm_mas_yr": rms(*e_pm),
    }


def _supplement_places(column: Mapping[str, Float]) -> dict[str, Float | NDArray[np.int64]]:
    return {
        "ra_deg": column["ra"],
        "dec_deg": column["dec"],
        "epoch_jyear": np.full(len(column["ra"]), HIPPARCOS_EPOCH),
        "pm_ra_mas_yr": column["pm_ra"],
        "pm_dec_mas_yr": column["pm_dec"],
        "sigma_mas": rms(column["e_ra"], column["e_dec"]),
        "sigma_pm_mas_yr": rms(column["e_pm_ra"], column["e_pm_dec"]),
    }


def rms(a: Float, b: Float) -> Float:
    """Root mean square (n,) of two columns: the error per axis of a star."""
    result: Float = np.hypot(a, b) / np.sqrt(2.0)
    return result


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
