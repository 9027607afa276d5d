"""Epochs: astropy ``Time`` at the border, ``et`` (TDB seconds past J2000) inside."""

from __future__ import annotations

import calendar
import math
import re
import warnings
from typing import TYPE_CHECKING

from giantlike.core.errors import InputError
from giantlike.core.units import J2000_JD, SECONDS_PER_DAY

if TYPE_CHECKING:
    from astropy.time import Time

_ORDINAL = re.compile(r"(\d{4})-(\d{3})T(\d{2}:\d{2}(?::\d{2}(?:\.\d*)?)?)")  # ISO 8601, ordinal date
_AMPLITUDE_S, _ECCENTRICITY, _ANOMALY_RAD = 1.657e-3, 1.671e-2, (6.239996, 1.99096871e-7)
"""DELTET/K, DELTET/EB and DELTET/M of all leap seconds kernels."""


def time_from_utc(text: str) -> Time:
    """Parse an ISO 8601 UTC epoch."""
    from astropy.time import Time

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # astropy warns of years for which leap seconds are not yet decided
        try:
            plain = text.strip().removesuffix("Z").replace(" ", "T")
            ordinal = _ORDINAL.fullmatch(plain)
            if ordinal is not None:
                if ordinal[2] == "366" and not calendar.isleap(int(ordinal[1])):  # astropy counts on into the next year
                    raise ValueError("no leap year")
                return Time(":".join(ordinal.groups()), format="yday", scale="utc")
            return Time(plain, format="isot", scale="utc")
        except ValueError as error:
            raise InputError(f"epoch {text!r} is not ISO 8601 UTC, such as 2018-12-01T10:07:11.123") from error


def utc_text(epoch: Time, digits: int = 6) -> str:
    """Return the ISO 8601 UTC text of an epoch, to the microsecond or to other digits of a second."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        utc = epoch.utc.copy()
        utc.precision = digits
        return str(utc.isot)


def et_from_time(epoch: Time) -> float:
    """Return TDB seconds past J2000: of an epoch in TDB as it is, else by SPICE's model, up to 30 us from astropy's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        known = epoch if epoch.scale == "tdb" else epoch.tt
    seconds = float(((known.jd1 - J2000_JD) + known.jd2) * SECONDS_PER_DAY)
    if epoch.scale == "tdb":
        return seconds
    et = seconds
    for _ in range(3):
        et = seconds + _tdb_minus_tt_s(et)
    return et


def time_from_et(et: float) -> Time:
    """Return the epoch, in TT, of TDB seconds past J2000 by SPICE's model of TDB."""
    from astropy.time import Time

    days, rest = divmod(et, SECONDS_PER_DAY)
    return Time(J2000_JD + days, (rest - _tdb_minus_tt_s(et)) / SECONDS_PER_DAY, format="jd", scale="tt")


def _tdb_minus_tt_s(et: float) -> float:
    """TDB minus TT by the model and the constants of SPICE's leap seconds kernels (SPICE Required Reading, TIME)."""
    anomaly = _ANOMALY_RAD[0] + _ANOMALY_RAD[1] * et
    return _AMPLITUDE_S * math.sin(anomaly + _ECCENTRICITY * math.sin(anomaly))
