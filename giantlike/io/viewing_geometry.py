"""Viewing geometry: position, orientation and Sun of a body as pictures, labels and press kits state them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.frames import rotate
from giantlike.core.units import RAD_PER_DEG
from giantlike.core.values import Value

_PHASE_TOLERANCE_DEG = 1.0  # of a stated phase angle from that of the stated points: both are rounded
_SUN_TOLERANCE_DEG = 5.0  # between the Sun by azimuth, read off by eye, and by the sub-solar point


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StatedGeometry(Value):
    """Geometry of one target in one image as a label or a table states it."""

    target: str  # name of the target there
    position_camera_km: Float  # from the camera to the center of the target
    sun_direction_camera: Float  # from the target to the Sun
    camera_from_body: Rotation | None = None  # orientation of the target; None where it is not stated
    camera_from_inertial: Rotation | None = None  # attitude of the camera; None where it is not stated
    covariance_camera_km2: Float | None = None  # of the position; None where it is not stated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewingGeometry(Value):
    """Angles by which planetary images are described; azimuths are in the image, at the center of the body."""

    target: str  # name
    center_px: Float  # pixel of the center of the body
    range_km: float  # distance from the camera to that center
    north_azimuth_rad: float | None = None  # of the projected +z axis of the body, from +x to +y of the image
    observer_direction_body: Float | None = None  # to the camera, body-fixed axes: the sub-observer point
    sun_direction_body: Float | None = None  # to the Sun, body-fixed axes: the sub-solar point
    sun_azimuth_rad: float | None = None  # direction in which the Sun is, counted as for the pole
    phase_angle_rad: float | None = None  # angle at the body between camera and Sun

    def __post_init__(self) -> None:
        require_number(self.range_km, "the range", above=0.0)
        oriented = (self.north_azimuth_rad is None) == (self.observer_direction_body is None)
        require(oriented, "the orientation needs both the north azimuth and the sub-observer point")
        by_body = self.sun_direction_body is not None
        require(not by_body or self.north_azimuth_rad is not None, "a sub-solar point needs the orientation too")
        by_angles = self.phase_angle_rad is not None and self.sun_azimuth_rad is not None
        require(by_body or by_angles, "the Sun needs the sub-solar point, or the phase angle and the Sun azimuth")
        Value.__post_init__(self)

    def in_camera(self, model: CameraModel) -> StatedGeometry:
        """Geometry in camera axes."""
        sight, by_pixel = model.unproject(self.center_px), model.unproject_jacobian(self.center_px)
        require(bool(np.isfinite(sight).all()), f"the camera sees nothing at the pixel {self.center_px.tolist()}")
        viewer = -unit(sight)

        def across(azimuth_rad: float) -> Float:
            return unit(by_pixel @ [math.cos(azimuth_rad), math.sin(azimuth_rad)])

        camera_from_body = None
        if self.north_azimuth_rad is not None and self.observer_direction_body is not None:
            seen, body = _axes(viewer, across(self.north_azimuth_rad)), _axes_at(self.observer_direction_body)
            camera_from_body = Rotation.from_matrix(seen @ body.T)
        phase, azimuth = self.phase_angle_rad, self.sun_azimuth_rad
        sun = None
        if camera_from_body is not None and self.sun_direction_body is not None:
            sun = rotate(camera_from_body, self.sun_direction_body)
            between = _angle_rad(sun, viewer)
            require(
                phase is None or abs(phase - between) <= _PHASE_TOLERANCE_DEG * RAD_PER_DEG,
                f"the phase angle is {_text(phase)}, but the sub-solar point is {_text(between)} from the sub-observer "
                "point: is a longitude west instead of east, or of another body?",
            )
            phase = between
        if phase is not None and azimuth is not None:
            by_angles = math.cos(phase) * viewer + math.sin(phase) * across(azimuth)
            sun = by_angles if sun is None else sun
            apart = _angle_rad(sun, by_angles)
            require(
                apart <= _SUN_TOLERANCE_DEG * RAD_PER_DEG,
                f"the Sun by its azimuth is {_text(apart)} from the Sun by the sub-solar point: is an azimuth "
                "counterclockwise, or from another zero, or is the picture mirrored?",
            )
        assert sun is not None  # by the check of the fields
        return StatedGeometry(
            target=self.target,
            position_camera_km=self.range_km * unit(sight),
            sun_direction_camera=unit(sun),
            camera_from_body=camera_from_body,
        )


def _axes(outward: Float, north: Float) -> Float:
    """Matrix (3, 3) whose columns are the vertical, north and the third axis at a point of a body."""
    return np.stack([outward, north, np.cross(outward, north)], axis=1)


def _axes_at(outward: Float) -> Float:
    """Likewise in body-fixed axes, where north is along the meridian."""
    longitude, latitude = math.atan2(outward[1], outward[0]), math.asin(min(max(outward[2], -1.0), 1.0))
    south = math.sin(latitude) * np.array([math.cos(longitude), math.sin(longitude), 0.0])
    return _axes(outward, np.array([0.0, 0.0, math.cos(latitude)]) - south)


def _angle_rad(first: Float, second: Float) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second))


def _text(angle_rad: float | None) -> str:
    return "" if angle_rad is None else f"{angle_rad / RAD_PER_DEG:.4g} deg"
