"""Noise-free images of bodies: light integrated over pixels, with many rays at the limb, shadows and terminator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from giantlike.independent.bodies import Body
from giantlike.independent.laws import LAWS, Float, Law
from giantlike.independent.light import Motion, unaberrated
from giantlike.independent.psf import Psf
from giantlike.independent.views import PinholeView

RAYS_ACROSS_LIGHT, MOST_EDGE_RAYS = 24, 40
"""Least number of rays across the lit part of the disk, and most of them along the side of a cell."""

CELLS_ACROSS_LIGHT, MOST_CELLS = 16, 40
"""Least number of cells across the lit part of the disk, and most of them along the side of a pixel."""

SMALL_PX = 1.5
"""Distance from the center within which pixels count as edges: smaller bodies may miss the centers of all pixels."""

RAYS_AT_ONCE = 60_000  # rays in one call: keeps the arrays of a batch within a processor's cache and memory small


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a body is and from where it is lit.

    motion: velocities, for aberration and light time ray by ray; the position is then the geometric one at the time of
        reception.
    """

    position_camera_km: ArrayLike  # center of the body
    camera_from_body: Rotation  # its orientation
    sun_direction_camera: ArrayLike  # unit vector from the body to the Sun
    motion: Motion | None = None


@dataclass(frozen=True)
class Sampling:
    """Rays by pixel."""

    cells: int = 3  # cells along the side of every pixel, one ray each; also the grid on which the optics blur
    edge_rays: int = 4  # rays along the side of each cell in pixels with an edge: limb, shadow, terminator


@dataclass(frozen=True, eq=False)
class _Stage:
    """What rays are shaded with."""

    body: Body
    view: PinholeView
    pose: Pose
    law: Law

    def brightness(self, pixels: Float) -> tuple[Float, NDArray[np.int8]]:
        """Brightness (n,) and kind (n,) of pixels (n, 2): 0 beside the body, 1 dark ground, 2 lit ground."""
        brightness, kinds = np.zeros(len(pixels)), np.zeros(len(pixels), dtype=np.int8)
        for first in range(0, len(pixels), RAYS_AT_ONCE):
            part = slice(first, first + RAYS_AT_ONCE)
            brightness[part], kinds[part] = self._part(pixels[part])
        return brightness, kinds

    def _part(self, pixels: Float) -> tuple[Float, NDArray[np.int8]]:
        position = np.asarray(self.pose.position_camera_km, dtype=float)
        to_body = self.pose.camera_from_body.inv().as_matrix()
        rays = self.view.directions(pixels)
        if self.pose.motion is not None:
            rays = unaberrated(rays, self.pose.motion)
        rays = rays @ to_body.T
        sun = to_body @ np.asarray(self.pose.sun_direction_camera, dtype=float)
        hits = self.body.intersect(to_body @ -position, rays)
        seen = rays[hits.hit]
        incidence = hits.normals @ sun
        lit = incidence > 0.0
        lit[lit] = ~self.body.shadowed(hits.points[lit], sun)
        toward = -seen[lit] / np.sqrt(np.einsum("ij,ij->i", seen[lit], seen[lit]))[:, None]
        emission = np.einsum("ij,ij->i", hits.normals[lit], toward)
        light = self.law(incidence[lit], np.maximum(emission, 1e-9), toward @ sun)
        albedo = self.body.albedo_at(hits.points[lit])
        brightness, kinds = np.zeros(len(pixels)), np.zeros(len(pixels), dtype=np.int8)
        bright = np.flatnonzero(hits.hit)[lit]
        kinds[hits.hit] = 1
        kinds[bright] = 2
        brightness[bright] = light if albedo is None else light * albedo
        return brightness, kinds


def render_body(
    body: Body,
    view: PinholeView,
    pose: Pose,
    *,
    law: str | Law = "mcewen",
    peak_dn: float | None = 3000.0,
    psf: Psf | None = None,
    sampling: Sampling | None = None,
) -> Float:
    """Render a body: what the detector would count without noise and background."""
    psf, sampling = psf or Psf(), sampling or _fine_enough(body, view, pose)
    stage = _Stage(body=body, view=view, pose=pose, law=LAWS[law] if isinstance(law, str) else law)
    image = np.zeros((view.rows, view.columns))
    box = _box(stage, psf.reach_px)
    if box is None:
        return image
    left, top, columns, rows = box
    if top + rows <= 0 or left + columns <= 0 or top >= view.rows or left >= view.columns:
        return image  # no light of it reaches the frame
    cells = psf.blurred(_cells(stage, box, sampling), sampling.cells)
    pixels = cells.reshape(rows, sampling.cells, columns, sampling.cells).mean(axis=(1, 3))
    inner = slice(max(top, 0), min(top + rows, view.rows)), slice(max(left, 0), min(left + columns, view.columns))
    image[inner] = pixels[inner[0].start - top : inner[0].stop - top, inner[1].start - left : inner[1].stop - left]
    image[np.abs(image) < 1e-12 * max(float(pixels.max()), 1e-300)] = 0.0
    np.maximum(image, 0.0, out=image)
    highest = float(image.max())
    return image if peak_dn is None or highest == 0.0 else image * (peak_dn / highest)


def _fine_enough(body: Body, view: PinholeView, pose: Pose) -> Sampling:
    """Sampling with enough cells and rays across the lit part of the disk."""
    usual = Sampling()
    position = np.asarray(pose.position_camera_km, dtype=float)
    distance = float(np.linalg.norm(position))
    lit = 0.5 * (1.0 - float(position @ np.asarray(pose.sun_direction_camera, dtype=float)) / distance)
    across_px = 2.0 * body.bounding_radius_km / distance * view.focal_px * max(lit, 1e-3)
    cells = min(max(int(np.ceil(CELLS_ACROSS_LIGHT / across_px)), usual.cells), MOST_CELLS)
    wanted = int(np.ceil(RAYS_ACROSS_LIGHT / (across_px * cells)))
    return Sampling(cells=cells, edge_rays=min(max(wanted, usual.edge_rays), MOST_EDGE_RAYS))


def _box(stage: _Stage, margin: int) -> tuple[int, int, int, int] | None:
    """First column and row, columns and rows of the box of pixels that the body's light can reach; None when none."""
    position = np.asarray(stage.pose.position_camera_km, dtype=float)
    distance = float(np.linalg.norm(position))
    if position[2] <= 0.0:
        return None
    half = stage.body.bounding_radius_km / np.sqrt(max(distance**2 - stage.body.bounding_radius_km**2, 1e-12))
    center = stage.view.project(position)
    slack = 0.0 if stage.pose.motion is None else 2.0 * stage.pose.motion.speed * stage.view.focal_px
    off_axis = (distance / position[2]) ** 2  # a disk off the axis is stretched radially by up to this
    reach = np.ceil(1.02 * half * off_axis * stage.view.focal_px + slack + 2.0) + margin
    low = np.maximum(np.floor(center - reach), -margin)
    high = np.minimum(np.ceil(center + reach), np.array([stage.view.columns, stage.view.rows]) - 1 + margin)
    size = (high - low).astype(int) + 1
    if (size <= 0).any():
        return None
    return int(low[0]), int(low[1]), int(size[0]), int(size[1])


def _cells(stage: _Stage, box: tuple[int, int, int, int], sampling: Sampling) -> Float:
    """Light (rows * cells, columns * cells) of the box before the optics."""
    left, top, columns, rows = box
    grid = np.stack(np.meshgrid(left + np.arange(columns), top + np.arange(rows)), axis=-1).astype(float)
    _, kinds = stage.brightness(grid.reshape(-1, 2))
    kinds = kinds.reshape(rows, columns)
    around = np.ones((3, 3), dtype=bool)
    edge = maximum_filter(kinds, size=3) != minimum_filter(kinds, size=3)
    smooth = binary_dilation(kinds == 2, around) & ~edge
    light = np.zeros((rows, columns, sampling.cells, sampling.cells))
    light[smooth], within = _in_pixels(stage, grid[smooth], sampling.cells, 1)
    odd = smooth.copy()
    odd[smooth] = within.max(axis=(1, 2)) != within.min(axis=(1, 2))  # small shadows inside a pixel
    edge |= odd
    across = np.hypot(*(grid - stage.view.project(stage.pose.position_camera_km)).transpose(2, 0, 1))
    edge |= across < SMALL_PX  # a body that misses the centers of all pixels has no edge between them
    light[edge], _ = _in_pixels(stage, grid[edge], sampling.cells, sampling.edge_rays)
    return np.asarray(light.transpose(0, 2, 1, 3).reshape(rows * sampling.cells, columns * sampling.cells), dtype=float)


def _in_pixels(stage: _Stage, pixels: Float, cells: int, rays: int) -> tuple[Float, NDArray[np.int8]]:
    """Mean brightness (n, cells, cells) of the cells of pixels (n, 2), and kinds of the rays (n, side, side)."""
    side = cells * rays
    steps = (np.arange(side) + 0.5) / side - 0.5
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    brightness, kinds = stage.brightness((pixels[:, None, :] + offsets).reshape(-1, 2))
    means = brightness.reshape(len(pixels), cells, rays, cells, rays).mean(axis=(2, 4))
    return np.asarray(means, dtype=float), kinds.reshape(len(pixels), side, side)
