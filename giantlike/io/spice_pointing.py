"""Attitudes and epochs of old missions by SPICE: C-kernels of single attitudes, and clock counts in labels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.reading import library_message
from giantlike.core.arrays import Float, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.time import et_from_time, time_from_et, time_from_utc, utc_text
from giantlike.io.decoded import HeaderValue
from giantlike.io.spice import CoverageError, attitude

_CLASS_CK, _CLASS_FIXED = 3, 4  # NAIF's Frames Required Reading
_CODE = re.compile(r"-\d+")


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelClock:
    """A count of the spacecraft clock in a label, from which the epoch of an image follows."""

    spacecraft: str  # NAIF name or code of the spacecraft whose clock it is
    item: str  # item of the label
    pattern: str  # regular expression that is searched for in the value of the item
    count: str | None  # clock count as SPICE reads it, with the groups of the expression as ``{0}``, ``{1}``,
    zero_utc: str | None  # instead of ``count``: UTC at 0 of a clock of seconds without kernel
    after_exposure_s: float  # time from the closing of the shutter to that count

    def __post_init__(self) -> None:
        """Refuse an invalid expression or time, and a count of more groups than the expression has."""
        require((self.count is None) != (self.zero_utc is None), "give either count or zero_utc")
        try:
            groups = re.compile(self.pattern).groups
            if self.zero_utc is not None:
                time_from_utc(self.zero_utc)
            (self.count or "{0}").format(*[""] * groups)
        except (re.error, IndexError, KeyError, ValueError) as error:
            text = f"pattern {self.pattern!r} does not go with {self.count or '{0}'!r} ({error})"
            raise InputError(text) from error

    def middle_of_exposure(self, header: Mapping[str, HeaderValue], exposure_s: float | None) -> float | None:
        """Epoch ``et`` of an image by its label; None where it has no such item, or none of that form."""
        match = re.search(self.pattern, str(header.get(self.item, "")))
        if match is None:
            return None
        et = self._seconds(match[1]) if self.count is None else self._by_kernel(self.count.format(*match.groups()))
        return et - self.after_exposure_s - 0.5 * (exposure_s or 0.0)

    def _seconds(self, text: str) -> float:
        assert self.zero_utc is not None
        try:
            return et_from_time(time_from_utc(self.zero_utc)) + float(text)
        except ValueError as error:
            raise DataError(f"label item {self.item}", f"expected seconds of a clock, got {text!r}") from error

    def _by_kernel(self, count: str) -> float:
        import spiceypy
        from spiceypy.utils.exceptions import SpiceyError

        try:
            return float(spiceypy.scs2e(int(spiceypy.bods2c(self.spacecraft)), count))
        except (SpiceyError, spiceypy.NotFoundError) as error:
            raise CoverageError(
                f"no epoch of the clock count {count} of {self.spacecraft}: load its clock kernel (SCLK) and leap "
                f"seconds ({library_message(error)})"
            ) from error


def nearest_attitude(frame: str, et: float, tolerance_s: float) -> Rotation:
    """Attitude ``camera_from_inertial`` of a frame at ``et``, else the nearest in the C-kernel that it is fixed to."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    coded = _CODE.fullmatch(frame) is not None
    if not coded:
        if tolerance_s == 0.0:
            return attitude(frame, et)
        try:
            return attitude(frame, et)
        except CoverageError:
            pass  # no attitude at this very time
    try:
        matrix, code = (np.eye(3), int(frame)) if coded else _down_to_ck(frame)
        clock = int(spiceypy.ckmeta(code, "SCLK"))
        ticks = float(spiceypy.sce2c(clock, et))
        around = float(spiceypy.sce2c(clock, et + tolerance_s)) - ticks
        ck_from_inertial, _ = spiceypy.ckgp(code, ticks, around, "J2000")
    except (SpiceyError, spiceypy.NotFoundError) as error:
        when = utc_text(time_from_et(et))
        raise CoverageError(
            f"no attitude of frame {frame} within {tolerance_s:g} s of {when} UTC: load a CK with its SCLK kernel that "
            f"has one, or raise ck_tolerance_s ({library_message(error)})"
        ) from error
    return Rotation.from_matrix(matrix @ np.asarray(ck_from_inertial))


def _down_to_ck(frame: str) -> tuple[Float, int]:
    """Rotation ``frame_from_ck`` (3, 3), and the code of the instrument of the C-kernel that a frame rests on."""
    import spiceypy

    code, matrix = int(spiceypy.namfrm(frame)), np.eye(3)
    while True:
        _, kind, instrument = spiceypy.frinfo(code)
        if kind == _CLASS_CK:
            return matrix, int(instrument)
        if kind != _CLASS_FIXED:
            raise CoverageError(f"no attitude of frame {frame}: it does not rest on a frame of a C-kernel")
        base_from_frame, code = spiceypy.tkfram(instrument)
        matrix = matrix @ np.asarray(base_from_frame).T
