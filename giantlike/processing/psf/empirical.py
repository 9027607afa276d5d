"""Empirical point spread function: the mean of the stars of an image on a grid finer than the pixels.

The analytic shape is subtracted from the pixels near stars and the rest averaged with the weights of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from giantlike.core.arrays import Float, require
from giantlike.core.detector import Detector
from giantlike.core.values import Value
from giantlike.processing.detection.detections import Detections
from giantlike.processing.detection.patches import Patches
from giantlike.processing.psf.estimate import UNUSABLE, PsfEstimate, star_patches
from giantlike.processing.psf.profile import shape_shares

_MOST_STARS = 400  # brightest stars averaged: bounds the time
_PRIOR_SAMPLES = 0.5  # samples of the analytic shape added to each node: decides only where stars give none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EmpiricalPsf(Value):
    """Pixel-integrated point spread function on a grid."""

    shares: Float  # (m, m); fraction of the flux in a pixel at the offset of the node from the star, rows along y
    sigma: Float  # (m, m); standard error of each; very large without samples
    step_px: float  # spacing of the nodes; the middle node is at the star
    n_used: int  # number of stars

    @property
    def reach_px(self) -> float:
        """Largest offset of the grid, px."""
        return (len(self.shares) - 1) / 2 * self.step_px

    def shares_at(self, offsets_px: ArrayLike) -> Float:
        """Interpolate the flux fractions of pixels at offsets (..., 2) from a star by splines; 0 beyond the grid."""
        offsets = np.asarray(offsets_px, dtype=np.float64)
        x, y = offsets.reshape(-1, 2).T / self.step_px + (len(self.shares) - 1) / 2
        found: Float = map_coordinates(self.shares, [y, x], order=3, mode="constant")
        return found.reshape(offsets.shape[:-1])


def empirical_psf(
    pixels: ArrayLike,
    detections: Detections,
    psf: PsfEstimate,
    *,
    detector: Detector,
    mask: ArrayLike | None = None,
    oversampling: int = 4,
    half_px: int = 5,
) -> EmpiricalPsf:
    """Average the stars of an image on a grid."""
    require(
        oversampling >= 1 and half_px >= 1, f"oversampling and half_px must be >= 1, got {oversampling} and {half_px}"
    )
    usable = np.flatnonzero((detections.flags & np.uint16(UNUSABLE)) == 0)[:_MOST_STARS]
    stars = detections.select(usable)
    patches = star_patches(pixels, stars, detector=detector, mask=mask, half_px=half_px + 1)
    size, n = patches.size_px, len(stars)
    model = shape_shares(patches.corner_px, size, stars.points_px, psf.shapes_at(stars.points_px))
    flux = stars.flux_dn[:, None, None]
    left = (patches.values_dn - stars.background_dn[:, None, None]) / flux - model
    weight = np.where(patches.valid & ~patches.saturated, flux**2 / patches.variance_dn2(flux * model), 0.0)
    left -= _slopes_of(patches, left, weight)
    dx, dy = patches.offsets_px(stars.points_px)
    side = 2 * half_px * oversampling + 1
    column, row = (np.rint(away * oversampling).astype(np.int64) + side // 2 for away in (dx, dy))
    inside = ((row >= 0) & (row < side))[:, :, None] & ((column >= 0) & (column < side))[:, None, :]
    index = (row[:, :, None] * side + column[:, None, :])[inside]
    total, mean, count = (
        np.bincount(index, weights=values[inside], minlength=side**2).reshape(side, side)
        for values in (weight, weight * left, weight > 0.0)
    )
    certain = total * (1.0 + _PRIOR_SAMPLES / np.maximum(count, 1.0))
    middle = np.array([(psf.columns - 1) / 2, (psf.rows - 1) / 2])
    nodes = (np.arange(side) - side // 2) / oversampling
    offsets = -np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    shape = np.repeat(psf.shapes_at([middle]), side * side, axis=0)
    smooth = shape_shares(np.zeros((side * side, 2), dtype=np.int64), 1, offsets, shape).reshape(side, side)
    return EmpiricalPsf(
        shares=smooth + mean / np.maximum(certain, 1e-300),
        sigma=1.0 / np.sqrt(np.maximum(certain, 1e-300)),
        step_px=1.0 / oversampling,
        n_used=n,
    )


def _slopes_of(patches: Patches, left: Float, weight: Float) -> Float:
    """Planes (n, w, w) without a level that are left, by the given weights, of a background that is not even."""
    terms = patches.plane_terms()[1:]
    normal = np.einsum("nij,aij,bij->nab", weight, terms, terms) + 1e-12 * np.eye(2)
    right = np.einsum("nij,aij->na", weight * left, terms)
    return np.tensordot(np.linalg.solve(normal, right[:, :, None])[:, :, 0], terms, axes=1)
