"""A grid of heights that lies in several files, such as the quarters in which fine maps are archived."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.io.height_maps.grid import HeightGrid, Read, put

_SAME = 1e-6
"""Relative difference up to which steps and radii of files are the same: digits of labels."""
_ON_GRID = 0.01
"""Samples by which a part may lie off the grid of the first: digits of labels."""


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
