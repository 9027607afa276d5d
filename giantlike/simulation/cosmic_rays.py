"""Tracks of charged particles through a detector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, require_number
from giantlike.core.values import Value

_UM_PER_CM = 1e4  # micrometers to the centimeter
_STEPS_PER_PX = 16  # pieces per pixel of track length, each of which leaves its charge in one pixel
_FLATTEST_COSINE = 0.02  # cosine of incidence at which flatter tracks, one in 2,500 (its square), are cut off


@dataclass(frozen=True, slots=True, kw_only=True)
class CosmicRays:
    """Rate of the particles that hit a detector, isotropically, and the charge that they leave."""

    rate_s_cm2: float = 0.0  # in 1/s/cm^2; rate through the area of the detector
    hits_per_image: float = 0.0  # mean number of hits in an image of any exposure, added to the rate
    pixel_um: float = 10.0  # pixel pitch
    thickness_um: float = 15.0  # depth in which charge is collected: with the incidence it gives the length of a track
    charge_e_um: float = 80.0  # median per path length; 80 is about a minimum ionizing particle in silicon
    charge_spread: float = 0.4  # standard deviation of the natural logarithm of that charge, from particle to particle

    def __post_init__(self) -> None:
        for name in ("rate_s_cm2", "hits_per_image", "charge_spread"):
            require_number(getattr(self, name), f"cosmic ray {name}", least=0.0)
        for name in ("pixel_um", "thickness_um", "charge_e_um"):
            require_number(getattr(self, name), f"cosmic ray {name}", above=0.0)

    def mean_hits(self, columns: int, rows: int, exposure_s: float) -> float:
        """Expected number of hits on a detector of (rows, columns) pixels during an exposure, s."""
        area_cm2 = columns * rows * (self.pixel_um / _UM_PER_CM) ** 2
        return self.hits_per_image + self.rate_s_cm2 * area_cm2 * exposure_s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks(Value):
    """Tracks of particles."""

    start_px: Float  # start_px, end_px: (n, 2); points at which each enters and leaves the layer that collects charge
    end_px: Float
    charge_e: Float  # (n,); charge of the whole track, spread evenly over its length

    def deposited_e(self, columns: int, rows: int) -> Float:
        """Charge (rows, columns), electron, in the pixels; the parts of tracks outside the detector are left out."""
        along = self.end_px - self.start_px
        pieces = np.ceil(np.linalg.norm(along, axis=1) * _STEPS_PER_PX).astype(np.int64) + 1
        track = np.repeat(np.arange(pieces.size), pieces)
        piece = np.arange(track.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        middle = ((piece + 0.5) / pieces[track])[:, None]
        x, y = np.rint(self.start_px[track] + middle * along[track]).astype(np.int64).T
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        charge = (self.charge_e / pieces)[track]
        frame = np.bincount((y * columns + x)[inside], weights=charge[inside], minlength=rows * columns)
        return frame.astype(np.float64, copy=False).reshape(rows, columns)


def draw_tracks(options: CosmicRays, columns: int, rows: int, exposure_s: float, random: np.random.Generator) -> Tracks:
    """Draw the particles that hit a detector during an exposure."""
    count = int(random.poisson(options.mean_hits(columns, rows, exposure_s)))
    start = random.uniform(-0.5, [columns - 0.5, rows - 0.5], (count, 2))
    azimuth = random.uniform(0.0, 2.0 * math.pi, count)
    cosine = np.sqrt(1.0 - random.uniform(0.0, 1.0 - _FLATTEST_COSINE**2, count))
    per_um = options.charge_e_um * np.exp(options.charge_spread * random.standard_normal(count))
    length_px = options.thickness_um / options.pixel_um * np.sqrt(1.0 - cosine**2) / cosine
    step = length_px[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    return Tracks(start_px=start, end_px=start + step, charge_e=per_um * options.thickness_um / cosine)
