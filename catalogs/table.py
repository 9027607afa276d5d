"""Tables of stars, one array for each column, and Julian epochs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.units import RAD_PER_MAS, SECONDS_PER_JULIAN_YEAR
from giantlike.core.values import Value

_NO_COLORS: Float = np.empty(0)
_NO_FLAGS: Mask = np.empty(0, dtype=np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarTable(Value):
    """Astrometry of n stars at their catalog epochs, barycentric, ICRF.

    Parameters
    ----------
    ids : (n,) int64; catalog identifiers: Gaia source ids, negative Hipparcos numbers, or the user's own
    ra_deg, dec_deg : (n,) float64, deg; position at ``epoch_jyear``, as seen from the solar system barycenter
    pm_ra_mas_yr, pm_dec_mas_yr : (n,) float64, mas/yr; proper motion; the first one includes cos(dec)
    parallax_mas : (n,) float64, mas; 0 where unknown
    radial_velocity_km_s : (n,) float64, km/s; 0 where unknown
    epoch_jyear : (n,) float64; Julian epoch (TDB) of the position
    magnitude : (n,) float64; in the band of the catalog
    color_bv : (n,) float64; Johnson B-V, NaN where unknown
    sigma_mas : (n,) float64, mas; standard deviation of the position per axis at ``epoch_jyear``
    sigma_pm_mas_yr : (n,) float64, mas/yr; standard deviation of the proper motion per axis
    color_bp_rp : (n,) float64, optional; Gaia BP-RP, NaN where unknown
    is_double : (n,) bool, optional
        Known doubles: the catalog has a companion within a few arcseconds or flags the star as not single,
        or :func:`~giantlike.catalogs.blends.blended` made one of several. Position, motion and magnitude of such a star
        are less accurate than their standard deviations.
    """

    ids: NDArray[np.int64]
    ra_deg: Float
    dec_deg: Float
    pm_ra_mas_yr: Float
    pm_dec_mas_yr: Float
    parallax_mas: Float
    radial_velocity_km_s: Float
    epoch_jyear: Float
    magnitude: Float
    color_bv: Float
    sigma_mas: Float
    sigma_pm_mas_yr: Float
    color_bp_rp: Float = field(default_factory=lambda: _NO_COLORS)
    is_double: Mask = field(default_factory=lambda: _NO_FLAGS)

    def __post_init__(self) -> None:
        n = np.asarray(self.ids).shape
        require(len(n) == 1, f"star table: ids must have shape (n,), got {n}")
        if self.color_bp_rp is _NO_COLORS:
            object.__setattr__(self, "color_bp_rp", np.full(n, np.nan))
        if self.is_double is _NO_FLAGS:
            object.__setattr__(self, "is_double", np.zeros(n, dtype=np.bool_))
        for name, dtype in COLUMN_TYPES.items():
            column = np.asarray(getattr(self, name), dtype=dtype)
            require(column.shape == n, f"star table: {name} must have shape {n}, got {column.shape}")
            object.__setattr__(self, name, column)
        Value.__post_init__(self)

    def __len__(self) -> int:
        return int(self.ids.size)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return copies (n,) of the columns by name, in the order of :data:`COLUMN_TYPES`."""
        return {name: np.array(getattr(self, name)) for name in COLUMN_TYPES}

    def select(self, index: ArrayLike) -> StarTable:
        """Return some of the stars, by a mask (n,) or by indices (k,) in the order of the result."""
        chosen = np.asarray(index)
        if chosen.size == 0 and chosen.dtype != np.bool_:
            chosen = chosen.astype(np.intp)
        return StarTable(**{name: getattr(self, name)[chosen] for name in COLUMN_TYPES})

    def sigma_rad(self, et: float) -> Float:
        """Standard deviations (n,), rad per axis, of the directions at an epoch, with errors of proper motion."""
        years = julian_year(et) - self.epoch_jyear
        return np.asarray(np.hypot(self.sigma_mas, self.sigma_pm_mas_yr * years) * RAD_PER_MAS)


COLUMN_TYPES: Mapping[str, type[np.generic]] = MappingProxyType(
    {"ids": np.int64} | {f.name: np.float64 for f in fields(StarTable)[1:-1]} | {"is_double": np.bool_}
)
"""The columns of a :class:`StarTable` in their order, and the types of their values."""


def join_tables(tables: Sequence[StarTable]) -> StarTable:
    """Concatenate star tables."""
    require(len(tables) > 0, "joined needs at least one star table")
    return StarTable(**{name: np.concatenate([getattr(table, name) for table in tables]) for name in COLUMN_TYPES})


def julian_year(et: float) -> float:
    """Julian epoch of a time.

    >>> julian_year(504921600.0)
    2016.0
    """
    return 2000.0 + et / SECONDS_PER_JULIAN_YEAR


def et_of_julian_year(year: float) -> float:
    """Time of a Julian epoch.

    >>> et_of_julian_year(2016.0)
    504921600.0
    """
    return (year - 2000.0) * SECONDS_PER_JULIAN_YEAR
