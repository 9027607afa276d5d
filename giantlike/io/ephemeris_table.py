"""An ephemeris sampled in a table.

Columns: the epoch, as ``epoch_utc`` (ISO 8601) or ``et`` (TDB seconds past J2000); the position ``x_km``,
``y_km``, ``z_km``; optionally the velocity ``vx_km_s``, ``vy_km_s``, ``vz_km_s`` and the orientation
``body_qx``, ``body_qy``, ``body_qz``, ``body_qw``, which is body_from_inertial, scalar last, as in
``geometry.csv``. Inertial axes (ICRF). A column is filled in every row or absent.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.io.csv_rows import CsvRow, read_csv_rows

_POSITION = ("x_km", "y_km", "z_km")
_VELOCITY = ("vx_km_s", "vy_km_s", "vz_km_s")
_BODY = ("body_qx", "body_qy", "body_qz", "body_qw")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EphemerisSamples(Value):
    """Samples of an ephemeris, in order of time.

    et: (n,); strictly increasing, n >= 1.
    position_km: (n, 3), inertial axes.
    velocity_km_s: (n, 3), inertial axes.
    """

    et: Float
    position_km: Float
    velocity_km_s: Float | None
    inertial_from_body: Rotation | None


def read_ephemeris_table(path: str | Path) -> EphemerisSamples:
    """Read a sampled ephemeris; rows may be in any order.

    Parameters
    ----------
    path : path-like
        CSV file with the columns of :mod:`giantlike.io.ephemeris_table`.

    Returns
    -------
    EphemerisSamples

    Raises
    ------
    DataError
        Names file, line, column and value: unknown, repeated or missing columns; none or both of ``epoch_utc``
        and ``et``; empty cells; cells that are not a number or epoch; a quaternion that is not unit to 1e-3; two
        rows with the same epoch; a table without rows.
    """
    rows = read_csv_rows(path, ("epoch_utc", "et", *_POSITION, *_VELOCITY, *_BODY), _POSITION)
    if not rows:
        raise DataError(path, "the table has no rows")
    names = set(rows[0].cells)
    if len(names & {"epoch_utc", "et"}) != 1:
        raise DataError(path, "line 1: one of the columns epoch_utc and et is needed, not both")
    et = np.array([row.et() for row in rows])
    order = np.argsort(et, kind="stable")
    for before, after in itertools.pairwise(order):
        if et[before] == et[after]:
            raise rows[after].error(
                "et" if "et" in names else "epoch_utc",
                f"an epoch other than that of line {rows[before].line} is needed",
            )
    has_velocity, has_body = bool(names & set(_VELOCITY)), bool(names & set(_BODY))
    ordered = [rows[k] for k in order]
    body = [row.require(row.rotation(_BODY), _BODY) for row in ordered] if has_body else []
    return EphemerisSamples(
        et=et[order],
        position_km=_vectors(ordered, _POSITION),
        velocity_km_s=_vectors(ordered, _VELOCITY) if has_velocity else None,
        inertial_from_body=Rotation.concatenate(body).inv() if body else None,
    )


def _vectors(rows: Sequence[CsvRow], columns: tuple[str, ...]) -> Float:
    """Values (n, 3) of three columns, which every row must fill."""
    return np.array([row.require(row.vector(columns), columns) for row in rows])
