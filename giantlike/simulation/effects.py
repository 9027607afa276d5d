"""What a detector does to light and charge: stray light, flat field, transfer smear, dark current, full well.

Each effect is a value with one pure method from arrays to arrays; the default of each changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True)
class StrayLight:
    """Light that comes from nothing in the image: a plane and a round glow.

    Parameters
    ----------
    level_e_s : float, electron/s
        In the middle of the detector.
    gradient_e_s_px : (float, float), electron/s/px
        Growth along x and y.
    glow_e_s : float, electron/s
        Peak of a Gaussian glow.
    glow_center_px : (float, float), px
    glow_sigma_px : float, px
    """

    level_e_s: float = 0.0
    gradient_e_s_px: tuple[float, float] = (0.0, 0.0)
    glow_e_s: float = 0.0
    glow_center_px: tuple[float, float] = (0.0, 0.0)
    glow_sigma_px: float = 100.0

    def __post_init__(self) -> None:
        numbers = (self.level_e_s, *self.gradient_e_s_px, self.glow_e_s, *self.glow_center_px)
        require(all(map(math.isfinite, numbers)), f"stray light needs finite numbers, got {numbers}")
        require(self.level_e_s >= 0, f"stray level_e_s must be >= 0, got {self.level_e_s}")
        require(self.glow_e_s >= 0, f"stray glow_e_s must be >= 0, got {self.glow_e_s}")
        require(self.glow_sigma_px > 0, f"stray glow_sigma_px must be > 0, got {self.glow_sigma_px}")

    def rate_e_s(self, columns: int, rows: int) -> Float:
        """Electrons per second (rows, columns); nowhere negative."""
        x, y = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)[:, None]
        along_x, along_y = self.gradient_e_s_px
        plane = self.level_e_s + along_x * (x - (columns - 1) / 2) + along_y * (y - (rows - 1) / 2)
        near = [
            np.exp(-0.5 * ((axis - center) / self.glow_sigma_px) ** 2)
            for axis, center in zip((x, y), self.glow_center_px, strict=True)
        ]
        rate: Float = np.maximum(plane, 0.0) + self.glow_e_s * near[1] * near[0]
        return rate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlatField(Value):
    """How much of the light each pixel answers to.

    Parameters
    ----------
    response : (rows, columns) float64, optional
        Relative response of single pixels, 1 on average; :func:`pixel_response` draws one.
    vignetting : float
        Part of the light lost in the corners of the image; the loss grows with the square of the distance from
        its center.
    """

    response: Float | None = None
    vignetting: float = 0.0

    def __post_init__(self) -> None:
        require(0.0 <= self.vignetting <= 1.0, f"vignetting must be in [0, 1], got {self.vignetting}")
        if self.response is not None:
            response = as_floats(self.response, (), "flat field response")
            lowest = float(response.min(initial=math.inf))
            require(
                response.ndim == 2 and bool(np.isfinite(response).all()) and lowest >= 0.0,
                f"a flat field response must be (rows, columns), finite and >= 0, got {response.shape}, least {lowest}",
            )
        Value.__post_init__(self)

    def factor(self, columns: int, rows: int) -> Float:
        """Factor (rows, columns) on the light; 1 where nothing is lost.

        Raises
        ------
        InputError
            The response has another size.
        """
        x, y = np.arange(columns) - (columns - 1) / 2, (np.arange(rows) - (rows - 1) / 2)[:, None]
        corner_px2 = (columns / 2) ** 2 + (rows / 2) ** 2
        factor: Float = 1.0 - self.vignetting * (x**2 + y**2) / corner_px2
        if self.response is None:
            return factor
        size = self.response.shape
        require(size == (rows, columns), f"the flat field response has {size} pixels, the camera {(rows, columns)}")
        result: Float = factor * self.response
        return result


def pixel_response(columns: int, rows: int, *, rms: float, random: np.random.Generator) -> Float:
    """Draw the relative response (rows, columns) of pixels: normal about 1 with standard deviation ``rms``."""
    require(0.0 <= rms < 0.3, f"pixel response rms must be in [0, 0.3), got {rms}")
    return np.maximum(1.0 + rms * random.standard_normal((rows, columns)), 0.0)


class StorageSide(StrEnum):
    """Which edge of the image borders the storage region that a frame is transferred to."""

    FIRST_ROW = "first_row"
    LAST_ROW = "last_row"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTransfer:
    """Smear of a detector without shutter, whose rows move under the light.

    Parameters
    ----------
    row_time_s : float, s
        For which a row stays under the light of each other row that it passes; 0 switches the smear off.
    storage : StorageSide
        Where the rows move to after the exposure.
    swept_before : bool
        Whether the rows also move in that way right before the exposure (to clear the detector): then every row
        has passed all others, and the smear of a column is nearly constant; else only those on its way out.
    """

    row_time_s: float = 0.0
    storage: StorageSide = StorageSide.FIRST_ROW
    swept_before: bool = True

    def __post_init__(self) -> None:
        require(
            math.isfinite(self.row_time_s) and self.row_time_s >= 0,
            f"frame transfer row_time_s must be >= 0, got {self.row_time_s}",
        )

    def smear_e(self, light_e: Float, exposure_s: float) -> Float:
        """Electrons (rows, columns) that the moving rows gather.

        Parameters
        ----------
        light_e : (rows, columns) float64, electron
            Gathered in the exposure.
        exposure_s : float, s
            The rate of light is taken as constant: ``light_e / exposure_s``.
        """
        if self.row_time_s == 0.0 or exposure_s <= 0.0:
            return np.zeros_like(light_e)
        share = self.row_time_s / exposure_s
        if self.swept_before:
            passed: Float = light_e.sum(axis=0) - light_e
        else:
            toward = light_e if self.storage is StorageSide.FIRST_ROW else light_e[::-1]
            below = np.cumsum(toward, axis=0) - toward
            passed = below if self.storage is StorageSide.FIRST_ROW else below[::-1]
        return share * np.maximum(passed, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DarkCurrent:
    """Charge that heat sets free, the same in every pixel (hot pixels come on top).

    Parameters
    ----------
    rate_e_s : float, electron/s
        Per pixel, at the reference temperature.
    temperature_k : float, K, optional
        Of the detector; without one the rate holds as it is.
    reference_temperature_k : float, K
    doubling_k : float, K
        Rise of temperature that doubles the rate.
    """

    rate_e_s: float = 0.0
    temperature_k: float | None = None
    reference_temperature_k: float = 293.15
    doubling_k: float = 6.5

    def __post_init__(self) -> None:
        require(
            math.isfinite(self.rate_e_s) and self.rate_e_s >= 0,
            f"dark rate_e_s must be >= 0, got {self.rate_e_s}",
        )
        for name in ("temperature_k", "reference_temperature_k", "doubling_k"):
            value = getattr(self, name)
            require(value is None or 0 < value < 1000, f"dark {name} must be in (0, 1000), got {value}")

    @property
    def actual_rate_e_s(self) -> float:
        """Electrons per second and pixel at the temperature of the detector."""
        if self.temperature_k is None:
            return self.rate_e_s
        return self.rate_e_s * math.pow(2.0, (self.temperature_k - self.reference_temperature_k) / self.doubling_k)


@dataclass(frozen=True, slots=True, kw_only=True)
class FullWell:
    """How much charge a pixel holds, and what becomes of the rest.

    Parameters
    ----------
    capacity_e : float, electron
        Infinite: the pixels hold everything, and only the numbers are cut off.
    blooming : bool
        The rest spills along the column, half of it either way, into the nearest pixels that have room; what
        reaches an edge of the detector drains off. Without blooming it is lost at once.
    """

    capacity_e: float = math.inf
    blooming: bool = False

    def __post_init__(self) -> None:
        require(self.capacity_e > 0, f"full well capacity_e must be > 0, got {self.capacity_e}")

    def held_e(self, charge_e: Float) -> Float:
        """Charge (rows, columns) after the overfull pixels have spilled; none holds more than the capacity."""
        held = np.minimum(charge_e, self.capacity_e)
        if not self.blooming:
            return held
        over = np.flatnonzero((charge_e > self.capacity_e).any(axis=0))
        if over.size:
            columns, excess = held[:, over], (charge_e - held)[:, over] / 2.0
            held[:, over] = self._spilled(self._spilled(columns, excess)[::-1], excess[::-1])[::-1]
        return held

    def _spilled(self, held_e: Float, excess_e: Float) -> Float:
        """Columns (rows, n) after the excess of each pixel has run towards the last row."""
        result = held_e.copy()
        running = np.zeros(held_e.shape[1])
        for row, excess in zip(result, excess_e, strict=True):
            taken = np.minimum(self.capacity_e - row, running)
            row += taken
            running += excess - taken
        return result
