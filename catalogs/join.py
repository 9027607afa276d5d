"""Catalogs joined into one: a user's own stars on top of a published catalog."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from giantlike.catalogs.astrometry import apparent_directions
from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.table import StarTable, et_of_julian_year, join_tables
from giantlike.core.arrays import Mask, require
from giantlike.core.units import RAD_PER_ARCSEC

SAME_STAR_ARCSEC = 3.0  # stars of two catalogs this close to each other at the epoch of the later one are the same star
UNNAMED_BAND = "user"  # magnitudes in this band are taken to be in the band of the first catalog


def join_catalogs(catalogs: Sequence[MemoryCatalog], *, name: str) -> MemoryCatalog:
    """Join catalogs in the band of the first; a star that two have, within ``SAME_STAR_ARCSEC``, is from the later one.

    A later star whose identifier belongs to another star gets a negative number below all others. Magnitudes of a table
    without a band are used unchanged.
    """
    require(len(catalogs) > 0, "join_catalogs needs at least one catalog")
    first, *others = catalogs
    stars = first.stars
    for other in others:
        added = (other if other.band == UNNAMED_BAND else other.in_band(first.band)).stars
        rest = stars.select(~_found_in(stars, added))
        stars = join_tables([rest, _renumber(added, rest)])
    version = " + ".join(catalog.version for catalog in catalogs)
    return MemoryCatalog(stars, name=name, band=first.band, version=version)


def _found_in(stars: StarTable, others: StarTable) -> Mask:
    """Mask (n,) of the stars that are among the others."""
    found = np.zeros(len(stars), dtype=np.bool_)
    for epoch in np.unique(others.epoch_jyear):
        et = et_of_julian_year(float(epoch))
        some = others.select(others.epoch_jyear == epoch)
        tree = cKDTree(apparent_directions(some, et))
        distance, _ = tree.query(apparent_directions(stars, et), distance_upper_bound=SAME_STAR_ARCSEC * RAD_PER_ARCSEC)
        found |= np.isfinite(distance)
    return found


def _renumber(stars: StarTable, taken: StarTable) -> StarTable:
    """Stars with new identifiers where ``taken`` has theirs."""
    twice = np.isin(stars.ids, taken.ids)
    if not twice.any():
        return stars
    lowest = min(int(stars.ids.min()), int(taken.ids.min()), 0)
    ids = np.array(stars.ids)
    ids[twice] = lowest - 1 - np.arange(int(twice.sum()))
    return replace(stars, ids=ids)
