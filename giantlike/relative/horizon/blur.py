"""Blur of the brightness inside a horizon, as a sum over depths: exact for a straight limb, with a curvature term."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value

LEAST_RADIUS = 0.3  # minimum ratio of the radius of lines of equal depth to the radius of the horizon
_REACH_WIDTHS = 4.0  # light from deeper than so many widths beyond the window does not reach it
_PIXEL_FOURTH_CUMULANT = -1.0 / 120.0  # fourth cumulant of a uniform density of width 1, px^4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthBlur(Value):
    """A blur of some width at m distances from a horizon."""

    width_px: float  # standard deviation
    depths_px: Float  # (q,); depths inside the horizon that the sum goes over
    kernels: Float  # (q, 7, m); A Gaussian and its first six derivatives, times the weights of the depths

    @classmethod
    def from_width(cls, width_px: float, offsets_px: Float, count: int) -> DepthBlur:
        """Make the weights of a blur.

        ``offsets_px`` (m,), distances from the horizon, positive outward (the first is the innermost).
        """
        deepest = float(-offsets_px[0]) + _REACH_WIDTHS * width_px
        places, shares = _depth_rule(count)
        roots = 0.5 * math.sqrt(deepest) * (places + 1.0)
        depths, weights = roots**2, math.sqrt(deepest) * shares * roots
        kernels = _kernels(offsets_px[None] + depths[:, None], width_px) * weights[:, None]
        return cls(width_px=width_px, depths_px=depths, kernels=np.ascontiguousarray(np.swapaxes(kernels, 0, 1)))

    def apply(self, light: Float, curvature: Float, normals_px: Float) -> Float:
        """Blur brightness inside points of a horizon.

        ``light`` (b, k, q); ``curvature`` (k,) 1/px; ``normals_px`` (k, 2); returns (b, k, 3, m).
        """
        bend = curvature[:, None]
        bends = bend / np.maximum(1.0 - bend * self.depths_px, LEAST_RADIUS)  # of the lines of equal depth
        spread = 0.5 * self.width_px**2 * bends
        pixel = (_PIXEL_FOURTH_CUMULANT / 24.0 * np.sum(normals_px**4, axis=1))[:, None]
        parts = ((1.0 + spread * bends, 0), (spread, 1), (pixel, 4))
        blurred = sum((light * part) @ self._orders(first) for part, first in parts)
        return np.asarray(blurred).reshape(*light.shape[:2], 3, -1)

    def _orders(self, first: int) -> Float:
        """Three successive derivatives (q, 3 m)."""
        return self.kernels[:, first : first + 3].reshape(len(self.depths_px), -1)


@cache
def _depth_rule(count: int) -> tuple[Float, Float]:
    """Places (count,) from -1 to 1 and weights of Gauss and Legendre."""
    places, weights = np.polynomial.legendre.leggauss(count)
    return places, weights


def _kernels(distances: Float, width: float) -> Float:
    """A Gaussian and its first six derivatives (7, ...)."""
    z = distances / width
    bell = np.exp(-0.5 * z**2) / (width * math.sqrt(2.0 * np.pi))
    before, here = np.zeros_like(z), np.ones_like(z)  # Hermite polynomials
    kernels = [bell]
    for order in range(1, 7):
        before, here = here, z * here - (order - 1) * before
        kernels.append((-1.0 / width) ** order * here * bell)
    return np.stack(kernels)
