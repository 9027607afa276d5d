"""Options of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, require

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


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationOptions:
    """Options of a calibration.

    Parameters
    ----------
    prior_sigma : mapping of str to float
        Standard deviation that the starting value of a parameter has, in its unit: an a priori weight. A narrow
        field cannot tell the principal point from the attitude; give it one here, or leave it out of what is
        estimated (it then stays where it is).
    loss : Loss
        Of the last fit. The fits before, which look for outliers, use Huber's at least.
    false_rejections : float
        How many good observations a whole calibration may be expected to lose as outliers.
    max_rounds : int
        Rounds of fit and rejection.
    max_steps : int
        Of Levenberg-Marquardt, per round.

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
