"""Catalog stars of one image: those that its camera can see, with their apparent directions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog, StarTable, apparent_directions
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import rotate
from giantlike.core.values import Value, select_rows

EPOCH_WHEN_UNKNOWN = 2016.0
"""Julian epoch of the stars for an image without time, years: the epoch of most positions in the default catalog."""
_MARGIN = 1.05  # radius of the catalog cone / radius of the field of view: the focal length may change by 5 %


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarField(Value):
    """Stars in and around the field of view, brightest first."""

    stars: StarTable  # n stars
    directions_inertial: Float  # (n, 3), unitless, inertial; apparent unit vectors
    sigma_rad: Float  # (n,), rad; catalog error of the directions, per axis

    def __len__(self) -> int:
        return len(self.stars)

    def select(self, which: NDArray[np.integer]) -> StarField:
        """Stars of the given indices (k,), in that order. ``which`` (k,)."""
        return replace(select_rows(self, which), stars=self.stars.select(which))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky(Value):
    """A star catalog as seen by an observer at one time."""

    catalog: StarCatalog
    et: float | None = None  # s; TDB seconds past J2000; default: stars at ``EPOCH_WHEN_UNKNOWN``
    observer_position_km: Float | None = None  # (3,), km, barycentric, inertial; without it no parallax
    # (3,), km/s, inertial; relative to the solar system barycenter; without it aberration is not applied and becomes
    # part of the attitude
    observer_velocity_km_s: Float | None = None
    max_magnitude: float | None = None  # faintest star, in the band of the catalog
    light_deflection: bool = False  # apply the deflection by the Sun; only where the position of the observer is known

    def field(
        self, camera: Camera, camera_from_inertial: Rotation, *, margin_px: float = 0.0, count: int | None = None
    ) -> StarField:
        """Stars in the field of view of a camera."""
        radius = half_diagonal_rad(camera) * _MARGIN + margin_px / camera.model.focal_length_px
        return self.cone(line_of_sight(camera, camera_from_inertial), min(radius, np.pi), count=count)

    def cone(self, direction_inertial: ArrayLike, radius_rad: float, *, count: int | None = None) -> StarField:
        """Stars in a cone. ``direction_inertial``: axis, a unit vector."""
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


def line_of_sight(camera: Camera, camera_from_inertial: Rotation) -> Float:
    """Return the unit vector through the image center. Returns (3,), inertial axes."""
    return unit(rotate(camera_from_inertial.inv(), camera.model.unproject(camera.center_px)))


def half_diagonal_px(camera: Camera) -> float:
    """Distance of the corners of an image from its center, px."""
    return float(np.hypot(camera.columns, camera.rows)) / 2.0


def half_diagonal_rad(camera: Camera) -> float:
    """Largest angle of an image from its center, rad; of a pinhole camera if the lens images no edge."""
    radius = camera.half_diagonal_rad
    return radius if np.isfinite(radius) else float(np.arctan(half_diagonal_px(camera) / camera.model.focal_length_px))
