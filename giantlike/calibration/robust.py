"""Losses that keep a wrong identification from ruling a fit."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float

_HUBER_SQUARE = 1.345**2 * 2.0  # two axes: 95 % efficient for Gaussian residuals, near enough
_CAUCHY_SQUARE = 2.385**2 * 2.0


class Loss(StrEnum):
    """What a squared residual (two axes, in units of its variance) costs.

    ``linear`` is least squares; ``huber`` grows with the distance beyond two sigma, ``cauchy`` with its logarithm.
    """

    LINEAR = "linear"
    HUBER = "huber"
    CAUCHY = "cauchy"

    def cost(self, squares: Float) -> Float:
        """Cost (n,) of squared residuals (n,): equal to them where they are small."""
        if self is Loss.HUBER:
            beyond = 2.0 * np.sqrt(_HUBER_SQUARE * squares) - _HUBER_SQUARE
            return np.where(squares <= _HUBER_SQUARE, squares, beyond)
        if self is Loss.CAUCHY:
            result: Float = _CAUCHY_SQUARE * np.log1p(squares / _CAUCHY_SQUARE)
            return result
        return squares

    def weight(self, squares: Float) -> Float:
        """Derivative (n,) of the cost: the factor on the weight in iteratively reweighted least squares."""
        if self is Loss.HUBER:
            return np.sqrt(_HUBER_SQUARE / np.maximum(squares, _HUBER_SQUARE))
        if self is Loss.CAUCHY:
            result: Float = 1.0 / (1.0 + squares / _CAUCHY_SQUARE)
            return result
        return np.ones_like(squares)
