"""CCSDS Attitude Ephemeris Messages (AEM) in keyword-value notation.

Source opened: CCSDS 504.0-B-2, Attitude Data Messages, sections 4.2.2 to 4.2.4 (header, metadata, data lines) and annex
F2 (the quaternion "from frame A to frame B", whose matrix takes coordinates in A to coordinates in B: the conjugate of
the quaternion of that matrix in the sense of this project).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from giantlike._system.atomic import write_text_atomic
from giantlike.core.arrays import Float, require
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.version import VERSION
from giantlike.io.attitude_series import AttitudeSeries

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])  # signs of the quaternion x, y, z, w of the opposite rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class AemNames:
    """Names in the header and metadata of an AEM."""

    object_name: str = "UNKNOWN"  # object_name, object_id: spacecraft and its international designator
    object_id: str = "UNKNOWN"
    originator: str = "UNKNOWN"  # organization that writes the message
    frame: str = "INSTRUMENT_1"  # ``REF_FRAME_B``, the camera
    inertial: str = "ICRF"  # ``REF_FRAME_A``: ``ICRF`` or, with the same axes, ``GCRF``

    def __post_init__(self) -> None:
        _require_lines([getattr(self, field.name) for field in fields(self)])


def write_aem(
    path: str | Path, series: AttitudeSeries, names: AemNames, *, max_gap_s: float = 600.0, comments: Sequence[str] = ()
) -> None:
    """Write attitudes as an AEM, version 2.0, times in UTC."""
    _require_lines(comments)
    epochs = [utc_text(time_from_et(et)) for et in series.et.tolist()]
    for name, first, second in zip(series.names[1:], epochs, epochs[1:], strict=False):
        require(first != second, f"{name!r}: an AEM must not repeat the epoch {second}")
    lines = [
        "CCSDS_AEM_VERS = 2.0",
        f"COMMENT written by giantlike {VERSION}",
        f"CREATION_DATE = {time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime())}",
        f"ORIGINATOR = {names.originator}",
    ]
    for part in series.segments(max_gap_s):
        lines += [
            "",
            "META_START",
            *(f"COMMENT {text}" for text in comments),
            f"OBJECT_NAME = {names.object_name}",
            f"OBJECT_ID = {names.object_id}",
            f"REF_FRAME_A = {names.inertial}",
            f"REF_FRAME_B = {names.frame}",
            "TIME_SYSTEM = UTC",
            f"START_TIME = {epochs[part][0]}",
            f"STOP_TIME = {epochs[part][-1]}",
            "ATTITUDE_TYPE = QUATERNION",
            *(["INTERPOLATION_METHOD = LINEAR", "INTERPOLATION_DEGREE = 1"] if len(epochs[part]) > 1 else []),
            "META_STOP",
            "",
            "DATA_START",
            *_data_lines(epochs[part], series.quaternions_xyzw[part] * _CONJUGATE),
            "DATA_STOP",
        ]
    write_text_atomic(Path(path), "\n".join(lines) + "\n")


def _require_lines(texts: Sequence[str]) -> None:
    for text in texts:
        require(bool(text.strip()) and "\n" not in text, f"an AEM needs one line of text here, got {text!r}")


def _data_lines(epochs: Sequence[str], quaternions: Float) -> list[str]:
    return [
        " ".join([epoch, *(f"{value:.16f}" for value in quaternion)])
        for epoch, quaternion in zip(epochs, quaternions.tolist(), strict=True)
    ]
