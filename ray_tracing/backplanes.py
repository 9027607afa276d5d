"""Backplanes: body, facet, range, angles of light, longitude and latitude at every pixel of an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body, suns_of
from giantlike.ray_tracing.footprint import FocalPlane, visible_box
from giantlike.ray_tracing.neighbors import neighbors_of
from giantlike.ray_tracing.options import DEFAULT_OPTIONS
from giantlike.ray_tracing.sampling import RayGrid, Tile
from giantlike.ray_tracing.trace import View, view_of

_RAYS_AT_A_TIME = 100_000  # rays traced together, to bound the memory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Backplanes(Value):
    """Geometry at the center of every pixel; off all bodies numbers are -1, values NaN and flags False.

    Parameters
    ----------
    body : (rows, columns) int32; number of the nearest body, in the order they were given
    facet : (rows, columns) int32; facet of its mesh; 0 on an ellipsoid
    range_km : (rows, columns) float64, km; from the camera, along the line of sight
    depth_km : (rows, columns) float64, km; the part of it along the boresight: camera z
    incidence_rad, emission_rad, phase_rad : (rows, columns) float64, rad; from the normal to Sun and camera
    longitude_rad, latitude_rad : (rows, columns) float64, rad; planetocentric, body axes, east in [0, 2 pi)
    point_body_km : (rows, columns, 3) float64, km, body axes; the point of the surface
    shadowed : (rows, columns) bool; no direct light of the center of the Sun
    normal_body : (rows, columns, 3) float64, body axes; outward unit normal of the facet or ellipsoid
    resolution_km : (rows, columns) float64, km/px; side of a pixel across the line of sight
    """

    body: NDArray[np.int32]
    facet: NDArray[np.int32]
    range_km: Float
    depth_km: Float
    incidence_rad: Float
    emission_rad: Float
    phase_rad: Float
    longitude_rad: Float
    latitude_rad: Float
    point_body_km: Float
    shadowed: Mask
    normal_body: Float
    resolution_km: Float

    @property
    def oblique_resolution_km(self) -> Float:
        """Resolution (rows, columns) over the cosine of the emission angle, km/px: where most foreshortened."""
        return np.asarray(self.resolution_km / np.cos(self.emission_rad))

    @property
    def slope_rad(self) -> Float:
        """Angle (rows, columns) between the normal and the direction from the center of the body."""
        return np.asarray(_angle(self.normal_body, self._up))

    @property
    def slope_azimuth_rad(self) -> Float:
        """Direction (rows, columns) in which the surface falls, clockwise from north in [0, 2 pi)."""
        north = np.stack(
            [
                -np.sin(self.latitude_rad) * np.cos(self.longitude_rad),
                -np.sin(self.latitude_rad) * np.sin(self.longitude_rad),
                np.cos(self.latitude_rad),
            ],
            axis=-1,
        )
        to_east = np.sum(self.normal_body * np.cross(north, self._up), axis=-1)
        return np.asarray(np.arctan2(to_east, np.sum(self.normal_body * north, axis=-1)) % (2.0 * np.pi))

    @property
    def _up(self) -> Float:
        """Unit vectors (rows, columns, 3) from the center of the body, body axes."""
        return np.asarray(self.point_body_km / np.linalg.norm(self.point_body_km, axis=-1, keepdims=True))


def trace_backplanes(
    bodies: Sequence[Body], model: CameraModel, *, sun_direction_camera: ArrayLike, columns: int, rows: int
) -> Backplanes:
    """Trace one ray through the center of every pixel, in float64 but for the choice of the facet.

    Parameters
    ----------
    bodies : sequence of Body; they hide each other and shade each other
    model : CameraModel
    sun_direction_camera : (3,) or (n, 3), unitless, camera axes; unit vector to the Sun, for all bodies or for each
    columns, rows : int, px

    Raises
    ------
    InputError
        A size is not positive, or a direction is not a unit vector or not one for each body.
    """
    plane = FocalPlane(model=model, columns=columns, rows=rows)
    bodies = [body.seen_by(model) for body in bodies]
    planes = _blank(columns, rows)
    for number, sun in enumerate(suns_of(bodies, sun_direction_camera)):
        box = visible_box(bodies[number], plane, 0)
        if isinstance(box, Failure):
            continue
        x, y = box.cells(per_px=1)
        view = view_of(bodies[number], model, sun, DEFAULT_OPTIONS, tuple(neighbors_of(bodies, number, sun, 0.0)))
        grid = RayGrid(model, x, y, view.body.camera_from_body.as_matrix().T)
        step = max(_RAYS_AT_A_TIME // x.count, 1)
        for start in range(0, y.count, step):
            tile = Tile(start, min(start + step, y.count), 0, x.count)
            window = slice(y.first + tile.start, y.first + tile.stop), slice(x.first, x.first + x.count)
            directions = grid.directions(tile)[:, :3].reshape(x.count, tile.rows, 3)
            _fill(
                {name: values[window] for name, values in planes.items()}, number, view, np.swapaxes(directions, 0, 1)
            )
    hit = planes["body"] >= 0
    by_pixel = model.unproject_jacobian(np.argwhere(hit)[:, ::-1].astype(np.float64))
    areas = np.linalg.norm(np.cross(by_pixel[..., 0], by_pixel[..., 1]), axis=-1)
    planes["resolution_km"][hit] = planes["range_km"][hit] * np.sqrt(areas)
    return Backplanes(**planes)


def _blank(columns: int, rows: int) -> dict[str, NDArray[Any]]:
    """Planes of a frame without bodies."""
    planes: dict[str, NDArray[Any]] = {field.name: np.full((rows, columns), np.nan) for field in fields(Backplanes)}
    planes |= {name: np.full((rows, columns), -1, np.int32) for name in ("body", "facet")}
    planes |= {name: np.full((rows, columns, 3), np.nan) for name in ("point_body_km", "normal_body")}
    return planes | {"shadowed": np.zeros((rows, columns), bool)}


def _fill(planes: dict[str, NDArray[Any]], number: int, view: View, directions: Float) -> None:
    """Write a body along directions (h, w, 3), body axes, into its part of the planes, where it is nearest."""
    body, sun, camera_km = view.body, view.sun_body[:3], view.body.camera_body_km
    rays = directions.reshape(-1, 3)
    hits = body.tracer.intersect(camera_km, rays)
    range_km = np.linalg.norm(hits.points_km - camera_km, axis=1)
    nearest = np.flatnonzero(hits.hit & ~(range_km >= planes["range_km"].reshape(-1)))
    points, normals, rays = hits.points_km[nearest], hits.normals[nearest], rays[nearest]
    shadowed = body.tracer.is_shadowed(hits, sun)[nearest]
    for neighbor in view.neighbors:
        if neighbor.shades:
            shadowed |= neighbor.dark(points, sun)
    values = {
        "body": number,
        "facet": hits.facets[nearest],
        "range_km": range_km[nearest],
        "depth_km": (body.to_camera(points) + body.position_camera_km)[:, 2],
        "incidence_rad": _angle(normals, sun),
        "emission_rad": _angle(normals, -rays),
        "phase_rad": _angle(-rays, sun),
        "longitude_rad": np.arctan2(points[:, 1], points[:, 0]) % (2.0 * np.pi),
        "latitude_rad": np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])),
        "point_body_km": points,
        "shadowed": shadowed,
        "normal_body": normals,
    }
    place = np.unravel_index(nearest, directions.shape[:2])
    for name, value in values.items():
        planes[name][place] = value


def _angle(first: Float, second: Float) -> Float:
    """Angles (k,), rad, between unit vectors (k, 3) and one (3,) or as many (k, 3); good to rounding also near 0."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(first * second, axis=-1)))
