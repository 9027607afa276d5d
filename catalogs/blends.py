"""Blends: stars that a camera does not resolve, merged into one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from giantlike.catalogs.astrometry import apparent_directions
from giantlike.catalogs.table import StarTable, julian_year
from giantlike.core.arrays import Float, require
from giantlike.core.frames import radec_from_direction
from giantlike.core.units import RAD_PER_MAS

_MAGNITUDE = 2.5 / np.log(10.0)  # magnitudes by the natural logarithm of a ratio of fluxes (Pogson)


def blended(stars: StarTable, radius_rad: float, *, et: float) -> StarTable:
    """Merge stars that are nearer to each other than a camera resolves.

    Each star, the brightest first, takes in all fainter ones within ``radius_rad`` that no brighter one has taken. The
    merged star has the identifier, colors and radial velocity of the brightest, the flux of all, and at ``et`` the
    position (correct to second order in the separation), motion and parallax of the photocenter, as a fit to the
    blended image measures while the separation is well below the width of the PSF. It is marked as double.
    """
    require(0.0 < radius_rad < np.inf, f"radius_rad must be positive, got {radius_rad}")
    stars = stars.select(np.argsort(stars.magnitude, kind="stable"))
    directions = apparent_directions(stars, et)
    leader = blend_leaders(directions, radius_rad)
    sizes = np.bincount(leader, minlength=len(stars))
    mixed = sizes > 1
    if not mixed.any():
        return stars
    flux = np.exp((stars.magnitude[leader] - stars.magnitude) / _MAGNITUDE)  # of the brightest of each blend
    total = np.bincount(leader, weights=flux, minlength=len(stars))
    weight = flux / total[leader]

    def mean(values: Float) -> Float:
        return np.asarray(np.bincount(leader, weights=weight * values, minlength=len(stars)).astype(np.float64))

    columns = stars.columns()
    center = np.stack([mean(component) for component in directions.T], axis=-1)
    ra, dec = radec_from_direction(center[mixed])
    columns["ra_deg"][mixed], columns["dec_deg"][mixed] = ra, dec
    columns["epoch_jyear"][mixed] = julian_year(et)
    for name in ("pm_ra_mas_yr", "pm_dec_mas_yr", "parallax_mas"):
        columns[name][mixed] = mean(columns[name])[mixed]
    variance = np.bincount(leader, weights=(weight * stars.sigma_rad(et) / RAD_PER_MAS) ** 2, minlength=len(stars))
    drift = np.bincount(leader, weights=(weight * stars.sigma_pm_mas_yr) ** 2, minlength=len(stars))
    columns["sigma_mas"][mixed], columns["sigma_pm_mas_yr"][mixed] = np.sqrt(variance[mixed]), np.sqrt(drift[mixed])
    columns["magnitude"][mixed] -= _MAGNITUDE * np.log(total[mixed])
    columns["is_double"][mixed] = True
    merged = StarTable(**columns).select(sizes > 0)
    return merged.select(np.argsort(merged.magnitude, kind="stable"))


def blend_leaders(directions: Float, radius_rad: float) -> NDArray[np.intp]:
    """Number (n,) of the star that each is merged into. ``directions`` (n, 3), unit vectors, brightest stars first."""
    count = len(directions)
    leader = np.arange(count)
    chord = 2.0 * np.sin(min(radius_rad, np.pi) / 2.0)
    pairs = cKDTree(directions).query_pairs(chord, output_type="ndarray") if count else np.empty((0, 2), dtype=np.intp)
    for bright, faint in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        if leader[bright] == bright and leader[faint] == faint:
            leader[faint] = bright
    return leader
