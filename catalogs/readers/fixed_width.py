"""Readers of catalogs in lines of fixed columns: Hipparcos, its new reduction, and Tycho-2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import decompress_gzip, reads
from giantlike.catalogs.readers.rows import CLOSE_ARCSEC, HIPPARCOS_EPOCH, ReadStars, parse_number, rms, stars_of
from giantlike.core.arrays import Float
from giantlike.core.values import Value

Places = Mapping[str, tuple[int, int]]
"""First and last byte of each column, counted from 1, as in the byte-by-byte descriptions of the CDS."""
_LARGEST = 2.0**53  # whole numbers beyond this are not exact as float64; no column of these catalogs holds one


@dataclass(frozen=True, slots=True, eq=False)
class FileLines(Value):
    """Lines of a file."""

    text: NDArray[np.bytes_]  # (n, width) bytes; one byte in each element; short lines are padded with blanks

    def words(self, place: tuple[int, int]) -> NDArray[np.bytes_]:
        """Text (n,) of a column, without blanks around it."""
        first, last = place
        field = np.ascontiguousarray(self.text[:, first - 1 : last]).view(f"S{last - first + 1}")[:, 0]
        return np.strings.strip(field)

    def numbers(self, place: tuple[int, int]) -> Float:
        """Numbers (n,) of a column, NaN where it is blank; anything else is a ``ValueError``."""
        words = self.words(place)
        words = np.where(words == b"", b"nan", words)
        try:
            found = words.astype(np.float64)
        except ValueError:
            row = next(row for row, word in enumerate(words) if parse_number(word) is None)
            raise self._refusal(row, place, "a number") from None
        wrong = np.abs(found) > _LARGEST
        if wrong.any():
            raise self._refusal(int(wrong.argmax()), place, "a number below 9e15")
        return found

    def integers(self, place: tuple[int, int]) -> NDArray[np.int64]:
        """Whole numbers (n,) of a column, 0 where it is blank; anything else is a ``ValueError``."""
        found = self.numbers(place)
        found = np.where(np.isnan(found), 0.0, found)
        wrong = found != np.round(found)
        if wrong.any():
            raise self._refusal(int(wrong.argmax()), place, "a whole number")
        return found.astype(np.int64)

    def _refusal(self, row: int, place: tuple[int, int], needed: str) -> ValueError:
        """Error for the text of a column in a line."""
        found = self.words(place)[row].decode(errors="replace")
        return ValueError(f"{self.record(row)}, bytes {place[0]}-{place[1]}: expected {needed}, got {found!r}")

    def record(self, row: int) -> str:
        """Name of a line in error messages."""
        return f"line {row + 1}"


def lines_of(path: Path, widths: tuple[int, ...]) -> FileLines:
    """Lines of a file, gzipped or not, whose first and longest line has one of the given widths."""
    lines = decompress_gzip(path.read_bytes()).splitlines()
    width = len(lines[0]) if lines else 0
    if width not in widths:
        expected = " or ".join(str(number) for number in widths)
        raise ValueError(f"line 1: expected {expected} bytes, got {width}; check --format")
    for number, line in enumerate(lines, start=1):
        if len(line) > width:
            raise ValueError(f"line {number}: expected {width} bytes as in line 1, got {len(line)}")
    text = b"".join([line.ljust(width) for line in lines])
    return FileLines(np.frombuffer(text, dtype="S1").reshape(len(lines), width))


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
HIP_MAIN_BYTES, HIP_NEW_BYTES = 450, 276
"""Width of a line of ``hip_main.dat`` and of ``hip2.dat`` (CDS ReadMe of I/239 and I/311)."""


@reads("Hipparcos")
def read_hipparcos(path: Path, *, max_magnitude: float | None = None) -> ReadStars:
    """Read ``hip_main.dat`` (I/239) or ``hip2.dat`` (I/311).

    ``hip_main.dat`` has lines of 450 bytes, ICRS positions in degrees at J1991.25 and Johnson V; ``hip2.dat`` has 276
    bytes, radians and Hp. Identifiers are the negative Hipparcos numbers. 263 entries of ``hip_main.dat`` have no
    position and are left out. Stars are double that have several components or a curved or orbital solution.

    References
    ----------
    .. [1] CDS ReadMe of I/239, The Hipparcos and Tycho Catalogs (ESA 1997): byte-by-byte description.
    .. [2] CDS ReadMe of I/311, Hipparcos, the New Reduction (van Leeuwen 2007): byte-by-byte description.
    """
    lines = lines_of(path, (HIP_MAIN_BYTES, HIP_NEW_BYTES))
    new = lines.text.shape[1] == HIP_NEW_BYTES
    places = HIP_NEW if new else HIP_MAIN
    column = {name: lines.numbers(place) for name, place in places.items() if name != "flag"}
    bv = column["bv"]
    columns = {
        "ids": -lines.integers(places["hip"]),
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
    return stars_of(columns, band="Hp" if new else "V", record=lines.record, max_magnitude=max_magnitude)


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
_USUAL_BT_VT = 0.8  # mag, assumed for stars that lack one of the two
TYCHO_BYTES, TYCHO_SUPPLEMENT_BYTES, TYCHO_SUPPLEMENT_SHORT_BYTES = 206, 122, 115
"""Width of a line of ``tyc2.dat`` and of the supplements, with and without their last columns (CDS ReadMe of I/259)."""


@reads("Tycho-2")
def read_tycho2(path: Path, *, max_magnitude: float | None = None) -> ReadStars:
    """Read ``tyc2.dat`` or a part of it, or ``suppl_1.dat`` (I/259); magnitudes are Johnson V.

    Lines have 206 bytes, in the supplements 122. Positions are ICRS: mean ones at J2000, or where there is
    none (flag X) the one observed at about J1991.5; in the supplement J1991.25. The errors of mean positions, which
    are given at their mean epochs, are propagated to J2000. Johnson magnitudes follow from Tycho's by
    ``V = VT - 0.090 (BT - VT)`` and ``B - V = 0.850 (BT - VT)`` (Note 7); where one of the two is missing, BT - VT is
    taken as 0.8; where the supplement has Hp, that stands for V. Identifiers are
    ``TYC1 * 1,000,000 + TYC2 * 10 + TYC3``. Stars are double that Tycho solved as such or whose next entry is within
    5 arcsec. The brightest stars are in the supplement only: give both files.

    Source: CDS ReadMe of I/259, The Tycho-2 Catalog (Hog+ 2000): byte-by-byte descriptions and notes.
    """
    lines = lines_of(path, (TYCHO_BYTES, TYCHO_SUPPLEMENT_BYTES, TYCHO_SUPPLEMENT_SHORT_BYTES))
    main = lines.text.shape[1] == TYCHO_BYTES
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
    double = column["near"] <= 10.0 * CLOSE_ARCSEC  # the column is in 0.1 arcsec
    if main:
        double |= np.isin(lines.words(TYCHO["solution"]), (b"D", b"P")) | (lines.words(TYCHO["mean_flag"]) == b"P")
    else:
        has_hp = lines.words(TYCHO_SUPPLEMENT["magnitude_flag"]) == b"H"
        columns["magnitude"] = np.where(has_hp, vt, columns["magnitude"])
    columns["is_double"] = double.astype(np.float64)
    region, number, component = (lines.integers(places[name]) for name in ("tyc1", "tyc2", "tyc3"))
    columns["ids"] = region * 1_000_000 + number * 10 + component
    return stars_of(columns, band="V", record=lines.record, max_magnitude=max_magnitude)


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
