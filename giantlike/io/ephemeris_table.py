"""An ephemeris sampled in a table.

Columns: the epoch, as ``epoch_utc`` (ISO 8601) or ``et`` (TDB seconds past J2000); the position ``x_km``,
``y_km``, ``z_km``; optionally the velocity ``vx_km_s``, ``vy_km_s``, ``vz_km_s`` and the orientation
``body_qx``, ``body_qy``, ``body_qz``, ``body_qw``, which is body_from_inertial, scalar last, as in
``geometry.csv``. Inertial axes (ICRF). A column is filled in every row or absent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.io.csv_rows import CsvRow, read_timed_rows

_POSITION = ("x_km", "y_km", "z_km")
_VELOCITY = ("vx_km_s", "vy_km_s", "vz_km_s")
_BODY = ("body_qx", "body_qy", "body_qz", "body_qw")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EphemerisSamples(Value):
    """Samples of an ephemeris, in order of time."""

    et: Float  # (n,); strictly increasing, n >= 1
    position_km: Float  # (n, 3), inertial axes
    velocity_km_s: Float | None  # (n, 3), inertial axes
    inertial_from_body: Rotation | None


def read_ephemeris_table(path: str | Path) -> EphemerisSamples:
    """Read a sampled ephemeris; rows may be in any order.

    Parameters
    ----------
    path : path-like; CSV file with the columns of :mod:`giantlike.io.ephemeris_table`

    Raises
    ------
    DataError
        Names file, line, column and value: unknown, repeated or missing columns; none or both of ``epoch_utc``
        and ``et``; empty cells; cells that are not a number or epoch; a quaternion that is not unit to 1e-3; two
        rows with the same epoch; a table without rows.
    """
    et, rows = read_timed_rows(path, (*_POSITION, *_VELOCITY, *_BODY), _POSITION)
    names = set(rows[0].cells)
    has_velocity, has_body = bool(names & set(_VELOCITY)), bool(names & set(_BODY))
    body = [row.require(row.rotation(_BODY), _BODY) for row in rows] if has_body else []
    return EphemerisSamples(
        et=et,
        position_km=_vectors(rows, _POSITION),
        velocity_km_s=_vectors(rows, _VELOCITY) if has_velocity else None,
        inertial_from_body=Rotation.concatenate(body).inv() if body else None,
    )


def _vectors(rows: Sequence[CsvRow], columns: tuple[str, ...]) -> Float:
    """Values (n, 3) of three columns, which every row must fill."""
    return np.array([row.require(row.vector(columns), columns) for row in rows])
