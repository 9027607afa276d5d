"""Interface and base of reflectance laws: the horizon and the checks of parameters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, require

_HORIZON = 1e-200  # smallest cosine that counts as above the horizon, so that no quotient of cosines overflows
_BLOCK = 8192  # rays at a time: temporary arrays of 64 kB stay in the cache, several times faster than fresh memory


class Reflectance(Protocol):
    """Reflectance law; an immutable value."""

    type_name: ClassVar[str]
    """Name in campaign files."""

    def __call__(self, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike) -> Float:
        """Brightness (...) relative to normal incidence; 0 where the Sun or the camera is below the horizon.

        The cosines (...) are of the angles from the surface normal to Sun and camera; ``phase_rad`` (...), rad: angle
        Sun - surface - camera, in [0, pi].
        """
        ...


class SurfaceLaw(ABC):
    """Base of the laws: a formula above the horizon, and 0 below.

    A subclass is a frozen dataclass with a ``type_name`` and a formula ``above_horizon``.
    """

    __slots__ = ()
    type_name: ClassVar[str]

    def __call__(self, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike) -> Float:
        """Brightness (...) relative to normal incidence and emission at zero phase, 0 below either horizon.

        The cosines (...) are of the angles from the surface normal to Sun and camera, NaN below the horizon;
        ``phase_rad`` (...), rad: angle Sun - surface - camera, in [0, pi].
        """
        angles = (np.asarray(angle, dtype=np.float64) for angle in (cos_incidence, cos_emission, phase_rad))
        mu0, mu, phase = np.broadcast_arrays(*angles)
        shape = mu0.shape
        mu0, mu, phase = mu0.reshape(-1), mu.reshape(-1), phase.reshape(-1)
        brightness = np.empty(mu0.size)
        for start in range(0, mu0.size, _BLOCK):
            part = slice(start, start + _BLOCK)
            brightness[part] = self._block(mu0[part], mu[part], phase[part])
        return brightness.reshape(shape)

    def _block(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        seen = np.minimum(mu0, mu) > _HORIZON
        if seen.all():  # as in a render: nothing to select
            return self.above_horizon(mu0, mu, phase_rad)
        brightness = np.zeros(mu0.size)
        brightness[seen] = self.above_horizon(mu0[seen], mu[seen], phase_rad[seen])
        return brightness

    @abstractmethod
    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """Return the brightness (n,) by the formula of the law, for positive cosines (n,) of incidence and emission."""


def checked_number(law: str, name: str, value: float, interval: str = "(-inf, inf)") -> None:
    """Raise unless a parameter of a law is a finite number in its range."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    require(number and math.isfinite(value), f"reflectance {law}: {name} must be a number, got {value!r}")
    low, high = (float(end) for end in interval[1:-1].split(","))
    inside = low < value < high or (value == low and interval[0] == "[") or (value == high and interval[-1] == "]")
    require(inside, f"reflectance {law}: {name} must be in {interval}, got {value:g}")


def checked_numbers(law: str, name: str, values: object) -> tuple[float, ...]:
    """Return the numbers of a list, at least one, as a tuple."""
    if not isinstance(values, list | tuple):
        values = ()
    require(len(values) > 0, f"reflectance {law}: {name} must be a list of numbers")
    for number, value in enumerate(values):
        checked_number(law, f"{name}[{number}]", value)
    return tuple(float(value) for value in values)
