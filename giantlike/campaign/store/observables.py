"""From fixes to the numbers that tables hold: what follows from a fix, its geometry and its attitude."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.store.records import Attitude, Matrix, Status
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import pointing_deg, quaternion_xyzw, radec_from_direction, rotate, skew
from giantlike.core.outcomes import CenterFix, PositionFix, Quality
from giantlike.image import AttitudeSource
from giantlike.scene import TargetGeometry


def status_of(flags: Quality) -> Status:
    """``suspect`` where a named check objects to a fix, else ``ok``."""
    return "suspect" if flags.suspect else "ok"


def rows(values: ArrayLike) -> Matrix:
    """Nested lists of a matrix."""
    result: Matrix = np.asarray(values, dtype=np.float64).tolist()
    return result


def attitude_value(rotation: Rotation, source: AttitudeSource, covariance_rad2: Float | None = None) -> Attitude:
    """``camera_from_inertial`` and its covariance as a record."""
    return Attitude(
        source=str(source),
        quaternion_xyzw=quaternion_xyzw(rotation).tolist(),
        covariance_rad2=None if covariance_rad2 is None else rows(covariance_rad2),
    )


def rotation_of(attitude: Attitude) -> Rotation:
    """``camera_from_inertial`` of a record."""
    return Rotation.from_quat(attitude.quaternion_xyzw)


def attitude_fields(camera: Camera, attitude: Attitude) -> dict[str, Any]:
    """Fields of an attitude record with this attitude: pointing of the image center, field of view, status."""
    center = camera.model.unproject(camera.center_px)
    fields = {"status": "ok", "attitude": attitude, "fov_deg": camera.fov_deg}
    try:
        ra, dec, roll = pointing_deg(rotation_of(attitude), center)
    except InputError:  # at a celestial pole there is no roll (nor right ascension, but the direction is known)
        direction_ra, direction_dec = radec_from_direction(rotate(rotation_of(attitude).inv(), center))
        return fields | {"ra_deg": float(direction_ra), "dec_deg": float(direction_dec), "roll_deg": None}
    return fields | {"ra_deg": ra, "dec_deg": dec, "roll_deg": roll}


def predicted_fields(camera: Camera, geometry: TargetGeometry) -> dict[str, Any]:
    """Fields of an observation that the a priori geometry gives."""
    predicted = camera.model.project(geometry.position_camera_km)
    return {
        "predicted_px": predicted.tolist() if np.isfinite(predicted).all() else None,
        "predicted_camera_km": geometry.position_camera_km.tolist(),
    }


def fix_fields(camera: Camera, geometry: TargetGeometry, attitude: Attitude | None, fix: CenterFix) -> dict[str, Any]:
    r"""Fields of an observation record that a fix gives.

    Notes
    -----
    With ``J`` the derivative of the projection at ``p`` and ``e`` the small rotation about the camera axes by which
    the attitude is off, the center moves by ``J (e x p) = -J [p]x e``; the position in inertial axes
    ``R^T p`` moves by ``R^T [p]x e``.
    """
    fields: dict[str, Any] = {
        "status": status_of(fix.flags),
        "predicted_px": fix.predicted_px.tolist(),
        "center_px": fix.center_px.tolist(),
        "covariance_px2": rows(fix.covariance_px2),
        "score": fix.score if np.isfinite(fix.score) else None,
        "n_used": fix.n_used,
        "n_rejected": fix.n_rejected,
        "flags": list(fix.flags.names()),
        "provenance": dict(fix.provenance),
    }
    position = camera.model.unproject(fix.center_px) * geometry.range_km
    if isinstance(fix, PositionFix):
        position = fix.position_camera_km
        fields |= {
            "position_camera_km": position.tolist(),
            "covariance_camera_km2": rows(fix.covariance_camera_km2),
            "range_km": fix.range_km,
            "sigma_range_km": fix.sigma_range_km,
            "limb_px": rows(fix.limb_px),
        }
    return fields if attitude is None else fields | _attitude_partials(camera, attitude, fix, position)


def _attitude_partials(camera: Camera, attitude: Attitude, fix: CenterFix, position_camera_km: Float) -> dict[str, Any]:
    camera_from_inertial = rotation_of(attitude).as_matrix()
    by_position = camera.model.project_jacobian(position_camera_km)
    cross = skew(position_camera_km)
    by_attitude = -by_position @ cross
    fields: dict[str, Any] = {
        "partial_position_inertial_px_km": rows(by_position @ camera_from_inertial),
        "partial_attitude_px_rad": rows(by_attitude),
    }
    known = attitude.covariance_rad2 is not None
    covariance = np.asarray(attitude.covariance_rad2 if known else np.full((3, 3), np.nan))
    if known:
        fields["covariance_with_attitude_px2"] = rows(fix.covariance_px2 + by_attitude @ covariance @ by_attitude.T)
    if isinstance(fix, PositionFix):
        fields["position_inertial_km"] = (camera_from_inertial.T @ position_camera_km).tolist()
        if known:
            combined = fix.covariance_camera_km2 + cross @ covariance @ cross.T
            fields["covariance_inertial_km2"] = rows(camera_from_inertial.T @ combined @ camera_from_inertial)
    return fields
