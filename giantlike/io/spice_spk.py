"""SPK: trajectories of a spacecraft relative to a body, written with SPICE as segments of type 13 (Hermite)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from giantlike._system.atomic import replacing
from giantlike._system.reading import library_message
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.core.version import VERSION

_DEGREE = 3  # of the polynomial between two epochs, from their positions and velocities
_SEGMENT_NAME, _COMMENT = 40, 80  # characters, of a segment and of a line of comments


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpkArc(Value):
    """States of a body along an arc.

    body, center: NAIF codes.
    et: (n,); TDB seconds past J2000, strictly increasing, n >= 2.
    states: (n, 6), km and km/s, geometric, axes of J2000.
    name: of the segment.
    """

    body: int
    center: int
    et: Float
    states: Float
    name: str


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
