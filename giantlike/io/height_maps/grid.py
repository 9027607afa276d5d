"""An equirectangular grid of heights, wherever it is stored, in one file or several, and tiles of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import check
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.values import Value

Read = Callable[[slice, slice], NDArray[Any]]
"""Stored values (r, c) of a slice of rows and one of columns, both with start and stop."""

MOST_AT_ONCE = 400_000_000
"""Bytes that an array which can only be read whole may take: larger maps are to be written in tiles."""
RADIUS_SHARE = 0.3
"""Values beyond this fraction of the radius are radii, not heights: no body has relief of a third of its size."""
_SMALLEST_STEP_RAD = 1e-12  # 2 micrometers on the Moon: a smaller one is invalid, and overflows
_MOST_SAMPLES = 1 << 36  # samples of a map at most; the finest global one, of the Moon with 256 to the degree, has 4e9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeightGrid(Value):
    """An equirectangular grid of heights, planetocentric, longitudes to the east, in a file or in memory."""

    rows: int
    columns: int
    first_latitude_rad: float  # first_latitude_rad, first_longitude_rad: center of the first sample
    first_longitude_rad: float
    latitude_step_rad: float  # latitude_step_rad, longitude_step_rad: negative towards south and west
    longitude_step_rad: float
    reference_radii_km: Float  # semi-axes of the ellipsoid above which the heights are
    read: Read  # stored values (r, c) of a slice of rows and one of columns, both with start and stop
    unit_km: float = 1.0  # unit_km, offset_km: A height is ``unit_km value + offset_km``
    offset_km: float = 0.0
    missing: tuple[float, ...] = ()  # stored values that stand for no height
    path: Path | None = None
    sigma_km: float | None = None  # standard deviation of the heights, where the file gives it

    def __post_init__(self) -> None:
        if not (self.rows > 1 and self.columns > 1 and self.rows * self.columns <= _MOST_SAMPLES):
            raise ValueError(f"needed a grid of 2 x 2 to 2^36 samples, got {self.rows} x {self.columns}")
        numbers = self.first_longitude_rad, self.unit_km, self.offset_km
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"needed finite numbers of the layout, got {numbers}")
        steps = self.latitude_step_rad, self.longitude_step_rad
        if not all(math.isfinite(step) and _SMALLEST_STEP_RAD < abs(step) < 1.0 for step in steps):
            raise ValueError(f"needed steps of the grid between 6e-11 and 57 deg, got {np.degrees(steps).tolist()} deg")
        last = self.first_latitude_rad + (self.rows - 1) * self.latitude_step_rad
        limit = 0.5 * math.pi + abs(self.latitude_step_rad)
        if not (abs(self.first_latitude_rad) < limit and abs(last) < limit):
            north, south = (round(math.degrees(end), 4) for end in (self.first_latitude_rad, last))
            raise ValueError(f"needed latitudes in [-90, 90] deg, the rows go from {north} to {south}")
        if self.columns * abs(self.longitude_step_rad) > 2.0 * math.pi + 2.0 * abs(self.longitude_step_rad):
            raise ValueError(f"the {self.columns} columns cover more than 360 deg of longitude")
        radii = np.asarray(self.reference_radii_km, dtype=np.float64)
        if radii.shape != (3,) or not (np.isfinite(radii).all() and bool((radii > 0.0).all())):
            raise ValueError(f"needed three positive radii of the reference, got {radii.tolist()}")
        self._keep(reference_radii_km=radii)

    @property
    def global_columns(self) -> bool:
        """True if the columns go all around the body."""
        return self.columns * abs(self.longitude_step_rad) > 2.0 * math.pi - 0.5 * abs(self.longitude_step_rad)

    def block(self, rows: slice, columns: slice) -> NDArray[np.float32]:
        """Heights of a part of the grid. Returns (r, c) km, NaN where there is none."""
        stored = self.read(rows, columns)
        with np.errstate(over="ignore", invalid="ignore"):
            heights = (stored.astype(np.float64) * self.unit_km + self.offset_km).astype(np.float32)
        heights[~np.isfinite(heights)] = np.nan
        for value in self.missing:
            heights[stored == value] = np.nan
        return heights


def require_usable(grid: HeightGrid, heights_km: NDArray[np.float32]) -> None:
    """Raise unless heights (n,), NaN where there is none, are plausible for relief."""
    known = heights_km[np.isfinite(heights_km)]
    where = grid.path or Path("heights")
    if not known.size:
        raise DataError(where, "the height map holds no heights: every sample looked at is missing")
    worst = float(np.max(np.abs(known)))
    if worst > RADIUS_SHARE * float(grid.reference_radii_km.min()):
        raise DataError(
            where,
            f"heights of {worst:.4g} km on a body of {grid.reference_radii_km.min():.6g} km: another unit, or radii; "
            "give unit_km, or a map of heights",
        )


def tiles_of(rows: slice, columns: slice, size: int) -> Iterator[tuple[int, int]]:
    """Tiles that a part of a grid touches."""
    for i in range(rows.start // size, (rows.stop - 1) // size + 1):
        for j in range(columns.start // size, (columns.stop - 1) // size + 1):
            yield i, j


def put(result: NDArray[Any], corner: tuple[int, int], tile: NDArray[Any], tile_corner: tuple[int, int]) -> None:
    """Copy the overlap of a tile (h, w) and a part (r, c) of a grid, given the row and column where each begins."""
    check(tile.ndim == 2, f"needed tiles of rows and columns, got one of shape {tile.shape}")
    first = [max(a, b) for a, b in zip(corner, tile_corner, strict=True)]
    last = [min(a + n, b + m) for a, n, b, m in zip(corner, result.shape, tile_corner, tile.shape, strict=True)]
    if last[0] > first[0] and last[1] > first[1]:
        here, there = (
            tuple(slice(f - c, e - c) for f, e, c in zip(first, last, place, strict=True))
            for place in (corner, tile_corner)
        )
        result[here] = tile[there]


_SAME = 1e-6  # relative difference up to which steps and radii of files are the same: digits of labels
_ON_GRID = 0.01  # samples by which a part may lie off the grid of the first: digits of labels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part(Value):
    """A grid, and the row and column of its first sample in the whole."""

    grid: HeightGrid
    corner: tuple[int, int]


def joined_grid(grids: Sequence[HeightGrid]) -> HeightGrid:
    """Join grids of one body and one step; where none is, no height is known."""
    first = grids[0]
    places = [_place(first, grid) for grid in grids]
    top = min(row for row, _ in places)
    parts = tuple(
        _Part(grid=grid, corner=(row - top, column)) for grid, (row, column) in zip(grids, places, strict=True)
    )

    def read(rows: slice, columns: slice) -> NDArray[Any]:
        result = np.full((rows.stop - rows.start, columns.stop - columns.start), np.nan, dtype=np.float32)
        for part in parts:
            inside = [
                slice(max(asked.start - start, 0), min(asked.stop - start, size))
                for asked, start, size in zip(
                    (rows, columns), part.corner, (part.grid.rows, part.grid.columns), strict=True
                )
            ]
            if all(one.stop > one.start for one in inside):
                corner = part.corner[0] + inside[0].start, part.corner[1] + inside[1].start
                put(result, (rows.start, columns.start), part.grid.block(*inside), corner)
        return result

    sigmas = [grid.sigma_km for grid in grids if grid.sigma_km is not None]
    try:
        return _whole(first, top, parts, read, max(sigmas) if sigmas else None)
    except ValueError as error:
        raise DataError(first.path or Path("heights"), f"cannot be joined with the other files: {error}") from error


def _whole(first: HeightGrid, top: int, parts: tuple[_Part, ...], read: Read, sigma_km: float | None) -> HeightGrid:
    return HeightGrid(
        rows=max(part.corner[0] + part.grid.rows for part in parts),
        columns=max(part.corner[1] + part.grid.columns for part in parts),
        first_latitude_rad=first.first_latitude_rad + top * first.latitude_step_rad,
        first_longitude_rad=first.first_longitude_rad,
        latitude_step_rad=first.latitude_step_rad,
        longitude_step_rad=first.longitude_step_rad,
        reference_radii_km=first.reference_radii_km,
        read=read,
        sigma_km=sigma_km,
    )


def _place(first: HeightGrid, grid: HeightGrid) -> tuple[int, int]:
    """Row of the first sample of a grid in the first one, and column, counted onward around the body."""
    here = grid.path or Path("heights")
    for what, one, other in (
        ("step of latitude", grid.latitude_step_rad, first.latitude_step_rad),
        ("step of longitude", grid.longitude_step_rad, first.longitude_step_rad),
        ("radii of the reference", grid.reference_radii_km, first.reference_radii_km),
    ):
        if not np.allclose(one, other, rtol=_SAME, atol=0.0):
            raise DataError(here, f"the {what} is not that of {first.path}: join files of one map")
    row = (grid.first_latitude_rad - first.first_latitude_rad) / first.latitude_step_rad
    east = (grid.first_longitude_rad - first.first_longitude_rad) * math.copysign(1.0, first.longitude_step_rad)
    step = abs(first.longitude_step_rad)
    column = ((east + 0.5 * step) % (2.0 * math.pi) - 0.5 * step) / step
    if max(abs(row - round(row)), abs(column - round(column))) > _ON_GRID:
        raise DataError(here, f"its samples lie between those of {first.path}: join files of one map")
    return round(row), round(column)
