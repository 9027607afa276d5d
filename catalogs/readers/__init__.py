"""Readers of published catalogs, one for each format; :func:`build_catalog` makes a catalog of their stars."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from giantlike._system.reading import file_sha256
from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.readers.fixed_width import read_hipparcos, read_tycho2
from giantlike.catalogs.readers.mapped import ColumnMap, column_map, read_gaia, read_mapped, read_usno_gnc
from giantlike.catalogs.readers.rows import ReadStars
from giantlike.catalogs.readers.ucac4 import read_ucac4, zone_files
from giantlike.catalogs.stored import Source
from giantlike.catalogs.table import join_tables
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.core.values import Value

__all__ = ["FORMATS", "Built", "ColumnMap", "build_catalog", "column_map"]

Reader = Callable[..., ReadStars]
FORMATS: Mapping[str, Reader] = MappingProxyType(
    {
        "hipparcos": read_hipparcos,
        "tycho2": read_tycho2,
        "ucac4": read_ucac4,
        "usno-gnc": read_usno_gnc,
        "gaia": read_gaia,
        "table": read_mapped,
    }
)
"""Readers by format; each takes the path and ``max_magnitude``, the reader of tables also a column map."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built(Value):
    """A catalog and its sources.

    Parameters
    ----------
    catalog : MemoryCatalog
    sources : tuple of Source
    left_out : int; number of entries without a position or a magnitude
    repeated : int; number of entries whose identifier an earlier one has
    """

    catalog: MemoryCatalog
    sources: tuple[Source, ...]
    left_out: int
    repeated: int


def build_catalog(
    paths: Sequence[Path],
    form: str,
    *,
    name: str,
    mapping: ColumnMap | None = None,
    max_magnitude: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Built:
    """Read published files and make one catalog; all stars are in memory at once, about 400 bytes each at the peak.

    Parameters
    ----------
    paths : sequence of Path; files of one format; for UCAC4 also folders of zone files
    form : str; a key of :data:`FORMATS`
    name : str; name of the new catalog
    mapping : ColumnMap, optional; for the format ``table``, which needs one
    max_magnitude : float, optional; leave out fainter stars
    progress : callable, optional; called with the number of files done and of all files

    Raises
    ------
    InputError
        An unknown format, no files, or a column map where none belongs.
    DataError
        A file is missing or damaged, holds no stars, or has magnitudes in another band than the first.
    """
    if (form == "table") != (mapping is not None):
        raise InputError("a column map belongs to the format 'table', and that format needs one")
    files = _files(paths, form)
    read = FORMATS[form] if mapping is None else partial(read_mapped, mapping=mapping)
    parts: list[ReadStars] = []
    for done, file in enumerate(files, start=1):
        parts.append(read(file, max_magnitude=max_magnitude))
        have, first_band = parts[-1].band, parts[0].band
        if have != first_band:
            raise DataError(file, f"has magnitudes in {have}, {files[0].name} in {first_band}: build two catalogs")
        if progress is not None:
            progress(done, len(files))
    stars = join_tables([part.stars for part in parts])
    if not len(stars):
        limit = "" if max_magnitude is None else f" to magnitude {max_magnitude:g}"
        raise DataError(files[0], f"no stars{limit} in {len(files)} file(s)")
    first = np.sort(np.unique(stars.ids, return_index=True)[1])
    repeated = len(stars) - len(first)
    if repeated:
        stars = stars.select(first)
    sources = tuple(Source(name=file.name, sha256=file_sha256(file)) for file in files)
    catalog = MemoryCatalog(stars, name=name, band=parts[0].band, version=_version(form, sources, max_magnitude))
    left_out = sum(part.left_out for part in parts)
    return Built(catalog=catalog, sources=sources, left_out=left_out, repeated=repeated)


def _files(paths: Sequence[Path], form: str) -> list[Path]:
    require(form in FORMATS, f"unknown format {form!r}: one of {', '.join(FORMATS)} is needed")
    files = [file for path in paths for file in (zone_files(path) if form == "ucac4" else [path])]
    require(bool(files), f"no files to read: {', '.join(str(path) for path in paths) or 'none given'}")
    return files


def _version(form: str, sources: Sequence[Source], max_magnitude: float | None) -> str:
    """Text for provenance, with one hash of all sources."""
    limit = "" if max_magnitude is None else f", to magnitude {max_magnitude:g}"
    if len(sources) == 1:
        return f"{form} from {sources[0].name}, sha256:{sources[0].sha256}{limit}"
    digest = hashlib.sha256("".join(source.sha256 for source in sources).encode()).hexdigest()
    return f"{form} from {len(sources)} files, sha256:{digest}{limit}"
