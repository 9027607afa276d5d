"""Attitude and position at one time from two cameras: one sees stars, the other a body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, symmetric
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate, skew
from giantlike.core.outcomes import AttitudeFix, PositionFix
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Interlock(Value):
    """Fixed rotation between two cameras."""

    second_from_first: Rotation
    covariance_rad2: Float  # of the small rotation in one pair of images: calibration and bending

    def reversed(self) -> Interlock:
        """Return the rotation from the second camera to the first."""
        back = self.second_from_first.inv()
        turn = back.as_matrix()
        return Interlock(second_from_first=back, covariance_rad2=symmetric(turn @ self.covariance_rad2 @ turn.T))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairPose(Value):
    """Attitude of the camera on a body, and position of the body, from a pair of images."""

    target: str
    camera_from_inertial: Rotation  # of the camera that sees the body
    covariance_attitude_rad2: Float  # stars and interlock
    position_camera_km: Float  # apparent, from the camera to the body: light time and aberration not removed
    covariance_camera_km2: Float  # without the attitude
    position_inertial_km: Float  # in ICRF axes; the same vector
    covariance_inertial_km2: Float  # in ICRF axes; with the attitude
    parts: Mapping[Cause, Float]  # Cause to (3, 3) km^2, ICRF axes; ``noise`` and ``attitude``, which sum to it


def carried_attitude(stars: AttitudeFix, interlock: Interlock) -> tuple[Rotation, Float]:
    """Attitude of the second camera from stars in the first."""
    turn = interlock.second_from_first.as_matrix()
    covariance = turn @ stars.covariance_rad2 @ turn.T + interlock.covariance_rad2
    return interlock.second_from_first * stars.camera_from_inertial, symmetric(covariance)


def pose_of_pair(body: PositionFix, camera_from_inertial: Rotation, attitude_covariance_rad2: ArrayLike) -> PairPose:
    """Pose from a position in the axes of a camera and the attitude of that camera.

    Parameters
    ----------
    body : PositionFix; of the image with the body
    camera_from_inertial : Rotation; of that camera, from :func:`carried_attitude`
    attitude_covariance_rad2 : (3, 3), rad^2, axes of that camera

    Raises
    ------
    InputError
        The covariance has another shape or is not finite.

    References
    ----------
    .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation (ODIN), section
       "Simultaneous Attitude and Position Estimation".
    """
    attitude = as_finite(attitude_covariance_rad2, (3, 3), "attitude_covariance_rad2")
    inertial_from_camera = camera_from_inertial.inv().as_matrix()
    by_turn = skew(body.position_camera_km)
    parts = {
        Cause.NOISE: symmetric(inertial_from_camera @ body.covariance_camera_km2 @ inertial_from_camera.T),
        Cause.ATTITUDE: symmetric(inertial_from_camera @ by_turn @ attitude @ by_turn.T @ inertial_from_camera.T),
    }
    return PairPose(
        target=body.target,
        camera_from_inertial=camera_from_inertial,
        covariance_attitude_rad2=attitude,
        position_camera_km=body.position_camera_km,
        covariance_camera_km2=body.covariance_camera_km2,
        position_inertial_km=rotate(camera_from_inertial.inv(), body.position_camera_km),
        covariance_inertial_km2=parts[Cause.NOISE] + parts[Cause.ATTITUDE],
        parts=parts,
    )
