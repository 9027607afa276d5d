"""Star catalogs, epochs, and the directions in which an observer sees stars."""

from __future__ import annotations

from pathlib import Path

from giantlike.catalogs.astrometry import apparent_directions
from giantlike.catalogs.bands import BANDS, Band
from giantlike.catalogs.cache import cache_folder
from giantlike.catalogs.catalog import MemoryCatalog, StarCatalog
from giantlike.catalogs.proper_names import proper_names
from giantlike.catalogs.table import StarTable
from giantlike.core.deprecation import forward_names
from giantlike.core.errors import DataError

__all__ = [
    "BANDS",
    "Band",
    "MemoryCatalog",
    "StarCatalog",
    "StarTable",
    "apparent_directions",
    "cache_folder",
    "load_catalog",
    "proper_names",
]

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.catalogs.blends": "blended",
        "giantlike.catalogs.cache": "write_to_cache",
        "giantlike.catalogs.table": "et_of_julian_year julian_year",
    },
    until="0.4",
)


def load_catalog(name: str | Path = "default", *, band: str | Band | None = None) -> MemoryCatalog:
    """Load a star catalog.

    Parameters
    ----------
    name : str or path-like
        ``"default"`` for Gaia to G = 10 merged with Hipparcos (magnitudes in Gaia G), else the path of a file that
        ``giantlike catalog build`` made, or of a CSV file with the columns of :class:`StarTable`.
    band : str or Band, optional; give magnitudes in this band; see :meth:`MemoryCatalog.in_band`

    Raises
    ------
    DataError
        The file is missing or damaged.
    InputError
        The catalog's magnitudes cannot be turned into the band.
    """
    if str(name) == "default":
        from giantlike.catalogs.default import default_catalog

        catalog = default_catalog()
    else:
        catalog = _of_file(Path(name))
    return catalog if band is None else catalog.in_band(band)


def _of_file(path: Path) -> MemoryCatalog:
    if not path.exists():
        raise DataError(path, "there is no such catalog: give 'default', a built catalog or a CSV file")
    from giantlike.catalogs.stored import is_catalog_file, open_catalog

    if path.is_file() and is_catalog_file(path):
        return open_catalog(path)
    from giantlike.catalogs.csv_catalog import read_csv_catalog

    return read_csv_catalog(path)
