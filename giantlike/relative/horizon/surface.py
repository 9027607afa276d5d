"""The surface of an ellipsoid just inside its horizon, where its brightness is evaluated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.ray_tracing import Reflectance
from giantlike.ray_tracing.air import Air


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonSurface(Value):
    """The surface at q depths inside k points of a horizon."""

    meets: Mask  # (k, q); the ray meets the ellipsoid
    incidence: Float  # incidence, emission: (k, q); cosines of the angles to the Sun and to the camera
    emission: Float
    phase_rad: Float  # (k, q)
    air: Air | None = None  # over it

    def brightness(self, law: Reflectance | None) -> Float:
        """Brightness of the surface. Returns (k, q), 0 where a ray meets nothing."""
        if law is None:
            return self.meets.astype(np.float64)
        angles = self.incidence, self.emission, self.phase_rad
        light = law(*angles) if self.air is None else self.air.brightness(law, *angles)
        return np.where(self.meets, light, 0.0)

    def to_depth(self, count: int) -> HorizonSurface:
        """Return the first so many of the depths."""
        return HorizonSurface(
            meets=self.meets[:, :count],
            incidence=self.incidence[:, :count],
            emission=self.emission[:, :count],
            phase_rad=self.phase_rad[:, :count],
            air=self.air,
        )


@compiled
def trace_rays(
    directions: Float,
    inward: Float,
    depths_px: Float,
    position_km: Float,
    shape_matrix: Float,
    conic: Float,
    sun: Float,
) -> tuple[Mask, Float, Float, Float]:
    """Trace rays inside points of a horizon.

    ``directions`` (k, 3), camera axes; ``inward`` (k, 3) 1/px, their change by one pixel inward; ``depths_px`` (q,);
    ``position_km`` in camera axes; ``shape_matrix`` (3, 3) 1/km^2, camera axes, points of its surface about the center
    have ``x.A.x == 1``; ``conic`` (3, 3) 1/km^2, directions of its horizon have ``x.M.x == 0``, those that meet it
    more; ``sun`` in camera axes, unit vector from body to Sun; returns ``meets`` (k, q); ``incidence``, ``emission``,
    ``phase_rad`` (k, q), as of :class:`HorizonSurface`.
    """
    shape = (len(directions), len(depths_px))
    meets, incidence = np.empty(shape, np.bool_), np.empty(shape)
    emission, phase = np.empty(shape), np.empty(shape)
    ray, point, normal = np.empty(3), np.empty(3), np.empty(3)
    for k in range(shape[0]):
        for q in range(shape[1]):
            for i in range(3):
                ray[i] = directions[k, i] + depths_px[q] * inward[k, i]
            ray /= math.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
            inside, stretch, pull = 0.0, 0.0, 0.0
            for i in range(3):
                for j in range(3):
                    inside += ray[i] * conic[i, j] * ray[j]
                    stretch += ray[i] * shape_matrix[i, j] * ray[j]
                    pull += ray[i] * shape_matrix[i, j] * position_km[j]
            distance = (pull - math.sqrt(max(inside, 0.0))) / stretch
            for i in range(3):
                point[i] = distance * ray[i] - position_km[i]
            for i in range(3):
                normal[i] = 0.0
                for j in range(3):
                    normal[i] += shape_matrix[i, j] * point[j]
            length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            to_sun, to_camera, back = 0.0, 0.0, 0.0
            for i in range(3):
                to_sun += normal[i] * sun[i]
                to_camera -= normal[i] * ray[i]
                back -= ray[i] * sun[i]
            meets[k, q] = inside > 0.0
            incidence[k, q] = min(max(to_sun / length, -1.0), 1.0)
            emission[k, q] = min(max(to_camera / length, 0.0), 1.0)
            phase[k, q] = math.acos(min(max(back, -1.0), 1.0))
    return meets, incidence, emission, phase
