"""Neighbors of a body in a scene: others that may stand before it, or between it and the Sun."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.embree import Float32
from giantlike.ray_tracing.tracer import Tracer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neighbor(Value):
    """Another body, reached from the axes of the body that is rendered."""

    tracer: Tracer
    neighbor_from_body: Float  # (3, 3)
    offset_km: Float  # from the origin of the neighbor to the origin of the body
    hides: bool  # hides, shades: True if it can stand before the body, and between body and Sun
    shades: bool

    def hidden(self, camera_body_km: Float, directions_body: Float, points_body_km: Float32) -> Mask:
        """Return True for points (k, 4), seen in directions (k, 4) from the camera, that the neighbor hides."""
        camera_km = self.neighbor_from_body @ camera_body_km + self.offset_km
        hits = self.tracer.intersect(camera_km, directions_body[:, :3] @ self.neighbor_from_body.T)
        own_km2 = np.sum((points_body_km[:, :3] - camera_body_km) ** 2, axis=1)
        return np.asarray(np.sum((hits.points_km - camera_km) ** 2, axis=1) < own_km2)

    def dark(self, points_body_km: Float32 | Float, to_sun_body: Float) -> Mask:
        """Return True for points (k, 3) or (k, 4) in the shadow of the neighbor, the Sun in one or k directions."""
        starts = points_body_km[:, :3].astype(np.float64) @ self.neighbor_from_body.T + self.offset_km
        directions = np.broadcast_to(to_sun_body[..., :3] @ self.neighbor_from_body.T, starts.shape)
        return self.tracer.is_occluded(starts, directions)


def neighbors_of(bodies: Sequence[Body], number: int, sun_camera: Float, sun_radius_rad: float) -> list[Neighbor]:
    """Return the other bodies that can hide or shade body ``number``, by the spheres around them."""
    body = bodies[number]
    found = []
    for other in (*bodies[:number], *bodies[number + 1 :]):
        neighbor = Neighbor(
            tracer=other.tracer,
            neighbor_from_body=other.camera_from_body.as_matrix().T @ body.camera_from_body.as_matrix(),
            offset_km=other.to_body(body.position_camera_km - other.position_camera_km),
            hides=_hides(other, body),
            shades=_shades(other, body, sun_camera, sun_radius_rad),
        )
        if neighbor.hides or neighbor.shades:
            found.append(neighbor)
    return found


def _hides(other: Body, body: Body) -> bool:
    """Return True if the sphere around one body may lie before that around another, seen from the camera."""
    near, far = other.position_camera_km, body.position_camera_km
    radii_km = other.tracer.radius_km, body.tracer.radius_km
    ranges_km = float(np.linalg.norm(near)), float(np.linalg.norm(far))
    apart_rad = math.atan2(float(np.linalg.norm(np.cross(near, far))), float(near @ far))
    reach_rad = sum(
        math.asin(radius / range_) if radius < range_ else math.pi
        for radius, range_ in zip(radii_km, ranges_km, strict=True)
    )
    return ranges_km[0] - ranges_km[1] < sum(radii_km) and apart_rad <= reach_rad


def _shades(other: Body, body: Body, sun: Float, sun_radius_rad: float) -> bool:
    """Return True if the sphere around one body may lie between another and some of the Sun."""
    offset_km = other.position_camera_km - body.position_camera_km
    reach_km = other.tracer.radius_km + body.tracer.radius_km
    ahead_km = float(offset_km @ sun)
    aside_km = float(np.linalg.norm(offset_km - ahead_km * sun))
    penumbra_km = max(ahead_km + reach_km, 0.0) * math.tan(sun_radius_rad)
    return ahead_km > -reach_km and aside_km <= reach_km / math.cos(sun_radius_rad) + penumbra_km
