"""From light to numbers: shot noise, dark current, read noise, gain, bias, saturation and rounding."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.detector import Detector

MAX_DN = 65535
"""Largest number that a pixel of 16 bits holds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HotPixels:
    """Single pixels that fill up without light.

    Parameters
    ----------
    points_px : (n, 2) int64, px
        (x, y) of each; those outside a frame are left out.
    rate_e_s : (n,) float64, electron/s
    """

    points_px: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    rate_e_s: Float = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        require(
            self.points_px.ndim == 2 and self.points_px.shape == (len(self.rate_e_s), 2),
            f"hot pixels need points_px (n, 2) and rate_e_s (n,), got {self.points_px.shape} and {self.rate_e_s.shape}",
        )

    @classmethod
    def scattered(
        cls, count: int, columns: int, rows: int, rng: np.random.Generator, *, median_e_s: float
    ) -> HotPixels:
        """Draw hot pixels anywhere on a detector, with rates spread over a factor of ten about their median."""
        points = np.stack([rng.integers(0, columns, count), rng.integers(0, rows, count)], axis=-1)
        return cls(points_px=points, rate_e_s=median_e_s * 10.0 ** rng.uniform(-0.5, 0.5, count))

    def signal_e(self, columns: int, rows: int, exposure_s: float) -> Float:
        """Electrons (rows, columns) that they add in an exposure."""
        frame = np.zeros((rows, columns))
        x, y = self.points_px[:, 0], self.points_px[:, 1]
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        np.add.at(frame, (y[inside], x[inside]), self.rate_e_s[inside] * exposure_s)
        return frame


def expose(signal_e: Float, detector: Detector, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Read out a detector on which light has fallen.

    Parameters
    ----------
    signal_e : (rows, columns) float64, electron
        Expected number of electrons in each pixel, from light and dark current.
    detector : Detector
    rng : numpy Generator
        Shot noise (Poisson) and read noise (Gaussian) are drawn from it.

    Returns
    -------
    (rows, columns) uint16, DN
        Rounded; cut off at 0 and at ``detector.saturation_dn``, or at 65535 where that is higher.

    Raises
    ------
    InputError
        The signal is not two-dimensional, negative or not finite.
    """
    signal = as_floats(signal_e, (), "signal_e")
    require(signal.ndim == 2, f"signal_e must have shape (rows, columns), got {signal.shape}")
    lowest, highest = float(signal.min(initial=0.0)), float(signal.max(initial=0.0))
    require(lowest >= 0.0 and math.isfinite(highest), f"signal_e must be >= 0 and finite, got {lowest} to {highest}")
    electrons = rng.normal(0.0, 1.0, signal.shape) * detector.read_noise_e
    bright = signal > 0.0
    electrons[bright] += rng.poisson(signal[bright])
    numbers = np.rint(electrons / detector.gain_e_per_dn + detector.bias_dn)
    return np.clip(numbers, 0.0, min(detector.saturation_dn, MAX_DN)).astype(np.uint16)
