"""A sphere in an atmosphere: single scattering summed along rays, with what haze takes of the light of the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.independent.laws import LAWS, Float
from giantlike.independent.psf import Psf
from giantlike.independent.render import Pose
from giantlike.independent.views import PinholeView

TOP_SCALE_HEIGHTS = 14.0
"""Height of the top of the haze, in scale heights over where a vertical ray has met a depth of 1: 1e-6 is above."""

STEPS = 96  # places along a ray, denser near its lowest point: light of a limb is right to 1e-3

CELLS = 3  # cells along the side of a pixel

RAYS_AT_ONCE = 4_000
"""Rays in one call: keeps the arrays of a batch, a number for each of the steps along a ray, within a cache."""

HEIGHTS, COSINES, TO_SUN = 81, 241, 200
"""Heights and cosines of incidence at which sunlight is tabulated, and steps along each ray to the Sun."""


@dataclass(frozen=True)
class HazeSunlight:
    """Share of sunlight that reaches places in haze, tabulated over height and cosine of incidence."""

    high_km: float  # height of the top of the haze
    width: float  # cosines are tabulated at ``width sinh(v)``, for v in even steps up to ``end`` either way
    end: float
    table: Float

    @classmethod
    def through(cls, radius_km: float, haze: Haze, high_km: float) -> HazeSunlight:
        """Sum the haze up along straight rays to the Sun; 0 where they meet the sphere."""
        width = float(np.sqrt(2.0 * haze.scale_height_km / radius_km))
        end = float(np.arcsinh(1.0 / width))
        cosines = width * np.sinh(np.linspace(-end, end, COSINES))
        away = radius_km + np.linspace(0.0, high_km, HEIGHTS)[:, None]
        lowest2, first = away**2 * (1.0 - cosines**2), away * cosines
        length = np.sqrt(np.maximum((radius_km + high_km) ** 2 - lowest2, 0.0)) - first
        depth = np.zeros_like(length)
        for step in range(TO_SUN):
            height = np.sqrt(lowest2 + (first + (step + 0.5) / TO_SUN * length) ** 2) - radius_km
            depth += np.exp(-np.maximum(height, 0.0) / haze.scale_height_km) * length / TO_SUN
        dark = (cosines < 0.0) & (lowest2 < radius_km**2)
        share = np.exp(-haze.vertical_depth / haze.scale_height_km * depth)
        return cls(high_km, width, end, np.where(dark, 0.0, share))

    def at(self, height_km: Float, cosine: Float) -> Float:
        """Interpolate the table, linearly in both directions."""
        row = np.clip(height_km / self.high_km, 0.0, 1.0) * (HEIGHTS - 1)
        column = (np.arcsinh(np.clip(cosine, -1.0, 1.0) / self.width) / self.end + 1.0) / 2.0 * (COSINES - 1)
        i, j = np.minimum(row.astype(int), HEIGHTS - 2), np.clip(column.astype(int), 0, COSINES - 2)
        up, across = row - i, column - j
        below = (1.0 - across) * self.table[i, j] + across * self.table[i, j + 1]
        above = (1.0 - across) * self.table[i + 1, j] + across * self.table[i + 1, j + 1]
        return np.asarray((1.0 - up) * below + up * above, dtype=float)


@dataclass(frozen=True)
class Haze:
    """Haze whose extinction falls exponentially with height.

    albedo: share of the light that is scattered, alike in all directions, over the brightness of the ground at normal
        incidence and emission.
    twilight: haze is lit wherever the sphere does not stand before the Sun; else only where the ground below is.
    """

    scale_height_km: float
    vertical_depth: float  # optical depth of all of it
    albedo: float = 0.25
    twilight: bool = False


def hazy_sphere(
    radius_km: float, haze: Haze, view: PinholeView, pose: Pose, *, law: str = "lambert", psf: Psf | None = None
) -> Float:
    """Render a sphere in haze, without noise."""
    psf = psf or Psf()
    margin = psf.reach_px
    rows, columns = view.rows + 2 * margin, view.columns + 2 * margin
    places = (np.arange(max(rows, columns) * CELLS) + 0.5) / CELLS - 0.5 - margin
    x, y = np.meshgrid(places[: columns * CELLS], places[: rows * CELLS])
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    light = np.zeros(len(pixels))
    for first in range(0, len(pixels), RAYS_AT_ONCE):
        part = slice(first, first + RAYS_AT_ONCE)
        light[part] = _brightness(radius_km, haze, view.directions(pixels[part]), pose, law)
    blurred = psf.blurred(light.reshape(rows * CELLS, columns * CELLS), CELLS)
    whole = blurred.reshape(rows, CELLS, columns, CELLS).mean(axis=(1, 3))
    return np.asarray(whole[margin : margin + view.rows, margin : margin + view.columns], dtype=float)


def _brightness(radius_km: float, haze: Haze, rays: Float, pose: Pose, law: str) -> Float:
    """Brightness (n,) along rays (n, 3)."""
    center = np.asarray(pose.position_camera_km, dtype=float)
    sun = np.asarray(pose.sun_direction_camera, dtype=float)
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    middle = rays @ center
    lowest = np.sqrt(np.maximum(center @ center - middle**2, 0.0))
    high = haze.scale_height_km * (TOP_SCALE_HEIGHTS + max(np.log(haze.vertical_depth), 0.0))
    top = radius_km + high
    light = np.zeros(len(rays))
    meets = lowest < top
    rays, middle, lowest = rays[meets], middle[meets], lowest[meets]
    half = np.sqrt(top**2 - lowest**2)
    ground = lowest < radius_km
    end = np.where(ground, -np.sqrt(np.maximum(radius_km**2 - lowest**2, 0.0)), half)
    # Places along the way from the top to the ground or out again: crowded at both ends, or about the lowest point.
    share = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, STEPS + 1)))
    about = np.linspace(-1.0, 1.0, STEPS + 1)
    way = np.where(ground[:, None], -half[:, None] + share * (end + half)[:, None], half[:, None] * about**3)
    along = 0.5 * (way[:, 1:] + way[:, :-1])
    height = np.sqrt(along**2 + lowest[:, None] ** 2) - radius_km
    extinction = haze.vertical_depth / haze.scale_height_km * np.exp(-np.maximum(height, 0.0) / haze.scale_height_km)
    steps = extinction * np.diff(way, axis=1)
    passed = np.cumsum(steps, axis=1)
    points = (middle[:, None] + along)[..., None] * rays[:, None] - center
    incidence = points @ sun / np.linalg.norm(points, axis=-1)
    above = haze.vertical_depth * np.exp(-np.maximum(height, 0.0) / haze.scale_height_km)
    sunlight = HazeSunlight.through(radius_km, haze, high) if haze.twilight else None
    if sunlight is None:
        lit = np.where(incidence > 0.0, np.exp(-above / np.maximum(incidence, 0.03)), 0.0)
    else:
        lit = sunlight.at(height, incidence)
    sent = haze.albedo * np.sum(lit * np.exp(steps - passed) * -np.expm1(-steps), axis=1)
    hit = (middle + end)[ground, None] * rays[ground] - center
    normals = hit / radius_km
    towards = np.maximum(normals @ sun, 0.0)
    emission = np.maximum(np.einsum("ij,ij->i", -rays[ground], normals), 1e-9)
    seen = LAWS[law](towards, emission, -(rays[ground] @ sun))
    if sunlight is None:
        down = np.exp(-haze.vertical_depth / np.maximum(towards, 0.03))
    else:
        down = sunlight.at(np.zeros_like(towards), towards)
    sent[ground] += np.where(towards > 0.0, seen, 0.0) * down * np.exp(-passed[ground, -1])
    light[meets] = sent
    return light
