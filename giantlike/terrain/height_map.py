"""Height maps: relief above an ellipsoid, looked up by direction, with what the grid does not resolve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike._system.reading import file_sha256
from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.values import Value
from giantlike.io.height_maps import HeightGrid, joined_grid, read_height_grid, require_usable, write_height_archive
from giantlike.shapes import TriangleMesh

_TILE = 256  # samples along the side of a tile that is kept: a quarter of a megabyte
_TILES_KEPT = 256  # tiles in memory, 67 MB: all of a map with 16 samples to the degree, and a limb zone of one with 32
_SAMPLED_TILES = 48  # tiles that are looked at for what is true of the whole map
_LEAST_GROWTH, _MOST_GROWTH = 1.1, 16.0
"""Growth of the variance that a grid twice as coarse does not resolve: between that of noise, and that of slopes."""
_EARTH_LIKE = 1.3  # how far the extremes of a map may lie beyond those of the tiles that were looked at


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeightMap(Value):
    """Relief of a body on an equirectangular grid, never whole in memory where it is large.

    The surface lies at the radius of the reference ellipsoid plus the height, along the radius; latitudes are
    planetocentric and longitudes go to the east.

    Parameters
    ----------
    grid : HeightGrid; as read, or of :meth:`from_array`
    sigma_km : float, km
        Standard deviation of the heights over wide areas: what is not known of them, beside what the grid does not
        resolve, which the map itself tells.

    Examples
    --------
    >>> moon = HeightMap.from_array(np.full((18, 36), 2.0), reference_radii_km=[1737.4] * 3)
    >>> moon.heights_km([0.0, 0.0, 1.0])
    array(2.)
    """

    grid: HeightGrid
    sigma_km: float = 0.0

    def __post_init__(self) -> None:
        Value.__post_init__(self)
        require_number(self.sigma_km, "sigma_km", least=0.0)

    @classmethod
    def open(
        cls,
        path: str | Path | Sequence[str | Path],
        *,
        sigma_km: float | None = None,
        reference_radii_km: ArrayLike | None = None,
        unit_km: float | None = None,
    ) -> HeightMap:
        """Open the file of a map: a PDS3 image with its label (such as LOLA's), a GeoTIFF or a numpy archive.

        Parameters
        ----------
        path : path-like or sequence of path-like; files of one map are joined; of overlaps the later counts
        sigma_km : float, km, optional; standard deviation of the heights; that of the file, else 0
        reference_radii_km : (3,), km, optional; semi-axes of the reference ellipsoid, where the file lacks them
        unit_km : float, km, optional; length of a stored unit, where the file lacks it

        Raises
        ------
        DataError
            A file is missing, damaged, of another kind or in another projection; or files are not of one map.
        InputError
            An argument makes no sense, no file is given, or a GeoTIFF is to be read and tifffile is not installed.
        """
        radii = None if reference_radii_km is None else as_finite(reference_radii_km, (3,), "reference_radii_km")
        if unit_km is not None:
            require_number(unit_km, "unit_km", above=0.0)
        paths = [path] if isinstance(path, str | Path) else list(path)
        require(bool(paths), "a height map needs a file")
        grids = [read_height_grid(each, reference_radii_km=radii, unit_km=unit_km) for each in paths]
        grid = grids[0] if len(grids) == 1 else joined_grid(grids)
        found = cls(grid=grid, sigma_km=(grid.sigma_km or 0.0) if sigma_km is None else sigma_km)
        require_usable(grid, np.concatenate([block.ravel() for block in _sample(found)]))
        return found

    @classmethod
    def from_array(cls, heights_km: ArrayLike, *, reference_radii_km: ArrayLike, sigma_km: float = 0.0) -> HeightMap:
        """Make a map of the whole body from heights (rows, columns), km; InputError for another shape.

        Rows go from the north pole to the south, columns from longitude 0 to the east, samples are in the middles of
        cells; NaN where nothing is known. ``reference_radii_km`` (3,), km.
        """
        heights = as_floats(heights_km, (), "heights_km").astype(np.float32)
        require(heights.ndim == 2 and min(heights.shape) > 1, f"heights_km must be a grid, got {heights.shape}")
        rows, columns = heights.shape
        grid = HeightGrid(
            rows=rows,
            columns=columns,
            first_latitude_rad=0.5 * math.pi * (1.0 - 1.0 / rows),
            first_longitude_rad=math.pi / columns,
            latitude_step_rad=-math.pi / rows,
            longitude_step_rad=2.0 * math.pi / columns,
            reference_radii_km=as_finite(reference_radii_km, (3,), "reference_radii_km"),
            read=lambda some_rows, some_columns: heights[some_rows, some_columns],
        )
        found = cls(grid=grid, sigma_km=sigma_km)
        require_usable(grid, heights.ravel())
        return found

    def save(self, path: str | Path) -> None:
        """Write the map as a numpy archive in tiles, which is opened again without reading all of it.

        Raises InputError where rows do not go from north to south, or columns not to the east.
        """
        down = self.grid.latitude_step_rad < 0.0 < self.grid.longitude_step_rad
        require(down, "a map is written with rows from north to south and columns to the east")
        write_height_archive(path, self.grid, sigma_km=self.sigma_km)

    @property
    def name(self) -> str:
        """Name of the file, or ``heights``."""
        return "heights" if self.grid.path is None else self.grid.path.name

    @property
    def sha256(self) -> str:
        """Hash of the file, hexadecimal; of the samples of a map that was made in memory or joined of files."""
        return _sha256(self)

    @property
    def step_rad(self) -> float:
        """Distance of neighboring samples on the equator, rad."""
        return max(abs(self.grid.latitude_step_rad), abs(self.grid.longitude_step_rad))

    @property
    def span_km(self) -> float:
        """About the largest difference of two heights, km."""
        return _statistics(self)[0]

    @property
    def rms_km(self) -> float:
        """About the root mean square of the heights about their mean, km."""
        return _statistics(self)[1]

    def unresolved_km(self, step_rad: float | None = None) -> float:
        """Root mean square, km, of the relief that samples at a step do not resolve, as the map itself lets expect.

        ``step_rad``, rad: distance of the samples; that of the map by default.

        Notes
        -----
        Taken from what is lost where the map is made twice and four times as coarse and interpolated: the ratio of the
        two variances is how relief goes on to shorter lengths.
        """
        variance, growth = _statistics(self)[2:]
        wider = max((step_rad or self.step_rad) / self.step_rad, 1.0)
        return math.sqrt(variance * wider ** math.log2(growth))

    def heights_km(self, directions: ArrayLike) -> Float:
        """Heights (...), km, linear, above the ellipsoid in directions (..., 3), body axes; NaN outside the map."""
        vectors = as_floats(directions, (3,), "directions")
        x, y, z = np.moveaxis(vectors, -1, 0)
        latitude, longitude = np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)
        return self._looked_up(latitude.ravel(), longitude.ravel()).reshape(latitude.shape)

    def radii_km(self, directions: ArrayLike) -> Float:
        """Distances (...), km, of the surface from the center in directions (..., 3); NaN outside the map."""
        vectors = as_floats(directions, (3,), "directions")
        length = np.linalg.norm(vectors, axis=-1)
        reference = length / np.linalg.norm(vectors / self.grid.reference_radii_km, axis=-1)
        return np.asarray(reference + self.heights_km(vectors), dtype=np.float64)

    def mesh(self, step_deg: float = 1.0) -> TriangleMesh:
        """Closed mesh of the surface, for templates that are rendered.

        ``step_deg``, deg, in [0.1, 20]: distance of the vertices; 1 deg makes 129,000 facets. Where the map holds
        nothing it lies on the reference ellipsoid.
        """
        require_number(step_deg, "step_deg", least=0.1, most=20.0)
        bands, around = max(round(180.0 / step_deg), 4), max(round(360.0 / step_deg), 8)
        latitude = np.radians(np.linspace(90.0, -90.0, bands + 1))[1:-1]
        longitude = np.arange(around) * (2.0 * np.pi / around)
        level = np.cos(latitude)[:, None]
        ring = np.stack(
            [
                level * np.cos(longitude),
                level * np.sin(longitude),
                np.repeat(np.sin(latitude)[:, None], around, axis=1),
            ],
            axis=-1,
        )
        directions = np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
        reference = 1.0 / np.linalg.norm(directions / self.grid.reference_radii_km, axis=1)
        radii = reference + np.nan_to_num(self.heights_km(directions))
        return TriangleMesh(
            vertices_km=directions * radii[:, None], faces=_grid_faces(bands - 1, around), name=self.name
        )

    def _looked_up(self, latitude: Float, longitude: Float) -> Float:
        """Heights (n,) at latitudes and longitudes (n,), rad."""
        grid = self.grid
        row = (latitude - grid.first_latitude_rad) / grid.latitude_step_rad
        column = (longitude - grid.first_longitude_rad) / grid.longitude_step_rad
        period = 2.0 * math.pi / abs(grid.longitude_step_rad)
        # The half cell beyond the outermost centers still belongs to the map; what lies beyond a pole is its last row.
        column = (column + 0.5) % period - 0.5
        outside = (row < -0.5 - 1e-9) | (row > grid.rows - 0.5 + 1e-9)
        if not grid.global_columns:
            outside |= column > grid.columns - 0.5
            column = np.clip(column, 0.0, grid.columns - 1.0)
        row = np.clip(row, 0.0, grid.rows - 1.0)
        top = np.minimum(row.astype(np.int64), grid.rows - 2)
        left = np.floor(column).astype(np.int64)
        if not grid.global_columns:
            left = np.minimum(left, grid.columns - 2)
        down, right = row - top, column - left
        left %= grid.columns
        result = np.empty(row.size)
        across = -(-grid.columns // _TILE)
        keys = (top // _TILE) * across + left // _TILE
        order = np.argsort(keys, kind="stable")
        found, starts = np.unique(keys[order], return_index=True)
        for key, part in zip(found, np.split(order, starts[1:]), strict=True):
            tile = _tile(self, int(key) // across, int(key) % across)
            i, j = top[part] - (int(key) // across) * _TILE, left[part] - (int(key) % across) * _TILE
            upper = (1.0 - right[part]) * tile[i, j] + right[part] * tile[i, j + 1]
            lower = (1.0 - right[part]) * tile[i + 1, j] + right[part] * tile[i + 1, j + 1]
            result[part] = (1.0 - down[part]) * upper + down[part] * lower
        result[outside] = np.nan
        return result


def _grid_faces(rings: int, around: int) -> NDArray[np.int64]:
    """Facets of a body of two poles and rings of vertices between them, counterclockwise seen from outside."""
    east = (np.arange(around) + 1) % around
    here = np.arange(around)
    north = np.stack([np.zeros(around, dtype=np.int64), 1 + here, 1 + east], axis=1)
    last = 1 + (rings - 1) * around
    south = np.stack([np.full(around, 1 + rings * around), last + east, last + here], axis=1)
    start = 1 + around * np.arange(rings - 1)[:, None]
    upper_left, upper_right = (start + here).ravel(), (start + east).ravel()
    lower_left, lower_right = upper_left + around, upper_right + around
    return np.concatenate(
        [
            north,
            np.stack([upper_left, lower_left, lower_right], axis=1),
            np.stack([upper_left, lower_right, upper_right], axis=1),
            south,
        ]
    )


@lru_cache(maxsize=_TILES_KEPT)
def _tile(heights: HeightMap, i: int, j: int) -> NDArray[np.float32]:
    """Tile of a map, with one row and column of the next ones."""
    grid = heights.grid
    rows = slice(i * _TILE, min((i + 1) * _TILE + 1, grid.rows))
    columns = slice(j * _TILE, min((j + 1) * _TILE + 1, grid.columns))
    block = grid.block(rows, columns)
    if columns.stop == grid.columns and grid.global_columns:
        block = np.concatenate([block, grid.block(rows, slice(0, 1))], axis=1)
    return block


def _sample(heights: HeightMap) -> list[NDArray[np.float32]]:
    """Tiles spread over a map, without those near its poles where there are others, for what holds everywhere."""
    grid = heights.grid
    down, across = -(-grid.rows // _TILE), -(-grid.columns // _TILE)
    every = max(down * across // _SAMPLED_TILES, 1)
    chosen = [(key // across, key % across) for key in range(every // 2, down * across, every)]
    return [
        grid.block(
            slice(i * _TILE, min((i + 1) * _TILE, grid.rows)), slice(j * _TILE, min((j + 1) * _TILE, grid.columns))
        )
        for i, j in chosen
    ]


@lru_cache(maxsize=32)
def _statistics(heights: HeightMap) -> tuple[float, float, float, float]:
    """Span and root mean square of the heights, km; variance not resolved, km^2, and its growth with twice the step."""
    grid, blocks = heights.grid, _sample(heights)
    known = np.concatenate([block[np.isfinite(block)] for block in blocks]).astype(np.float64)
    span = float(np.ptp(known)) * (_EARTH_LIKE if len(blocks) * _TILE**2 < grid.rows * grid.columns else 1.0)
    lost = np.array([_lost(blocks, every) for every in (2, 4)])
    if not lost[0] > 0.0:
        return span, float(known.std()), 0.0, 2.0
    growth = float(np.clip(lost[1] / lost[0], _LEAST_GROWTH, _MOST_GROWTH))
    return span, float(known.std()), float(lost[0]) / growth, growth


def _lost(blocks: list[NDArray[np.float32]], every: int) -> float:
    """Mean square, km^2, of what interpolation between every so-many-th row leaves, doubled for the columns."""
    squares = []
    for block in blocks:
        rows = (len(block) - 1) // every * every
        if rows < every:
            continue
        nodes = block[: rows + 1 : every].astype(np.float64)
        for step in range(1, every):
            share = step / every
            between = (1.0 - share) * nodes[:-1] + share * nodes[1:]
            off = (block[step : rows + 1 : every] - between).ravel()
            squares.append(off[np.isfinite(off)] ** 2)
    values = np.concatenate(squares) if squares else np.zeros(0)
    return 2.0 * float(values.mean()) * (every - 1) / every if values.size else 0.0


@lru_cache(maxsize=32)
def _sha256(heights: HeightMap) -> str:
    if heights.grid.path is not None:
        return file_sha256(heights.grid.path)
    import hashlib

    grid, digest = heights.grid, hashlib.sha256()
    for top in range(0, grid.rows, _TILE):
        rows = slice(top, min(top + _TILE, grid.rows))
        digest.update(np.ascontiguousarray(grid.block(rows, slice(0, grid.columns))).tobytes())
    digest.update(grid.reference_radii_km.tobytes())
    return digest.hexdigest()
