"""Picture sequence files (PSF) of JPL's orbit programs: cameras, pointing and image positions as FORTRAN namelists.

Sources opened: the description at ``https://ssd.jpl.nasa.gov/dat/sats/format.txt`` (order and names of the namelists,
and the variables of the first two), and for the other variables and their meaning the reader of Tudat (``readPsfFile``,
``PsfCameraProjectionModel``), which was checked by its authors on the file of Voyager 2 at Neptune.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike.core.arrays import Float, require
from giantlike.core.frames import east_north, radec_from_direction, rotate
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.values import Value
from giantlike.core.version import VERSION

_CAMERA = "A"  # name of the one camera of a file: names are letters
_TWIST_OF_EAST_DEG = 90.0  # twist of a camera whose columns run to the east; it grows towards the north
_N_COMMENTS = 3
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")


class PictureObject(StrEnum):
    """Kind of object in a picture."""

    PLANET = "PLAN"
    SATELLITE = "SAT"
    SMALL_BODY = "ROCK"
    STAR = "STAR"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PsfCamera(Value):
    """A camera: ``(pixel, line) = center_px + pixels_per_mm (x, y)``, with x and y in mm in the focal plane."""

    columns: int
    rows: int
    focal_length_mm: float  # mm
    center_px: Float
    pixels_per_mm: Float  # (2, 2) px/mm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PsfImage(Value):
    """Place of a body or star in a picture."""

    kind: PictureObject
    name: str
    number: int  # NAIF code of a body, catalog number of a star; 0 where there is none
    observed_px: Float  # (2,); measured pixel and line
    correction_px: Float  # (2,); shift by the lens: without it the camera of the file holds
    sigma_px: Float  # (2,)
    radec_deg: tuple[float, float] | None = None  # of a star: its catalog position at the epoch, without aberration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PsfPicture(Value):
    """A picture with its pointing."""

    name: str
    et: float  # Mid-exposure
    exposure_s: float
    camera_from_inertial: Rotation
    images: tuple[PsfImage, ...]


def write_psf(
    path: str | Path,
    camera: PsfCamera,
    pictures: Iterable[PsfPicture],
    *,
    spacecraft: str = "UNKNOWN",
    name: str = "UNKNOWN",
    comments: Sequence[str] = (),
) -> int:
    """Write pictures of one camera as a picture sequence file."""
    require(len(comments) <= _N_COMMENTS, f"a picture sequence file has {_N_COMMENTS} comments, got {len(comments)}")
    lines = [*_identification(spacecraft, name, comments), *_camera(camera)]
    count = 0
    for number, picture in enumerate(pictures, start=1):
        lines += _picture(picture, number)
        count += len(picture.images)
    lines += _group("PIC", {"PICNM": "END"})
    write_text_atomic(Path(path), "\n".join(lines) + "\n")
    return count


def radec_twist_deg(camera_from_inertial: Rotation) -> tuple[float, float, float]:
    """Right ascension and declination of the boresight and twist of a picture, deg."""
    columns, _, boresight = rotate(camera_from_inertial.inv(), np.eye(3))
    ra_deg, dec_deg = (float(angle) for angle in radec_from_direction(boresight))
    east, north = east_north(ra_deg, dec_deg)
    turn_deg = math.degrees(math.atan2(float(columns @ north), float(columns @ east)))
    return ra_deg, dec_deg, math.remainder(turn_deg + _TWIST_OF_EAST_DEG, 360.0)


def _identification(spacecraft: str, name: str, comments: Sequence[str]) -> list[str]:
    fields: dict[str, Any] = {
        "SCID": spacecraft,
        "PSFID": name,
        "PSFTIM": _calendar(time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime())),
        "PSFPRG": f"giantlike {VERSION}",
    }
    if comments:
        fields["PSFCOM"] = list(comments)
    return _group("ID", fields | {"EQUNOX": 2000, "NCAM": 1})


def _camera(camera: PsfCamera) -> list[str]:
    columns = camera.pixels_per_mm.T.tolist()
    return _group(
        "CAM",
        {
            "CAMID(1)": _CAMERA,
            "FL(1)": camera.focal_length_mm,
            "PLCTR(1,1)": camera.center_px.tolist(),
            "PLSIZ(1,1)": [-0.5, camera.columns - 0.5, -0.5, camera.rows - 0.5],
            "KMAT(1,1,1)": columns[0],
            "KMAT(1,2,1)": columns[1],
            "KMAT(1,3,1)": [0.0, 0.0],
            "EM(1,1)": [0.0] * 3,
            "EM(4,1)": [0.0] * 3,
            "OFFSET(1,1)": [0.0] * 3,
        },
    )


def _picture(picture: PsfPicture, number: int) -> Iterator[str]:
    ra_deg, dec_deg, twist_deg = radec_twist_deg(picture.camera_from_inertial)
    yield from _group(
        "PIC",
        {
            "PICNM": picture.name,
            "PICNO": number,
            "TOB": _calendar(utc_text(time_from_et(picture.et + 0.5 * picture.exposure_s))),
            "CAMERA": _CAMERA,
            "EXPTIM": picture.exposure_s,
            "PICDEL": 0,
            "RA": ra_deg,
            "DEC": dec_deg,
            "TWIST": twist_deg,
        },
    )
    for image in picture.images:
        fields: dict[str, Any] = {"IMGTYP": str(image.kind), "IMG": image.name, "IMGID": image.number, "USE": 0}
        for key, pair in (("Z", image.observed_px), ("ZC", image.correction_px), ("SIG", image.sigma_px)):
            fields[key] = pair.tolist()
        if image.radec_deg is not None:
            fields |= {"STRA": image.radec_deg[0], "STDEC": image.radec_deg[1]}
        yield from _group("IM", fields)
    yield from _group("IM", {"IMGTYP": "END", "IMG": "END"})


def _calendar(utc: str) -> str:
    """``2024 FEB 01 05:59:30`` for ``2024-02-01T05:59:30``."""
    date, _, clock = utc.partition("T")
    year, month, day = date.split("-")
    return f"{year} {_MONTHS[int(month) - 1]} {day} {clock}"


def _group(name: str, fields: dict[str, Any]) -> list[str]:
    """Lines of a namelist."""
    return [f" ${name}", *(f"  {key} = {_value(value)}," for key, value in fields.items()), " $END"]


def _value(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_value(each) for each in value)
    if isinstance(value, str):
        require("\n" not in value, f"a picture sequence file needs one line of text here, got {value!r}")
        return "'" + value.replace("'", "''") + "'"
    return repr(value)
