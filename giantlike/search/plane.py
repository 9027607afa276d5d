"""A plane that touches the sky, on which all images of a sequence have common coordinates in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, unit
from giantlike.core.frames import rotate, skew
from giantlike.core.values import Value
from giantlike.search.residuals import Residuals


@dataclass(frozen=True, slots=True, eq=False)
class TangentPlane(Value):
    """Gnomonic coordinates about a direction: ``axes`` (3, 3) are rows x, y and the direction, ICRF axes."""

    axes: Float
    px_per_rad: float

    @classmethod
    def from_residuals(cls, one: Residuals) -> TangentPlane:
        """Plane before the camera at an image, with its axes; one pixel is one on the axis of the camera."""
        axes = one.camera_from_inertial.as_matrix()
        return cls(axes, 1.0 / float(one.camera.ifov_rad()))

    def project(self, directions_inertial: Float) -> Float:
        """Points (..., 2), px, of directions (..., 3)."""
        seen = directions_inertial @ self.axes.T
        return np.asarray(self.px_per_rad * seen[..., :2] / seen[..., 2:])

    def jacobian(self, directions_inertial: Float) -> Float:
        """Derivative (..., 2, 3), px, of :meth:`project`."""
        seen = directions_inertial @ self.axes.T
        slope = np.zeros((*seen.shape[:-1], 2, 3))
        slope[..., 0, 0] = slope[..., 1, 1] = 1.0
        slope[..., :, 2] = -seen[..., :2] / seen[..., 2:]
        return np.asarray(self.px_per_rad * slope @ self.axes / seen[..., 2, None, None])

    def unproject(self, points_px: Float) -> Float:
        """Directions (..., 3) of points (..., 2)."""
        flat = np.concatenate([points_px / self.px_per_rad, np.ones((*points_px.shape[:-1], 1))], axis=-1)
        return unit(flat @ self.axes)

    def covariances(self, one: Residuals, floor_px: float) -> tuple[Float, Float]:
        """Covariances (n, 2, 2), px^2, of the sources of an image: of their own, and that by the attitude."""
        turn = one.camera_from_inertial.as_matrix()
        slope = self.jacobian(one.directions_inertial) @ turn.T
        own = slope @ one.camera.model.unproject_jacobian(one.points_px)
        common = slope @ skew(rotate(one.camera_from_inertial, one.directions_inertial))
        spread = own @ (one.covariance_px2 + floor_px**2 * np.eye(2)) @ own.swapaxes(1, 2)
        return spread, common @ one.attitude_rad2 @ common.swapaxes(1, 2)
