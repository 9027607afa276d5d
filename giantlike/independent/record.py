"""A detector: background, noise, saturation, blooming and bad pixels on top of noise-free light."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from giantlike.independent.laws import Float

Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Recorder:
    """Properties of a detector."""

    gain_e_per_dn: float = 1.0  # e-/DN; electrons per DN
    read_noise_e: float = 5.0  # e-
    bias_dn: float = 0.0  # level without light
    saturation_dn: float = np.inf  # highest value
    quantized: bool = True  # round to whole DN
    blooms: bool = False  # charge above saturation flows to both sides along its column


@dataclass(frozen=True)
class Defects:
    """Bad pixels."""

    dead_columns: tuple[int, ...] = ()  # dead_columns, dead_rows: without signal
    dead_rows: tuple[int, ...] = ()
    hot_pixels: int = 0  # number of pixels at random places with extra charge
    hot_dn: float = 500.0  # mean of that charge (exponential)
    cosmic_rays: int = 0  # number of tracks at random places
    cosmic_dn: float = 800.0  # mean signal of a pixel of a track
    cosmic_length_px: float = 5.0  # mean length of a track


@dataclass(frozen=True, eq=False)
class Recorded:
    """Image as read out."""

    pixels: Float  # in DN; values
    saturated: Bool  # at the highest value, by light or by blooming
    bad: Bool = field(repr=False)  # dead, hot, or hit by a cosmic ray


def background(
    shape: tuple[int, int],
    *,
    constant_dn: float = 0.0,
    slope_dn: tuple[float, float] = (0.0, 0.0),
    glare_dn: float = 0.0,
    glare_center_px: tuple[float, float] = (0.0, 0.0),
    glare_sigma_px: float = 300.0,
) -> Float:
    """Make a background: constant, plane, and the glow of a source outside or inside the frame.

    ``shape``: rows and columns; returns (rows, columns).
    """
    rows, columns = shape
    y, x = np.arange(rows)[:, None], np.arange(columns)[None, :]
    plane = slope_dn[0] * (x / max(columns - 1, 1) - 0.5) + slope_dn[1] * (y / max(rows - 1, 1) - 0.5)
    squared = (x - glare_center_px[0]) ** 2 + (y - glare_center_px[1]) ** 2
    return np.asarray(constant_dn + plane + glare_dn * np.exp(-0.5 * squared / glare_sigma_px**2), dtype=float)


def record(
    signal_dn: Float, rng: np.random.Generator, recorder: Recorder | None = None, defects: Defects | None = None
) -> Recorded:
    """Expose and read out."""
    recorder, defects = recorder or Recorder(), defects or Defects()
    electrons = rng.poisson(np.maximum(signal_dn, 0.0) * recorder.gain_e_per_dn).astype(float)
    bad = _struck(electrons, rng, recorder, defects)
    full = (recorder.saturation_dn - recorder.bias_dn) * recorder.gain_e_per_dn
    if recorder.blooms and np.isfinite(full):
        electrons = _bloom(electrons, full)
    electrons += rng.normal(scale=recorder.read_noise_e, size=electrons.shape)
    pixels = electrons / recorder.gain_e_per_dn + recorder.bias_dn
    for columns in defects.dead_columns:
        pixels[:, columns] = recorder.bias_dn
        bad[:, columns] = True
    for rows in defects.dead_rows:
        pixels[rows] = recorder.bias_dn
        bad[rows] = True
    if recorder.quantized:
        pixels = np.round(pixels)
    saturated = pixels >= recorder.saturation_dn
    return Recorded(pixels=np.minimum(pixels, recorder.saturation_dn), saturated=saturated, bad=bad)


def _struck(electrons: Float, rng: np.random.Generator, recorder: Recorder, defects: Defects) -> Bool:
    """Add hot pixels and cosmic rays in place; return the pixels concerned."""
    rows, columns = electrons.shape
    bad = np.zeros(electrons.shape, dtype=bool)
    if defects.hot_pixels:
        y, x = rng.integers(rows, size=defects.hot_pixels), rng.integers(columns, size=defects.hot_pixels)
        electrons[y, x] += rng.exponential(defects.hot_dn * recorder.gain_e_per_dn, size=defects.hot_pixels)
        bad[y, x] = True
    for _ in range(defects.cosmic_rays):
        length, angle = rng.exponential(defects.cosmic_length_px), rng.uniform(0.0, np.pi)
        steps = np.arange(0.0, max(length, 1.0), 0.5)
        y = np.round(rng.uniform(0, rows - 1) + steps * np.sin(angle)).astype(int)
        x = np.round(rng.uniform(0, columns - 1) + steps * np.cos(angle)).astype(int)
        places = np.unique(np.stack([y, x], axis=1), axis=0)
        places = places[((places >= 0) & (places < [rows, columns])).all(axis=1)]
        charge = rng.exponential(defects.cosmic_dn * recorder.gain_e_per_dn, size=len(places))
        electrons[places[:, 0], places[:, 1]] += charge
        bad[places[:, 0], places[:, 1]] = True
    return bad


def _bloom(electrons: Float, full: float) -> Float:
    """Spread the charge above the full well evenly up and down each column, into the next pixels with room."""
    result = np.minimum(electrons, full)
    excess = electrons - result
    for column in np.flatnonzero(excess.any(axis=0)):
        for step in (-1, 1):
            carried = 0.0
            order = range(len(electrons)) if step > 0 else range(len(electrons) - 1, -1, -1)
            for row in order:
                carried += 0.5 * excess[row, column]
                taken = min(carried, full - result[row, column])
                result[row, column] += taken
                carried -= taken
    return np.asarray(result, dtype=float)
