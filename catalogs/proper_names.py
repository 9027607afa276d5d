"""Proper names of bright stars, by position and magnitude, in any catalog.

``iau_star_names.csv`` has the names (edition of 2022-04-04, CC BY) that the IAU Working Group on Star Names approved
for single stars of Hipparcos brighter than V = 6.5, with the position at J2000.0 and Hp in the new reduction of
Hipparcos (van Leeuwen 2007, I/311), which lacks Alula Australis.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from giantlike.catalogs.astrometry import apparent_directions
from giantlike.catalogs.table import StarTable
from giantlike.core.arrays import Float
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import RAD_PER_ARCSEC

_FILE = Path(__file__).with_name("iau_star_names.csv")
_RADIUS_ARCSEC = 5.0  # maximum distance of one star in two catalogs at J2000.0, orbits of double stars included
_MAGNITUDES = 2.0
"""Maximum difference of Hp and the magnitude of a named star in any band; much fainter companions do not get its
name."""


@dataclass(frozen=True, slots=True)
class _Named:
    names: tuple[str, ...]
    tree: cKDTree
    magnitude: Float


def proper_names(stars: StarTable) -> tuple[str, ...]:
    """Proper names of stars.

    Parameters
    ----------
    stars : StarTable; of any catalog, in any band

    Returns
    -------
    tuple of n str
        Empty for the many that have none. A name is given once, to the star nearest to its position.

    Examples
    --------
    >>> from giantlike.catalogs import load_catalog, proper_names
    >>> from giantlike.core.frames import direction_from_radec
    >>> proper_names(load_catalog().cone(direction_from_radec(101.288, -16.713), 0.001, max_magnitude=2.0))
    ('Sirius',)
    """
    known = _load_names()
    found = [""] * len(stars)
    bright = np.flatnonzero(stars.magnitude < known.magnitude.max() + _MAGNITUDES)
    if not len(bright):
        return tuple(found)
    some = stars.select(bright)
    limit = _RADIUS_ARCSEC * RAD_PER_ARCSEC
    apart, which = map(np.asarray, known.tree.query(apparent_directions(some, 0.0), distance_upper_bound=limit))
    near = np.flatnonzero(apart < limit)
    near = near[np.abs(some.magnitude[near] - known.magnitude[which[near]]) < _MAGNITUDES]
    nearest = near[np.argsort(apart[near])]
    _, first = np.unique(which[nearest], return_index=True)
    for place in nearest[first]:
        found[bright[place]] = known.names[which[place]]
    return tuple(found)


@lru_cache(maxsize=1)
def _load_names() -> _Named:
    """The names of the file with positions and magnitudes."""
    with _FILE.open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    ra, dec, magnitude = (
        np.array([float(row[name]) for row in rows]) for name in ("ra_deg", "dec_deg", "magnitude_hp")
    )
    return _Named(tuple(row["name"] for row in rows), cKDTree(direction_from_radec(ra, dec)), magnitude)
