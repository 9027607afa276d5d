"""Fixes to records: everything that follows from a fix, its geometry and its attitude."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.store.record_values import Landmarks, Residuals, SightingRecord, StarMatches, Status, TurnRecord
from giantlike.campaign.store.records import Attitude, AttitudeRecord, ObservationRecord
from giantlike.core.arrays import Float, finite_or_none
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.errors import InputError
from giantlike.core.frames import pointing_deg, quaternion_xyzw, radec_from_direction, rotate, skew
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import AttitudeErrors, AttitudeFix, BodyTurn, CenterFix, PositionFix, Quality
from giantlike.image import AttitudeSource, Image
from giantlike.relative.budget import position_covariance
from giantlike.relative.landmarks.surface_features import LandmarkFix
from giantlike.scene import Scene, TargetGeometry

_MAP_CELLS = 32  # along the longer side of a map of residuals: 200 px in a report, 3 kB in the store


def status_of(flags: Quality) -> Status:
    """Status of a fix with quality flags."""
    return "suspect" if flags.suspect else "ok"


def attitude_of(
    rotation: Rotation,
    source: AttitudeSource,
    covariance_rad2: Float | None = None,
    errors: AttitudeErrors | None = None,
) -> Attitude:
    """Attitude as a record holds it."""
    errors = errors or AttitudeErrors()
    return Attitude(
        source=str(source),
        quaternion_xyzw=quaternion_xyzw(rotation).tolist(),
        covariance_rad2=None if covariance_rad2 is None else covariance_rad2.tolist(),
        parts={cause: part.tolist() for cause, part in errors.parts.items()},
        by_camera=None if errors.by_camera is None else errors.by_camera.tolist(),
        flags=list(errors.flags.names()),
    )


def with_observer(record: AttitudeRecord, observer: ObserverState | None) -> AttitudeRecord:
    """Record with the state of the spacecraft."""
    if observer is None:
        return record
    return record.replace(
        observer_position_km=observer.position_km.tolist(), observer_velocity_km_s=observer.velocity_km_s.tolist()
    )


def with_attitude(record: AttitudeRecord, camera: Camera, attitude: Attitude, status: Status = "ok") -> AttitudeRecord:
    """Record with an attitude that was found, the pointing of the image center and the field of view."""
    center = camera.model.unproject(camera.center_px)
    roll: float | None
    try:
        ra, dec, roll = pointing_deg(attitude.rotation, center)
    except InputError:  # at a celestial pole there is no roll (nor right ascension, but the direction is known)
        ra, dec = (float(angle) for angle in radec_from_direction(rotate(attitude.rotation.inv(), center)))
        roll = None
    return record.replace(
        status=status, problem=None, attitude=attitude, fov_deg=camera.fov_deg, ra_deg=ra, dec_deg=dec, roll_deg=roll
    )


def with_stars(
    record: AttitudeRecord, camera: Camera, fix: AttitudeFix, detected_px: list[list[float]]
) -> AttitudeRecord:
    """Record with an attitude that was found from stars. ``detected_px`` (n, 2)."""
    attitude = attitude_of(fix.camera_from_inertial, AttitudeSource.STARS, fix.covariance_rad2, fix.errors)
    return with_attitude(record, camera, attitude, status_of(fix.flags)).replace(
        detected_px=detected_px,
        n_detected=fix.n_detected,
        n_matched=fix.n_used,
        n_rejected=fix.n_rejected,
        rms_px=fix.rms_px,
        false_match_probability=fix.false_match_probability,
        fov_deg=fix.fov_deg,
        flags=list(fix.flags.names()),
        provenance=dict(fix.provenance),
        stars=StarMatches(**{name: np.asarray(getattr(fix, name)).tolist() for name in StarMatches.model_fields}),
    )


def sighting_of(scene: Scene, image: Image, geometry: TargetGeometry) -> SightingRecord:
    """A priori record of a target."""
    known = geometry.target.uncertainty
    record = SightingRecord(
        target=geometry.target.name,
        camera_from_body_xyzw=quaternion_xyzw(geometry.camera_from_body).tolist(),
        sun_direction_camera=geometry.sun_direction_camera.tolist(),
        scale_sigma=known.scale,
        pole_sigma_rad=known.pole_rad,
        spin_sigma_rad=known.spin_rad,
        ephemeris_sigma_km=known.ephemeris_km,
        sun_sigma_rad=known.sun_rad,
        ephemeris_icrf_km2=known.ephemeris_icrf_km2 and list(map(list, known.ephemeris_icrf_km2)),
    )
    circumstances = scene.circumstances(image, geometry.target.name)
    if circumstances is None:
        return record
    return record.replace(**{name: _plain(value) for name, value in asdict(circumstances).items()})


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _landmarks(fix: LandmarkFix) -> Landmarks:
    return Landmarks(
        names=list(fix.landmark_names),
        observed_px=fix.landmark_px.tolist(),
        predicted_px=fix.landmark_predicted_px.tolist(),
        covariance_px2=fix.covariance_landmarks_px2.tolist(),
        body_km=fix.landmark_body_km.tolist(),
        rejected_names=list(fix.rejected_names),
        rejected_px=fix.rejected_predicted_px.tolist(),
        rejected_because=list(fix.rejected_because),
    )


def _turn(turn: BodyTurn | None) -> TurnRecord | None:
    if turn is None:
        return None
    return TurnRecord(
        turn_rad=turn.turn_rad,
        center_px=turn.center_px.tolist(),
        covariance=turn.covariance.tolist(),
        by_rotation=turn.by_rotation.tolist(),
    )


def _points(fix: PositionFix) -> dict[str, list[list[float]]]:
    """Limb points of a fix that was made of them, else its outline; landmarks are kept apart."""
    if isinstance(fix, LandmarkFix):
        return {}
    measured = fix.measured_limb_px
    return {"limb_px": measured.tolist()} if len(measured) else {"outline_px": fix.limb_px.tolist()}


def _residuals(fix: CenterFix) -> Residuals | None:
    """Residuals for a picture: points one by one, pixels as means over cells; None where positions are unknown."""
    at_px, values, cell_px = fix.residuals_at_px, fix.residuals, 0.0
    if isinstance(fix, LandmarkFix) or not len(at_px):
        return None
    if not (isinstance(fix, PositionFix) and len(fix.measured_limb_px)):
        low = at_px.min(axis=0)
        cell_px = max(float(np.ptp(at_px, axis=0).max()) / _MAP_CELLS, 1.0)
        cells = np.floor((at_px - low + 0.5) / cell_px).astype(np.int64)  # from the edge of the first pixel
        number = cells[:, 1] * (_MAP_CELLS + 1) + cells[:, 0]
        count = np.bincount(number)
        full = np.flatnonzero(count)
        values = np.bincount(number, values)[full] / count[full]
        at_px = low + cell_px * (np.stack([full % (_MAP_CELLS + 1), full // (_MAP_CELLS + 1)], axis=1) + 0.5) - 0.5
    places = np.round(at_px, 3).tolist()
    return Residuals(at_px=places, values=np.round(values, 6).tolist(), cell_px=cell_px)


def with_prediction(record: ObservationRecord, camera: Camera, geometry: TargetGeometry) -> ObservationRecord:
    """Record with the position of the target by the a priori geometry."""
    predicted = camera.model.project(geometry.position_camera_km)
    return record.replace(
        predicted_px=predicted.tolist() if np.isfinite(predicted).all() else None,
        predicted_camera_km=geometry.position_camera_km.tolist(),
    )


def with_fix(record: ObservationRecord, camera: Camera, geometry: TargetGeometry, fix: CenterFix) -> ObservationRecord:
    r"""Record with a fix and, if the record has an attitude, its partials and combined covariances.

    With ``J`` the derivative of the projection at ``p`` and ``e`` the small rotation of the attitude about camera axes,
    the center moves by ``J (e x p) = -J [p]x e``; the position in inertial axes ``R^T p`` moves by ``R^T [p]x e``.
    """
    record = record.replace(
        status=status_of(fix.flags),
        predicted_px=fix.predicted_px.tolist(),
        center_px=fix.center_px.tolist(),
        covariance_px2=fix.covariance_px2.tolist(),
        score=finite_or_none(fix.score),
        n_used=fix.n_used,
        n_rejected=fix.n_rejected,
        flags=list(fix.flags.names()),
        provenance=dict(fix.provenance),
        checks={name: number for name, number in fix.findings.checks.items() if math.isfinite(number)},
        parts={cause: part.tolist() for cause, part in fix.parts.items()},
        partials={cause: partial.tolist() for cause, partial in fix.partials.items()},
        landmarks=_landmarks(fix) if isinstance(fix, LandmarkFix) else None,
        residuals=_residuals(fix),
    )
    position = camera.model.unproject(fix.center_px) * geometry.range_km
    if isinstance(fix, PositionFix):
        position = fix.position_camera_km
        record = record.replace(
            position_camera_km=position.tolist(),
            covariance_camera_km2=fix.covariance_camera_km2.tolist(),
            range_km=fix.range_km,
            sigma_range_km=fix.sigma_range_km,
            limb_rejected_px=fix.limb_rejected_px.tolist(),
            turn=_turn(fix.turn),
            **_points(fix),
        )
    attitude = record.attitude
    if attitude is None:
        return record
    camera_from_inertial = attitude.rotation.as_matrix()
    by_position = camera.model.project_jacobian(position)
    by_attitude = -by_position @ skew(position)
    record = record.replace(
        partial_position_inertial_px_km=(by_position @ camera_from_inertial).tolist(),
        partial_attitude_px_rad=by_attitude.tolist(),
    )
    if isinstance(fix, PositionFix):
        record = record.replace(position_inertial_km=(camera_from_inertial.T @ position).tolist())
    if Cause.ATTITUDE not in fix.parts:
        return record
    total = sum_parts(fix.parts, [cause for cause in Cause if cause is not Cause.EPHEMERIS])
    record = record.replace(covariance_with_attitude_px2=total[:2, :2].tolist())
    if isinstance(fix, PositionFix):
        inertial = camera_from_inertial.T @ position_covariance(camera.model, position, total) @ camera_from_inertial
        record = record.replace(covariance_inertial_km2=inertial.tolist())
    return record
