"""Epoch and exposure from VICAR and PDS3 labels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from giantlike.core.errors import InputError
from giantlike.core.time import time_from_utc
from giantlike.io.decoded import HeaderValue

if TYPE_CHECKING:
    from astropy.time import Time

_CALENDAR = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}(:\d{2}(\.\d*)?)?Z?")
_DAY_OF_YEAR = re.compile(r"(\d{4})-(\d{3})T(\d{2}:\d{2}(?::\d{2}(?:\.\d*)?)?)Z?")
_VOYAGER_EXPOSURE = re.compile(r"\bEXP\s+(\d+(?:\.\d*)?)\s+MSEC\b")


def utc_from_label(value: object) -> Time | None:
    """Epoch of a UTC label value, ``2004-054T17:59:04.527Z`` or ``2004-02-23T17:59:04.527``; else None."""
    text = str(value).strip()
    day_of_year = _DAY_OF_YEAR.fullmatch(text)
    if day_of_year is not None:
        return _utc_of_day(int(day_of_year[1]), int(day_of_year[2]), day_of_year[3])
    if _CALENDAR.fullmatch(text) is None:
        return None
    try:
        return time_from_utc(text)
    except InputError:
        return None


def midpoint(start: Time, stop: Time) -> Time:
    """Epoch halfway between two."""
    return start + 0.5 * (stop - start)


def add_seconds(epoch: Time, seconds: float) -> Time:
    """Add elapsed time, in which a leap second counts, to an epoch."""
    from astropy.time import TimeDelta

    return epoch + TimeDelta(seconds, format="sec")


def label_exposure_s(label: Mapping[str, HeaderValue], units: Mapping[str, str]) -> float | None:
    """Exposure time of a label.

    ``label``: label items by name; ``units``: units that the label states, by item name; without one
    ``EXPOSURE_DURATION`` is in milliseconds, as the PDS3 data dictionary has it (the VICAR labels of Cassini ISS follow
    it); returns s, None where the label does not state it.

    Notes
    -----
    Read, in this order: ``EXPOSURE_DURATION``; ``EXP`` (ms) where ``SENSOR`` is ``SSI`` (Galileo); the words
    ``EXP ... MSEC`` in ``LAB03`` (Voyager ISS).
    """
    duration = _positive(label.get("EXPOSURE_DURATION"))
    if duration is not None:
        in_seconds = units.get("EXPOSURE_DURATION", "ms").strip().lower() in {"s", "sec", "second", "seconds"}
        return duration if in_seconds else duration / 1e3
    if label.get("SENSOR") == "SSI":
        milliseconds = _positive(label.get("EXP"))
        return None if milliseconds is None else milliseconds / 1e3
    voyager = _VOYAGER_EXPOSURE.search(str(label.get("LAB03", "")))
    return None if voyager is None else float(voyager[1]) / 1e3


def label_epoch(label: Mapping[str, HeaderValue], exposure_s: float | None) -> Time | None:
    """Mid-exposure epoch of a label.

    ``label``: label items by name; ``exposure_s`` s: exposure time, for labels with a start only; returns None where
    the label does not determine it.

    Notes
    -----
    Read, in this order: ``IMAGE_MID_TIME``; the middle of ``START_TIME`` and ``STOP_TIME``; ``START_TIME``
    plus half the exposure; for Galileo SSI ``IMAGE_TIME`` (where ``INSTRUMENT_NAME`` is the solid state imager)
    or the items ``SCETYEAR``, ``SCETDAY``, ``SCETHOUR``, ``SCETMIN``, ``SCETSEC``, ``SCETMSEC`` (where ``SENSOR`` is
    ``SSI``), which are the center of the exposure. ``IMAGE_TIME`` of other cameras is not read (for Cassini it is the
    closing of the shutter), nor are spacecraft clock counts. The SCET in Voyager's ``LAB02`` is the frame count
    truncated to a second, not a time of the exposure: such images need their epoch from a geometry table.

    References
    ----------
    .. [1] PDS data dictionary, ``image_time`` of Cassini ISS: time of shutter close.
    .. [2] USGS ISIS, SsiCamera and VoyagerCamera, ``ShutterOpenCloseTimes``: the time in Galileo SSI labels is the
       shutter center (others use it for the opening: half an exposure, some milliseconds, apart); Voyager's clock
       count is for the readout, seconds after the shutter has closed.
    """
    middle = utc_from_label(label.get("IMAGE_MID_TIME"))
    if middle is not None:
        return middle
    start, stop = utc_from_label(label.get("START_TIME")), utc_from_label(label.get("STOP_TIME"))
    if start is not None and stop is not None and stop >= start:
        return midpoint(start, stop)
    if start is not None and exposure_s is not None:
        return add_seconds(start, exposure_s / 2.0)
    if str(label.get("INSTRUMENT_NAME", "")).replace("_", " ").startswith("SOLID STATE IMAGING"):
        return utc_from_label(label.get("IMAGE_TIME"))
    return _galileo_epoch(label) if label.get("SENSOR") == "SSI" else None


def _galileo_epoch(label: Mapping[str, HeaderValue]) -> Time | None:
    names = ("SCETYEAR", "SCETDAY", "SCETHOUR", "SCETMIN", "SCETSEC", "SCETMSEC")
    values = [label.get(name) for name in names]
    if not all(type(value) is int for value in values):
        return None
    year, day, hour, minute, second, millisecond = (int(value) for value in values if value is not None)
    return _utc_of_day(year, day, f"{hour:02d}:{minute:02d}:{second:02d}.{millisecond:03d}")


def _utc_of_day(year: int, day: int, clock: str) -> Time | None:
    """Epoch of a day of the year; None where there is no such day or hour."""
    from astropy.time import Time

    try:
        return Time(f"{year:04d}:{day:03d}:{clock}", format="yday", scale="utc")
    except ValueError:
        return None


def _positive(value: object) -> float | None:
    """Duration of a label value; None where it is negative or a word such as ``UNK``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < 1e9:
        return None
    return float(value)
