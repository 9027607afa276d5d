"""SUMFILEs of stereophotoclinometry (SPC): camera, pose and landmarks of one image in axes of the body.

Source opened: the wiki of SPC at the Planetary Science Institute, page SUMFILES (fields, order and an example). Pixels
count from 1, as arrays of Fortran do: the page does not say so, and :class:`Sumfile` has them from 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike.core.arrays import Float, as_finite, unit
from giantlike.core.errors import DataError
from giantlike.core.time import time_from_utc, utc_text
from giantlike.core.values import Value

if TYPE_CHECKING:
    from astropy.time import Time

FIRST_PIXEL = 1.0  # coordinate of the center of the first pixel in SPC
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
_HUGE = 1e75  # numbers of a line are smaller, so that products of four of them do not overflow
_ORTHOGONAL = (
    1e-6  # largest departure of the camera's axes from orthogonal unit vectors: they are written with 10 digits
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sumfile(Value):
    """Content of a SUMFILE."""

    name: str  # of the image; SPC takes up to 12 characters
    epoch: Time  # mid-exposure; written to the millisecond
    columns: int
    rows: int
    thresholds_dn: tuple[int, int]  # least and largest valid pixel value
    focal_length_mm: float  # mm
    center_px: Float  # optical axis in the image; 0 is the center of the first pixel
    pixels_per_mm: Float  # (2, 3); ``K``: (x, y) mm of the focal plane is at ``center + K (x, y, x y)``
    target_km: Float  # in body axes; from the spacecraft to the center of the body, as it is seen
    camera_from_body: Rotation
    sun_direction_body: Float  # from the body to the Sun
    sigma_target_km: Float  # in body axes
    sigma_pointing_rad: Float  # (3,), camera axes
    landmarks_px: Mapping[str, Float] = field(default_factory=dict)  # (2,); by name; 0 is the center of the first one

    def __post_init__(self) -> None:
        for name in ("center_px", "pixels_per_mm", "target_km", "sun_direction_body", "sigma_target_km",
                     "sigma_pointing_rad"):  # fmt: skip
            shape = {"center_px": (2,), "pixels_per_mm": (2, 3)}.get(name, (3,))
            object.__setattr__(self, name, as_finite(getattr(self, name), shape, name))
        Value.__post_init__(self)


def write_sumfile(path: str | Path, content: Sumfile) -> None:
    """Write a SUMFILE."""
    axes = content.camera_from_body.as_matrix()
    k = content.pixels_per_mm
    center = content.center_px + FIRST_PIXEL
    lines = [
        content.name,
        _spice_utc(content.epoch),
        f"{content.columns:6d}{content.rows:6d}{content.thresholds_dn[0]:6d}{content.thresholds_dn[1]:6d}"
        f"{'':<40}NPX, NLN, THRSH",
        numbers_line([content.focal_length_mm, *center], "MMFL, CTR"),
        numbers_line(content.target_km, "SCOBJ"),
        *(numbers_line(axis, name) for axis, name in zip(axes, ("CX", "CY", "CZ"), strict=True)),
        numbers_line(content.sun_direction_body, "SZ"),
        "".join(f"{value:11.5f}" for value in k.ravel()) + "   K-MATRIX",
        "".join(f"{_fortran(0.0, 5):>15}" for _ in range(4)) + "   DISTORTION",
        numbers_line(content.sigma_target_km, "SIGMA_VSO"),
        numbers_line(content.sigma_pointing_rad, "SIGMA_PTG"),
        "LANDMARKS",
        *(f"{name:<6}{x + FIRST_PIXEL:10.3f}{y + FIRST_PIXEL:10.3f}" for name, (x, y) in content.landmarks_px.items()),
        "LIMB FITS",
        "END FILE",
    ]
    write_text_atomic(Path(path), "\n".join(lines) + "\n")


def read_sumfile(path: str | Path) -> Sumfile:
    """Read a SUMFILE."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, f"cannot be read as a SUMFILE: {error}") from error
    if len(lines) < 14:
        raise DataError(path, f"is no SUMFILE: it needs at least 14 lines, got {len(lines)}")
    values = [read_numbers(path, lines, number, count) for number, count in
              ((2, 4), (3, 3), (4, 3), (8, 3), (9, 6), (11, 3), (12, 3))]  # fmt: skip
    size, optics, target, sun, k, sigma_target, sigma_pointing = values
    if not sun @ sun:
        raise DataError(path, "line 9: SZ must not be zero")
    return Sumfile(
        name=lines[0].strip(),
        epoch=_read_epoch(path, lines[1]),
        columns=int(size[0]),
        rows=int(size[1]),
        thresholds_dn=(int(size[2]), int(size[3])),
        focal_length_mm=float(optics[0]),
        center_px=optics[1:] - FIRST_PIXEL,
        pixels_per_mm=k.reshape(2, 3),
        target_km=target,
        camera_from_body=Rotation.from_matrix(read_axes(path, lines, 5, "CX, CY, CZ")),
        sun_direction_body=unit(sun),
        sigma_target_km=sigma_target,
        sigma_pointing_rad=sigma_pointing,
        landmarks_px=dict(_read_landmarks(path, lines)),
    )


def _read_landmarks(path: Path, lines: list[str]) -> Iterator[tuple[str, Float]]:
    """Yield names and positions of the landmarks, from the line after ``LANDMARKS`` to one of a single word or two."""
    start = next((number for number, line in enumerate(lines) if line.strip() == "LANDMARKS"), len(lines))
    for number in range(start + 1, len(lines)):
        words = lines[number].split()
        if len(words) < 3:
            return
        yield words[0], read_numbers(path, lines, number, 2, skip=1) - FIRST_PIXEL


def read_axes(path: Path, lines: list[str], first: int, names: str) -> Float:
    """Three orthogonal unit vectors (3, 3), right-handed, of three lines."""
    axes = np.array([read_numbers(path, lines, number, 3) for number in range(first, first + 3)])
    if np.abs(axes @ axes.T - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(axes) < 0.0:
        where = f"lines {first + 1} to {first + 3}"
        raise DataError(path, f"{where}: {names} must be orthogonal unit vectors, right-handed")
    return axes


def read_numbers(path: Path, lines: list[str], number: int, count: int, *, skip: int = 0) -> Float:
    """Numbers of a line, which Fortran may have written with D as the exponent."""
    words = lines[number].replace("D", "E").replace("d", "e").split()[skip : skip + count]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) < count or not (np.abs(values) < _HUGE).all():
        raise DataError(path, f"line {number + 1}: {count} numbers are needed, got {lines[number].strip()!r}")
    return np.array(values)


def _read_epoch(path: Path, line: str) -> Time:
    try:
        year, month, day, clock = line.split()[:4]
        return time_from_utc(f"{int(year):04d}-{_MONTHS.index(month.upper()) + 1:02d}-{int(day):02d}T{clock}")
    except ValueError as error:
        raise DataError(path, f"line 2: a date such as 2014 NOV 12 17:20:03.128 is needed, got {line!r}") from error


def _spice_utc(epoch: Time) -> str:
    day, _, clock = utc_text(epoch, digits=3).partition("T")
    year, month, of_month = day.split("-")
    return f"{year} {_MONTHS[int(month) - 1]} {of_month} {clock}"


def numbers_line(values: Float | list[float], name: str) -> str:
    """Numbers of a line with 10 digits, and their name."""
    return "".join(f"{_fortran(float(value), 10):>20}" for value in values) + f"   {name}"


def _fortran(value: float, digits: int) -> str:
    """A number as Fortran's D format has it: 0.1234567890D+02."""
    mantissa, exponent = f"{value:.{digits - 1}E}".split("E")
    sign, figures = ("-" if mantissa.startswith("-") else ""), mantissa.lstrip("-").replace(".", "")
    power = int(exponent) + 1 if value else 0
    return f"{sign}0.{figures}D{'-' if power < 0 else '+'}{abs(power):02d}"
