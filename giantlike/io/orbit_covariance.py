"""A priori covariance of the position of a target relative to the spacecraft along an arc, in a table.

Columns: the epoch, as ``epoch_utc`` (ISO 8601) or ``et`` (TDB seconds past J2000); the lower triangle of the
covariance, by rows, with the names of a CCSDS orbit ephemeris message and units: ``cx_x_km2``, ``cy_x_km2``,
``cy_y_km2``, ``cz_x_km2``, ``cz_y_km2``, ``cz_z_km2``; optionally that of the velocity, ``cx_dot_x_km2_s`` to
``cz_dot_z_dot_km2_s2``, all fifteen. Inertial axes (ICRF). Rows may be in any order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.values import Value, check_covariance
from giantlike.io.csv_rows import read_timed_rows

_STATE = ("x", "y", "z", "x_dot", "y_dot", "z_dot")
COLUMNS = tuple(
    f"c{one}_{other}_km2{('', '_s', '_s2')[one.endswith('dot') + other.endswith('dot')]}"
    for row, one in enumerate(_STATE)
    for other in _STATE[: row + 1]
)
"""Columns of the covariance; the first six are those of the position."""
_OF_POSITION = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrbitCovariance(Value):
    """Covariance of a relative position, or of a relative state, by epoch."""

    path: Path
    et: Float  # (n,); strictly increasing, n >= 1
    covariances: Float  # (n, 3, 3) or (n, 6, 6), km and km/s, ICRF axes

    @property
    def largest_sigma_km(self) -> float:
        """Largest standard deviation of the position in any direction at the epochs of the table."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariances[:, :3, :3]).max()))

    def at(self, et: float) -> Float:
        """Covariance (3, 3), km^2, of the position, linear in time; states are carried along straight lines first."""
        if not self.et[0] <= et <= self.et[-1]:
            first, last, epoch = (utc_text(time_from_et(each), 0) for each in (*self.et[[0, -1]].tolist(), et))
            raise DataError(self.path, f"covers {first} to {last} UTC, and {epoch} is needed")
        after = min(int(np.searchsorted(self.et, et)), self.et.size - 1)
        before = max(after - 1, 0)
        share = (et - self.et[before]) / (self.et[after] - self.et[before]) if after else 1.0
        size = self.covariances.shape[1]
        total = np.zeros((3, 3))
        for number, weight in ((before, 1.0 - share), (after, share)):
            by_state = np.hstack([np.eye(3), (et - self.et[number]) * np.eye(3)])[:, :size]
            total += weight * by_state @ self.covariances[number] @ by_state.T
        return (total + total.T) / 2.0


def read_orbit_covariance(path: str | Path) -> OrbitCovariance:
    """Read the covariance of an arc; every row has all its columns."""
    et, rows = read_timed_rows(path, COLUMNS, COLUMNS[:_OF_POSITION])
    names = COLUMNS if COLUMNS[-1] in rows[0].cells else COLUMNS[:_OF_POSITION]
    size = 6 if len(names) > _OF_POSITION else 3
    lower = np.tril_indices(size)
    covariances = np.zeros((len(rows), size, size))
    for row, matrix in zip(rows, covariances, strict=True):
        matrix[lower] = row.require(row.vector(names), names)
        matrix.T[lower] = matrix[lower]
        try:
            check_covariance(matrix, "the covariance")
        except InputError as error:
            raise DataError(path, f"line {row.line}: {error}") from error
    return OrbitCovariance(path=Path(path), et=et, covariances=covariances)
