"""A body traced once: its image at other places, ranges and blurs in closed form, with derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from giantlike.core.arrays import Float, Indices
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Reflectance
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.ray_tracing.daylight import Daylight
from giantlike.ray_tracing.refined import RefinedTrace
from giantlike.ray_tracing.sampling import AxisCells
from giantlike.relative.template.spread_parts import spread, spread_along_axis
from giantlike.relative.template.state import TemplateState

_LEAST_BLUR_PX = 1e-3
"""Least standard deviation of the point spread function, px: an infinitely sharp one has no derivative by its width."""

_REACH_SIGMA = 5.5
"""Of the point spread function, where shares end: 4e-8 of the light lies beyond, and derivatives do not show it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShadedRays(Value):
    """Light that the rays of a body bring under k laws."""

    cells: Float  # (columns, k, rows); brightness of whole cells; 0 in those that are split
    parts: Float  # (n, k); brightness of the parts of the others; none of a trace that is not refined


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovedBody(Value):
    """A body as a grid of rays, each with the light that it brings.

    From a place nearby the same rays meet the same surface: their light only falls elsewhere. It is even over the cell
    of the ray, blurred by a Gaussian and summed over the pixel, exactly as in a render
    (:meth:`giantlike.ray_tracing.sampling.AxisCells.spread`), but with cells that lie anywhere and have any size.
    """

    trace: Trace | RefinedTrace
    state: TemplateState  # geometry of the trace

    def daylight(self, state: TemplateState) -> Daylight | None:
        """Lit parts of the body, for a finer trace. Returns None of a refined trace."""
        if isinstance(self.trace, RefinedTrace):
            return None
        return Daylight(
            cells=self.trace.cells,
            lit=self.trace.lit_cells,
            center_px=state.center_px,
            traced_center_px=self.state.center_px,
            scale=math.exp(self.state.log_range - state.log_range),
        )

    def shade(self, laws: tuple[Reflectance, ...]) -> ShadedRays:
        """Light that the rays bring."""
        trace, (x, y) = self.trace, self.trace.cells
        cells = np.empty((x.count, len(laws), y.count))
        for number, law in enumerate(laws):
            cells[:, number] = trace.cell_brightness(law)
        parts = np.empty((0, len(laws)))
        if isinstance(trace, RefinedTrace):
            parts = np.stack([trace.part_brightness(law) for law in laws], axis=-1)
        return ShadedRays(cells=cells, parts=parts)

    def lights(self, box: PixelBox, state: TemplateState, rays: ShadedRays) -> tuple[Float, Callable[[Float], Float]]:
        """Light on the pixels of a box, and its derivatives. Returns ``lights`` (k, h, w) and ``derivatives``."""
        x, y = self.trace.cells
        down = self._row(y, 1, state).on_pixels(box.y, box.height)
        first = _Grid(_Columns(self._row(x, 0, state).on_pixels(box.x, box.width)), down, rays.cells)
        rest: list[_Grid] = []
        if len(rays.parts) and isinstance(self.trace, RefinedTrace):
            x, y = self.trace.part_cells
            down = self._row(y, 1, state).on_pixels(box.y, box.height)
            across = self._row(x, 0, state).of_parts(*self.trace.part_places, y.count, box.x, box.width)
            rest.append(_Grid(across, down, rays.parts))
        lights = np.ascontiguousarray(np.moveaxis(sum((grid.lights for grid in rest), first.lights), -1, 0))
        return lights, lambda weights: sum((grid.derivatives(weights) for grid in rest), first.derivatives(weights))

    def _row(self, cells: AxisCells, axis: int, state: TemplateState) -> _Row:
        """Cells along an axis, where they are at a state."""
        before = self.state
        scale = math.exp(before.log_range - state.log_range)
        return _Row(
            center=float(state.center_px[axis]),
            away=scale * (cells.centers_px - before.center_px[axis]),
            half=0.5 * scale / cells.per_px,
            sigma=max(math.sqrt(state.psf_variance_px2), _LEAST_BLUR_PX),
        )


@dataclass(frozen=True, slots=True)
class _Shares:
    """Shares of the light of cells along one axis, px.

    ``values`` (4, m, w) are those on each of m pixels of w cells from the number ``first`` (m,) on, where there are
    such, and their derivatives by center, log range and variance.
    """

    values: Float
    first: Indices

    def lights(self, light: Float) -> Float:
        """Light (m, k) of that (n, k) of cells."""
        return np.asarray(spread_along_axis(self.values[:1], self.first, light)[0])


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns of a whole grid, whose light (columns, ...) is spread over columns of pixels."""

    shares: _Shares

    def lights(self, light: Float) -> Float:
        """Light (rows, w, k) of that (columns, k, rows) of cells."""
        spread = self.shares.lights(light.reshape(len(light), -1))
        return np.ascontiguousarray(spread.reshape(-1, *light.shape[1:]).transpose(2, 0, 1))

    def with_derivatives(self, light: Float) -> Float:
        """Light (rows, 4, w) of that (columns, rows) of cells, and derivatives by center, log range and variance."""
        return np.ascontiguousarray(spread_along_axis(self.shares.values, self.shares.first, light).transpose(2, 0, 1))


@dataclass(frozen=True, slots=True)
class _Parts:
    """Some cells, at ``columns`` (n,) and ``rows`` (n,) of a grid, whose light is spread over columns of pixels.

    ``shares`` (4, columns, p) are those of each column on ``p`` pixels from ``first_px`` (columns,), and derivatives.
    """

    columns: Indices
    rows: Indices
    row_count: int
    shares: Float
    first_px: Indices
    width: int

    def lights(self, light: Float) -> Float:
        """Light (rows, w, k) of that (n, k) of parts."""
        of_value = self._spread(light, self.shares[:1])
        return np.asarray(of_value[0])

    def with_derivatives(self, light: Float) -> Float:
        """Light (rows, 4, w) of that (n,) of parts, and its derivatives by center, log range and variance."""
        return np.ascontiguousarray(self._spread(light[:, None], self.shares)[..., 0].transpose(1, 0, 2))

    def _spread(self, light: Float, shares: Float) -> Float:
        places = self.columns, self.rows, shares, self.first_px, self.row_count, self.width
        return spread(np.array(light), *places)  # a copy: values are read-only, for which loops are compiled anew


@dataclass(frozen=True, slots=True)
class _Grid:
    """Cells of one size, whose light is spread over pixels along x and then along y.

    ``light`` is (columns, k, rows) of a whole grid or (n, k) of some of its cells; ``down`` is (h, rows).
    """

    across: _Columns | _Parts
    down: _Shares
    light: Float

    @property
    def lights(self) -> Float:
        """Light (h, w, k) under each law."""
        columns = self.across.lights(self.light)
        return self.down.lights(columns.reshape(len(columns), -1)).reshape(-1, *columns.shape[1:])

    def derivatives(self, weights: Float) -> Float:
        """Derivatives (4, h, w) of the sum with weights (j,) of the first ``j`` laws."""
        some = self.light[:, : len(weights)]
        mixed = weights @ some if some.ndim == 3 else some @ weights
        columns = self.across.with_derivatives(mixed)
        width = columns.shape[2]
        by_x, by_log_range, by_variance = np.split(self.down.lights(columns[:, 1:].reshape(-1, 3 * width)), 3, axis=1)
        shares = self.down.values[1:]
        by_y, down_by_log_range, down_by_variance = spread_along_axis(shares, self.down.first, columns[:, 0].copy())
        return np.stack([by_x, by_y, by_log_range + down_by_log_range, by_variance + down_by_variance])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """Cells ``away`` (k,) from a center, 2 ``half`` wide, px, whose light a Gaussian of width ``sigma`` blurs."""

    center: float
    away: Float
    half: float
    sigma: float

    def on_pixels(self, first_px: int, count_px: int) -> _Shares:
        """Shares on so many pixels from the first."""
        lows = first_px - 0.5 - self.center + np.arange(count_px, dtype=np.float64)
        reach, count = _REACH_SIGMA * self.sigma + self.half, self.away.size
        first = np.ceil((lows - reach - self.away[0]) / (2.0 * self.half)).astype(np.int64)
        within = first[:, None] + np.arange(math.ceil((1.0 + 2.0 * reach) / (2.0 * self.half)) + 1)
        away = self.away[np.clip(within, 0, count - 1)]
        return _Shares(np.stack(self._shares(np.broadcast_to(lows[:, None], within.shape), away)), first)

    def of_parts(self, columns: Indices, rows: Indices, row_count: int, first_px: int, count_px: int) -> _Parts:
        """Shares on so many pixels from the first of the n cells at some ``columns`` of this row, in ``rows``."""
        reach = _REACH_SIGMA * self.sigma + self.half
        first = np.floor(self.center + self.away - reach - (first_px - 0.5)).astype(np.int64)
        pixels = first[:, None] + np.arange(math.ceil(2.0 * reach) + 1)
        lows = first_px - 0.5 + pixels - self.center
        shares = self._shares(np.asarray(lows, np.float64), np.broadcast_to(self.away[:, None], lows.shape))
        return _Parts(columns, rows, row_count, np.stack(shares), first, count_px)

    def _shares(self, lows: Float, away: Float) -> tuple[Float, Float, Float, Float]:
        """Shares, as in :class:`_Shares`, on pixels from ``lows`` (...) to 1 px more of cells at ``away`` (...).

        The second antiderivative of a Gaussian, ``r(t) = sigma^2 g(t) + t G(t)``, with the Gaussian g and its integral
        G, at both sides of a cell; its derivative by the variance is ``g / 2``.
        """
        half, sigma = self.half, self.sigma
        distance = np.stack([lows - away, lows - away + 1.0])
        sides = np.stack([distance + half, distance - half])
        bell = np.exp(-0.5 * (sides / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
        integral = ndtr(sides / sigma)
        ramp = sigma**2 * bell + sides * integral

        def on_pixels(values: Float) -> Float:
            return np.asarray(values[1] - values[0])

        by_center = -on_pixels(integral[0] - integral[1])
        by_half = on_pixels(integral[0] + integral[1])
        return (
            on_pixels(ramp[0] - ramp[1]),
            by_center,
            -(away * by_center + half * by_half),
            0.5 * on_pixels(bell[0] - bell[1]),
        )
