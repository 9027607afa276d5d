"""Sampling of an image: cells, directions of the rays through them, and the spread of their light over pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, unit
from giantlike.ray_tracing.spread import Spread

PSF_REACH_SIGMA = 5.0  # of the point spread function: less than 4e-6 of its light lies beyond
_NODES = (9, 25)  # of the interpolation, tried in turn: enough for narrow fields and for strong distortion
_DIRECTION_TOLERANCE_RAD = 1e-11  # 1e-7 px of 0.1 mrad
_BLAS_PRODUCTS = 200_000  # few enough that BLAS does not start its own threads
_CHECK = np.array([-0.93, -0.41, 0.17, 0.66, 0.98])  # positions between the nodes, of the half width: uneven, both ends


@dataclass(frozen=True, slots=True)
class AxisCells:
    """A row of equal cells along one axis of the image, ``per_px`` to a pixel and aligned with the pixels."""

    first: int  # first, count: numbers of the first cell and of cells; cell 0 starts at x = -0.5, left of pixel 0
    count: int
    per_px: int

    @classmethod
    def covering(cls, low_px: float, high_px: float, per_px: int) -> AxisCells:
        """Return the cells that cover ``low_px`` to ``high_px``; at least one."""
        first = int(np.floor((low_px + 0.5) * per_px))
        return cls(first, max(int(np.ceil((high_px + 0.5) * per_px)) - first, 1), per_px)

    @property
    def edges_px(self) -> Float:
        """Coordinates (count + 1,) of the edges, px."""
        return (np.arange(self.count + 1) + self.first) / self.per_px - 0.5

    @property
    def centers_px(self) -> Float:
        """Coordinates (count,) of the centers, px."""
        return (np.arange(self.count) + self.first + 0.5) / self.per_px - 0.5

    @property
    def middles(self) -> tuple[int, int]:
        """Number, from the first, of the first cell in the middle of a pixel, and that pixel."""
        number = (self.per_px // 2 - self.first) % self.per_px
        return number, (self.first + number) // self.per_px

    def spread(self, first_px: int, count_px: int, sigma_px: float) -> Spread:
        """Fraction of the light of each cell that falls on each pixel: even in the cell, Gaussian blur, exact."""
        half = 0.5 / self.per_px
        reach = PSF_REACH_SIGMA * sigma_px
        width = int(np.ceil(2 * reach + 2 * half)) + 1
        numbers = np.arange(self.count) + self.first
        kinds = min(self.per_px, self.count)  # cells alike in their pixels spread alike
        place = np.arange(self.count) % kinds
        centers = (numbers[:kinds] % self.per_px + 0.5) / self.per_px - 0.5
        lowest = np.floor(centers - half - reach + 0.5).astype(np.int64)
        left = lowest[:, None] + np.arange(width) - 0.5 - centers[:, None]
        weights = _ramp(left + 1 + half, sigma_px) - _ramp(left + 1 - half, sigma_px)
        weights -= _ramp(left + half, sigma_px) - _ramp(left - half, sigma_px)
        np.maximum(weights, 0.0, out=weights)  # rounding of differences far out
        return Spread(shares=weights, first=lowest[place] + numbers // self.per_px - first_px, count_px=count_px)


@dataclass(frozen=True, slots=True)
class Tile:
    """Cells in rows ``start`` to ``stop`` and columns ``left`` to ``right``, counted from the first of a grid."""

    start: int
    stop: int
    left: int
    right: int

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.stop - self.start


def _ramp(x: Float, sigma: float) -> Float:
    """Function whose second derivative is a Gaussian (sigma > 0) or a spike (sigma = 0)."""
    if sigma == 0.0:
        return np.maximum(x, 0.0)
    z = x / sigma
    return np.asarray(sigma * np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi) + x * ndtr(z))


class RayGrid:
    """Directions through a grid of cells, by polynomials through a few exact ones.

    A camera model is smooth, so a tensor-product Chebyshev interpolant of 9 or 25 nodes a side reaches 1e-11 rad.
    That is checked, and where it fails, or the model has no direction for part of the grid, every point is
    unprojected on its own.

    ``rotation`` (3, 3), applied to the directions: ``to_from_camera``.
    """

    def __init__(
        self, model: CameraModel, x: AxisCells, y: AxisCells, rotation: Float, jitter_seed: int | None = None
    ) -> None:
        self._model, self._rotation, self._jitter_seed = model, rotation, jitter_seed
        centered = jitter_seed is None
        self._columns_px, self._rows_px = (x.centers_px, y.centers_px) if centered else (x.edges_px, y.edges_px)
        self._basis: tuple[Float, Float, Float] | None = None
        for nodes in _NODES:
            across, down = Interval.around(self._columns_px, nodes), Interval.around(self._rows_px, nodes)
            values = self._exact(across.nodes, down.nodes)
            if not np.isfinite(values).all():
                return
            check_px = across.middle + across.half * _CHECK, down.middle + down.half * _CHECK
            check = _interpolate(down.basis(check_px[1]), values, across.basis(check_px[0]))
            if np.abs(np.swapaxes(check, 0, 1) - self._exact(*check_px)).max() < _DIRECTION_TOLERANCE_RAD:
                self._basis = down.basis(self._rows_px), values, across.basis(self._columns_px)
                return

    def directions(self, tile: Tile) -> Float:
        """Directions (n, 4), unit vectors and zeros, of the rays through some cells, columns of the tile in turn."""
        start, stop, left, right = tile.start, tile.stop, tile.left, tile.right
        if self._jitter_seed is None:
            return self._points(start, stop, left, right).reshape(-1, 4)
        corners = self._points(start, stop + 1, left, right + 1)
        random = np.random.default_rng([self._jitter_seed, start])
        u, v = random.uniform(size=(2, right - left, stop - start, 1))
        upper, lower = ((1.0 - u) * side[:-1] + u * side[1:] for side in (corners[:, :-1], corners[:, 1:]))
        return unit(((1.0 - v) * upper + v * lower).reshape(-1, 4))

    def _points(self, start: int, stop: int, left: int, right: int) -> Float:
        """Directions (right - left, stop - start, 4) of grid points."""
        if self._basis is None:
            return np.swapaxes(self._exact(self._columns_px[left:right], self._rows_px[start:stop]), 0, 1)
        by_row, values, by_column = self._basis
        return _interpolate(by_row[start:stop], values, by_column[left:right])

    def _exact(self, columns_px: Float, rows_px: Float) -> Float:
        """Directions (h, w, 4)."""
        x, y = np.meshgrid(columns_px, rows_px)
        directions = np.zeros((*x.shape, 4))
        directions[..., :3] = self._model.unproject(np.stack([x, y], axis=-1)) @ self._rotation.T
        return directions


class Interval:
    """Chebyshev nodes on an interval, and the Lagrange polynomials through them."""

    def __init__(self, low: float, high: float, count: int) -> None:
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        angles = (np.arange(count) + 0.5) * np.pi / count
        self._unit_nodes = np.cos(angles)
        self._weights = np.sin(angles) * (-1.0) ** np.arange(count)
        self.nodes: Float = self.middle + self.half * self._unit_nodes

    @classmethod
    def around(cls, points: Float, count: int) -> Interval:
        """Return the interval that points (n,) span."""
        low, high = float(points.min()), float(points.max())
        return cls(low, high if high > low else low + 1e-6, count)

    def basis(self, points: Float) -> Float:
        """Values (n, count) of the Lagrange polynomials, by the barycentric formula."""
        offset = ((points - self.middle) / self.half)[:, None] - self._unit_nodes
        offset[np.abs(offset) < 1e-15] = 1e-15
        terms = self._weights / offset
        return np.asarray(terms / terms.sum(axis=1, keepdims=True))


def _interpolate(by_row: Float, values: Float, by_column: Float) -> Float:
    """Tensor product (w, h, 4) of row basis (h, k), values (k, k, 4) and column basis (w, k)."""
    k = len(values)
    half = (by_row @ values.reshape(k, -1)).reshape(len(by_row), k, 4)
    right = np.swapaxes(half, 0, 1).reshape(k, -1)
    result = np.empty((len(by_column), right.shape[1]))
    step = max(_BLAS_PRODUCTS // right.size, 1)
    for start in range(0, len(by_column), step):
        np.matmul(by_column[start : start + step], right, out=result[start : start + step])
    return result.reshape(len(by_column), len(by_row), 4)


def span(points_px: Float) -> tuple[Float, Float] | None:
    """Smallest and largest finite coordinates (2,) of points (k, 2); None if there is no finite point."""
    finite = finite_rows(points_px)
    if not finite.any():
        return None
    return points_px[finite].min(axis=0), points_px[finite].max(axis=0)


def finite_rows(points: Float) -> Mask:
    """Return True for rows (n,) of an array (n, k) that are finite throughout."""
    return np.asarray(np.isfinite(points).all(axis=1))
