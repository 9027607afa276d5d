"""The sky of one image: which catalog stars its camera can see, and where they appear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog, StarTable, apparent_directions, et_of_julian_year
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.values import Value

EPOCH_WHEN_UNKNOWN = 2016.0
"""Julian epoch at which stars are put when an image has none: that of most positions in the default catalog."""
_MARGIN = 1.05  # a little more sky than the camera sees: its model may still change


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarField(Value):
    """Stars in and around the field of view, brightest first.

    Parameters
    ----------
    stars : StarTable
        n stars.
    directions_inertial : (n, 3) float64, unitless, inertial
        Apparent.
    sigma_rad : (n,) float64, rad
        Catalog error of the directions, per axis.
    """

    stars: StarTable
    directions_inertial: Float
    sigma_rad: Float

    def __len__(self) -> int:
        return len(self.stars)

    def select(self, which: NDArray[np.integer]) -> StarField:
        """Stars of the given indices (k,), in that order.

        Parameters
        ----------
        which : (k,) int

        Returns
        -------
        StarField
        """
        return StarField(
            stars=self.stars.select(which),
            directions_inertial=self.directions_inertial[which],
            sigma_rad=self.sigma_rad[which],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky(Value):
    """A catalog as an observer sees it at one time.

    Parameters
    ----------
    catalog : StarCatalog
    et : float, s, optional
        TDB seconds past J2000; without it stars are at ``EPOCH_WHEN_UNKNOWN``.
    observer_position_km : (3,) float64, km, inertial, optional
        With respect to the solar system barycenter; without it no parallax.
    observer_velocity_km_s : (3,) float64, km/s, inertial, optional
        Likewise; without it no aberration, which then goes into the attitude.
    max_magnitude : float, optional
    light_deflection : bool
        By the Sun; only where the observer's position is known.
    """

    catalog: StarCatalog
    et: float | None = None
    observer_position_km: Float | None = None
    observer_velocity_km_s: Float | None = None
    max_magnitude: float | None = None
    light_deflection: bool = False

    def field(
        self, camera: Camera, camera_from_inertial: Rotation, *, margin_px: float = 0.0, count: int | None = None
    ) -> StarField:
        """Stars within the field of view of a camera, and ``margin_px`` around it; the ``count`` brightest of them."""
        axis = rotate(camera_from_inertial.inv(), camera.model.unproject(camera.center_px))
        radius = _half_diagonal_rad(camera) * _MARGIN + margin_px / camera.model.focal_length_px
        return self.cone(axis / np.linalg.norm(axis), min(radius, np.pi), count=count)

    def cone(self, direction_inertial: ArrayLike, radius_rad: float, *, count: int | None = None) -> StarField:
        """Stars within ``radius_rad`` of a unit vector (3,); the ``count`` brightest of them."""
        stars = self.catalog.cone(direction_inertial, radius_rad, max_magnitude=self.max_magnitude)
        if count is not None and count < len(stars):
            stars = stars.select(np.arange(count))
        et = et_of_julian_year(EPOCH_WHEN_UNKNOWN) if self.et is None else self.et
        directions = apparent_directions(
            stars,
            et,
            observer_position_km=self.observer_position_km,
            observer_velocity_km_s=self.observer_velocity_km_s,
            light_deflection=self.light_deflection and self.observer_position_km is not None,
        )
        return StarField(stars=stars, directions_inertial=directions, sigma_rad=stars.sigma_rad(et))


def _half_diagonal_rad(camera: Camera) -> float:
    """Angle from the image center to its corners; that of a pinhole where the model cannot see the corners."""
    radius = camera.half_diagonal_rad
    if np.isfinite(radius):
        return radius
    return float(np.arctan(np.hypot(camera.columns, camera.rows) / 2.0 / camera.model.focal_length_px))
