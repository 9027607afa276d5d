"""Pinhole cameras from SPICE instrument kernels (text, ``INS<id>_...`` keywords).

No standard fixes the camera keywords of an IK. Read are FOCAL_LENGTH (mm), PIXEL_SIZE or PIXEL_PITCH (mm, or
micrometers where the number is 0.5 or more: no pixel is half a millimeter), the center (CCD_CENTER, FOV_CENTER_PIXEL,
BORESIGHT_PIXEL or BORESIGHT_SAMPLE and BORESIGHT_LINE) and the size (PIXEL_SAMPLES, PIXEL_LINES), as in the kernels
of OSIRIS-REx, Mars Science Laboratory and others at naif.jpl.nasa.gov. The coordinate of the first pixel differs by
mission: the caller gives it, or it is the one for which the center is the middle of the detector.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from giantlike._system.reading import check, reads
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.io.mission_frame import Boresight, ImportedCamera, from_mission_frame

_BLOCK = re.compile(r"\\begindata(.*?)(?=\\begintext|\Z)", re.DOTALL)
_VALUE = re.compile(r"\s*(\([^()]*+\)|'[^']*+'|\S+)")  # no parenthesis within one: a list that is not closed ends there
_ITEM = re.compile(r"'([^']*)'|([^\s,()']+)")
_CENTERS = ("CCD_CENTER", "FOV_CENTER_PIXEL", "BORESIGHT_PIXEL", "PIXEL_CENTER")
_LENS_WORDS = ("DISTORTION", "OD_K", "DISTOR", "DISTCOEFF")
_MICROMETERS_FROM = 0.5  # larger pixel sizes are in micrometers, smaller ones in mm: no detector has pixels of 0.5 mm
_CENTER_PX = 1e-6  # the center is the middle of the detector to this: rounding of the kernel's decimal text


@reads("a SPICE instrument kernel")
def read_ik_camera(
    path: str | Path,
    instrument_id: int,
    *,
    first_pixel: float | None = None,
    signs: tuple[int, int] = (1, 1),
    boresight: Boresight = "+z",
) -> ImportedCamera:
    """Read the geometry of one camera from an instrument kernel.

    ``first_pixel``: coordinate of the center of the first pixel (0, 1 or 0.5); ``signs``: sense, 1 or -1, of the
    frame's x along columns and y along rows (kernels state both in comments only).
    """
    keywords = _keywords(Path(path).read_text(encoding="ascii", errors="replace"), f"INS{instrument_id}_")
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
        PinholeModel, parameters, name=str(instrument_id), columns=int(size[0]), rows=int(size[1]), boresight=boresight
    )
    return replace(camera, ignored=tuple(sorted(key for key in keywords if any(word in key for word in _LENS_WORDS))))


def _keywords(text: str, prefix: str) -> dict[str, list[str]]:
    """Values of all keywords of one instrument, by the part of the name after the prefix."""
    found: dict[str, list[str]] = {}
    for block in _BLOCK.findall(text):
        for key, value in _assignments(block):
            if key.startswith(prefix):
                items = [quoted or bare for quoted, bare in _ITEM.findall(value)]
                found.setdefault(key.removeprefix(prefix), []).extend(items)
    check(bool(found), f"it holds no keyword that begins with {prefix}")
    return found


def _assignments(block: str) -> Iterator[tuple[str, str]]:
    """Yield keys and values of ``KEY = VALUE`` and ``KEY += VALUE``; every character is looked at once."""
    position = 0
    while (equals := block.find("=", position)) >= 0:
        before = block[position:equals].rstrip().removesuffix("+").split()
        value = _VALUE.match(block, equals + 1)
        position = equals + 1 if value is None else value.end()
        if before and value is not None:
            yield before[-1], value[1]


def _numbers(keywords: Mapping[str, list[str]], key: str) -> list[float]:
    try:
        return [float(item.replace("D", "E").replace("d", "e")) for item in keywords[key]]
    except ValueError as error:
        raise InputError(f"{key} must be numbers, got {' '.join(keywords[key])}") from error


def _number(keywords: Mapping[str, list[str]], key: str) -> float:
    require(key in keywords, f"{key} is missing; there are {', '.join(sorted(keywords))}")
    return _numbers(keywords, key)[0]


def _pair(keywords: Mapping[str, list[str]], keys: tuple[str, ...]) -> Float:
    for key in keys:
        if key in keywords:
            values = _numbers(keywords, key)
            return np.array((values * 2)[:2] if len(values) == 1 else values[:2])
    raise InputError(f"one of {', '.join(keys)} is needed; there are {', '.join(sorted(keywords))}")


def _center(keywords: Mapping[str, list[str]]) -> Float:
    if "BORESIGHT_SAMPLE" in keywords and "BORESIGHT_LINE" in keywords:
        return np.array([_number(keywords, "BORESIGHT_SAMPLE"), _number(keywords, "BORESIGHT_LINE")])
    return _pair(keywords, _CENTERS)


def _origin(center: Float, size: Float) -> float:
    """Coordinate of the first pixel for which the center is the middle of the detector."""
    for origin in (0.0, 0.5, 1.0):
        if np.allclose(center, (size - 1) / 2 + origin, rtol=0, atol=_CENTER_PX):
            return origin
    raise InputError(
        f"the center {center.tolist()} is not the middle of a detector of {size.tolist()} pixels: give the "
        "coordinate of its first pixel, 0, 0.5 or 1 (first_pixel)"
    )
