"""Random smooth functions on the sphere, tabulated on an octahedral map: heights and albedo of made-up bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.independent.laws import Float

CELLS = 768  # cells along the side of the octahedral table, about 0.2 degrees each: 0.5 px on a disk of 300 px

FAINTEST = -16.0  # exponent below which a bump is left out: 1e-7 of its height


def _unfold(directions: Float) -> tuple[Float, Float]:
    """Octahedral coordinates in [-1, 1] of directions (n, 3): z > 0 inside the diamond, z < 0 folded outside it."""
    size = np.abs(directions)
    scale = 1.0 / (size[:, 0] + size[:, 1] + size[:, 2])
    first, second = directions[:, 0] * scale, directions[:, 1] * scale
    below = directions[:, 2] < 0.0
    outer_first = np.copysign(1.0 - np.abs(second), first)
    outer_second = np.copysign(1.0 - np.abs(first), second)
    return np.where(below, outer_first, first), np.where(below, outer_second, second)


def _grid_directions(cells: int) -> Float:
    """Unit directions ((cells + 1)^2, 3) of the nodes of the octahedral table, rows first."""
    steps = np.linspace(-1.0, 1.0, cells + 1)
    second, first = np.meshgrid(steps, steps, indexing="ij")
    height = 1.0 - np.abs(first) - np.abs(second)
    below = height < 0.0
    x = np.where(below, np.copysign(1.0 - np.abs(second), first), first)
    y = np.where(below, np.copysign(1.0 - np.abs(first), second), second)
    vectors = np.stack([x, y, height], axis=-1).reshape(-1, 3)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), dtype=float)


@dataclass(frozen=True, eq=False)
class SphereField:
    """Scalar function of direction, its values and surface gradient interpolated bilinearly in a table.

    The table is the function: a renderer and a mesh that both read it see one and the same body.
    """

    values: Float  # (cells + 1, cells + 1); values at the nodes of the octahedral map
    gradients: Float  # (cells + 1, cells + 1, 3); derivatives along the sphere, per radian, at the nodes

    def _corners(self, directions: Float) -> tuple[NDArray[np.int64], Float, Float]:
        cells = self.values.shape[0] - 1
        first, second = _unfold(directions)
        column, row = (first + 1.0) * (0.5 * cells), (second + 1.0) * (0.5 * cells)
        left = np.minimum(column.astype(np.int64), cells - 1)
        top = np.minimum(row.astype(np.int64), cells - 1)
        return top * (cells + 1) + left, column - left, row - top

    def __call__(self, directions: Float) -> Float:
        """Return the values (n,) at directions (n, 3), which need not have unit length."""
        index, right, down = self._corners(directions)
        flat, width = self.values.ravel(), self.values.shape[1]
        upper = flat[index] * (1.0 - right) + flat[index + 1] * right
        lower = flat[index + width] * (1.0 - right) + flat[index + width + 1] * right
        return np.asarray(upper * (1.0 - down) + lower * down, dtype=float)

    def gradient(self, directions: Float) -> Float:
        """Return the derivatives along the sphere (n, 3), per radian, at directions (n, 3)."""
        index, right, down = self._corners(directions)
        flat, width = self.gradients.reshape(-1, 3), self.values.shape[1]
        right, down = right[:, None], down[:, None]
        upper = flat[index] * (1.0 - right) + flat[index + 1] * right
        lower = flat[index + width] * (1.0 - right) + flat[index + width + 1] * right
        return np.asarray(upper * (1.0 - down) + lower * down, dtype=float)

    def __add__(self, other: SphereField) -> SphereField:
        """Return the sum of two functions with tables of one size."""
        return SphereField(values=self.values + other.values, gradients=self.gradients + other.gradients)

    @property
    def extremes(self) -> tuple[float, float]:
        """Least and greatest value."""
        return float(self.values.min()), float(self.values.max())

    @property
    def steepest(self) -> float:
        """Largest length of the gradient, per radian."""
        return float(np.sqrt((self.gradients**2).sum(axis=-1).max()))


def _table(values: Float, gradients: Float, directions: Float, cells: int) -> SphereField:
    gradients = gradients - (gradients * directions).sum(axis=1, keepdims=True) * directions
    side = cells + 1
    return SphereField(values=values.reshape(side, side), gradients=gradients.reshape(side, side, 3))


def _relative(values: Float, gradients: Float, directions: Float, rms: float, cells: int) -> SphereField:
    """Table of a function of some root mean square, without what scales a body (degree 0) or moves it (degree 1)."""
    weights = np.abs(directions).sum(axis=1) ** 3  # solid angle of a cell of the octahedral map
    rigid = np.concatenate([np.ones((len(directions), 1)), directions], axis=1)
    found = np.linalg.solve((rigid * weights[:, None]).T @ rigid, (rigid * weights[:, None]).T @ values)
    values = values - rigid @ found
    gradients = gradients - found[1:]
    scale = rms / float(np.sqrt(np.average(values**2, weights=weights)))
    return _table(values * scale, gradients * scale, directions, cells)


def tabulate(function: Callable[[Float], Float], *, cells: int = CELLS, step_rad: float = 1e-3) -> SphereField:
    """Tabulate a function of unit vectors (n, 3), with its gradient by differences."""
    directions = _grid_directions(cells)
    gradients = np.zeros_like(directions)
    for axis in np.eye(3) * step_rad:
        ends = [(directions + sign * axis) for sign in (1.0, -1.0)]
        high, low = (function(end / np.linalg.norm(end, axis=1, keepdims=True)) for end in ends)
        gradients += (high - low)[:, None] * axis / (2.0 * step_rad**2)
    return _table(function(directions), gradients, directions, cells)


def bumps(
    seed: int, *, rms: float, count: int = 60, widths_deg: tuple[float, float] = (5.0, 30.0), cells: int = CELLS
) -> SphereField:
    """Make a sum of smooth round bumps and hollows at random places that neither scales nor moves a sphere."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    widths = np.radians(np.exp(rng.uniform(np.log(widths_deg[0]), np.log(widths_deg[1]), size=count)))
    heights = rng.normal(size=count) * widths
    directions = _grid_directions(cells)
    values, gradients = np.zeros(len(directions)), np.zeros_like(directions)
    for center, width, height in zip(centers, widths, heights, strict=True):
        sharpness = 1.0 / width**2
        exponent = sharpness * (directions @ center - 1.0)
        near = exponent > FAINTEST
        bump = height * np.exp(exponent[near])
        values[near] += bump
        gradients[near] += (bump * sharpness)[:, None] * center
    return _relative(values, gradients, directions, rms, cells)


def rough(
    seed: int,
    *,
    rms: float,
    power: float = 2.0,
    degrees: tuple[float, float] = (2.5, 400.0),
    count: int = 600,
    cells: int = CELLS,
) -> SphereField:
    """Make rough ground like that of the Moon: waves whose variance per degree falls as a power of the degree."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    low, high = np.log(degrees)
    waves = np.exp(low + (high - low) * (np.arange(count) + rng.uniform(size=count)) / count)
    phases = rng.uniform(0.0, 2.0 * np.pi, size=count)
    sizes = waves ** (
        0.5 * (1.0 - power)
    )  # as many waves in every octave: their squares times the degree are the power
    directions = _grid_directions(cells)
    values, gradients = np.zeros(len(directions)), np.zeros_like(directions)
    for axis, wave, phase, size in zip(axes, waves, phases, sizes, strict=True):
        angle = wave * (directions @ axis) + phase
        values += size * np.cos(angle)
        gradients -= (size * wave * np.sin(angle))[:, None] * axis
    return _relative(values, gradients, directions, rms, cells)


def craters(
    seed: int, *, depth: float = 0.15, count: int = 80, radii_deg: tuple[float, float] = (3.0, 20.0), cells: int = CELLS
) -> SphereField:
    """Make bowls with raised rims at random places; many small ones, few large ones."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    least, most = np.radians(radii_deg)
    radii = least / np.sqrt(1.0 - rng.uniform(size=count) * (1.0 - (least / most) ** 2))
    directions = _grid_directions(cells)
    values, gradients = np.zeros(len(directions)), np.zeros_like(directions)
    for center, radius in zip(centers, radii, strict=True):
        squared = 2.0 * (1.0 - directions @ center) / radius**2
        near = squared < 12.0
        # a bowl (2 s - 1) exp(-2 s) in s = (distance / radius)^2: deepest at the center, a low rim, smooth.
        share = squared[near]
        bowl = depth * radius
        fall = np.exp(-2.0 * share)
        values[near] += bowl * (2.0 * share - 1.0) * fall
        slope = bowl * (4.0 - 4.0 * share) * fall
        gradients[near] += (slope * (-2.0 / radius**2))[:, None] * center
    return _table(values, gradients, directions, cells)
