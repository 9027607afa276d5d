"""Star indices of the whole sky: made from any catalog on demand, and kept in memory and in the cache folder."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np

from giantlike.catalogs import (
    StarCatalog,
    StarTable,
    apparent_directions,
    cache_folder,
    et_of_julian_year,
    write_to_cache,
)
from giantlike.stars.field import EPOCH_WHEN_UNKNOWN
from giantlike.stars.star_index import Pattern, StarIndex, build_index, density_for

_FORMAT = 1  # of the files; raise it when patterns change
_STEP = math.sqrt(2.0)
_WIDEST_STEP = 9  # 22.6 degrees
_NARROWEST_STEP = -7  # 0.088 degrees
_FIRST_MAGNITUDE, _LAST_MAGNITUDE = 5.0, 22.0
_KEPT = 8
_memory: OrderedDict[tuple[int, Pattern, int, float | None], tuple[StarCatalog, StarIndex]] = OrderedDict()


def cap_radius_rad(wanted_rad: float) -> float:
    """The largest radius not above ``wanted_rad`` for which there are indices: they are a factor of 1.4 apart."""
    return math.radians(_STEP ** _step(wanted_rad))


def sky_index(
    catalog: StarCatalog, pattern: Pattern, radius_rad: float, *, max_magnitude: float | None = None
) -> StarIndex:
    """Index of a catalog's whole sky, from memory, the cache folder, or made now.

    Making one takes well below a second for fields from 10 degrees up, and some 10 s at 1 degree, where it holds
    half a million stars; a file of the cache is recognized by the stars themselves, so that a catalog that has
    changed never meets the patterns of another.

    Parameters
    ----------
    catalog : StarCatalog
    pattern : Pattern
    radius_rad : float, rad
        Of the caps; see :func:`cap_radius_rad`.
    max_magnitude : float, optional
        Faintest star to use; default: as deep as the caps need.
    """
    key = (id(catalog), pattern, _step(radius_rad), max_magnitude)
    held = _memory.get(key)
    if held is None:
        held = (catalog, _stored(catalog, pattern, cap_radius_rad(radius_rad), max_magnitude))
        _memory[key] = held
        while len(_memory) > _KEPT:
            _memory.popitem(last=False)
    _memory.move_to_end(key)
    return held[1]


def _step(radius_rad: float) -> int:
    step = math.floor(math.log(math.degrees(radius_rad)) / math.log(_STEP) + 1e-9)
    return min(max(step, _NARROWEST_STEP), _WIDEST_STEP)


def _stored(catalog: StarCatalog, pattern: Pattern, radius_rad: float, max_magnitude: float | None) -> StarIndex:
    stars = _brightest(catalog, density_for(radius_rad).stars_wanted(radius_rad), max_magnitude)
    digest = hashlib.sha256(stars.ids.tobytes() + stars.ra_deg.tobytes() + stars.dec_deg.tobytes()).hexdigest()[:16]
    name = f"star-index-{_FORMAT}-{pattern}-{math.degrees(radius_rad):.3f}-{digest}.npz"
    index = _read(cache_folder() / name, pattern, radius_rad)
    if index is not None:
        return index
    directions = apparent_directions(stars, et_of_julian_year(EPOCH_WHEN_UNKNOWN))
    made = build_index(pattern, stars.ids, directions, radius_rad)
    write_to_cache(
        name,
        lambda path: np.savez(path, ids=made.ids, directions=made.directions, patterns=made.patterns, cells=made.cells),
    )
    return made


def _brightest(catalog: StarCatalog, count: int, max_magnitude: float | None) -> StarTable:
    """The ``count`` brightest stars of a catalog, or all that it has."""
    deepest = _LAST_MAGNITUDE if max_magnitude is None else max_magnitude
    limit = min(_FIRST_MAGNITUDE, deepest)
    while True:
        stars = catalog.cone([0.0, 0.0, 1.0], np.pi, max_magnitude=limit)
        if len(stars) >= count or limit >= deepest:
            return stars.select(np.arange(min(count, len(stars))))
        step = math.log(count / max(len(stars), 10)) / math.log(3.0) if len(stars) else 2.0
        limit = min(limit + max(step, 0.3), deepest)


def _read(path: Path, pattern: Pattern, radius_rad: float) -> StarIndex | None:
    """The index of a file; None where there is none or it is damaged, so that it is made again."""
    try:
        with np.load(path, allow_pickle=False) as columns:
            return StarIndex(pattern=pattern, radius_rad=radius_rad, **{name: columns[name] for name in columns.files})
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile):
        return None
