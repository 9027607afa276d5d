"""C-kernels of type 3 or 1 with clock and frame kernels where the mission has none; trajectories as SPK of type 13.

The clock has the form of NAIF's fictional clocks (``mex_fake.tsc`` was opened): type 1, running with TDB,
one coefficient triple.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from giantlike._system.atomic import replacing, write_text_atomic
from giantlike._system.reading import library_message
from giantlike.core.arrays import Float, require
from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.core.version import VERSION
from giantlike.io.attitude_series import AttitudeSeries
from giantlike.io.spice import load_kernels

_INERTIAL = "J2000"
_CLOCK_START_ET = -1577880000.0  # s, the year 1950: earlier than any image of a spacecraft
_TICKS_PER_SECOND = 100_000  # of the made-up clock: epochs are rounded to 10 us, below the exposure times of cameras
_MARGIN_S = 1e-3
"""Time before the first and after the last attitude of a run over which a C-kernel of type 3 holds them still, s.

Texts of epochs are rounded to 1 us, and clocks count ticks: an attitude alone would not be found at its own epoch.
Exposures are longer than a millisecond, or the camera hardly turns.
"""
_FRAME_NAME = re.compile(r"[A-Z][A-Z0-9_+-]{0,25}")  # SPICE allows 26 characters
_SEGMENT_NAME = 40  # characters of a segment identifier: NAIF's CK Required Reading
_COMMENT = 1000  # characters of a line that dafac takes


@dataclass(frozen=True, slots=True, kw_only=True)
class CkTarget:
    """The instrument whose attitudes a C-kernel holds."""

    instrument_id: int  # NAIF code of the camera frame, as -64361: thousands, -64, are the spacecraft's clock
    frame_name: str  # name for the frame kernel: capitals, digits, underscores; at most 26

    def __post_init__(self) -> None:
        require(
            self.instrument_id <= -1000,
            f"instrument id must be a NAIF code of -1000 or below, such as -64361, got {self.instrument_id}",
        )
        require(
            _FRAME_NAME.fullmatch(self.frame_name) is not None,
            f"frame name must be up to 26 capitals, digits and underscores, got {self.frame_name!r}",
        )

    @property
    def clock_id(self) -> int:
        """NAIF code of the spacecraft, whose clock counts."""
        return -(-self.instrument_id // 1000)


def write_ck(
    path: str | Path,
    series: AttitudeSeries,
    target: CkTarget,
    *,
    sclk: str | Path | None = None,
    max_gap_s: float | None = 600.0,
    comments: Sequence[str] = (),
) -> tuple[Path, ...]:
    """Write attitudes as a C-kernel of type 3 (without rates, interpolated at a constant rate) or 1 (discrete)."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    path = Path(path)
    written = [path]
    if sclk is None:
        sclk = path.with_suffix(".tsc")
        write_text_atomic(sclk, _clock_kernel(target.clock_id))
        frame = path.with_suffix(".tf")
        write_text_atomic(frame, _frame_kernel(target))
        written += [sclk, frame]
    padded = None if max_gap_s is None else _pad_runs(series, max_gap_s)
    et, quaternions = (series.et, series.quaternions_xyzw) if padded is None else (padded.et, padded.quaternions_xyzw)
    spice_quaternions = np.ascontiguousarray(np.roll(quaternions, 1, axis=1))
    try:
        with load_kernels([Path(sclk).absolute()], path.parent):
            ticks = np.array([spiceypy.sce2c(target.clock_id, each) for each in et.tolist()])
        with replacing(path) as file:
            handle = spiceypy.ckopn(str(file), "giantlike attitudes", 0)
            try:
                spiceypy.dafac(handle, [f"giantlike {VERSION}", *(text[:_COMMENT] for text in comments)])
                common = (
                    handle, ticks[0], ticks[-1], target.instrument_id, _INERTIAL, False,
                    f"giantlike {target.frame_name}"[:_SEGMENT_NAME], ticks.size, ticks, spice_quaternions,
                    np.zeros((ticks.size, 3)),
                )  # fmt: skip
                if padded is None:
                    spiceypy.ckw01(*common)
                else:
                    spiceypy.ckw03(*common, len(padded.starts), ticks[padded.starts])
            finally:
                spiceypy.ckcls(handle)
    except SpiceyError as error:
        raise DataError(path, f"the C-kernel cannot be written: {library_message(error)}") from error
    return tuple(written)


@dataclass(frozen=True, slots=True, eq=False)
class _Padded(Value):
    """Times and attitudes with those beyond the ends of runs, and the indices of the first of each run."""

    et: Float
    quaternions_xyzw: Float
    starts: NDArray[np.intp]


def _pad_runs(series: AttitudeSeries, max_gap_s: float) -> _Padded:
    """Attitudes with the first and last of each run held still for a margin, or a third of the time to the next run."""
    parts = series.segments(max_gap_s)
    gaps = [series.et[after.start] - series.et[before.stop - 1] for before, after in pairwise(parts)]
    margin_s = min([_MARGIN_S, *(gap / 3.0 for gap in gaps)])
    et, quaternions, starts = list[Float](), list[Float](), list[int]()
    for part in parts:
        times, attitudes = series.et[part], series.quaternions_xyzw[part]
        starts.append(sum(each.size for each in et))
        et.append(np.concatenate([[times[0] - margin_s], times, [times[-1] + margin_s]]))
        quaternions.append(np.concatenate([attitudes[:1], attitudes, attitudes[-1:]]))
    return _Padded(np.concatenate(et), np.concatenate(quaternions), np.array(starts, dtype=np.intp))


def _clock_kernel(clock_id: int) -> str:
    """A clock of type 1: seconds of TDB since 1950 and hundred-thousandths."""
    clock = -clock_id
    last = 10_000_000_000 * _TICKS_PER_SECOND
    return f"""KPL/SCLK

A clock that runs with TDB, for the attitudes written by giantlike beside it. It is not the spacecraft's own clock.
It counts seconds and hundred-thousandths from et {_CLOCK_START_ET:.0f} (TDB seconds past J2000).

\\begindata
SCLK_KERNEL_ID            = ( @2000-01-01 )
SCLK_DATA_TYPE_{clock}        = ( 1 )
SCLK01_TIME_SYSTEM_{clock}    = ( 1 )
SCLK01_N_FIELDS_{clock}       = ( 2 )
SCLK01_MODULI_{clock}         = ( 10000000000 {_TICKS_PER_SECOND} )
SCLK01_OFFSETS_{clock}        = ( 0 0 )
SCLK01_OUTPUT_DELIM_{clock}   = ( 1 )
SCLK_PARTITION_START_{clock}  = ( 0.0 )
SCLK_PARTITION_END_{clock}    = ( {last:.1f} )
SCLK01_COEFFICIENTS_{clock}   = ( 0.0 {_CLOCK_START_ET:.1f} 1.0 )
\\begintext
"""


def _frame_kernel(target: CkTarget) -> str:
    code, name = target.instrument_id, target.frame_name
    return f"""KPL/FK

The camera frame whose attitudes giantlike wrote: +x along increasing columns, +y along increasing rows, +z boresight,
unless the camera file names a frame of the mission.

\\begindata
FRAME_{name} = {code}
FRAME_{code}_NAME = '{name}'
FRAME_{code}_CLASS = 3
FRAME_{code}_CLASS_ID = {code}
FRAME_{code}_CENTER = {target.clock_id}
CK_{code}_SCLK = {target.clock_id}
CK_{code}_SPK = {target.clock_id}
\\begintext
"""


_DEGREE = 3  # of the polynomial between two epochs, from their positions and velocities
_SEGMENT_NAME, _COMMENT = 40, 80  # characters, of a segment and of a line of comments


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpkArc(Value):
    """States of a body along an arc."""

    body: int  # body, center: NAIF codes
    center: int
    et: Float  # (n,); TDB seconds past J2000, strictly increasing, n >= 2
    states: Float  # (n, 6), km and km/s, geometric, axes of J2000
    name: str  # of the segment


def write_spk(path: str | Path, arcs: Sequence[SpkArc], comments: Sequence[str] = ()) -> None:
    """Write arcs as an SPK, one segment for each; every state at its epoch is read back as it is."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    path = Path(path)
    try:
        with replacing(path) as file:
            handle = spiceypy.spkopn(str(file), "giantlike trajectories", 0)
            try:
                spiceypy.dafac(handle, [f"giantlike {VERSION}", *(text[:_COMMENT] for text in comments)])
                for arc in arcs:
                    spiceypy.spkw13(
                        handle, arc.body, arc.center, "J2000", arc.et[0], arc.et[-1], arc.name[:_SEGMENT_NAME],
                        _DEGREE, arc.et.size, np.array(arc.states), np.array(arc.et),
                    )  # fmt: skip
            except SpiceyError:
                spiceypy.dafcls(handle)  # a file without segments cannot be closed as an SPK
                raise
            spiceypy.spkcls(handle)
    except SpiceyError as error:
        raise DataError(path, f"the SPK cannot be written: {library_message(error)}") from error
