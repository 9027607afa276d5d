"""Order of the stars in a catalog, in which a cone is a few runs of neighbors.

The sky is cut into ``ZONES`` zones of declination and each zone into cells of right ascension about as wide as it is
high. Stars stand zone after zone, cell after cell, the brightest first in each. Stars that may be seen far from their
catalog position, because they are fast or near, stand at the end, in no cell, and every cone looks at each of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.catalogs.table import StarTable
from giantlike.core.arrays import Float
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import AU_KM, RAD_PER_ARCSEC, RAD_PER_MAS, SECONDS_PER_JULIAN_YEAR
from giantlike.core.values import Value

ZONES = 180  # of declination, 1 degree each: a cone of a camera, some degrees wide, touches a few of them
YEARS_FROM_EPOCH = 125.0  # a cone holds every star that comes into it within this many years of its catalog epoch
OBSERVER_AU = 100.0  # a cone holds every star that parallax brings into it for an observer this far from the barycenter
ABERRATION_RAD = 1.5e-4  # margin, rad, added to the radius of a cone: aberration at 45 km/s, 45 km/s / c
FAST_RAD = 60.0 * RAD_PER_ARCSEC
"""Stars that may be seen farther than this from their catalog position are kept apart from the cells."""
_ROUNDING_RAD = 5e-7  # of directions in single precision
_PER_KM_S = SECONDS_PER_JULIAN_YEAR / AU_KM  # au per year

Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkyIndex(Value):
    """Directions and cells of the stars of a catalog in this order."""

    directions: NDArray[np.float32]  # (3, n), inertial axes; unit vectors to the catalog positions
    rank: NDArray[np.int32]  # (n,); position of each star by magnitude, so that equal ones have an order too
    starts: NDArray[np.int64]  # (cells + 1,); first star of each cell; the last entry is where the fast stars begin
    slow_margin_rad: float  # largest angle of the stars in cells from their catalog positions
    fast_margin_rad: Float  # (n_fast,); largest angle of each fast star

    def near(self, axis: Float, radius_rad: float) -> Index:
        """Return the stars of a cone, the fast ones last. ``axis`` in inertial axes, unit vector; returns (k,)."""
        reach = radius_rad + self.slow_margin_rad + ABERRATION_RAD + _ROUNDING_RAD
        slow = int(self.starts[-1])
        limits_of_runs = [*_runs(axis, reach, self.starts).tolist(), [slow, slow + self.fast_margin_rad.size]]
        runs = [slice(first, stop) for first, stop in limits_of_runs if stop > first]
        stars = np.concatenate([np.empty(0, np.intp), *(np.arange(run.start, run.stop) for run in runs)])
        squared = np.zeros(stars.size, dtype=np.float32)
        for row, component in zip(self.directions, axis.astype(np.float32), strict=True):
            difference = np.concatenate([np.empty(0, np.float32), *(row[run] for run in runs)])
            difference -= component
            with np.errstate(over="ignore", invalid="ignore"):  # directions of a damaged file are far from any axis
                difference *= difference
                squared += difference
        limits = np.full(stars.size, _chord_squared(reach), dtype=np.float32)
        wide = radius_rad + self.fast_margin_rad + ABERRATION_RAD + _ROUNDING_RAD
        limits[stars.size - self.fast_margin_rad.size :] = _chord_squared(wide)
        return stars[squared <= limits]


def sky_index(stars: StarTable) -> tuple[Index, SkyIndex]:
    """Order of stars by cells, and their index. Returns ``order`` (n,) and ``index``."""
    margin = margins_rad(stars)
    is_fast = margin > FAST_RAD
    by_brightness = np.argsort(stars.magnitude, kind="stable")
    rank = np.empty(len(stars), dtype=np.int32)
    rank[by_brightness] = np.arange(len(stars), dtype=np.int32)
    cell = np.where(is_fast, CELLS, _cells_of(stars.ra_deg, stars.dec_deg))
    order = np.lexsort((rank, cell))
    starts = np.searchsorted(cell[order], np.arange(CELLS + 1)).astype(np.int64)
    slow = margin[~is_fast]
    index = SkyIndex(
        directions=direction_from_radec(stars.ra_deg[order], stars.dec_deg[order]).T.astype(np.float32, order="C"),
        rank=rank[order],
        starts=starts,
        slow_margin_rad=float(slow.max(initial=0.0)),
        fast_margin_rad=margin[order[starts[-1] :]],
    )
    return order, index


def margins_rad(stars: StarTable) -> Float:
    """Largest angles of stars from their catalog positions, within ``YEARS_FROM_EPOCH`` and ``OBSERVER_AU``."""
    parallax = np.maximum(stars.parallax_mas, 0.0) * RAD_PER_MAS
    motion = np.hypot(stars.pm_ra_mas_yr, stars.pm_dec_mas_yr) * RAD_PER_MAS
    nearest = 1.0 - np.abs(stars.radial_velocity_km_s) * _PER_KM_S * parallax * YEARS_FROM_EPOCH
    across = (motion * YEARS_FROM_EPOCH + parallax * OBSERVER_AU) / np.maximum(nearest, 1e-3)
    return np.asarray(np.arcsin(np.minimum(1.01 * across, 1.0)))  # 1 % for light-time terms


def _cells_in_zones() -> NDArray[np.int64]:
    """Number (zones,) of cells in each zone."""
    middle = np.radians(-90.0 + (np.arange(ZONES) + 0.5) * 180.0 / ZONES)
    return np.asarray(np.maximum(np.rint(2 * ZONES * np.cos(middle)), 1).astype(np.int64))


_IN_ZONE = _cells_in_zones()
_FIRST = np.concatenate([[0], np.cumsum(_IN_ZONE)])
CELLS = int(_FIRST[-1])


def _cells_of(ra_deg: Float, dec_deg: Float) -> NDArray[np.int64]:
    zone = np.clip(np.floor((dec_deg + 90.0) * (ZONES / 180.0)), 0, ZONES - 1).astype(np.int64)
    turn = np.mod(ra_deg, 360.0) / 360.0
    return np.asarray(_FIRST[zone] + np.minimum((turn * _IN_ZONE[zone]).astype(np.int64), _IN_ZONE[zone] - 1))


def _runs(axis: Float, reach_rad: float, starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """First star and the one after the last (k, 2) of runs of cells that hold everything within ``reach_rad``."""
    dec = float(np.arctan2(axis[2], np.hypot(axis[0], axis[1])))
    height = np.pi / ZONES
    low, high = max(dec - reach_rad, -np.pi / 2), min(dec + reach_rad, np.pi / 2)
    first = int(np.clip(np.floor((low + np.pi / 2) / height - 1e-9), 0, ZONES - 1))
    last = int(np.clip(np.floor((high + np.pi / 2) / height + 1e-9), 0, ZONES - 1))
    zones = np.arange(first, last + 1)
    half_turn = _half_widths(zones, dec, reach_rad, low, high) / (2.0 * np.pi)
    middle = np.mod(np.arctan2(axis[1], axis[0]) / (2.0 * np.pi), 1.0)
    count = _IN_ZONE[zones]
    left = np.floor((middle - half_turn) * count - 1e-6).astype(np.int64)
    right = np.floor((middle + half_turn) * count + 1e-6).astype(np.int64) + 1
    whole = right - left >= count
    left, right = np.where(whole, 0, left), np.where(whole, count, right)
    base = _FIRST[zones]
    wraps_left, wraps_right = left < 0, right > count
    main = np.stack([base + np.maximum(left, 0), base + np.minimum(right, count)], axis=-1)
    before = np.stack([base + left + count, base + count], axis=-1)[wraps_left]
    after = np.stack([base, base + right - count], axis=-1)[wraps_right]
    return np.asarray(starts[np.concatenate([main, before, after])])


def _half_widths(zones: NDArray[np.intp], dec: float, reach: float, low: float, high: float) -> Float:
    """Largest difference (k,) in right ascension, rad, between the axis and the part of a cone in each zone."""
    if reach >= 0.5 * np.pi - 1e-3:
        return np.full(zones.size, np.pi)
    edges = np.clip(np.stack([zones, zones + 1]) * (np.pi / ZONES) - np.pi / 2, low, high)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (np.cos(reach) - np.sin(edges) * np.sin(dec)) / (np.cos(edges) * np.cos(dec))
    width = np.arccos(np.clip(np.nan_to_num(cosine, nan=-1.0), -1.0, 1.0)).max(axis=0)
    tangent = np.sin(dec) / np.cos(reach)
    if abs(tangent) < 1.0:  # the pole is outside: the cone is widest where meridians touch it
        at = np.arcsin(tangent)
        widest = np.arcsin(min(np.sin(reach) / np.cos(dec), 1.0))
        width = np.where((edges[0] <= at) & (at <= edges[1]), widest, width)
    else:
        width = np.where((np.abs(edges) > np.pi / 2 - 1e-9).any(axis=0), np.pi, width)
    return np.asarray(width + 1e-9)


def _chord_squared(angle_rad: float | Float) -> Float:
    return np.asarray(4.0 * np.sin(np.minimum(angle_rad, np.pi) / 2.0) ** 2 * (1.0 + 1e-6))
