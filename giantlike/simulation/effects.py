"""Detector effects on light and charge: stray light, flat field, transfer smear, dark current, full well.

Each effect is a value with one pure method from arrays to arrays; the default of each changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, as_floats, require, require_number
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True)
class StrayLight:
    """Stray light: a plane and a round glow."""

    level_e_s: float = 0.0  # in electron/s; level of the plane at the center of the detector
    gradient_e_s_px: tuple[float, float] = (0.0, 0.0)  # in electron/s/px; gradient of the plane along x and y
    glow_e_s: float = 0.0  # in electron/s; peak of a Gaussian glow
    glow_center_px: tuple[float, float] = (0.0, 0.0)
    glow_sigma_px: float = 100.0  # standard deviation of the glow

    def __post_init__(self) -> None:
        for number in (*self.gradient_e_s_px, *self.glow_center_px):
            require_number(number, "stray gradient_e_s_px and glow_center_px")
        require_number(self.level_e_s, "stray level_e_s", least=0.0)
        require_number(self.glow_e_s, "stray glow_e_s", least=0.0)
        require_number(self.glow_sigma_px, "stray glow_sigma_px", above=0.0)

    def rate_e_s(self, columns: int, rows: int) -> Float:
        """Stray light (rows, columns), electron/s; nowhere negative."""
        x, y = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)[:, None]
        along_x, along_y = self.gradient_e_s_px
        plane = self.level_e_s + along_x * (x - (columns - 1) / 2) + along_y * (y - (rows - 1) / 2)
        near = [
            np.exp(-0.5 * ((axis - center) / self.glow_sigma_px) ** 2)
            for axis, center in zip((x, y), self.glow_center_px, strict=True)
        ]
        return np.maximum(plane, 0.0) + self.glow_e_s * near[1] * near[0]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlatField(Value):
    """Relative response of the pixels: pixel-to-pixel differences and vignetting."""

    response: Float | None = None  # (rows, columns); of single pixels, 1 on average, as of ``pixel_response``
    vignetting: float = 0.0  # fraction lost in the corners, growing with the square from the center

    def __post_init__(self) -> None:
        require_number(self.vignetting, "vignetting", least=0.0, most=1.0)
        if self.response is not None:
            response = as_floats(self.response, (), "flat field response")
            lowest = float(response.min(initial=math.inf))
            require(
                response.ndim == 2 and bool(np.isfinite(response).all()) and lowest >= 0.0,
                f"a flat field response must be (rows, columns), finite and >= 0, got {response.shape}, least {lowest}",
            )
        Value.__post_init__(self)

    def factor(self, columns: int, rows: int) -> Float:
        """Factor (rows, columns) on the light; 1 where nothing is lost."""
        x, y = np.arange(columns) - (columns - 1) / 2, (np.arange(rows) - (rows - 1) / 2)[:, None]
        corner_px2 = (columns / 2) ** 2 + (rows / 2) ** 2
        factor: Float = 1.0 - self.vignetting * (x**2 + y**2) / corner_px2
        if self.response is None:
            return factor
        size = self.response.shape
        require(size == (rows, columns), f"the flat field response has {size} pixels, the camera {(rows, columns)}")
        return factor * self.response


def pixel_response(columns: int, rows: int, *, rms: float, random: np.random.Generator) -> Float:
    """Draw relative responses (rows, columns): normal about 1 with standard deviation ``rms``, in [0, 0.3]."""
    require_number(rms, "pixel response rms", least=0.0, most=0.3)
    return np.maximum(1.0 + rms * random.standard_normal((rows, columns)), 0.0)


class StorageSide(StrEnum):
    """Edge of the image next to the storage region of a frame-transfer detector."""

    FIRST_ROW = "first_row"
    LAST_ROW = "last_row"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTransfer:
    """Smear of a frame-transfer detector without shutter, whose rows move under the light."""

    row_time_s: float = 0.0  # under the light of each other row that it passes; 0: no smear
    storage: StorageSide = StorageSide.FIRST_ROW  # edge towards which the rows move after the exposure
    # True if the rows move in the same way right before the exposure, to clear the detector: then every row has passed
    # all others, and the smear of a column is nearly constant. Else a row passes only those on its way out
    swept_before: bool = True

    def __post_init__(self) -> None:
        require_number(self.row_time_s, "frame transfer row_time_s", least=0.0)

    def smear_e(self, light_e: Float, exposure_s: float) -> Float:
        """Charge (rows, columns) that the moving rows collect, at the rate of light ``light_e / exposure_s``."""
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
    """Dark current, the same in every pixel; hot pixels are added to it."""

    rate_e_s: float = 0.0  # in electron/s; rate per pixel at the reference temperature
    temperature_k: float | None = None  # K; temperature of the detector; without one the rate is not scaled
    reference_temperature_k: float = 293.15  # K; temperature of the rate; 20 degrees Celsius by default
    doubling_k: float = 6.5  # K; rise of temperature that doubles the rate; 6.5 until it is measured

    def __post_init__(self) -> None:
        require_number(self.rate_e_s, "dark rate_e_s", least=0.0)
        for name in ("temperature_k", "reference_temperature_k", "doubling_k"):
            if getattr(self, name) is not None:
                require_number(getattr(self, name), f"dark {name}", above=0.0, most=1000.0)

    @property
    def actual_rate_e_s(self) -> float:
        """Rate per pixel at the temperature of the detector, electron/s."""
        if self.temperature_k is None:
            return self.rate_e_s
        return self.rate_e_s * math.pow(2.0, (self.temperature_k - self.reference_temperature_k) / self.doubling_k)


@dataclass(frozen=True, slots=True, kw_only=True)
class FullWell:
    """Full-well capacity of the pixels and blooming."""

    capacity_e: float = math.inf  # charge that a pixel holds; infinite by default, so that only the converter saturates
    # True if excess charge spills along the column, half of it either way, into the nearest pixels that have room;
    # charge that reaches an edge of the detector drains off. Without blooming the excess is lost at once
    blooming: bool = False

    def __post_init__(self) -> None:
        require(self.capacity_e > 0, f"full well capacity_e must be > 0, got {self.capacity_e}")

    def held_e(self, charge_e: Float) -> Float:
        """Charge (rows, columns), electron, after blooming of ``charge_e``; no pixel holds more than the capacity."""
        held = np.minimum(charge_e, self.capacity_e)
        if not self.blooming:
            return held
        over = np.flatnonzero((charge_e > self.capacity_e).any(axis=0))
        if over.size:
            columns, excess = held[:, over], (charge_e - held)[:, over] / 2.0
            held[:, over] = self._spill(self._spill(columns, excess)[::-1], excess[::-1])[::-1]
        return held

    def _spill(self, held_e: Float, excess_e: Float) -> Float:
        """Charge of columns (rows, n) after the excess of each pixel has run towards the last row."""
        result = held_e.copy()
        running = np.zeros(held_e.shape[1])
        for row, excess in zip(result, excess_e, strict=True):
            taken = np.minimum(self.capacity_e - row, running)
            row += taken
            running += excess - taken
        return result
