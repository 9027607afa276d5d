"""Catalogs that are tables: which of their columns is what."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.catalogs.readers.fixed_width import rms
from giantlike.catalogs.readers.rows import DEFAULTS, REQUIRED, ReadStars, stars_of
from giantlike.catalogs.readers.tabular import Table, open_table
from giantlike.catalogs.table import COLUMN_TYPES
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, InputError

Term = str | float
"""``NAME`` or ``NAME*FACTOR`` of a column, or a number that all stars have in common."""
CLOSE_ARCSEC = 5.0
GAIA_EPOCH = 2016.0


def read_gaia(path: Path, *, max_magnitude: float | None = None) -> tuple[ReadStars, str]:
    """Read an extract of the Gaia archive: CSV, ECSV, FITS, Parquet or VOTable with the names of ``gaia_source``.

    Needed are ``source_id``, ``ra``, ``dec`` and ``phot_g_mean_mag``; used when there are ``ref_epoch`` (else J2016.0,
    that of DR3), ``pmra``, ``pmdec``, ``parallax``, ``radial_velocity``, ``bp_rp`` or ``phot_bp_mean_mag`` and
    ``phot_rp_mean_mag``, ``ra_error``, ``dec_error``, ``pmra_error``, ``pmdec_error`` and ``non_single_star``.

    Raises
    ------
    DataError
        The file is damaged, a needed column is missing, or a value is out of its limits.

    References
    ----------
    .. [1] Names, units and conventions as in the archive's own files: angles in deg and mas, pmra with cos(dec).
    """
    table = open_table(path)
    names = {"ids": "source_id", "ra_deg": "ra", "dec_deg": "dec", "magnitude": "phot_g_mean_mag"}
    names |= {"pm_ra_mas_yr": "pmra", "pm_dec_mas_yr": "pmdec", "parallax_mas": "parallax"}
    names |= {"radial_velocity_km_s": "radial_velocity", "epoch_jyear": "ref_epoch", "color_bp_rp": "bp_rp"}
    columns = _named(path, table, names)
    _add_pairs(table, columns, ("phot_bp_mean_mag", "phot_rp_mean_mag"), ("ra_error", "dec_error"), "pm{}_error")
    if "non_single_star" in table.names:
        columns["is_double"] = table.numbers("non_single_star")
    defaults = {**DEFAULTS, "epoch_jyear": GAIA_EPOCH}
    stars = stars_of(path, columns, record=table.record, defaults=defaults, max_magnitude=max_magnitude)
    return stars, "Gaia G"


def read_usno_gnc(path: Path, *, max_magnitude: float | None = None) -> tuple[ReadStars, str]:
    """Read the USNO GNC catalog (``gnc_v1_1_mar_2_2023.csv``), or an extract of it.

    A CSV file with positions in deg at J2016.0 (``ra_2016``, ``de_2016``) from Gaia DR3, Hipparcos and the USNO
    bright star catalog, proper motions in mas/yr (``pmra`` with cos(dec), ``pmde``), parallax in mas (``plx``), G, BP
    and RP (``gmag``, ``bpmag``, ``rpmag``), errors with ``e_`` before the name, and ``neighbor_distance_arcsec``.
    Identifiers are ``gnc_id``. Stars are double whose neighbor is within 5 arcsec. Empty cells are values not known.

    Raises
    ------
    DataError
        The file is damaged, a needed column is missing, or a value is out of its limits.

    References
    ----------
    .. [1] The catalog is published by the U.S. Naval Observatory with its ICRF products. Its own documentation could
       not be opened here; the columns, units and epoch are those that three independent public readers agree on: NASA
       GIANT 2 (``giant/catalogs/usno_gnc.py``), SONIC (``USNOGNC.m``), and a Rust crate with a field description.
    """
    table = open_table(path)
    names = {"ids": "gnc_id", "ra_deg": "ra_2016", "dec_deg": "de_2016", "magnitude": "gmag", "parallax_mas": "plx"}
    columns = _named(path, table, names | {"pm_ra_mas_yr": "pmra", "pm_dec_mas_yr": "pmde"})
    _add_pairs(table, columns, ("bpmag", "rpmag"), ("e_ra_2016", "e_de_2016"), "e_pm{}")
    if "neighbor_distance_arcsec" in table.names:
        columns["is_double"] = (table.numbers("neighbor_distance_arcsec") <= CLOSE_ARCSEC).astype(np.float64)
    defaults = {**DEFAULTS, "epoch_jyear": GAIA_EPOCH}
    stars = stars_of(path, columns, record=table.record, defaults=defaults, max_magnitude=max_magnitude)
    return stars, "Gaia G"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """Which column of a table is which of a :class:`~giantlike.catalogs.StarTable`.

    Parameters
    ----------
    terms : mapping of str to str or float
        Names of a star table to names in the file, ``NAME*FACTOR`` for another unit (``"RAh*15"``,
        ``"pmRA*1000"``), or a number for all stars (``epoch_jyear = 2000.0``). ``ra_deg``, ``dec_deg`` and
        ``magnitude`` are needed; without ``ids`` stars are numbered from 1. Columns of the file that already have the
        name of a star table need no term.
    band : str
        Photometric band of the magnitudes.

    Raises
    ------
    InputError
        A name that no star table has, or a term that is neither text nor a number.
    """

    terms: Mapping[str, Term]
    band: str = "user"

    def __post_init__(self) -> None:
        for name, term in self.terms.items():
            if name not in COLUMN_TYPES:
                raise InputError(f"unknown column {name!r}: a star table has {', '.join(COLUMN_TYPES)}")
            if isinstance(term, bool) or not isinstance(term, str | float | int) or term == "":
                raise InputError(f"column {name!r} must be the name of a column or a number, got {term!r}")
            if name == "ids" and not isinstance(term, str):
                raise InputError("column 'ids' must be the name of a column")
        object.__setattr__(self, "terms", MappingProxyType(dict(self.terms)))


def column_map(settings: Sequence[str], *, file: Path | None = None, band: str | None = None) -> ColumnMap:
    """Make a column map of ``NAME=TERM`` settings and of a TOML file, whose settings they override.

    The file has one ``name = "column"`` or ``name = number`` for each column, and may have ``band = "V"``.

    Raises
    ------
    InputError
        A setting is none.
    DataError
        The file cannot be read, or its settings are none.
    """
    terms: dict[str, Any] = {}
    if file is not None:
        try:
            terms = tomllib.loads(file.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise DataError(file, f"cannot be read as TOML: {error}") from error
    said = terms.pop("band", "user")
    if not isinstance(said, str):
        raise DataError(file or Path(), f"band must be text such as 'V', got {said!r}")
    for setting in settings:
        name, equals, term = setting.partition("=")
        if not equals or not term.strip():
            raise InputError(f"expected NAME=COLUMN such as ra_deg=RAJ2000, got {setting!r}")
        number = _number(term)
        terms[name.strip()] = term.strip() if number is None else number
    try:
        return ColumnMap(terms=terms, band=said if band is None else band)
    except InputError as error:
        if file is None:
            raise
        raise DataError(file, str(error)) from error


def read_mapped(path: Path, mapping: ColumnMap, *, max_magnitude: float | None = None) -> tuple[ReadStars, str]:
    """Read any table with a column map.

    Raises
    ------
    DataError
        The file is damaged, a column is missing, or a value is out of its limits.
    """
    table = open_table(path)
    terms: dict[str, Term] = {name: name for name in COLUMN_TYPES if name in table.names}
    terms |= mapping.terms
    for name in REQUIRED:
        if name not in terms:
            raise DataError(path, f"has no column {name!r}: say which one it is, --column {name}=NAME; {_there(table)}")
    columns: dict[str, NDArray[Any]] = {}
    for name, term in terms.items():
        if name != "ids":
            columns[name] = _values(path, table, term)
    count = max(len(values) for values in columns.values())
    columns = {name: np.broadcast_to(values, (count,)) for name, values in columns.items()}
    if "ids" in terms:
        columns["ids"] = table.integers(_known(path, table, str(terms["ids"])))
    else:
        columns["ids"] = np.arange(1, count + 1)
    return stars_of(path, columns, record=table.record, max_magnitude=max_magnitude), mapping.band


def _named(path: Path, table: Table, names: Mapping[str, str]) -> dict[str, NDArray[Any]]:
    """The columns of a table that there are of some; those that every star needs must be there."""
    columns: dict[str, NDArray[Any]] = {}
    for name, column in names.items():
        if name in ("ids", *REQUIRED):
            _known(path, table, column)
        if column in table.names:
            columns[name] = table.integers(column) if name == "ids" else table.numbers(column)
    return columns


def _add_pairs(
    table: Table, columns: dict[str, NDArray[Any]], colors: tuple[str, str], errors: tuple[str, str], motion: str
) -> None:
    """Add what comes of two columns: the color, the error of the place and that of the motion."""
    second = "dec" if errors[1].startswith("dec") else "de"
    motions = motion.format("ra"), motion.format(second)
    if "color_bp_rp" not in columns and set(colors) <= set(table.names):
        columns["color_bp_rp"] = table.numbers(colors[0]) - table.numbers(colors[1])
    for name, pair in (("sigma_mas", errors), ("sigma_pm_mas_yr", motions)):
        if set(pair) <= set(table.names):
            columns[name] = rms(table.numbers(pair[0]), table.numbers(pair[1]))


def _values(path: Path, table: Table, term: Term) -> Float:
    if not isinstance(term, str):
        return np.array([float(term)])
    if term in table.names:
        return table.numbers(term)
    name, _, factor = term.rpartition("*")
    scale = _number(factor) if name else None
    if scale is None:
        return table.numbers(_known(path, table, term))
    return scale * table.numbers(_known(path, table, name.strip()))


def _known(path: Path, table: Table, name: str) -> str:
    if name not in table.names:
        raise DataError(path, f"has no column {name!r}; {_there(table)}")
    return name


def _there(table: Table) -> str:
    shown = ", ".join(list(table.names)[:30])
    return f"it has {shown}" + (" and more" if len(table.names) > 30 else "")


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
