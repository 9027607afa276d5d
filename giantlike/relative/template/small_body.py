"""A small body traced once: its image at other places, ranges and blurs in closed form, with derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from giantlike.core.arrays import Float
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Reflectance, Trace
from giantlike.relative.template.state import TemplateState

_LEAST_BLUR_PX = 1e-3
"""Least standard deviation of the point spread function, px: an infinitely sharp one has no derivative by its width."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmallBody(Value):
    """A body of a few pixels as a grid of rays, each with the light that it brings.

    From a place nearby the same rays meet the same surface: their light only falls elsewhere. It is even over the cell
    of the ray, blurred by a Gaussian and summed over the pixel, exactly as in a render
    (:meth:`giantlike.ray_tracing.sampling.Cells.spread`), but with cells that lie anywhere and have any size.

    Parameters
    ----------
    trace : Trace
    state : TemplateState
        Geometry of the trace.
    """

    trace: Trace
    state: TemplateState

    def lights(self, box: PixelBox, state: TemplateState, laws: tuple[Reflectance, ...]) -> tuple[list[Float], Float]:
        """Light on the pixels of a box, and its derivatives.

        Parameters
        ----------
        box : PixelBox
        state : TemplateState
        laws : tuple of Reflectance

        Returns
        -------
        lights : list of (h, w) float64
            Under each law.
        derivatives : (4, h, w) float64
            Of the first, by x and y of the center in px, the logarithm of the range and the variance of the point
            spread function in px^2.
        """
        across = self._shares(0, box.x, box.width, state)
        down = self._shares(1, box.y, box.height, state)
        cells = [self.trace.with_reflectance(law).cell_brightness() for law in laws]
        columns = [across.value @ each for each in cells]
        lights = [down.value @ each.T for each in columns]

        def product(by_column: Float, by_row: Float) -> Float:
            result: Float = down.value @ (by_column @ cells[0]).T + by_row @ columns[0].T
            return result

        derivatives = [
            down.value @ (across.by_center @ cells[0]).T,
            down.by_center @ columns[0].T,
            product(across.by_log_range, down.by_log_range),
            product(across.by_variance, down.by_variance),
        ]
        return lights, np.stack(derivatives)

    def _shares(self, axis: int, first_px: int, count_px: int, state: TemplateState) -> _Shares:
        """Shares of the cells along an axis for a state, on so many pixels from the first."""
        cells, before = self.trace.footprint.cells[axis], self.state
        scale = math.exp(before.log_range - state.log_range)
        away = scale * (cells.centers_px - before.center_px[axis])
        edges = first_px - 0.5 + np.arange(count_px + 1)
        sigma_px = max(math.sqrt(state.psf_variance_px2), _LEAST_BLUR_PX)
        return _shares(edges - state.center_px[axis], away, 0.5 * scale / cells.per_px, sigma_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shares:
    """Shares (pixels, cells) of the light of cells along one axis, px, and their derivatives."""

    value: Float
    by_center: Float
    by_log_range: Float
    by_variance: Float


def _shares(edges: Float, away: Float, half: float, sigma: float) -> _Shares:
    """Shares between ``edges`` (n + 1,) of cells ``away`` (k,) from the center and 2 ``half`` wide, all in px.

    The second antiderivative of a Gaussian, ``r(t) = sigma^2 g(t) + t G(t)``, with the Gaussian g and its integral G,
    at both sides of a cell; its derivative by the variance is ``g / 2``.
    """
    distance = edges[:, None] - away
    sides = np.stack([distance + half, distance - half])
    bell = np.exp(-0.5 * (sides / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
    integral = ndtr(sides / sigma)
    ramp = sigma**2 * bell + sides * integral

    def within(values: Float) -> Float:
        return np.diff(values, axis=0)

    by_center = -within(integral[0] - integral[1])
    by_half = within(integral[0] + integral[1])
    return _Shares(
        value=within(ramp[0] - ramp[1]),
        by_center=by_center,
        by_log_range=-(away * by_center + half * by_half),
        by_variance=0.5 * within(bell[0] - bell[1]),
    )
