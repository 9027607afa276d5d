"""Star tables from the columns of numbers of a file: defaults, limits, and errors that name the record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.catalogs.table import COLUMN_TYPES, StarTable
from giantlike.core.arrays import Float

HIPPARCOS_EPOCH, GAIA_EPOCH = 1991.25, 2016.0
"""Julian years of the positions of Hipparcos (CDS ReadMe of I/239) and of Gaia DR3 (its column ``ref_epoch``)."""
CLOSE_ARCSEC = 5.0  # a star with a neighbor this close is called double
SIGMA_PM_UNKNOWN_MAS_YR = 15.0
"""Per axis, of stars without a proper motion. They are none of the fast ones, which Hipparcos was given."""
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
"""Values of the columns that a catalog does not give."""
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
"""Range of each column: a value outside belongs to another column or has another unit."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReadStars:
    """Stars of one file."""

    stars: StarTable
    band: str  # photometric band of the magnitudes
    left_out: int  # number of entries without a position or a magnitude


def stars_of(
    columns: Mapping[str, NDArray[Any]],
    *,
    band: str,
    record: Callable[[int], str],
    defaults: Mapping[str, float] = DEFAULTS,
    max_magnitude: float | None = None,
) -> ReadStars:
    """Make a star table of columns (n,) by the names of :class:`StarTable`; NaN stands for values not given."""
    given = {name: np.asarray(values) for name, values in columns.items()}
    for name, (low, high) in LIMITS.items():
        if name in given:
            wrong = ~np.isnan(given[name]) & ~((given[name] >= low) & (given[name] <= high))
            if wrong.any():
                row = int(np.argmax(wrong))
                raise ValueError(
                    f"{record(row)}: {name} must be in [{low:g}, {high:g}], got {given[name][row]:g}; "
                    "check the format and the units of the columns"
                )
    complete = np.logical_and.reduce([~np.isnan(given[name]) for name in REQUIRED])
    keep = complete if max_magnitude is None else complete & (given["magnitude"] <= max_magnitude)
    table: dict[str, NDArray[Any]] = {}
    for name in COLUMN_TYPES:
        values = given[name][keep] if name in given else np.full(int(keep.sum()), np.nan)
        table[name] = np.where(np.isnan(values), defaults[name], values) if name in defaults else values
    still = (table["pm_ra_mas_yr"] == 0.0) & (table["pm_dec_mas_yr"] == 0.0)
    unknown = np.where(still, SIGMA_PM_UNKNOWN_MAS_YR, 0.0)
    table["sigma_pm_mas_yr"] = np.where(np.isnan(table["sigma_pm_mas_yr"]), unknown, table["sigma_pm_mas_yr"])
    table["parallax_mas"] = np.maximum(table["parallax_mas"], 0.0)
    table["is_double"] = table["is_double"] != 0.0
    return ReadStars(stars=StarTable(**table), band=band, left_out=int((~complete).sum()))


def rms(a: Float, b: Float) -> Float:
    """Root mean square (n,) of two columns: the error per axis of a star."""
    return np.asarray(np.hypot(a, b) / np.sqrt(2.0))


def parse_number(word: str | bytes, of_text: Callable[[str | bytes], float] = float) -> float | None:
    """Number that a word stands for; None if it is not a number."""
    try:
        return of_text(word)
    except ValueError:
        return None
