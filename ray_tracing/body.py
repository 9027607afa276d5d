"""A body in front of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, require, unit
from giantlike.core.frames import rotate
from giantlike.core.values import Value
from giantlike.ray_tracing.air import Air
from giantlike.ray_tracing.reflectance import McEwen, Reflectance
from giantlike.ray_tracing.tracer import Tracer, tracer_for
from giantlike.shapes import Point, Shape, sphere
from giantlike.shapes.detail import LevelsOfDetail

_POINT_PX = 1e-3  # diameter of the disk that is traced for a point: its phase moves the light by 3e-4 px at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body(Value):
    """A shape with its surface and its pose.

    Parameters
    ----------
    shape : Shape; a ``TriangleMesh`` or an ``Ellipsoid``; or ``LevelsOfDetail`` or a ``Point``, see :meth:`seen_by`
    camera_from_body : Rotation
    position_camera_km : (3,) float64, km, camera axes; from the camera to the origin of the shape, apparent
    reflectance : Reflectance
    air : Air, optional; over an ellipsoid, which casts no shadow on itself

    Raises
    ------
    InputError
        The position is not finite, or zero.
    """

    shape: Shape
    camera_from_body: Rotation
    position_camera_km: Float
    reflectance: Reflectance = field(default_factory=McEwen)
    air: Air | None = None

    def __post_init__(self) -> None:
        position = as_finite(self.position_camera_km, (3,), "position_camera_km")
        require(
            bool(np.any(position != 0.0)),
            "position_camera_km must not be zero: the camera would be at the center of the body",
        )
        self._keep(position_camera_km=position)

    @property
    def camera_body_km(self) -> Float:
        """Position (3,) of the camera in body axes, km."""
        return -self.to_body(self.position_camera_km)

    @property
    def tracer(self) -> Tracer:
        """The shape prepared for rays, the finest of several levels; cached with the shape."""
        return tracer_for(self.shape.finest if isinstance(self.shape, LevelsOfDetail) else self.shape)

    def seen_by(self, model: CameraModel) -> Body:
        """Return the body with a shape that rays can meet, as fine as a camera resolves.

        Of several levels of detail that is the one for the pixels at the near side of the body; for a point a sphere of
        a thousandth of a pixel. Any other shape is itself.
        """
        shape, range_km = self.shape, float(np.linalg.norm(self.position_camera_km))
        if isinstance(shape, LevelsOfDetail):
            near_km = max(range_km - shape.circumscribing_radius_km, 0.0)
            return replace(self, shape=shape.for_scale(near_km / model.focal_length_px))
        if isinstance(shape, Point):
            return replace(self, shape=sphere(0.5 * _POINT_PX * range_km / model.focal_length_px, name=shape.name))
        return self

    def at(self, position_camera_km: ArrayLike) -> Body:
        """Return the same body at another position (3,), km, camera axes."""
        return replace(self, position_camera_km=np.asarray(position_camera_km, dtype=np.float64))

    def turned(self, turn: Rotation) -> Body:
        """Return the same body in the axes of a camera rotated in place: position and attitude rotate together.

        ``turn`` takes camera axes to the axes of the rotated camera.
        """
        return replace(
            self,
            position_camera_km=rotate(turn, self.position_camera_km),
            camera_from_body=turn * self.camera_from_body,
        )

    def to_body(self, vectors_camera: Float) -> Float:
        """Rotate vectors (..., 3) from camera to body axes."""
        return vectors_camera @ self.camera_from_body.as_matrix()

    def to_camera(self, vectors_body: Float) -> Float:
        """Rotate vectors (..., 3) from body to camera axes."""
        return vectors_body @ self.camera_from_body.as_matrix().T

    def center_px(self, model: CameraModel) -> Float:
        """Project the origin of the shape: (2,), px, in the distorted image; NaN where the model cannot image it."""
        return model.project(self.position_camera_km)

    def hull_px(self, model: CameraModel) -> Float:
        """Project points (k, 2), px, whose convex hull contains the body; NaN where the model cannot."""
        return model.project(self.to_camera(self.tracer.hull_points_km) + self.position_camera_km)


def suns_of(bodies: Sequence[Body], sun_direction_camera: ArrayLike) -> Float:
    """Return one Sun direction for each body. ``sun_direction_camera`` (3,) or (n, 3); returns (n, 3)."""
    suns = as_floats(sun_direction_camera, (3,), "sun_direction_camera")
    fits = suns.shape in ((3,), (len(bodies), 3))
    require(fits, f"sun_direction_camera must be (3,) or one for each of {len(bodies)} bodies, got {suns.shape}")
    return np.broadcast_to(suns, (len(bodies), 3))


def sun_in_body(body: Body, sun_direction_camera: ArrayLike) -> Float:
    """Return the unit vector from body to Sun in body axes. Returns (3,), body axes."""
    sun = as_finite(sun_direction_camera, (3,), "sun_direction_camera")
    norm = float(np.linalg.norm(sun))
    require(abs(norm - 1.0) < 1e-6, f"sun_direction_camera must be a unit vector, its norm is {norm:.6g}")
    return body.to_body(unit(sun))
