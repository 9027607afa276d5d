"""Rings in the equator of a body: which of its limb and face they hide or darken, and which pixels they cover."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.frames import rotate
from giantlike.ray_tracing import FocalPlane

_TURNS = 720  # corners of the polygons drawn: half a degree of a ring each
_NEAREST = 1e-3  # of the distance to the body: rings nearer to the camera's plane than this are not drawn


@dataclass(frozen=True, slots=True)
class Rings:
    """Flat annulus in the plane of the first two principal axes of a body.

    Parameters
    ----------
    inner_km, outer_km : float, km; radii

    Raises
    ------
    InputError
        The radii are not positive, finite and in this order.

    Examples
    --------
    >>> Rings.of("SATURN").inner_km
    74491.0
    """

    inner_km: float
    outer_km: float

    def __post_init__(self) -> None:
        require(
            math.isfinite(self.outer_km) and 0.0 < self.inner_km < self.outer_km,
            f"rings need 0 < inner < outer radius in km, got {self.inner_km:g} and {self.outer_km:g}",
        )

    @classmethod
    def of(cls, body: str) -> Rings:
        """Rings of a body from :data:`RINGS_KM`, by its NAIF name; InputError where none are known."""
        known = ", ".join(RINGS_KM)
        require(body.upper() in RINGS_KM, f"no rings of {body!r} are known, only of {known}: give their radii")
        return cls(*RINGS_KM[body.upper()])

    def hide(
        self, points_km: Float, center_km: Float, camera_from_axes: Rotation, *, sun_direction_camera: Float
    ) -> Mask:
        """Find the points (n, 3) of a body, km, camera axes, that lie behind the rings or in their shadow.

        ``center_km`` (3,) of the body; ``camera_from_axes`` rotates from its principal axes; the Sun is in camera axes.
        """
        to_axes = camera_from_axes.inv()
        points = rotate(to_axes, points_km - center_km)
        toward_camera = rotate(to_axes, -points_km)
        toward_sun = rotate(to_axes, sun_direction_camera)
        return self._intersects(points, toward_camera) | self._intersects(
            points, np.broadcast_to(toward_sun, points.shape)
        )

    def cover(self, plane: FocalPlane, center_km: Float, camera_from_axes: Rotation, *, widened_px: float) -> Mask:
        """Find the pixels (rows, columns) of the rings, widened by ``widened_px``, before or behind the body.

        ``center_km`` (3,) of the body, camera axes; ``camera_from_axes`` rotates from its principal axes.
        """
        turns = np.arange(_TURNS) * (2.0 * np.pi / _TURNS)
        circle = np.stack([np.cos(turns), np.sin(turns), np.zeros(_TURNS)], axis=-1)
        area = np.zeros((plane.rows, plane.columns), dtype=np.uint8)
        edges = [center_km + rotate(camera_from_axes, radius * circle) for radius in (self.inner_km, self.outer_km)]
        inner, outer = (plane.model.project(np.where(e[:, 2:] > _NEAREST * center_km[2], e, np.nan)) for e in edges)
        for start in range(_TURNS):
            corners = np.stack([inner[start], outer[start], outer[start - 1], inner[start - 1]])
            if np.isfinite(corners).all() and np.abs(corners).max() < 1e5:
                cv2.fillConvexPoly(area, np.rint(corners).astype(np.int32), 1)
        size = 2 * math.ceil(widened_px) + 1
        grown = cv2.dilate(area, np.ones((size, size), np.uint8))
        return grown > 0

    def seen_or_shading(
        self,
        rays_camera: Float,
        radii_km: Float,
        center_km: Float,
        camera_from_axes: Rotation,
        *,
        sun_direction_camera: Float,
    ) -> Mask:
        """Find the lines of sight (..., 3), or NaN, that meet the rings, or an ellipsoid in their shadow.

        ``radii_km`` (3,), ``center_km`` (3,) of the ellipsoid, camera axes; ``camera_from_axes`` rotates from its
        principal axes. Rings behind the body are not seen.
        """
        rays = rays_camera.reshape(-1, 3)
        to_axes = camera_from_axes.inv()
        eye, sights = rotate(to_axes, -center_km), rotate(to_axes, rays)
        # |(eye + t sight) / radii| = 1
        start, along = eye / radii_km, sights / radii_km
        square, half = np.sum(along**2, axis=1), along @ start
        root2 = half**2 - square * float(start @ start - 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = root2 > 0.0
            depth = np.where(hit, (-half - np.sqrt(np.maximum(root2, 0.0))) / square, np.inf)
            crossing = -eye[2] / sights[:, 2]
            radius = np.linalg.norm((eye + crossing[:, None] * sights)[:, :2], axis=1)
        seen = (crossing > 0.0) & (crossing < depth) & (radius > self.inner_km) & (radius < self.outer_km)
        surface = eye + np.where(hit, depth, 0.0)[:, None] * sights
        toward_sun = np.broadcast_to(rotate(to_axes, sun_direction_camera), surface.shape)
        result: Mask = (seen | (hit & self._intersects(surface, toward_sun))).reshape(rays_camera.shape[:-1])
        return result

    def _intersects(self, points: Float, directions: Float) -> Mask:
        """True for half-lines from points (n, 3) along directions (n, 3), principal axes, that meet the annulus."""
        with np.errstate(divide="ignore", invalid="ignore"):
            length = -points[:, 2] / directions[:, 2]
            meets = points + length[:, None] * directions
        radius = np.linalg.norm(meets[:, :2], axis=1)
        result: Mask = (length > 0.0) & (radius > self.inner_km) & (radius < self.outer_km)
        return result


RINGS_KM = MappingProxyType({"SATURN": (74_491.0, 140_600.0)})
"""Inner and outer radius, km, of opaque rings, by NAIF name.

Saturn: from the inner edge of the C ring (PDS Ring-Moon Systems Node, Vital Statistics for Saturn's Rings and Inner
Satellites) to the F ring (its distance in tables of the Voyager results), which encloses the A ring.
"""
