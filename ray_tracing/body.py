"""A body in front of a camera."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.ray_tracing.reflectance import McEwen, Reflectance
from giantlike.ray_tracing.tracer import Tracer, tracer_for
from giantlike.shapes import Shape


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """A shape with its surface and its pose.

    Parameters
    ----------
    shape : Shape
        A ``TriangleMesh`` or an ``Ellipsoid``.
    camera_from_body : Rotation
    position_camera_km : (3,) float64, km, camera axes
        From the camera to the origin of the shape, apparent.
    reflectance : Reflectance

    Raises
    ------
    InputError
        The position is not finite, or zero.
    """

    shape: Shape
    camera_from_body: Rotation
    position_camera_km: Float
    reflectance: Reflectance = field(default_factory=McEwen)

    def __post_init__(self) -> None:
        position = as_finite(self.position_camera_km, (3,), "position_camera_km")
        require(
            bool(np.any(position != 0.0)), "position_camera_km must not be zero: the camera sits in the body's centre"
        )
        object.__setattr__(self, "position_camera_km", position)

    @property
    def camera_body_km(self) -> Float:
        """Position (3,) of the camera in body axes, km."""
        return -self.to_body(self.position_camera_km)

    @property
    def tracer(self) -> Tracer:
        """The shape made ready for rays; kept with the shape."""
        return tracer_for(self.shape)

    def at(self, position_camera_km: ArrayLike) -> Body:
        """Return the same body elsewhere."""
        return replace(self, position_camera_km=np.asarray(position_camera_km, dtype=np.float64))

    def to_body(self, vectors_camera: Float) -> Float:
        """Rotate vectors (..., 3) from camera to body axes."""
        return vectors_camera @ self.camera_from_body.as_matrix()

    def to_camera(self, vectors_body: Float) -> Float:
        """Rotate vectors (..., 3) from body to camera axes."""
        return vectors_body @ self.camera_from_body.as_matrix().T

    def center_px(self, model: CameraModel) -> Float:
        """Pixel (2,) of the origin of the shape in the distorted image; NaN where the model cannot image it."""
        return model.project(self.position_camera_km)

    def hull_px(self, model: CameraModel) -> Float:
        """Pixels (k, 2) of points whose hull holds the body; NaN for those that the model cannot image."""
        return model.project(self.to_camera(self.tracer.hull_points_km) + self.position_camera_km)


def sun_in_body(body: Body, sun_direction_camera: ArrayLike) -> Float:
    """Unit vector (3,) from body to Sun in body axes.

    Raises
    ------
    InputError
        The direction is not finite, or not a unit vector to 1e-6.
    """
    sun = as_finite(sun_direction_camera, (3,), "sun_direction_camera")
    norm = float(np.linalg.norm(sun))
    require(abs(norm - 1.0) < 1e-6, f"sun_direction_camera must be a unit vector, its norm is {norm:.6g}")
    return body.to_body(unit(sun))
