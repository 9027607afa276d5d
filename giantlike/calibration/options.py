"""Options of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, require

_HUBER_SQUARE = 1.345**2 * 2.0  # Huber's constant of 95 % efficiency for one normal residual, here for two axes
_CAUCHY_SQUARE = 2.385**2 * 2.0  # the same constant of the Cauchy loss


class Loss(StrEnum):
    """Loss function of the squared residual of an observation (two axes, in units of the variance).

    ``linear`` is least squares; beyond two sigma ``huber`` grows with the distance, ``cauchy`` with its logarithm.
    """

    LINEAR = "linear"
    HUBER = "huber"
    CAUCHY = "cauchy"

    def cost(self, squares: Float) -> Float:
        """Cost (n,) of squared residuals (n,), unitless; equal to them if they are small."""
        if self is Loss.HUBER:
            beyond = 2.0 * np.sqrt(_HUBER_SQUARE * squares) - _HUBER_SQUARE
            return np.where(squares <= _HUBER_SQUARE, squares, beyond)
        if self is Loss.CAUCHY:
            return _CAUCHY_SQUARE * np.log1p(squares / _CAUCHY_SQUARE)
        return squares

    def weight(self, squares: Float) -> Float:
        """Derivative (n,) of the cost by the square: the weight in iteratively reweighted least squares."""
        if self is Loss.HUBER:
            return np.sqrt(_HUBER_SQUARE / np.maximum(squares, _HUBER_SQUARE))
        if self is Loss.CAUCHY:
            return 1.0 / (1.0 + squares / _CAUCHY_SQUARE)
        return np.ones_like(squares)


class Treatment(StrEnum):
    """Treatment of parameters of which an a priori covariance may be known."""

    ESTIMATE = "estimate"
    CONSIDER = "consider"  # kept at their values, while their covariance enters that of the others
    FIXED = "fixed"  # kept at their values as if these were exact


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationOptions:
    """Options of a calibration.

    Parameters
    ----------
    prior_sigma : mapping of str to float
        Standard deviation of the starting value of a parameter, in its unit: an a priori weight. In a narrow field the
        principal point is degenerate with the attitude: give it an a priori sigma here, or do not estimate it.
    loss : Loss
        Loss of the last fit; the fits before, which search for outliers, use at least Huber's. Default: least
        squares, whose covariance is exact once outliers are rejected.
    false_rejections : float; expected number of good observations rejected by a calibration; default 0.01
    max_rounds : int; rounds of fit and rejection; default 10, a bound
    max_steps : int; Levenberg-Marquardt steps per round; default 200, a bound

    Raises
    ------
    InputError
        A value is out of range.
    """

    prior_sigma: Mapping[str, float] = field(default_factory=dict)
    loss: Loss = Loss.LINEAR
    false_rejections: float = 0.01
    max_rounds: int = 10
    max_steps: int = 200

    def __post_init__(self) -> None:
        for name, sigma in self.prior_sigma.items():
            require(sigma > 0, f"prior_sigma of {name} must be > 0, got {sigma}")
        require(0.0 < self.false_rejections < 1.0, f"false_rejections must be in (0, 1), got {self.false_rejections}")
        require(self.max_rounds >= 1, f"max_rounds must be >= 1, got {self.max_rounds}")
        require(self.max_steps >= 1, f"max_steps must be >= 1, got {self.max_steps}")
        object.__setattr__(self, "loss", Loss(self.loss))
