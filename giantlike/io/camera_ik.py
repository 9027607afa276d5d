"""Pinhole cameras from SPICE instrument kernels (text, ``INS<id>_...`` keywords).

There is no standard for what an IK says of a camera. Read are FOCAL_LENGTH (mm), PIXEL_SIZE or PIXEL_PITCH (mm, or
micrometers where the number is 0.5 or more: no pixel is half a millimeter), the center (CCD_CENTER, FOV_CENTER_PIXEL,
BORESIGHT_PIXEL or BORESIGHT_SAMPLE and BORESIGHT_LINE) and the size (PIXEL_SAMPLES, PIXEL_LINES), as in the kernels
of OSIRIS-REx, Mars Science Laboratory and others at naif.jpl.nasa.gov. Where the first pixel is counted from differs
by mission: it is told by the caller, or found when the center is just the middle of the detector.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from giantlike.camera_models import PinholeModel
from giantlike.core.errors import DataError, InputError
from giantlike.io.mission_frame import Boresight, ImportedCamera, from_mission_frame

_BLOCK = re.compile(r"\\begindata(.*?)(?=\\begintext|\Z)", re.DOTALL)
_ASSIGNMENT = re.compile(r"(\S+?)\s*\+?=\s*(\([^)]*\)|'[^']*'|\S+)")
_ITEM = re.compile(r"'([^']*)'|([^\s,()']+)")
_CENTERS = ("CCD_CENTER", "FOV_CENTER_PIXEL", "BORESIGHT_PIXEL", "PIXEL_CENTER")
_LENS_WORDS = ("DISTORTION", "OD_K", "DISTOR", "DISTCOEFF")
_MICROMETERS_FROM = 0.5


def read_ik_camera(
    path: str | Path,
    instrument_id: int,
    *,
    first_pixel: float | None = None,
    signs: tuple[int, int] = (1, 1),
    boresight: Boresight = "+z",
) -> ImportedCamera:
    """Read the geometry of one camera from an instrument kernel.

    Parameters
    ----------
    path : path-like
        Text kernel.
    instrument_id : int
        NAIF code, such as -64361.
    first_pixel : float, optional
        What the mission calls the center of the first pixel: 0, 1 or 0.5 (edges counted from 0). By default the one
        for which the center is the middle of the detector.
    signs : (int, int)
        Sense of the instrument frame's x along columns and y along rows, 1 or -1; kernels say so in their text only.
    boresight : {"+z", "-z"}
        Sense of the instrument frame's z axis.

    Raises
    ------
    DataError
        The file is missing or no text kernel, a keyword is missing, or the origin of its pixels can't be told.
    """
    keywords = _keywords(Path(path), f"INS{instrument_id}_")
    try:
        focal_mm = _number(keywords, "FOCAL_LENGTH")
        pitch_mm = _pair(keywords, ("PIXEL_SIZE", "PIXEL_PITCH"))
        pitch_mm = np.where(pitch_mm >= _MICROMETERS_FROM, pitch_mm * 1e-3, pitch_mm)
        size = np.array([_number(keywords, "PIXEL_SAMPLES"), _number(keywords, "PIXEL_LINES")])
        center = _center(keywords)
        origin = _origin(center, size) if first_pixel is None else first_pixel
        parameters = {
            "fx_px": signs[0] * focal_mm / float(pitch_mm[0]),
            "fy_px": signs[1] * focal_mm / float(pitch_mm[1]),
            "cx_px": float(center[0]) - origin,
            "cy_px": float(center[1]) - origin,
        }
        camera = from_mission_frame(
            PinholeModel, parameters, name=str(instrument_id), columns=int(size[0]), rows=int(size[1]),
            boresight=boresight,
        )  # fmt: skip
    except InputError as error:
        raise DataError(path, f"instrument {instrument_id}: {error}") from error
    ignored = tuple(sorted(key for key in keywords if any(word in key for word in _LENS_WORDS)))
    return ImportedCamera(
        name=camera.name,
        model=camera.model,
        columns=camera.columns,
        rows=camera.rows,
        camera_from_mission=camera.camera_from_mission,
        rows_reversed=camera.rows_reversed,
        ignored=ignored,
    )


def _keywords(path: Path, prefix: str) -> dict[str, list[str]]:
    """Values of all keywords of one instrument, by what follows its number."""
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise DataError(path, f"cannot read instrument kernel: {error.strerror}") from error
    found: dict[str, list[str]] = {}
    for block in _BLOCK.findall(text):
        for key, value in _ASSIGNMENT.findall(block):
            if key.startswith(prefix):
                items = [quoted or bare for quoted, bare in _ITEM.findall(value)]
                found.setdefault(key.removeprefix(prefix), []).extend(items)
    if not found:
        raise DataError(path, f"holds no keyword that begins with {prefix}")
    return found


def _numbers(keywords: Mapping[str, list[str]], key: str) -> list[float]:
    try:
        return [float(item.replace("D", "E").replace("d", "e")) for item in keywords[key]]
    except ValueError as error:
        raise InputError(f"{key} must be numbers, got {' '.join(keywords[key])}") from error


def _number(keywords: Mapping[str, list[str]], key: str) -> float:
    if key not in keywords:
        raise InputError(f"{key} is missing; there are {', '.join(sorted(keywords))}")
    return _numbers(keywords, key)[0]


def _pair(keywords: Mapping[str, list[str]], keys: tuple[str, ...]) -> np.ndarray:
    for key in keys:
        if key in keywords:
            values = _numbers(keywords, key)
            return np.array((values * 2)[:2] if len(values) == 1 else values[:2])
    raise InputError(f"one of {', '.join(keys)} is needed; there are {', '.join(sorted(keywords))}")


def _center(keywords: Mapping[str, list[str]]) -> np.ndarray:
    if "BORESIGHT_SAMPLE" in keywords and "BORESIGHT_LINE" in keywords:
        return np.array([_number(keywords, "BORESIGHT_SAMPLE"), _number(keywords, "BORESIGHT_LINE")])
    return _pair(keywords, _CENTERS)


def _origin(center: np.ndarray, size: np.ndarray) -> float:
    for origin in (0.0, 0.5, 1.0):
        if np.allclose(center, (size - 1) / 2 + origin, rtol=0, atol=1e-6):
            return origin
    raise InputError(
        f"the center {center.tolist()} is not the middle of a detector of {size.tolist()} pixels: say what the first "
        "pixel is called, 0, 0.5 or 1"
    )
