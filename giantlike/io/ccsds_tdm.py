"""CCSDS Tracking Data Messages (TDM) 2.0 in keyword-value notation: angles of a target, and its range.

Keywords and their order follow the schema of TDM 2.0 (NDM/XML of SANA), as ``ccsds-ndm`` reads it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from giantlike._system.atomic import write_text_atomic
from giantlike.core.arrays import require
from giantlike.core.version import VERSION

ABERRATION_REMOVED = "stellar aberration is removed"
"""Words of the comment by which a message says that its angles are astrometric."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TdmPoint:
    """One observation."""

    epoch_utc: str  # when the light was received, ISO 8601
    ra_deg: float  # ra_deg, dec_deg: in ICRF
    dec_deg: float
    range_km: float | None = None  # one way, of light
    errors: str = ""  # standard deviations and correlations, in words; a TDM has no place for them but comments
    remarks: str = ""  # one line, or nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class TdmSegment:
    """Observations of one target from one spacecraft."""

    spacecraft: str  # spacecraft, target: names of the participants
    target: str
    points: Sequence[TdmPoint]  # in order of time; at least one
    comments: Sequence[str] = ()  # lines for the metadata: effects removed from the angles
    frame: str = "ICRF"  # of the angles: ``ICRF`` or, with the same axes, ``GCRF``

    def __post_init__(self) -> None:
        require(len(self.points) > 0, f"{self.target}: a TDM needs an observation")
        for text in (self.spacecraft, self.target, *self.comments):
            require(bool(text.strip()) and "\n" not in text, f"a TDM needs one line of text here, got {text!r}")
        epochs = [point.epoch_utc for point in self.points]
        for first, second in pairwise(epochs):
            require(first < second, f"{self.target}: epochs of a TDM must increase, got {second} after {first}")


def write_tdm(path: str | Path, segments: Sequence[TdmSegment], *, originator: str = "UNKNOWN") -> None:
    """Write a TDM: right ascension and declination in ICRF at the time of reception in UTC, and the range in km.

    The light goes from participant 2, the target, to participant 1. Errors are comments at the start of the data.
    """
    require(len(segments) > 0, "a TDM needs a segment")
    lines = [
        "CCSDS_TDM_VERS = 2.0",
        f"COMMENT written by giantlike {VERSION}",
        f"CREATION_DATE = {time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime())}",
        f"ORIGINATOR = {originator}",
    ]
    for segment in segments:
        lines += _segment_lines(segment)
    write_text_atomic(Path(path), "\n".join(lines) + "\n")


def _segment_lines(segment: TdmSegment) -> Iterator[str]:
    ranged = any(point.range_km is not None for point in segment.points)
    yield from ("", "META_START", *(f"COMMENT {text}" for text in segment.comments))
    yield f"DATA_TYPES = ANGLE_1,ANGLE_2{',RANGE' if ranged else ''}"
    yield "TIME_SYSTEM = UTC"
    yield f"START_TIME = {segment.points[0].epoch_utc}"
    yield f"STOP_TIME = {segment.points[-1].epoch_utc}"
    yield f"PARTICIPANT_1 = {segment.spacecraft}"
    yield f"PARTICIPANT_2 = {segment.target}"
    yield from ("MODE = SEQUENTIAL", "PATH = 2,1", "TIMETAG_REF = RECEIVE")
    if ranged:
        yield "RANGE_UNITS = km"
    yield from ("ANGLE_TYPE = RADEC", f"REFERENCE_FRAME = {segment.frame}", "META_STOP", "", "DATA_START")
    for point in segment.points:
        yield from (f"COMMENT {point.epoch_utc}: {text}" for text in (point.errors, point.remarks) if text)
    for point in segment.points:
        yield f"ANGLE_1 = {point.epoch_utc} {point.ra_deg:.12f}"
        yield f"ANGLE_2 = {point.epoch_utc} {point.dec_deg:.12f}"
        if point.range_km is not None:
            yield f"RANGE = {point.epoch_utc} {point.range_km:.9f}"
    yield "DATA_STOP"
