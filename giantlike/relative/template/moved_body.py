"""A body traced once: its image at other places, ranges and blurs in closed form, with derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import ndtr

from giantlike.core.arrays import Float
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Reflectance, Trace
from giantlike.ray_tracing.refined import RefinedTrace
from giantlike.ray_tracing.sampling import spread_over
from giantlike.relative.template.state import TemplateState

_LEAST_BLUR_PX = 1e-3
"""Least standard deviation of the point spread function, px: an infinitely sharp one has no derivative by its width."""

_REACH_SIGMA = 7.0
"""Of the point spread function, where shares end: 3e-12 of the light lies beyond, and derivatives do not show it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovedBody(Value):
    """A body as a grid of rays, each with the light that it brings.

    From a place nearby the same rays meet the same surface: their light only falls elsewhere. It is even over the cell
    of the ray, blurred by a Gaussian and summed over the pixel, exactly as in a render
    (:meth:`giantlike.ray_tracing.sampling.Cells.spread`), but with cells that lie anywhere and have any size.

    Parameters
    ----------
    trace : Trace or RefinedTrace
    state : TemplateState
        Geometry of the trace.
    """

    trace: Trace | RefinedTrace
    state: TemplateState

    def shaded(self, laws: tuple[Reflectance, ...]) -> Float:
        """Light that the rays bring.

        Parameters
        ----------
        laws : tuple of Reflectance

        Returns
        -------
        (columns, laws, rows) float64
            Brightness of the cells under each law.
        """
        return np.stack([self.trace.cell_brightness(law) for law in laws], axis=1)

    def lights(self, box: PixelBox, state: TemplateState, cells: Float) -> tuple[Float, Callable[[Float], Float]]:
        """Light on the pixels of a box, and its derivatives.

        Parameters
        ----------
        box : PixelBox
        state : TemplateState
        cells : (columns, k, rows) float64
            From :meth:`shaded`.

        Returns
        -------
        lights : (k, h, w) float64
            Under each law.
        derivatives : callable
            Takes the weights (j,) of the first ``j`` and returns the derivatives (4, h, w) of their sum, by x and y of
            the center in px, the logarithm of the range and the variance of the point spread function in px^2.
        """
        across = self._shares(0, box.x, box.width, state)
        down = self._shares(1, box.y, box.height, state)
        columns = spread_over(across.value, cells.reshape(len(cells), -1)).reshape(box.width, *cells.shape[1:])
        lights = np.stack([spread_over(down.value, columns[:, law].T) for law in range(cells.shape[1])])

        def derivatives(weights: Float) -> Float:
            whole, own = (weights @ each[:, : len(weights)] for each in (cells, columns))

            def by(by_column: csr_matrix[np.float64]) -> Float:
                return spread_over(down.value, spread_over(by_column, whole).T)

            return np.stack(
                [
                    by(across.by_center),
                    spread_over(down.by_center, own.T),
                    by(across.by_log_range) + spread_over(down.by_log_range, own.T),
                    by(across.by_variance) + spread_over(down.by_variance, own.T),
                ]
            )

        return lights, derivatives

    def _shares(self, axis: int, first_px: int, count_px: int, state: TemplateState) -> _Shares:
        """Shares of the cells along an axis for a state, on so many pixels from the first."""
        cells, before = self.trace.cells[axis], self.state
        scale = math.exp(before.log_range - state.log_range)
        away = scale * (cells.centers_px - before.center_px[axis])
        lows = first_px - 0.5 + np.arange(count_px)
        sigma_px = max(math.sqrt(state.psf_variance_px2), _LEAST_BLUR_PX)
        return _shares(lows - state.center_px[axis], away, 0.5 * scale / cells.per_px, sigma_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shares:
    """Shares (pixels, cells) of the light of cells along one axis, px, and their derivatives."""

    value: csr_matrix[np.float64]
    by_center: csr_matrix[np.float64]
    by_log_range: csr_matrix[np.float64]
    by_variance: csr_matrix[np.float64]


def _shares(lows: Float, away: Float, half: float, sigma: float) -> _Shares:
    """Shares of pixels from ``lows`` (n,) to 1 px more of cells ``away`` (k,) from the center, 2 ``half`` wide, in px.

    The second antiderivative of a Gaussian, ``r(t) = sigma^2 g(t) + t G(t)``, with the Gaussian g and its integral G,
    at both sides of a cell; its derivative by the variance is ``g / 2``.
    """
    reach, count = _REACH_SIGMA * sigma + half, away.size
    first = np.ceil((lows - reach - away[0]) / (2.0 * half)).astype(np.int64)
    within = first[:, None] + np.arange(math.ceil((1.0 + 2.0 * reach) / (2.0 * half)) + 1)
    inside = (within >= 0) & (within < count)
    starts = np.concatenate([[0], np.cumsum(np.count_nonzero(inside, axis=1))])
    numbers = within[inside]
    place = away[numbers]
    indices, ends = numbers.astype(np.int32), starts.astype(np.int32)  # as sparse matrices hold them, not made anew
    distance = np.broadcast_to(lows[:, None], within.shape)[inside] - place + np.array([[0.0], [1.0]])
    sides = np.stack([distance + half, distance - half])
    bell = np.exp(-0.5 * (sides / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
    integral = ndtr(sides / sigma)
    ramp = sigma**2 * bell + sides * integral

    def on_pixels(values: Float) -> Float:
        return np.asarray(values[1] - values[0])

    def matrix(values: Float) -> csr_matrix[np.float64]:
        return csr_matrix((values, indices, ends), shape=(lows.size, count))

    by_center = -on_pixels(integral[0] - integral[1])
    by_half = on_pixels(integral[0] + integral[1])
    return _Shares(
        value=matrix(on_pixels(ramp[0] - ramp[1])),
        by_center=matrix(by_center),
        by_log_range=matrix(-(place * by_center + half * by_half)),
        by_variance=matrix(0.5 * on_pixels(bell[0] - bell[1])),
    )
