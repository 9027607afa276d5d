"""Values of pixels that are coded by a power law or by sRGB: their light, and its noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require, require_number
from giantlike.core.errors import InputError

Gamma: TypeAlias = float | Literal["srgb"]
"""Exponent of the value that gives the signal (2.2: values are the signal to the power of 1/2.2), or the curve of
sRGB."""
_LINEAR_END, _LINEAR_SLOPE, _OFFSET, _POWER = 0.04045, 12.92, 0.055, 2.4
"""Curve of sRGB, IEC 61966-2-1: linear below a value, a power law of the shifted value above."""
_SAMPLES = 64  # values at which the noise of light is taken, evenly spread


def checked_gamma(gamma: object) -> Gamma | None:
    """Return a gamma as declared; None where none is."""
    if gamma is None:
        return None
    if isinstance(gamma, str) and gamma.lower() == "srgb":
        return "srgb"
    if isinstance(gamma, bool) or not isinstance(gamma, int | float):
        raise InputError(f'gamma must be "srgb" or a number, got {gamma!r}')
    require(1.0 <= gamma <= 5.0, f"gamma must be in [1, 5]: 2.2 where values are light to the power 1/2.2, got {gamma}")
    return float(gamma)


@dataclass(frozen=True, slots=True, kw_only=True)
class GammaCurve:
    """Light of coded values; 0 and the full scale remain as they are, and negative noise stays negative.

    >>> curve = GammaCurve(gamma="srgb", full_scale_dn=255.0)
    >>> [round(float(light), 2) for light in curve.light_dn([0.0, 10.0, 128.0, 255.0])]
    [0.0, 0.77, 55.04, 255.0]
    """

    gamma: Gamma
    full_scale_dn: float  # value above bias of the brightest signal

    def __post_init__(self) -> None:
        require(checked_gamma(self.gamma) is not None, "a gamma is needed")
        require_number(self.full_scale_dn, "full_scale_dn", above=0.0)

    def light_dn(self, values_dn: ArrayLike) -> Float:
        """Return the linear signal of values. ``values_dn`` (...); returns (...)."""
        values = as_floats(values_dn, (), "values_dn") / self.full_scale_dn
        size = np.abs(values)
        if self.gamma == "srgb":
            light = np.where(size > _LINEAR_END, ((size + _OFFSET) / (1.0 + _OFFSET)) ** _POWER, size / _LINEAR_SLOPE)
        else:
            light = size**self.gamma
        return np.asarray(np.copysign(light, values) * self.full_scale_dn)

    def values_dn(self, light_dn: ArrayLike) -> Float:
        """Return the values of a linear signal: the inverse of :meth:`light_dn`."""
        light = as_floats(light_dn, (), "light_dn") / self.full_scale_dn
        size = np.abs(light)
        if self.gamma == "srgb":
            bright = (1.0 + _OFFSET) * size ** (1.0 / _POWER) - _OFFSET
            values = np.where(size > _LINEAR_END / _LINEAR_SLOPE, bright, _LINEAR_SLOPE * size)
        else:
            values = size ** (1.0 / self.gamma)
        return np.asarray(np.copysign(values, light) * self.full_scale_dn)

    def slope(self, values_dn: ArrayLike) -> Float:
        """Return the derivative of :meth:`light_dn` by the value. ``values_dn`` (...); returns (...)."""
        size = np.abs(as_floats(values_dn, (), "values_dn")) / self.full_scale_dn
        if self.gamma == "srgb":
            above = (size + _OFFSET) / (1.0 + _OFFSET)
            power = _POWER / (1.0 + _OFFSET) * above ** (_POWER - 1.0)
            return np.where(size > _LINEAR_END, power, 1.0 / _LINEAR_SLOPE)
        return np.asarray(self.gamma * size ** (self.gamma - 1.0))

    def noise_of_light(self, variance_dn2: Float) -> tuple[float, float, float]:
        """Propagate the noise of values to the noise of the linear signal, as a polynomial of the signal.

        ``variance_dn2`` (64,), of the values of :meth:`samples_dn`; returns the coefficients, none negative, of the
        variance ``constant + linear light + square light^2``, accurate to a factor of 2 for a power of 2.2.
        """
        from scipy.optimize import nnls

        values = self.samples_dn()
        light = self.light_dn(values)
        variance = variance_dn2 * self.slope(np.sqrt(values**2 + variance_dn2)) ** 2
        terms = np.stack([np.ones_like(light), light / self.full_scale_dn, (light / self.full_scale_dn) ** 2], axis=1)
        constant, linear, square = nnls(terms / variance[:, None], np.ones_like(light))[0].tolist()
        constant = max(constant, float(variance[0]))  # a variance of 0 would be infinite weight
        return constant, linear / self.full_scale_dn, square / self.full_scale_dn**2

    def samples_dn(self) -> Float:
        """Values (64,) from 0 to the full scale, DN."""
        return np.linspace(0.0, self.full_scale_dn, _SAMPLES)
