"""The starry sky through a camera: catalog stars as point sources on the detector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from giantlike.camera import Camera
from giantlike.camera_models import ifov_rad
from giantlike.catalogs import StarCatalog, apparent_directions
from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.frames import rotate
from giantlike.core.values import Value
from giantlike.image import ObserverState

_REACH_SIGMA = 7.0  # what lies beyond is below 1e-11 of a star
_SHARPEST_PX = 1e-6  # a PSF of no width still needs one to divide by
_CONE_MARGIN_RAD = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarField(Value):
    """Stars on a detector, brightest first.

    Parameters
    ----------
    ids : (n,) int64
        Catalog identifiers.
    points_px : (n, 2) float64, px
        True places in the distorted image.
    magnitudes : (n,) float64
    directions_inertial : (n, 3) float64, unitless, inertial
        Apparent unit vectors to them.
    """

    ids: NDArray[np.int64]
    points_px: Float
    magnitudes: Float
    directions_inertial: Float

    @classmethod
    def empty(cls) -> StarField:
        """No star at all."""
        return cls(
            ids=np.zeros(0, np.int64),
            points_px=np.zeros((0, 2)),
            magnitudes=np.zeros(0),
            directions_inertial=np.zeros((0, 3)),
        )

    def select(self, index: ArrayLike) -> StarField:
        """The stars of a mask (n,) or of integer indices (k,)."""
        chosen = np.asarray(index)
        return StarField(
            ids=self.ids[chosen],
            points_px=self.points_px[chosen],
            magnitudes=self.magnitudes[chosen],
            directions_inertial=self.directions_inertial[chosen],
        )


def star_field(
    catalog: StarCatalog,
    camera: Camera,
    camera_from_inertial: Rotation,
    et: float,
    *,
    observer: ObserverState | None = None,
    max_magnitude: float | None = None,
    smear_px: float = 0.0,
) -> StarField:
    """Catalog stars where a camera sees them.

    Parameters
    ----------
    catalog : StarCatalog
    camera : Camera
    camera_from_inertial : Rotation
    et : float, s
        TDB seconds past J2000: stars are moved there from their catalog epochs.
    observer : ObserverState, optional
        Gives parallax and aberration; without it neither.
    max_magnitude : float, optional
        Faintest star.
    smear_px : float, px
        How far the image moves during the exposure: stars from that far outside come in.

    Returns
    -------
    StarField
        Those whose light reaches the detector, some a few pixels outside it.
    """
    axis = rotate(camera_from_inertial.inv(), camera.model.unproject(camera.center_px))
    sigma_px = 0.0 if camera.psf is None else camera.psf.sigma_px
    margin_px = _REACH_SIGMA * sigma_px + smear_px
    margin_rad = _CONE_MARGIN_RAD + margin_px * float(ifov_rad(camera.model, camera.center_px))
    stars = catalog.cone(axis, camera.half_diagonal_rad + margin_rad, max_magnitude=max_magnitude)
    directions = apparent_directions(
        stars,
        et,
        observer_position_km=None if observer is None else observer.position_km,
        observer_velocity_km_s=None if observer is None else observer.velocity_km_s,
    )
    points = camera.model.project(rotate(camera_from_inertial, directions))
    seen = camera.contains(points, margin_px=-margin_px)
    return StarField(
        ids=stars.ids[seen],
        points_px=points[seen],
        magnitudes=stars.magnitude[seen],
        directions_inertial=directions[seen],
    )


def point_sources(points_px: ArrayLike, flux: ArrayLike, *, sigma_px: float, columns: int, rows: int) -> Float:
    """Image of point sources: a round Gaussian PSF, integrated exactly over each pixel.

    Parameters
    ----------
    points_px : (n, 2), px
    flux : (n,)
        Total of each source, in any unit.
    sigma_px : float, px
        Standard deviation of the PSF; 0 puts all light into one pixel.
    columns, rows : int, px

    Returns
    -------
    (rows, columns) float64
        Sum in each pixel, in the unit of ``flux``.

    Raises
    ------
    InputError
        Shapes disagree or ``sigma_px`` is negative.
    """
    points, light = as_floats(points_px, (2,), "points_px"), as_floats(flux, (), "flux")
    require(
        points.ndim == 2 and light.shape == points.shape[:1],
        f"needed points_px (n, 2) and flux (n,), got {points.shape} and {light.shape}",
    )
    require(math.isfinite(sigma_px) and sigma_px >= 0, f"sigma_px must be >= 0, got {sigma_px}")
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
    """Share of a unit Gaussian at 0 that falls between ``offset - 1/2`` and ``offset + 1/2``."""
    width = max(sigma_px, _SHARPEST_PX)
    share: Float = ndtr((offset_px + 0.5) / width) - ndtr((offset_px - 0.5) / width)
    return share
