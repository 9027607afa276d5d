"""From columns of numbers to stars: defaults, limits, and errors that name the record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.catalogs.table import COLUMN_TYPES, StarTable
from giantlike.core.arrays import Mask
from giantlike.core.errors import DataError

SIGMA_PM_UNKNOWN_MAS_YR = 15.0
"""Per axis, of stars without a proper motion: they are none of the fast ones, which every catalog has found."""
REQUIRED = ("ra_deg", "dec_deg", "magnitude")
DEFAULTS: Mapping[str, float] = MappingProxyType(
    {
        "pm_ra_mas_yr": 0.0,
        "pm_dec_mas_yr": 0.0,
        "parallax_mas": 0.0,
        "radial_velocity_km_s": 0.0,
        "epoch_jyear": 2000.0,
        "color_bv": np.nan,
        "color_bp_rp": np.nan,
        "sigma_mas": 0.0,
        "is_double": 0.0,
    }
)
"""What a value is that a catalog does not give."""
LIMITS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "ra_deg": (-360.0, 720.0),
        "dec_deg": (-90.0, 90.0),
        "magnitude": (-30.0, 40.0),
        "epoch_jyear": (1800.0, 2300.0),
        "pm_ra_mas_yr": (-2e4, 2e4),
        "pm_dec_mas_yr": (-2e4, 2e4),
        "parallax_mas": (-1e4, 1e4),
        "radial_velocity_km_s": (-3e4, 3e4),
        "color_bv": (-10.0, 20.0),
        "color_bp_rp": (-15.0, 20.0),
        "sigma_mas": (0.0, 1e6),
        "sigma_pm_mas_yr": (0.0, 1e6),
    }
)
"""Between which values must be: outside, the column is another one or has another unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadStars:
    """Stars of one file.

    Parameters
    ----------
    stars : StarTable
    left_out : int
        Entries without a place or a magnitude.
    """

    stars: StarTable
    left_out: int


def stars_of(
    path: Path,
    columns: Mapping[str, NDArray[Any]],
    *,
    record: Callable[[int], str],
    defaults: Mapping[str, float] = DEFAULTS,
    max_magnitude: float | None = None,
) -> ReadStars:
    """Make a table of columns (n,) in which NaN means that a value is not given.

    Parameters
    ----------
    path : Path
        The file that errors name.
    columns : mapping of name to (n,)
        Names of :class:`StarTable`; at least ``ids``, ``ra_deg``, ``dec_deg`` and ``magnitude``.
    record : callable
        How an error calls row k, such as ``line 12``.
    defaults : mapping
        Of the values not given.
    max_magnitude : float, optional
        Fainter stars are dropped.

    Raises
    ------
    DataError
        A value is out of its limits.
    """
    given = {name: np.asarray(values) for name, values in columns.items()}
    for name, (low, high) in LIMITS.items():
        if name in given:
            wrong = ~np.isnan(given[name]) & ~((given[name] >= low) & (given[name] <= high))
            if wrong.any():
                row = int(np.argmax(wrong))
                raise DataError(
                    path,
                    f"{record(row)}: {name} must be in [{low:g}, {high:g}], got {given[name][row]:g}; "
                    "check the format and the units of the columns",
                )
    complete = np.logical_and.reduce([~np.isnan(given[name]) for name in REQUIRED])
    keep = complete
    if max_magnitude is not None:
        keep = complete & (given["magnitude"] <= max_magnitude)
    count = int(keep.sum())
    table: dict[str, Any] = {}
    for name in COLUMN_TYPES:
        values = given[name][keep] if name in given else np.full(count, np.nan)
        if name == "sigma_pm_mas_yr":
            still = (_value(given, "pm_ra_mas_yr", keep) == 0.0) & (_value(given, "pm_dec_mas_yr", keep) == 0.0)
            values = np.where(np.isnan(values), np.where(still, SIGMA_PM_UNKNOWN_MAS_YR, 0.0), values)
        elif name in defaults:
            values = np.where(np.isnan(values), defaults[name], values)
        table[name] = values
    table["parallax_mas"] = np.maximum(table["parallax_mas"], 0.0)
    table["is_double"] = table["is_double"] != 0.0
    return ReadStars(stars=StarTable(**table), left_out=int((~complete).sum()))


def _value(given: Mapping[str, NDArray[Any]], name: str, keep: Mask) -> NDArray[Any]:
    """Values with 0 for those that are not given."""
    return np.nan_to_num(given[name][keep]) if name in given else np.zeros(int(keep.sum()))
