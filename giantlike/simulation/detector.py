"""Conversion of light to digital numbers: a chain of detector effects, each of which can be left out.

In this order: stray light, flat field, smear of the frame transfer, dark current, shot noise, cosmic rays, full well,
read noise, gain and rounding. Every random effect draws from a separate stream.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, as_floats, require, require_number
from giantlike.core.detector import Detector
from giantlike.core.gamma import GammaCurve
from giantlike.core.values import Value
from giantlike.simulation.cosmic_rays import CosmicRays, draw_tracks
from giantlike.simulation.effects import DarkCurrent, FlatField, FrameTransfer, FullWell, StrayLight

_BRIGHTEST_E = 1e15  # electrons; Poisson numbers are 64 bit integers, which end at 9e18
_DECADES = 1.0  # range of hot pixel rates about their median, powers of ten: a factor of ten in all

Seed = int | tuple[int, ...]  # one or several whole numbers >= 0: equal seeds give equal images


class Stream(IntEnum):
    """Streams of random numbers, one for each effect (shot noise also follows the mean charge that others change)."""

    RAYS = 0
    SHOT_NOISE = 1
    READ_NOISE = 2
    COSMIC_RAYS = 3
    PIXEL_RESPONSE = 4
    HOT_PIXELS = 5
    DEAD_PIXELS = 6

    def random(self, seed: Seed) -> np.random.Generator:
        """Random generator of this effect for a seed; ``InputError`` for a negative or empty seed."""
        words = seed if isinstance(seed, tuple) else (seed,)
        require(len(words) > 0 and min(words) >= 0, f"a seed needs whole numbers >= 0, got {seed}")
        return np.random.default_rng([int(self), *words])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HotPixels(Value):
    """Pixels with a high dark current."""

    # (n, 2) int64, px; column and row of each; those outside a frame are left out
    points_px: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    rate_e_s: Float = field(default_factory=lambda: np.zeros(0))  # (n,), electron/s; dark current of each

    def __post_init__(self) -> None:
        require(
            self.points_px.ndim == 2 and self.points_px.shape == (len(self.rate_e_s), 2),
            f"hot pixels need points_px (n, 2) and rate_e_s (n,), got {self.points_px.shape} and {self.rate_e_s.shape}",
        )
        Value.__post_init__(self)

    @classmethod
    def draw(cls, count: int, columns: int, rows: int, rng: np.random.Generator, *, median_e_s: float) -> HotPixels:
        """Draw hot pixels uniformly over a detector, with log-uniform rates over a factor of ten about their median."""
        points = scattered_pixels(count, columns, rows, rng)
        return cls(points_px=points, rate_e_s=median_e_s * 10.0 ** rng.uniform(-_DECADES / 2, _DECADES / 2, count))

    def signal_e(self, columns: int, rows: int, exposure_s: float) -> Float:
        """Charge (rows, columns), electron, that the hot pixels add in an exposure, s."""
        frame = np.zeros((rows, columns))
        x, y, inside = _inside(self.points_px, columns, rows)
        np.add.at(frame, (y, x), self.rate_e_s[inside] * exposure_s)
        return frame


def scattered_pixels(count: int, columns: int, rows: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw pixels (count, 2), column and row, uniformly over a detector; two may coincide."""
    return np.stack([rng.integers(0, columns, count), rng.integers(0, rows, count)], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectorModel(Value):
    """Detector effects beyond those of a camera file; by default only shot noise is on."""

    stray: StrayLight = field(default_factory=StrayLight)  # stray light
    flat: FlatField = field(default_factory=FlatField)  # response of the pixels
    transfer: FrameTransfer = field(default_factory=FrameTransfer)  # smear of the frame transfer
    dark: DarkCurrent = field(default_factory=DarkCurrent)  # dark current
    hot_pixels: HotPixels = field(default_factory=HotPixels)  # pixels with a high dark current
    # (n, 2) int64, px; column and row of pixels that hold no charge; those outside a frame are left out
    dead_px: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    shot_noise: bool = True  # True to draw shot noise
    cosmic_rays: CosmicRays = field(default_factory=CosmicRays)  # tracks of charged particles
    well: FullWell = field(default_factory=FullWell)  # full-well capacity and blooming
    bits: int = 16  # bits of the converter, at most 16: numbers end at ``2^bits - 1``

    def __post_init__(self) -> None:
        require(
            self.dead_px.ndim == 2 and self.dead_px.shape[1] == 2,
            f"dead_px must have shape (n, 2), got {self.dead_px.shape}",
        )
        require(1 <= self.bits <= 16, f"bits must be in [1, 16], got {self.bits}")
        Value.__post_init__(self)

    def expected_e(self, light_e: Float, exposure_s: float) -> Float:
        """Mean charge (rows, columns), electron, before noise, of photoelectrons ``light_e`` (rows, columns)."""
        rows, columns = light_e.shape
        light = (light_e + self.stray.rate_e_s(columns, rows) * exposure_s) * self.flat.factor(columns, rows)
        charge = light + self.transfer.smear_e(light, exposure_s)
        charge += self.dark.actual_rate_e_s * exposure_s + self.hot_pixels.signal_e(columns, rows, exposure_s)
        return self.without_dead(charge)

    def without_dead(self, charge_e: Float) -> Float:
        """Copy of charge (rows, columns) with none in the dead pixels."""
        rows, columns = charge_e.shape
        x, y, _ = _inside(self.dead_px, columns, rows)
        result = charge_e.copy()
        result[y, x] = 0.0
        return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Readout(Value):
    """Digital numbers of an image, and the mean charge and cosmic-ray charge behind them."""

    pixels: NDArray[np.uint16]  # in DN
    expected_e: Float  # (rows, columns); mean charge without any noise, before saturation
    cosmic_e: Float  # (rows, columns); charge left by cosmic rays


def expose(
    light_e: Float, exposure_s: float, detector: Detector, *, seed: Seed, model: DetectorModel | None = None
) -> Readout:
    """Convert the light on a detector to the digital numbers of an image. ``light_e`` (rows, columns)."""
    light = as_floats(light_e, (), "light_e")
    require(light.ndim == 2, f"light_e must have shape (rows, columns), got {light.shape}")
    require_number(exposure_s, "exposure_s", least=0.0)
    lowest, highest = float(light.min(initial=0.0)), float(light.max(initial=0.0))
    within = lowest >= 0.0 and highest <= _BRIGHTEST_E
    require(within, f"light_e must be in [0, {_BRIGHTEST_E:g}], got {lowest} to {highest}")
    model = DetectorModel() if model is None else model
    rows, columns = light.shape
    expected_e = model.expected_e(light, exposure_s)
    charge_e = shot_noise(expected_e, Stream.SHOT_NOISE.random(seed)) if model.shot_noise else expected_e
    tracks = draw_tracks(model.cosmic_rays, columns, rows, exposure_s, Stream.COSMIC_RAYS.random(seed))
    cosmic_e = model.without_dead(tracks.deposited_e(columns, rows))
    held_e = model.well.held_e(charge_e + cosmic_e)
    read_e = held_e + detector.read_noise_e * Stream.READ_NOISE.random(seed).standard_normal(light.shape)
    return Readout(pixels=convert_charge(read_e, detector, bits=model.bits), expected_e=expected_e, cosmic_e=cosmic_e)


def shot_noise(expected_e: Float, random: np.random.Generator) -> Float:
    """Draw numbers of electrons (rows, columns) from Poisson distributions of the given means."""
    drawn = np.zeros(expected_e.shape)
    bright = expected_e > 0.0
    drawn[bright] = random.poisson(expected_e[bright])
    return drawn


def convert_charge(charge_e: Float, detector: Detector, *, bits: int = 16) -> NDArray[np.uint16]:
    """Digital numbers (rows, columns), DN, of charge, electron: gain, gamma, bias, rounding and clipping."""
    largest_dn = int(min(detector.saturation_dn, 2**bits - 1))
    light_dn = charge_e / detector.gain_e_per_dn
    if detector.gamma is not None:
        light_dn = GammaCurve(gamma=detector.gamma, full_scale_dn=largest_dn - detector.bias_dn).values_dn(light_dn)
    return np.clip(np.rint(light_dn + detector.bias_dn), 0.0, largest_dn).astype(np.uint16)


def _inside(points_px: NDArray[np.int64], columns: int, rows: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
    """Columns and rows of the pixels on a detector, and the mask (n,) of them."""
    x, y = points_px[:, 0], points_px[:, 1]
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return x[inside], y[inside], inside
