"""Readers of catalogs that are tables: Gaia archive, USNO GNC, and any table with a map of its columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check, reads, toml_table
from giantlike.catalogs.readers.rows import (
    CLOSE_ARCSEC,
    DEFAULTS,
    GAIA_EPOCH,
    REQUIRED,
    ReadStars,
    parse_number,
    rms,
    stars_of,
)
from giantlike.catalogs.readers.tabular import Table, open_table
from giantlike.catalogs.table import COLUMN_TYPES
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError

Term = str | float  # ``NAME`` or ``NAME*FACTOR`` of a column, or a number that all stars have in common
_SHOWN_COLUMNS = 30  # of the names of a table in an error message: enough to find the correct one on a screen
_ARCHIVE_DEFAULTS = MappingProxyType({**DEFAULTS, "epoch_jyear": GAIA_EPOCH})


@dataclass(frozen=True, slots=True, kw_only=True)
class _Archive:
    """Column names of a published table, by the names of a star table; pairs make one column of two."""

    names: Mapping[str, str]
    colors: tuple[str, str]
    position_errors: tuple[str, str]
    motion_errors: tuple[str, str]
    companions: str


_GAIA = _Archive(
    names={
        "ids": "source_id", "ra_deg": "ra", "dec_deg": "dec", "magnitude": "phot_g_mean_mag", "pm_ra_mas_yr": "pmra",
        "pm_dec_mas_yr": "pmdec", "parallax_mas": "parallax", "radial_velocity_km_s": "radial_velocity",
        "epoch_jyear": "ref_epoch", "color_bp_rp": "bp_rp",
    },
    colors=("phot_bp_mean_mag", "phot_rp_mean_mag"),
    position_errors=("ra_error", "dec_error"),
    motion_errors=("pmra_error", "pmdec_error"),
    companions="non_single_star",
)  # fmt: skip
_USNO_GNC = _Archive(
    names={
        "ids": "gnc_id", "ra_deg": "ra_2016", "dec_deg": "de_2016", "magnitude": "gmag", "pm_ra_mas_yr": "pmra",
        "pm_dec_mas_yr": "pmde", "parallax_mas": "plx",
    },
    colors=("bpmag", "rpmag"),
    position_errors=("e_ra_2016", "e_de_2016"),
    motion_errors=("e_pmra", "e_pmde"),
    companions="neighbor_distance_arcsec",
)  # fmt: skip


@reads("an extract of the Gaia archive")
def read_gaia(path: Path, *, max_magnitude: float | None = None) -> ReadStars:
    """Read an extract of the Gaia archive: CSV, ECSV, FITS, Parquet or VOTable with the names of ``gaia_source``.

    Needed are ``source_id``, ``ra``, ``dec`` and ``phot_g_mean_mag``; used when there are ``ref_epoch`` (else J2016.0,
    the epoch of DR3), ``pmra``, ``pmdec``, ``parallax``, ``radial_velocity``, ``bp_rp`` or ``phot_bp_mean_mag`` and
    ``phot_rp_mean_mag``, ``ra_error``, ``dec_error``, ``pmra_error``, ``pmdec_error`` and ``non_single_star``.

    Names, units and conventions as in the archive's own files: angles in deg and mas, pmra with cos(dec).
    """
    return _read_archive(path, _GAIA, lambda flags: flags, max_magnitude)


@reads("the USNO GNC catalog")
def read_usno_gnc(path: Path, *, max_magnitude: float | None = None) -> ReadStars:
    """Read the USNO GNC catalog (``gnc_v1_1_mar_2_2023.csv``), or an extract of it.

    A CSV file with positions in deg at J2016.0 (``ra_2016``, ``de_2016``) from Gaia DR3, Hipparcos and the USNO bright
    star catalog, proper motions in mas/yr (``pmra`` with cos(dec), ``pmde``), parallax in mas (``plx``), G, BP and RP
    (``gmag``, ``bpmag``, ``rpmag``), errors with ``e_`` before the name, and ``neighbor_distance_arcsec``. Identifiers
    are ``gnc_id``. Stars are double whose neighbor is within 5 arcsec. Empty cells are values not known.

    Columns, units and epoch are those that NASA GIANT 2, SONIC and a Rust crate agree on.
    """
    return _read_archive(path, _USNO_GNC, lambda arcsec: (arcsec <= CLOSE_ARCSEC).astype(np.float64), max_magnitude)


def _read_archive(
    path: Path, archive: _Archive, is_double: Callable[[Float], Float], max_magnitude: float | None
) -> ReadStars:
    table = open_table(path)
    columns: dict[str, NDArray[Any]] = {}
    for name, column in archive.names.items():
        if name in ("ids", *REQUIRED):
            _known(table, column)
        if column in table.names:
            columns[name] = table.integers(column) if name == "ids" else table.numbers(column)
    for name, pair, combined in (
        ("color_bp_rp", archive.colors, np.subtract),
        ("sigma_mas", archive.position_errors, rms),
        ("sigma_pm_mas_yr", archive.motion_errors, rms),
    ):
        if name not in columns and set(pair) <= set(table.names):
            columns[name] = combined(table.numbers(pair[0]), table.numbers(pair[1]))
    if archive.companions in table.names:
        columns["is_double"] = is_double(table.numbers(archive.companions))
    return stars_of(
        columns, band="Gaia G", record=table.record, defaults=_ARCHIVE_DEFAULTS, max_magnitude=max_magnitude
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """Columns of a table by the names of the columns of a :class:`~giantlike.catalogs.StarTable`.

    Parameters
    ----------
    terms : mapping of str to str or float
        Names of a star table to names in the file, ``NAME*FACTOR`` for another unit (``"RAh*15"``,
        ``"pmRA*1000"``), or a number for all stars (``epoch_jyear = 2000.0``). ``ra_deg``, ``dec_deg`` and
        ``magnitude`` are needed; without ``ids`` stars are numbered from 1. Columns of the file that already have the
        name of a star table need no term.
    band : str; photometric band of the magnitudes

    Raises
    ------
    InputError
        A name that no star table has, or a term that is neither text nor a number.
    """

    terms: Mapping[str, Term]
    band: str = "user"

    def __post_init__(self) -> None:
        for name, term in self.terms.items():
            require(name in COLUMN_TYPES, f"unknown column {name!r}: a star table has {', '.join(COLUMN_TYPES)}")
            if isinstance(term, bool) or not isinstance(term, str | float | int) or term == "":
                raise InputError(f"column {name!r} must be the name of a column or a number, got {term!r}")
            require(name != "ids" or isinstance(term, str), "column 'ids' must be the name of a column")
        object.__setattr__(self, "terms", MappingProxyType(dict(self.terms)))


def column_map(settings: Sequence[str], *, file: Path | None = None, band: str | None = None) -> ColumnMap:
    """Make a column map of ``NAME=TERM`` settings and of a TOML file, whose settings they override.

    The file has one ``name = "column"`` or ``name = number`` for each column, and may have ``band = "V"``.

    Parameters
    ----------
    settings : sequence of str
    file : Path, optional
    band : str, optional; photometric band of the magnitudes; default: the file's, or ``user``

    Raises
    ------
    InputError
        A setting is none.
    DataError
        The file cannot be read, or its settings are none.
    """
    known = ColumnMap(terms={}) if file is None else _read_column_map(file)
    terms = dict(known.terms)
    for setting in settings:
        name, equals, term = setting.partition("=")
        if not equals or not term.strip():
            raise InputError(f"expected NAME=COLUMN such as ra_deg=RAJ2000, got {setting!r}")
        number = parse_number(term)
        terms[name.strip()] = term.strip() if number is None else number
    return ColumnMap(terms=terms, band=known.band if band is None else band)


@reads("a TOML file of columns")
def _read_column_map(path: Path) -> ColumnMap:
    terms = toml_table(path, "file of columns")
    band = terms.pop("band", "user")
    check(isinstance(band, str), f"band must be text such as 'V', got {band!r}")
    return ColumnMap(terms=terms, band=band)


@reads("a table of stars")
def read_mapped(path: Path, mapping: ColumnMap, *, max_magnitude: float | None = None) -> ReadStars:
    """Read any table with a column map."""
    table = open_table(path)
    terms: dict[str, Term] = {name: name for name in COLUMN_TYPES if name in table.names}
    terms |= mapping.terms
    for name in REQUIRED:
        if name not in terms:
            raise ValueError(
                f"it has no column {name!r}: say which one it is, --column {name}=NAME; {_list_columns(table)}"
            )
    values = {name: _values(table, term) for name, term in terms.items() if name != "ids"}
    count = max(len(column) for column in values.values())
    columns: dict[str, NDArray[Any]] = {name: np.broadcast_to(column, (count,)) for name, column in values.items()}
    if "ids" in terms:
        columns["ids"] = table.integers(_known(table, str(terms["ids"])))
    else:
        columns["ids"] = np.arange(1, count + 1)
    return stars_of(columns, band=mapping.band, record=table.record, max_magnitude=max_magnitude)


def _values(table: Table, term: Term) -> Float:
    """Values (n,) of a term, or (1,) for a number."""
    if not isinstance(term, str):
        return np.array([float(term)])
    name, _, factor = term.rpartition("*")
    scale = parse_number(factor) if name and term not in table.names else None
    if scale is None:
        return table.numbers(_known(table, term))
    return scale * table.numbers(_known(table, name.strip()))


def _known(table: Table, name: str) -> str:
    """The name of a column, which the table must have."""
    if name not in table.names:
        raise ValueError(f"it has no column {name!r}; {_list_columns(table)}")
    return name


def _list_columns(table: Table) -> str:
    shown = ", ".join(list(table.names)[:_SHOWN_COLUMNS])
    return f"it has {shown}" + (" and more" if len(table.names) > _SHOWN_COLUMNS else "")
