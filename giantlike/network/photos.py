"""Images and tracks that a network is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.values import Value, check_covariance

MAX_POINTS = 500_000  # points of a network: each takes 2 kB, and as many again where their covariances are asked for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photo(Value):
    """An image of a network: camera, and a priori pose with its covariance.

    Parameters
    ----------
    name : str
    model : CameraModel
    camera_from_inertial : Rotation
        Takes vectors of the reference axes (inertial, or those of the body where ``inertial_from_body`` is the
        identity) to camera axes, stellar aberration at the center of the body removed.
    position_km : (3,) float64, km, reference axes; camera, from the center of the body, light time removed
    covariance_pose : (6, 6) float64, rad^2, rad km and km^2, optional
        Of the rotation vector ``e`` about the camera axes (true attitude: ``Rotation.from_rotvec(e) *
        camera_from_inertial``) and of the position. A singular one holds a direction; infinite variances leave one
        free. Without it nothing is known and the pose is only a start.
    inertial_from_body : Rotation; orientation of the body when its light left it
    et : float, s; that time, TDB seconds past J2000
    columns, rows : int; size of the image; 0 where it is not known
    sun_direction : (3,) float64, reference axes, optional; unit vector from the body to the Sun; files of SPC hold it

    Raises
    ------
    InputError
        A value is not finite, or the covariance is none.
    """

    name: str
    model: CameraModel
    camera_from_inertial: Rotation
    position_km: Float
    covariance_pose: Float | None = None
    inertial_from_body: Rotation = field(default_factory=Rotation.identity)
    et: float = 0.0
    columns: int = 0
    rows: int = 0
    sun_direction: Float | None = None

    def __post_init__(self) -> None:
        position = as_finite(self.position_km, (3,), f"{self.name}: position_km")
        require(bool(position.any()), f"{self.name}: position_km must not be zero: it is from the center of the body")
        require_number(self.et, f"{self.name}: et")
        object.__setattr__(self, "position_km", position)
        if self.covariance_pose is not None:
            checked = _checked_covariances(self.covariance_pose, (6, 6), f"{self.name}: covariance_pose")
            object.__setattr__(self, "covariance_pose", checked)
        Value.__post_init__(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks(Value):
    """Measures of p points in images, n in all; kept in the order of points, and of images for each point.

    Parameters
    ----------
    names : tuple of str; of the p points
    point, photo : (n,) int; indices of the point and the image of each measure
    points_px : (n, 2) float64, px
    sigma_px : (n,) float64, px; standard deviation per axis; a scalar applies to all
    points_km : (p, 3) float64, km, body axes, optional; a priori; NaN, or none: intersected from the images
    covariance_points_km2 : (p, 3, 3) float64, km^2, optional; infinite for a start only, 0 for held points
    common_sigma_km : float, km; per axis, of an error that all measures of a point have and no residual shows

    Raises
    ------
    InputError
        Shapes disagree, a value is not finite, an index does not exist, or a point is measured twice in an image.
    """

    names: tuple[str, ...]
    point: NDArray[np.int64]
    photo: NDArray[np.int64]
    points_px: Float
    sigma_px: Float
    points_km: Float | None = None
    covariance_points_km2: Float | None = None
    common_sigma_km: float = 0.0

    def __post_init__(self) -> None:
        require_number(self.common_sigma_km, "common_sigma_km", least=0.0)
        count, number = len(self.names), len(self.point)
        require(0 < count <= MAX_POINTS, f"a network has 1 to {MAX_POINTS} points, got {count}: thin them out")
        require(number > 0, "a network needs at least one measure")
        point, photo = np.asarray(self.point, dtype=np.int64), np.asarray(self.photo, dtype=np.int64)
        require(point.shape == photo.shape == (number,), f"photo must have shape ({number},), got {photo.shape}")
        require(bool((point >= 0).all() and (point < count).all()), f"point must hold indices from 0 to {count - 1}")
        require(bool((photo >= 0).all()), "photo must hold indices from 0")
        sigma = np.array(np.broadcast_to(np.asarray(self.sigma_px, dtype=np.float64), (number,)))
        require(bool((np.isfinite(sigma) & (sigma > 0)).all()), "sigma_px must be finite and > 0")
        order = np.lexsort((photo, point))
        point, photo = point[order], photo[order]
        twice = np.flatnonzero((np.diff(point) == 0) & (np.diff(photo) == 0))
        if len(twice):
            name = self.names[point[twice[0]]]
            require(False, f"point {name} is measured twice in image {photo[twice[0]]}: leave one of the measures out")
        pixels = as_finite(self.points_px, (number, 2), "points_px")[order]
        start = np.full((count, 3), np.nan) if self.points_km is None else as_floats(self.points_km, (3,), "points_km")
        require(start.shape == (count, 3), f"points_km must have shape ({count}, 3), got {start.shape}")
        free = np.broadcast_to(np.diag([np.inf] * 3), (count, 3, 3))
        given = self.covariance_points_km2
        covariance = free if given is None else _checked_covariances(given, (count, 3, 3), "covariance_points_km2")
        unknown = ~np.isfinite(start).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
        require(not unknown.any(), "a point with an a priori covariance needs an a priori position")
        self._keep(point=point, photo=photo, points_px=pixels, sigma_px=sigma[order], points_km=start,
                   covariance_points_km2=covariance)  # fmt: skip

    @property
    def views(self) -> NDArray[np.int64]:
        """Number (p,) of measures of each point."""
        return np.bincount(self.point, minlength=len(self.names))


def _checked_covariances(value: Float, shape: tuple[int, ...], name: str) -> Float:
    """Covariances whose variances may be infinite; covariances with these must be zero."""
    matrix = as_floats(value, (), name)
    require(matrix.shape == shape, f"{name} must have shape {shape}, got {matrix.shape}")
    variance = np.diagonal(matrix, axis1=-2, axis2=-1)
    free = np.isposinf(variance)
    crossed = free[..., :, None] | free[..., None, :]
    known = np.where(crossed, 0.0, matrix)
    sound = np.isfinite(known).all() and not np.where(crossed & ~np.eye(shape[-1], dtype=bool), matrix, 0.0).any()
    require(bool(sound), f"{name} must be finite, or infinite on its diagonal alone")
    check_covariance(known, name)
    return matrix


def require_photos(photos: Sequence[Photo], tracks: Tracks) -> None:
    """Raise unless all measures lie in images that exist, whose names differ."""
    require(len(photos) >= 2, f"a network needs at least two images, got {len(photos)}")
    names = [photo.name for photo in photos]
    require(len(set(names)) == len(names), "images of a network must have different names")
    last = int(tracks.photo.max(initial=-1))
    require(last < len(photos), f"a measure is in image {last}, and there are {len(photos)} images")
    size = np.array([(photo.columns or np.inf, photo.rows or np.inf) for photo in photos])[tracks.photo]
    outside = np.flatnonzero(((tracks.points_px < -0.5) | (tracks.points_px > size - 0.5)).any(axis=1))
    if len(outside):
        k = outside[0]
        photo = photos[tracks.photo[k]]
        at = ", ".join(f"{value:.1f}" for value in tracks.points_px[k])
        require(
            False,
            f"point {tracks.names[tracks.point[k]]} is measured at ({at}) px, outside of image {photo.name} "
            f"({photo.columns} x {photo.rows}); {len(outside)} measures are: check origin and reduction of the pixels",
        )
