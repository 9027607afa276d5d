"""Catalog stars as point sources on a detector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog, apparent_directions
from giantlike.core.arrays import Float, as_floats, require, require_number
from giantlike.core.frames import rotate
from giantlike.core.time import et_from_time
from giantlike.core.values import Value, select_rows
from giantlike.simulation.shot import Shot

_REACH_SIGMA = 7.0  # half width of the drawn PSF, sigmas: the light outside is below 1e-11 of a star
_SHARPEST_PX = 1e-6  # px, stands in for a PSF of zero width, which would divide by zero
_CONE_MARGIN_RAD = 1e-3  # rad, added to the cone of stars: aberration (v/c, 1e-4) and parallax move stars by less


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectorStars(Value):
    """Stars on a detector, in the order of the catalog: brightest first."""

    ids: NDArray[np.int64]  # (n,) int64; catalog identifiers
    points_px: Float  # (n, 2), px; true positions in the distorted image
    magnitudes: Float  # (n,); catalog magnitudes
    directions_inertial: Float  # (n, 3), unitless, inertial; apparent unit vectors to them

    def select(self, index: ArrayLike) -> DetectorStars:
        """Return some of the stars. ``index`` (n,) or (k,)."""
        return select_rows(self, np.asarray(index))


def star_field(
    catalog: StarCatalog | None,
    camera: Camera,
    shot: Shot,
    *,
    max_magnitude: float | None = None,
    smear_px: float = 0.0,
) -> DetectorStars:
    """Project the stars of a catalog into an image."""
    if catalog is None:
        empty = np.zeros((0, 3))
        return DetectorStars(
            ids=np.zeros(0, np.int64), points_px=empty[:, :2], magnitudes=empty[:, 0], directions_inertial=empty
        )
    axis = rotate(shot.camera_from_inertial.inv(), camera.model.unproject(camera.center_px))
    sigma_px = 0.0 if camera.psf is None else camera.psf.sigma_px
    margin_px = _REACH_SIGMA * sigma_px + smear_px
    margin_rad = _CONE_MARGIN_RAD + margin_px * float(camera.ifov_rad())
    stars = catalog.cone(axis, camera.half_diagonal_rad + margin_rad, max_magnitude=max_magnitude)
    observer = shot.observer
    directions = apparent_directions(
        stars,
        et_from_time(shot.epoch),
        observer_position_km=None if observer is None else observer.position_km,
        observer_velocity_km_s=None if observer is None else observer.velocity_km_s,
    )
    points = camera.model.project(rotate(shot.camera_from_inertial, directions))
    return DetectorStars(
        ids=stars.ids, points_px=points, magnitudes=stars.magnitude, directions_inertial=directions
    ).select(camera.contains(points, margin_px=-margin_px))


def point_sources(points_px: ArrayLike, flux: ArrayLike, *, sigma_px: float, columns: int, rows: int) -> Float:
    """Draw point sources (n, 2) of flux (n,) with a round Gaussian PSF, integrated exactly over each pixel."""
    points, light = as_floats(points_px, (2,), "points_px"), as_floats(flux, (), "flux")
    require(
        points.ndim == 2 and light.shape == points.shape[:1],
        f"needed points_px (n, 2) and flux (n,), got {points.shape} and {light.shape}",
    )
    require_number(sigma_px, "sigma_px", least=0.0)
    reach = math.ceil(_REACH_SIGMA * sigma_px) + 1
    offsets = np.arange(-reach, reach + 1)
    nearest = np.rint(points).astype(np.int64)
    columns_of, rows_of = (nearest[:, axis, None] + offsets for axis in (0, 1))
    along_x, along_y = (
        _pixel_shares(cells - points[:, axis, None], sigma_px) for axis, cells in ((0, columns_of), (1, rows_of))
    )
    values = light[:, None, None] * along_y[:, :, None] * along_x[:, None, :]
    inside = ((rows_of >= 0) & (rows_of < rows))[:, :, None] & ((columns_of >= 0) & (columns_of < columns))[:, None, :]
    flat = (rows_of[:, :, None] * columns + columns_of[:, None, :])[inside]
    frame = np.bincount(flat, weights=values[inside], minlength=rows * columns)
    return frame.astype(np.float64, copy=False).reshape(rows, columns)


def _pixel_shares(offset_px: Float, sigma_px: float) -> Float:
    """Fraction of a unit Gaussian at 0 between ``offset - 1/2`` and ``offset + 1/2``."""
    width = max(sigma_px, _SHARPEST_PX)
    return ndtr((offset_px + 0.5) / width) - ndtr((offset_px - 0.5) / width)
