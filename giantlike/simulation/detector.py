"""From light to numbers: a chain of steps through the detector, each of which can be left out.

Light on the pixels, stray light, flat field, smear of the frame transfer, dark current, shot noise, cosmic rays,
full well, read noise, gain and rounding, in this order: what is light goes through the flat field and what is charge
does not. Every random effect draws from a stream of its own: switching on another leaves its numbers as they were.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, as_floats, require
from giantlike.core.detector import Detector
from giantlike.core.values import Value
from giantlike.simulation.cosmic_rays import CosmicRays, draw_tracks
from giantlike.simulation.effects import DarkCurrent, FlatField, FrameTransfer, FullWell, StrayLight

_BRIGHTEST_E = 1e15  # Poisson numbers are 64 bit integers

Seed = int | tuple[int, ...]
"""One or several whole numbers >= 0: equal seeds give equal images."""


class Stream(IntEnum):
    """Which random numbers: each effect has its own, independent of all others.

    Shot noise is drawn about the mean charge: what changes that mean draws other numbers, of the same law.
    """

    RAYS = 0
    SHOT_NOISE = 1
    READ_NOISE = 2
    COSMIC_RAYS = 3
    PIXEL_RESPONSE = 4
    HOT_PIXELS = 5
    DEAD_PIXELS = 6

    def random(self, seed: Seed) -> np.random.Generator:
        """Return the generator of this effect for a seed."""
        words = seed if isinstance(seed, tuple) else (seed,)
        require(len(words) > 0 and min(words) >= 0, f"a seed needs whole numbers >= 0, got {seed}")
        return np.random.default_rng([int(self), *words])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HotPixels(Value):
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
        Value.__post_init__(self)

    @classmethod
    def scattered(
        cls, count: int, columns: int, rows: int, rng: np.random.Generator, *, median_e_s: float
    ) -> HotPixels:
        """Draw hot pixels anywhere on a detector, with rates spread over a factor of ten about their median."""
        points = scattered_pixels(count, columns, rows, rng)
        return cls(points_px=points, rate_e_s=median_e_s * 10.0 ** rng.uniform(-0.5, 0.5, count))

    def signal_e(self, columns: int, rows: int, exposure_s: float) -> Float:
        """Electrons (rows, columns) that they add in an exposure."""
        frame = np.zeros((rows, columns))
        x, y, inside = _inside(self.points_px, columns, rows)
        np.add.at(frame, (y, x), self.rate_e_s[inside] * exposure_s)
        return frame


def scattered_pixels(count: int, columns: int, rows: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw pixels (count, 2), (x, y), anywhere on a detector; two may coincide."""
    return np.stack([rng.integers(0, columns, count), rng.integers(0, rows, count)], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectorModel(Value):
    """What a detector does beyond the gain, bias, read noise and saturation of a camera file.

    By default only shot noise is on.

    Parameters
    ----------
    stray : StrayLight
    flat : FlatField
    transfer : FrameTransfer
    dark : DarkCurrent
    hot_pixels : HotPixels
    dead_px : (n, 2) int64, px
        (x, y) of pixels that hold no charge; those outside a frame are left out.
    shot_noise : bool
    cosmic_rays : CosmicRays
    well : FullWell
    bits : int
        Of the converter, at most 16: numbers end at ``2^bits - 1``.
    """

    stray: StrayLight = field(default_factory=StrayLight)
    flat: FlatField = field(default_factory=FlatField)
    transfer: FrameTransfer = field(default_factory=FrameTransfer)
    dark: DarkCurrent = field(default_factory=DarkCurrent)
    hot_pixels: HotPixels = field(default_factory=HotPixels)
    dead_px: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    shot_noise: bool = True
    cosmic_rays: CosmicRays = field(default_factory=CosmicRays)
    well: FullWell = field(default_factory=FullWell)
    bits: int = 16

    def __post_init__(self) -> None:
        require(
            self.dead_px.ndim == 2 and self.dead_px.shape[1] == 2,
            f"dead_px must have shape (n, 2), got {self.dead_px.shape}",
        )
        require(1 <= self.bits <= 16, f"bits must be in [1, 16], got {self.bits}")
        Value.__post_init__(self)

    def expected_e(self, light_e: Float, exposure_s: float) -> Float:
        """Mean number of electrons (rows, columns) before any noise, of light (rows, columns) on the pixels."""
        rows, columns = light_e.shape
        light = (light_e + self.stray.rate_e_s(columns, rows) * exposure_s) * self.flat.factor(columns, rows)
        charge = light + self.transfer.smear_e(light, exposure_s)
        charge += self.dark.actual_rate_e_s * exposure_s + self.hot_pixels.signal_e(columns, rows, exposure_s)
        return self.without_dead(charge)

    def without_dead(self, charge_e: Float) -> Float:
        """Return charge (rows, columns) with none in the dead pixels."""
        rows, columns = charge_e.shape
        x, y, _ = _inside(self.dead_px, columns, rows)
        result = charge_e.copy()
        result[y, x] = 0.0
        return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Readout(Value):
    """Numbers that came out of a detector, and what is true of them.

    Parameters
    ----------
    pixels : (rows, columns) uint16, DN
    expected_e : (rows, columns) float64, electron
        Mean charge without any noise, before saturation.
    cosmic_e : (rows, columns) float64, electron
        Charge left by cosmic rays.
    """

    pixels: NDArray[np.uint16]
    expected_e: Float
    cosmic_e: Float


def expose(
    light_e: Float,
    exposure_s: float,
    detector: Detector,
    *,
    seed: Seed,
    model: DetectorModel | None = None,
) -> Readout:
    """Read out a detector on which light has fallen.

    Parameters
    ----------
    light_e : (rows, columns) float64, electron
        Mean number of electrons that the light of the scene sets free in each pixel during the exposure.
    exposure_s : float, s
        For what depends on time: dark current, stray light, cosmic rays, smear.
    detector : Detector
        Gain, read noise, bias and the number at which pixels saturate.
    seed : int or tuple of int
        Of all noise.
    model : DetectorModel, optional
        All other effects; by default there is only shot noise.

    Returns
    -------
    Readout
        Numbers are rounded, and cut off at 0 and at ``detector.saturation_dn`` or the last number of the converter.

    Raises
    ------
    InputError
        The light is not two-dimensional, negative or not finite, or a map has another size.
    """
    light = as_floats(light_e, (), "light_e")
    require(light.ndim == 2, f"light_e must have shape (rows, columns), got {light.shape}")
    require(math.isfinite(exposure_s) and exposure_s >= 0, f"exposure_s must be >= 0, got {exposure_s}")
    lowest, highest = float(light.min(initial=0.0)), float(light.max(initial=0.0))
    require(lowest >= 0.0 and highest <= _BRIGHTEST_E, f"light_e must be in [0, 1e15], got {lowest} to {highest}")
    model = DetectorModel() if model is None else model
    rows, columns = light.shape
    expected_e = model.expected_e(light, exposure_s)
    charge_e = shot_noise(expected_e, Stream.SHOT_NOISE.random(seed)) if model.shot_noise else expected_e
    tracks = draw_tracks(model.cosmic_rays, columns, rows, exposure_s, Stream.COSMIC_RAYS.random(seed))
    cosmic_e = model.without_dead(tracks.deposited_e(columns, rows))
    held_e = model.well.held_e(charge_e + cosmic_e)
    read_e = held_e + detector.read_noise_e * Stream.READ_NOISE.random(seed).standard_normal(light.shape)
    return Readout(pixels=converted(read_e, detector, bits=model.bits), expected_e=expected_e, cosmic_e=cosmic_e)


def shot_noise(expected_e: Float, random: np.random.Generator) -> Float:
    """Draw whole electrons (rows, columns) by Poisson's law about their mean."""
    drawn = np.zeros(expected_e.shape)
    bright = expected_e > 0.0
    drawn[bright] = random.poisson(expected_e[bright])
    return drawn


def converted(charge_e: Float, detector: Detector, *, bits: int = 16) -> NDArray[np.uint16]:
    """Numbers (rows, columns), DN, of charge: gain, bias, rounding, and both ends of the scale."""
    numbers = np.rint(charge_e / detector.gain_e_per_dn + detector.bias_dn)
    return np.clip(numbers, 0.0, int(min(detector.saturation_dn, 2**bits - 1))).astype(np.uint16)


def _inside(points_px: NDArray[np.int64], columns: int, rows: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
    """Columns and rows of the pixels on a detector, and which of all they are."""
    x, y = points_px[:, 0], points_px[:, 1]
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return x[inside], y[inside], inside
