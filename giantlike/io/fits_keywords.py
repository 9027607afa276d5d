"""Time, exposure, attitude and position of the camera from FITS header keywords."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.frames import rotation_from_xyzw
from giantlike.core.observer import ObserverState
from giantlike.core.time import time_from_et
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.io.decoded import HeaderValue
from giantlike.io.label_times import add_seconds, midpoint

if TYPE_CHECKING:
    from astropy.time import Time

QUATERNION_KEYS = ("GL_QX", "GL_QY", "GL_QZ", "GL_QW")  # keywords of camera_from_inertial, scalar last
OBSERVER_KEYS = ("GL_OBSX", "GL_OBSY", "GL_OBSZ", "GL_OBSVX", "GL_OBSVY", "GL_OBSVZ")
"""Keywords of the spacecraft's position (km) and velocity (km/s), solar system barycenter, ICRF."""

_SUN_FROM_SPACECRAFT = ("SPCSSCX", "SPCSSCY", "SPCSSCZ", "SPCSSCVX", "SPCSSCVY", "SPCSSCVZ")
_SCALES = {"UTC": "utc", "TAI": "tai", "IAT": "tai", "TT": "tt", "TDT": "tt", "ET": "tt", "TDB": "tdb", "UT1": "ut1"}
_EXPOSURE_KEYS = ("XPOSURE", "EXPTIME", "EXPOSURE", "NEAR-010")
_ISO = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}(:\d{2}(\.\d*)?)?Z?")
_MILLISECONDS = re.compile(r"(?<![a-z])(ms|msecs?|milli-?sec\w*)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Card:
    """A keyword's value and comment."""

    value: HeaderValue
    comment: str


def fits_exposure_s(cards: Mapping[str, Card]) -> float | None:
    """Exposure time: the first of ``XPOSURE``, ``EXPTIME``, ``EXPOSURE`` that is a number.

    Returns None where no card gives it.

    Notes
    -----
    They are seconds unless the comment names milliseconds (New Horizons writes ``EXPOSURE = 500 / Exposure
    Time (1 ms)``). ``NEAR-010`` of NEAR MSI is read in the same way.
    """
    return next((s for s in (_seconds(cards.get(key)) for key in _EXPOSURE_KEYS) if s is not None), None)


def fits_epoch(cards: Mapping[str, Card], exposure_s: float | None) -> Time | None:
    """Mid-exposure epoch of a header.

    ``exposure_s`` s: exposure time, for headers with a start only; returns None where the header does not determine it.

    Notes
    -----
    The first of these that is there and can be read:

    1. ``DATE-AVG``, ``MJD-AVG``: the middle, by the FITS standard;
    2. ``SPCSCET`` (New Horizons): the middle of the observation, TDB seconds past J2000;
    3. ``DATE-OBS``, ``MJD-OBS`` where the comment says that it is the middle (``mid...``);
    4. the middle between a start and ``DATE-END`` (``MJD-END``), where the start is ``DATE-BEG``,
       ``MJD-BEG``, else ``DATE-OBS``, ``MJD-OBS``;
    5. that start plus half of ``TELAPSE``, or of the exposure time where there is no ``TELAPSE``.

    ``DATE-OBS`` counts as a start, which is the usual reading, unless its comment says otherwise. A date
    without a time is completed by ``TIME-OBS``, else not used; a start without any duration is not used.
    Dates are in the scale that ``TIMESYS`` names, UTC without it (or where the date ends in ``Z``).
    """
    scale = _SCALES.get(str(cards["TIMESYS"].value).strip().upper()) if "TIMESYS" in cards else "utc"
    average = _time_of(cards, "AVG", scale)
    if average is not None:
        return average
    mid_et = _number(cards.get("SPCSCET"))
    if mid_et is not None:
        return time_from_et(mid_et)
    observed, role = _time_of(cards, "OBS", scale), _role_of_date_obs(cards)
    if observed is not None and role == "middle":
        return observed
    start = _time_of(cards, "BEG", scale)
    if start is None and role == "start":
        start = observed
    if start is None:
        return None
    end = _time_of(cards, "END", scale)
    if end is not None and end >= start:
        return midpoint(start, end)
    elapsed_s = _seconds(cards.get("TELAPSE"))
    duration_s = exposure_s if elapsed_s is None else elapsed_s
    return None if duration_s is None else add_seconds(start, duration_s / 2.0)


def fits_attitude(cards: Mapping[str, Card]) -> Rotation | None:
    """A priori attitude ``camera_from_inertial`` of :data:`QUATERNION_KEYS`.

    Returns None when there are none of them. Raises ValueError: some are missing, or they make no unit quaternion.
    """
    values = _group(cards, QUATERNION_KEYS)
    return None if values is None else rotation_from_xyzw(values, "the quaternion GL_QX, GL_QY, GL_QZ, GL_QW")


def fits_observer(cards: Mapping[str, Card], epoch: Time | None) -> ObserverState | None:
    """State of the spacecraft with respect to the solar system barycenter.

    ``epoch``: mid-exposure; returns None when the header has none. Raises ValueError: some of :data:`OBSERVER_KEYS` are
    missing.

    Notes
    -----
    Read from :data:`OBSERVER_KEYS`; else from ``SPCSSCX``, ``SPCSSCY``, ``SPCSSCZ``, ``SPCSSCVX``, ``SPCSSCVY``,
    ``SPCSSCVZ`` (New Horizons), the vector from the spacecraft to where the Sun was one light time ago, to which the
    Sun's own barycentric state of that time is added.
    """
    values = _group(cards, OBSERVER_KEYS)
    if values is not None:
        return ObserverState(position_km=np.array(values[:3]), velocity_km_s=np.array(values[3:]))
    numbers = [_number(cards.get(key)) for key in _SUN_FROM_SPACECRAFT]
    sun = [n for n in numbers if n is not None and abs(n) < 1e30]  # -1E+32 stands for unknown
    if len(sun) < 6 or epoch is None:
        return None
    position, velocity = _sun_state(add_seconds(epoch, -math.hypot(*sun[:3]) / SPEED_OF_LIGHT_KM_S))
    return ObserverState(position_km=position - np.array(sun[:3]), velocity_km_s=velocity - np.array(sun[3:]))


def _sun_state(epoch: Time) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,), km, and velocity (3,), km/s, of the Sun from the barycenter, ICRF, to about 100 km."""
    from astropy.coordinates import get_body_barycentric_posvel

    position, velocity = get_body_barycentric_posvel("sun", epoch, ephemeris="builtin")
    return position.xyz.to_value("km"), velocity.xyz.to_value("km/s")


def _role_of_date_obs(cards: Mapping[str, Card]) -> str:
    """Meaning of DATE-OBS by its comment: ``middle``, ``start`` (the default) or ``unclear``."""
    card = cards.get("DATE-OBS") or cards.get("MJD-OBS")
    comment = "" if card is None else card.comment.lower()
    if "mid" in comment:
        return "middle"
    ends = any(word in comment for word in ("end of", "stop", "close"))
    return "unclear" if ends and "start" not in comment and "begin" not in comment else "start"


def _time_of(cards: Mapping[str, Card], suffix: str, scale: str | None) -> Time | None:
    """Epoch of ``DATE-suffix``, else of ``MJD-suffix``."""
    from astropy.time import Time

    if scale is None:
        return None
    date = cards.get(f"DATE-{suffix}")
    if date is not None:
        text = str(date.value).strip()
        clock = cards.get("TIME-OBS")
        if suffix == "OBS" and clock is not None and len(text) == 10:
            text = f"{text}T{str(clock.value).strip()}"
        if _ISO.fullmatch(text):
            plain = text.removesuffix("Z").replace(" ", "T")
            try:
                return Time(plain, format="isot", scale="utc" if text.endswith("Z") else scale)
            except ValueError:
                return None
    mjd = _number(cards.get(f"MJD-{suffix}"))
    return None if mjd is None or not 0.0 < mjd < 1e6 else Time(mjd, format="mjd", scale=scale)


def _seconds(card: Card | None) -> float | None:
    number = _number(card)
    if card is None or number is None or not 0.0 <= number < 1e9:
        return None
    return number / 1e3 if _MILLISECONDS.search(card.comment) else number


def _number(card: Card | None) -> float | None:
    if card is None or isinstance(card.value, bool):
        return None
    try:
        number = float(card.value)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _group(cards: Mapping[str, Card], keys: tuple[str, ...]) -> list[float] | None:
    """Numbers of keywords that only make sense together, None when none of them is there."""
    if not any(key in cards for key in keys):
        return None
    numbers = {key: _number(cards.get(key)) for key in keys}
    missing = [key for key, number in numbers.items() if number is None]
    if missing:
        raise ValueError(f"FITS keyword {missing[0]} must be a number: {', '.join(keys)} are needed together")
    return [number for number in numbers.values() if number is not None]
