"""Angular rates, of a gyro for example, and their integral over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.io.csv_rows import CsvRow, read_csv_rows

_RATE = ("rate_x_rad_s", "rate_y_rad_s", "rate_z_rad_s")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AngularRates(Value):
    """Angular rates of a camera with respect to inertial axes, linear in time between samples.

    Parameters
    ----------
    et : (n,) float64, TDB seconds past J2000; increasing, n >= 2
    rates_rad_s : (n, 3) float64, rad/s; about the camera axes, right-handed: the rotation of the camera itself
    """

    et: Float
    rates_rad_s: Float

    def __post_init__(self) -> None:
        count = len(np.asarray(self.et))
        require(count >= 2, f"angular rates need at least 2 samples, got {count}")
        object.__setattr__(self, "et", as_finite(self.et, (count,), "et"))
        object.__setattr__(self, "rates_rad_s", as_finite(self.rates_rad_s, (count, 3), "rates_rad_s"))
        require(bool((np.diff(self.et) > 0).all()), "times of angular rates must increase")
        Value.__post_init__(self)

    def turn(self, from_et: float, to_et: float) -> Rotation | Failure:
        """Integrate the rates to a rotation ``camera(to_et) from camera(from_et)``.

        The times may be in any order; NO_ATTITUDE if the samples do not cover both. Each interval between samples is
        integrated with its mean rate and the commutator of its ends (Magnus series to second order), so that the error
        falls with the fourth power of the interval. In ``dC/dt = -[w x] C``, with ``w`` going linearly from ``w0`` to
        ``w1`` in a time ``h``, the commutators of the rates at two times add ``h^2 / 12 (w0 x w1)`` to the turn ``h (w0
        + w1) / 2`` of the camera.
        """
        start, stop = min(from_et, to_et), max(from_et, to_et)
        if not (self.et[0] <= start and stop <= self.et[-1]):
            detail = f"angular rates cover et {self.et[0]:.3f} to {self.et[-1]:.3f}, needed {start:.3f} to {stop:.3f}"
            return Failure(Reason.NO_ATTITUDE, detail)
        inside = self.et[(self.et > start) & (self.et < stop)]
        times = np.concatenate([[start], inside, [stop]])
        rates = np.stack([np.interp(times, self.et, axis) for axis in self.rates_rad_s.T], axis=1)
        steps = np.diff(times)[:, None]
        before, after = rates[:-1], rates[1:]
        turns = (before + after) / 2.0 * steps + np.cross(before, after) * steps**2 / 12.0
        result = Rotation.identity()
        for turn in turns:
            result = Rotation.from_rotvec(-turn) * result
        return result if from_et <= to_et else result.inv()


def read_rates(path: str | Path) -> AngularRates:
    """Read a table of angular rates, in any order of time.

    Parameters
    ----------
    path : str or Path
        CSV file with the columns ``epoch_utc`` or ``et`` (TDB seconds past J2000), and ``rate_x_rad_s``,
        ``rate_y_rad_s``, ``rate_z_rad_s`` about the camera axes.

    Raises
    ------
    DataError
        The file is missing or damaged, has fewer than two rows, or two rows have the same time.
    """
    rows = sorted((_sample(row) for row in read_csv_rows(path, ("epoch_utc", "et", *_RATE), _RATE)), key=lambda s: s[0])
    et = np.array([time for time, _ in rows])
    if len(rows) < 2 or not bool((np.diff(et) > 0).all()):
        raise DataError(Path(path), f"angular rates need at least 2 rows of different times, got {len(rows)} rows")
    return AngularRates(et=et, rates_rad_s=np.stack([rate for _, rate in rows]))


def _sample(row: CsvRow) -> tuple[float, Float]:
    return row.et(), row.require(row.vector(_RATE), _RATE)
