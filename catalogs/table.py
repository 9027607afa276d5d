"""A table of stars, one array per column."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Float, frozen, require
from giantlike.core.units import RAD_PER_MAS, SECONDS_PER_JULIAN_YEAR


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarTable:
    """Astrometry of n stars at their catalogue epochs, barycentric, ICRF.

    Parameters
    ----------
    ids : (n,) int64
        Catalogue identifiers: Gaia source ids, negative Hipparcos numbers, or the user's own.
    ra_deg, dec_deg : (n,) float64, deg
        Position at ``epoch_jyear``, as seen from the solar system barycentre.
    pm_ra_mas_yr, pm_dec_mas_yr : (n,) float64, mas/yr
        Proper motion; the first one includes cos(dec).
    parallax_mas : (n,) float64, mas
        0 where unknown.
    radial_velocity_km_s : (n,) float64, km/s
        0 where unknown.
    epoch_jyear : (n,) float64
        Julian epoch (TDB) of the position.
    magnitude : (n,) float64
        In the band of the catalogue.
    color_bv : (n,) float64
        Johnson B-V, NaN where unknown.
    sigma_mas : (n,) float64, mas
        Standard deviation of the position per axis at ``epoch_jyear``.
    sigma_pm_mas_yr : (n,) float64, mas/yr
        Standard deviation of the proper motion per axis.
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

    def __post_init__(self) -> None:
        n = np.asarray(self.ids).shape
        require(len(n) == 1, f"star table: ids must have shape (n,), got {n}")
        for field in fields(self):
            dtype = np.int64 if field.name == "ids" else np.float64
            column = np.asarray(getattr(self, field.name), dtype=dtype)
            require(column.shape == n, f"star table: {field.name} must have shape {n}, got {column.shape}")
            object.__setattr__(self, field.name, frozen(column.view()))

    def __len__(self) -> int:
        return int(self.ids.size)

    def select(self, index: ArrayLike) -> StarTable:
        """The stars of a mask (n,) or of integer indices (k,), in that order."""
        chosen = np.asarray(index)
        return StarTable(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    def sigma_rad(self, et: float) -> Float:
        """Standard deviation (n,) per axis, rad, of the directions at ``et``: position and proper motion."""
        years = julian_year(et) - self.epoch_jyear
        sigma: Float = np.hypot(self.sigma_mas, self.sigma_pm_mas_yr * years) * RAD_PER_MAS
        return sigma


def julian_year(et: float) -> float:
    """Julian epoch of TDB seconds past J2000.

    >>> julian_year(504921600.0)
    2016.0
    """
    return 2000.0 + et / SECONDS_PER_JULIAN_YEAR


def et_of_julian_year(year: float) -> float:
    """TDB seconds past J2000 of a Julian epoch.

    >>> et_of_julian_year(2016.0)
    504921600.0
    """
    return (year - 2000.0) * SECONDS_PER_JULIAN_YEAR
