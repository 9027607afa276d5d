"""Rows of the observables file from fixes, landmarks and stars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, unit
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.frames import east_north, quaternion_xyzw, radec_from_direction, rotate, skew
from giantlike.core.light import aberrate
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import AttitudeErrors, BodyTurn, CenterFix, PositionFix
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.values import Value
from giantlike.ephemeris import BARYCENTER
from giantlike.io.observables_file import ObservableBlock, ObservableRow
from giantlike.observables.apparent import apparent_by_position, removed
from giantlike.relative.budget import attitude_parts_rad2, position_covariance
from giantlike.scene import Circumstances, TargetUncertainty

_ESTIMATED_LATER = (Cause.EPHEMERIS,)  # causes not in the covariance of an observable: a filter estimates them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageContext(Value):
    """What all rows of an image have in common."""

    file: str
    camera: Camera
    shared_camera: str  # key of camera and calibration
    camera_from_inertial: Rotation  # the attitude used
    attitude_source: str
    attitude_covariance_rad2: Float | None = None  # in camera axes
    attitude_errors: AttitudeErrors = field(default_factory=AttitudeErrors)
    # star images that a transferred attitude is made of, and the share of each
    attitude_shares: Mapping[str, float] = field(default_factory=dict)
    epoch_utc: str | None = None
    et: float | None = None
    exposure_s: float | None = None
    # accepted_by, accepted_why: user who accepted the result of the rows, which is suspect, and the reason
    accepted_by: str | None = None
    accepted_why: str | None = None
    camera_rate_rad_s: Float | None = None  # in rad/s; rotation rate of the camera

    @property
    def attitude_parts_rad2(self) -> dict[Cause, Float]:
        """Covariance (3, 3) of the attitude by cause, apart from the camera."""
        return attitude_parts_rad2(self.attitude_covariance_rad2, self.attitude_errors, self.camera)

    def cells(self) -> dict[str, Any]:
        """Cells that all rows of the image have."""
        covariance = self.attitude_parts_rad2.get(Cause.ATTITUDE)
        shares = self.attitude_shares or ({self.file: 1.0} if self.attitude_source == "stars" else {})
        return {
            "file": self.file,
            "accepted_by": self.accepted_by,
            "accepted_why": self.accepted_why,
            "epoch_utc": self.epoch_utc,
            "epoch_et_s": self.et,
            "exposure_s": self.exposure_s,
            "shared_image": self.file,
            "shared_camera": self.shared_camera,
            "shared_attitude": " + ".join(sorted(shares)) or self.file,
            "attitude_source": self.attitude_source,
            "attitude_images": list(shares) or None,
            "attitude_weights": list(shares.values()) or None,
            "camera_from_icrf_xyzw": quaternion_xyzw(self.camera_from_inertial).tolist(),
            "attitude_covariance_rad2": _flat(covariance),
            "camera_rate_rad_s": _flat(self.camera_rate_rad_s),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting(Value):
    """What was known of a target in an image beforehand."""

    predicted_camera_km: Float  # apparent vector to the target by the a priori geometry
    camera_from_body: Rotation  # when the light left, by the attitude used
    sun_direction_camera: Float
    uncertainty: TargetUncertainty = field(default_factory=TargetUncertainty)
    # states that light time and aberration are taken out by; without them the row is apparent alone
    circumstances: Circumstances | None = None

    def cells(self, inertial_from_camera: Rotation) -> dict[str, Any]:
        """Cells of what was known."""
        known, states = self.uncertainty, self.circumstances
        cells: dict[str, Any] = {
            "icrf_from_body_xyzw": quaternion_xyzw(inertial_from_camera * self.camera_from_body).tolist(),
            "sun_direction_icrf": rotate(inertial_from_camera, self.sun_direction_camera).tolist(),
            "sigma_shape_scale": known.scale or None,
            "sigma_pole_rad": known.pole_rad or None,
            "sigma_spin_rad": known.spin_rad or None,
            "sigma_ephemeris_km": known.ephemeris_km or None,
            "covariance_ephemeris_icrf_km2": _flat(known.covariance_ephemeris_km2) if known.ephemeris_km else None,
            "sigma_sun_rad": known.sun_rad or None,
        }
        if states is not None:
            cells |= {
                "states_origin": states.origin,
                "observer_position_icrf_km": states.observer_position_km.tolist(),
                "observer_velocity_icrf_km_s": states.observer_velocity_km_s.tolist(),
                "target_velocity_icrf_km_s": _flat(states.target_velocity_km_s),
            }
        return cells


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkSeen(Value):
    """A landmark of a fix."""

    name: str
    body_km: Float
    observed_px: Float  # (2,)
    covariance_px2: Float  # of the measured place alone


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarsSeen(Value):
    """Stars of an attitude."""

    numbers: NDArray[np.int64]  # (n,); of the catalog
    magnitudes: Float  # (n,)
    observed_px: Float  # (n, 2)
    predicted_px: Float  # (n, 2)
    sigma_px: Float  # (n,); per axis


def row_of_body(
    context: ImageContext, sighting: Sighting, fix: CenterFix, *, is_preferred: bool = False, reason: str | None = None
) -> ObservableRow:
    """Row of a fix of a body."""
    model, ranged = context.camera.model, isinstance(fix, PositionFix)
    apparent_km = model.unproject(fix.center_px) * float(np.linalg.norm(sighting.predicted_camera_km))
    if isinstance(fix, PositionFix):
        apparent_km = fix.position_camera_km
    units = np.array([1.0, 1.0, float(np.linalg.norm(apparent_km))])
    parts = {cause: _pad_covariance(part) * np.outer(units, units) for cause, part in fix.parts.items()}
    partials = {cause: _padded_rows(partial) * units[:, None] for cause, partial in fix.partials.items()}
    point = _Point(context=context, apparent_km=apparent_km, circumstances=sighting.circumstances, ranged=ranged)
    return ObservableRow(
        kind="body",
        target=fix.target,
        estimator=fix.estimator,
        preferred=is_preferred,
        preferred_reason=reason,
        **_quality(fix),
        score=fix.score,
        n_used=fix.n_used,
        n_rejected=fix.n_rejected,
        shared_body=fix.target,
        **context.cells(),
        **sighting.cells(context.camera_from_inertial.inv()),
        **_pixel_cells(fix.center_px, model.project(sighting.predicted_camera_km)),
        **_range_cells(apparent_km, sighting.predicted_camera_km, ranged=ranged),
        **_turn_cells(fix.turn if isinstance(fix, PositionFix) else None),
        **point.directions(),
        **point.errors(parts),
        **point.partials(partials),
    )


def row_of_landmark(
    context: ImageContext, sighting: Sighting, fix: PositionFix, landmark: LandmarkSeen
) -> ObservableRow:
    """Row of a landmark of a fix."""
    model, known = context.camera.model, sighting.uncertainty
    turned_km = rotate(sighting.camera_from_body, landmark.body_km)
    point_km, computed_km = fix.position_camera_km + turned_km, sighting.predicted_camera_km + turned_km
    by_place = model.project_jacobian(point_km)
    by_turn = by_place @ sighting.camera_from_body.as_matrix() @ -skew(landmark.body_km)
    by_attitude = -by_place @ skew(point_km)
    partials = {
        Cause.ATTITUDE: by_attitude,
        Cause.SHAPE_SCALE: (by_place @ turned_km)[:, None],
        Cause.POLE: by_turn[:, :2],
        Cause.SPIN: by_turn[:, 2:],
    }
    sigmas = {Cause.SHAPE_SCALE: known.scale, Cause.POLE: known.pole_rad, Cause.SPIN: known.spin_rad}
    parts = {Cause.NOISE: landmark.covariance_px2}
    parts |= {cause: sigma**2 * partials[cause] @ partials[cause].T for cause, sigma in sigmas.items() if sigma > 0.0}
    parts |= {cause: by_attitude @ part @ by_attitude.T for cause, part in context.attitude_parts_rad2.items()}
    uncertain = context.camera.uncertainty
    if uncertain is not None and uncertain.estimated:
        chosen = [model.parameter_names.index(name) for name in uncertain.estimated]
        by_camera = model.parameter_jacobian(point_km)[:, chosen]
        if context.attitude_errors.by_camera is not None:
            by_camera = by_camera + by_attitude @ context.attitude_errors.by_camera[:, chosen]
        partials[Cause.CAMERA] = by_camera
        parts[Cause.CAMERA] = by_camera @ uncertain.covariance @ by_camera.T
    seen_km = model.unproject(landmark.observed_px) * float(np.linalg.norm(point_km))
    point = _Point(context=context, apparent_km=seen_km, circumstances=sighting.circumstances, ranged=False)
    return ObservableRow(
        kind="landmark",
        target=fix.target,
        estimator=fix.estimator,
        feature=landmark.name,
        preferred=False,
        **_quality(fix),
        shared_body=fix.target,
        shared_landmark=f"{fix.target} {landmark.name}",
        feature_position_body_km=landmark.body_km.tolist(),
        partial_landmark=_flat(_padded_rows(by_place @ sighting.camera_from_body.as_matrix())),
        **context.cells(),
        **sighting.cells(context.camera_from_inertial.inv()),
        **_pixel_cells(landmark.observed_px, model.project(computed_km)),
        **point.directions(),
        **point.errors({cause: _pad_covariance(part) for cause, part in parts.items()}),
        **point.partials({cause: _padded_rows(partial) for cause, partial in partials.items()}),
    )


def rows_of_stars(
    context: ImageContext, stars: StarsSeen, observer: ObserverState | None, *, status: str
) -> ObservableBlock:
    """Rows of the stars of an image."""
    model, turn = context.camera.model, context.camera_from_inertial.inv()
    in_camera = unit(model.unproject(stars.observed_px))
    apparent = rotate(turn, in_camera)
    shared = context.cells() | {"kind": "star", "status": status, "preferred": False}
    vectors = {"apparent": apparent}
    if observer is not None:
        still = unit(aberrate(apparent, -observer.velocity_km_s))
        vectors |= {"astrometric": still, "geometric": still}
        shared |= {
            "states_origin": BARYCENTER,
            "observer_position_icrf_km": observer.position_km.tolist(),
            "observer_velocity_icrf_km_s": observer.velocity_km_s.tolist(),
        }
    columns: dict[str, NDArray[Any]] = {
        "feature": stars.numbers.astype(str).astype(object),
        "magnitude": stars.magnitudes,
        "sigma_pixel_px": stars.sigma_px,
        "sigma_line_px": stars.sigma_px,
        "correlation_pixel_line": np.zeros_like(stars.sigma_px),
    }
    for k, name in enumerate(("pixel", "line")):
        columns[f"observed_{name}_px"] = stars.observed_px[:, k]
        columns[f"computed_{name}_px"] = stars.predicted_px[:, k]
        columns[f"o_minus_c_{name}_px"] = stars.observed_px[:, k] - stars.predicted_px[:, k]
    for name, vector in vectors.items():
        columns[f"{name}_direction_icrf"] = vector
        columns[f"{name}_ra_deg"], columns[f"{name}_dec_deg"] = radec_from_direction(vector)
    noise = np.full((len(stars.numbers), 3, 3), np.nan)
    noise[:, :2, :2] = stars.sigma_px[:, None, None] ** 2 * np.eye(2)
    columns["covariance"] = columns["part_noise"] = noise.reshape(-1, 9)
    by_px = _sky_by_px(turn, apparent, model.unproject_jacobian(stars.observed_px))
    sky = by_px @ noise[:, :2, :2] @ np.swapaxes(by_px, 1, 2)
    sigmas = np.sqrt(np.diagonal(sky, axis1=1, axis2=2))
    columns["sigma_ra_cos_dec_arcsec"], columns["sigma_dec_arcsec"] = (ARCSEC_PER_RAD * sigmas).T
    columns["correlation_ra_dec"] = sky[:, 0, 1] / sigmas.prod(axis=1)
    by_attitude = np.full((len(stars.numbers), 3, 3), np.nan)
    by_attitude[:, :2] = -model.project_jacobian(in_camera) @ skew(in_camera)
    columns["partial_attitude"] = by_attitude.reshape(-1, 9)
    by_focal_length = np.full((len(stars.numbers), 3), np.nan)
    by_focal_length[:, :2] = _by_focal_length(model, in_camera)
    columns["partial_focal_length"] = by_focal_length
    return ObservableBlock(count=len(stars.numbers), shared=shared, columns=columns)


def _direction_cells(name: str, direction: Float) -> dict[str, Any]:
    """Cells of a direction (3,), inertial axes."""
    ra, dec = radec_from_direction(direction)
    return {f"{name}_direction_icrf": direction.tolist(), f"{name}_ra_deg": float(ra), f"{name}_dec_deg": float(dec)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Point(Value):
    """A measured point: its apparent vector (3,), km, camera axes, and whether its length was measured."""

    context: ImageContext
    apparent_km: Float
    circumstances: Circumstances | None
    ranged: bool

    @property
    def inertial_from_camera(self) -> Rotation:
        return self.context.camera_from_inertial.inv()

    def directions(self) -> dict[str, Any]:
        """Cells of apparent, astrometric and geometric directions and positions."""
        inertial_km = rotate(self.inertial_from_camera, self.apparent_km)
        vectors = {"apparent": inertial_km}
        cells: dict[str, Any] = {}
        if self.circumstances is not None:
            found = removed(inertial_km, self.circumstances)
            vectors["astrometric"] = found.astrometric_km
            if found.geometric_km is not None:
                vectors["geometric"] = found.geometric_km
            cells["light_time_s"] = found.light_time_s
            et = self.context.et
            cells["emission_et_s"] = None if et is None else et - found.light_time_s
        for name, vector in vectors.items():
            cells |= _direction_cells(name, unit(vector))
            if self.ranged:
                cells[f"{name}_position_icrf_km"] = vector.tolist()
        return cells

    def errors(self, parts: Mapping[Cause, Float]) -> dict[str, Any]:
        """Cells of the covariance and of its parts (3, 3)."""
        cells: dict[str, Any] = {
            f"part_{cause}": _flat(part) for cause, part in parts.items() if cause not in _ESTIMATED_LATER
        }
        if Cause.ATTITUDE not in parts:
            return cells
        total = sum_parts(parts, [cause for cause in Cause if cause not in _ESTIMATED_LATER])
        cells |= _covariance_cells(total) | self.sky_errors(total)
        if self.ranged:
            units = np.array([1.0, 1.0, 1.0 / float(np.linalg.norm(self.apparent_km))])
            turn = self.inertial_from_camera.as_matrix()
            camera = position_covariance(self.context.camera.model, self.apparent_km, total * np.outer(units, units))
            cells["covariance_position_icrf_km2"] = _flat(turn @ camera @ turn.T)
        return cells

    def sky_errors(self, covariance: Float) -> dict[str, Any]:
        """Cells of the errors to the east and to the north, by the covariance of pixel and line."""
        model, turn = self.context.camera.model, self.inertial_from_camera
        by_direction = model.unproject_jacobian(model.project(self.apparent_km))
        by_px = _sky_by_px(turn, rotate(turn, self.apparent_km), by_direction)
        return _sky_cells(by_px @ covariance[:2, :2] @ by_px.T)

    def partials(self, by_cause: Mapping[Cause, Float]) -> dict[str, Any]:
        """Cells of the derivatives of (pixel, line, apparent range)."""
        model, turn = self.context.camera.model, self.context.camera_from_inertial.as_matrix()
        by_apparent = np.vstack([model.project_jacobian(self.apparent_km), unit(self.apparent_km)]) @ turn
        by_target = by_apparent
        if self.circumstances is not None:
            found = removed(turn.T @ self.apparent_km, self.circumstances)
            by_target = by_apparent @ apparent_by_position(found.astrometric_km, self.circumstances)
        names = {
            Cause.ATTITUDE: "partial_attitude",
            Cause.SHAPE_SCALE: "partial_shape_scale",
            Cause.POLE: "partial_pole",
            Cause.SPIN: "partial_spin",
            Cause.SUN: "partial_sun",
            Cause.CAMERA: "partial_camera_parameters",
        }
        return {
            "partial_target_position": _flat(by_target),
            "partial_camera_position": _flat(-by_target),
            "partial_focal_length": _flat(self.by_focal_length()),
            "partial_time_tag": _flat(self.by_time_tag(by_target, by_cause.get(Cause.ATTITUDE))),
        } | {names[cause]: _flat(partial) for cause, partial in by_cause.items() if cause in names}

    def by_time_tag(self, by_target: Float, by_attitude: Float | None) -> Float | None:
        """Derivative (3,) by the lateness of the exposure; None where the velocities or the rate are not known."""
        states, rate = self.circumstances, self.context.camera_rate_rad_s
        if states is None or states.target_velocity_km_s is None:
            return None
        moved: Float = by_target @ (states.target_velocity_km_s - states.observer_velocity_km_s)
        if self.context.attitude_source == "stars":  # of the same exposure
            return moved
        return None if rate is None or by_attitude is None else moved - by_attitude @ rate

    def by_focal_length(self) -> Float:
        """Derivative (3,) of (pixel, line, apparent range) by the focal length, relative."""
        shrinks = -float(np.linalg.norm(self.apparent_km)) if self.ranged else np.nan
        return np.append(_by_focal_length(self.context.camera.model, self.apparent_km), shrinks)


def _by_focal_length(model: CameraModel, points_camera: Float) -> Float:
    """Derivative (..., 2) of pixels by the focal length, relative."""
    names, values = list(model.parameter_names), model.parameters
    jacobian = model.parameter_jacobian(points_camera)
    which = [names.index(name) for name in ("fx_px", "fy_px")]
    return jacobian[..., which] @ values[which]


def _sky_by_px(inertial_from_camera: Rotation, directions: Float, by_px: Float) -> Float:
    """Derivative (..., 2, 2) of the way to the east and north, rad, by pixels."""
    sky = np.stack(east_north(*radec_from_direction(directions)), axis=-2)
    return sky @ inertial_from_camera.as_matrix() @ by_px


def _sky_cells(east_north_rad2: Float) -> dict[str, Any]:
    """Cells of a covariance (2, 2) to the east and to the north."""
    sigmas = np.sqrt(np.diag(east_north_rad2))
    return {
        "sigma_ra_cos_dec_arcsec": float(sigmas[0] * ARCSEC_PER_RAD),
        "sigma_dec_arcsec": float(sigmas[1] * ARCSEC_PER_RAD),
        "correlation_ra_dec": _ratio(float(east_north_rad2[0, 1]), float(sigmas[0] * sigmas[1])),
    }


def _quality(fix: CenterFix) -> dict[str, Any]:
    return {"status": "suspect" if fix.flags.suspect else "ok", "flags": "|".join(fix.flags.names()) or None}


def _pixel_cells(observed_px: Float, computed_px: Float) -> dict[str, Any]:
    """Cells of pixel and line, observed and computed."""
    cells: dict[str, Any] = {}
    for k, name in enumerate(("pixel", "line")):
        computed = float(computed_px[k]) if np.isfinite(computed_px).all() else None
        cells |= {
            f"observed_{name}_px": float(observed_px[k]),
            f"computed_{name}_px": computed,
            f"o_minus_c_{name}_px": None if computed is None else float(observed_px[k]) - computed,
        }
    return cells


def _range_cells(apparent_km: Float, predicted_km: Float, *, ranged: bool) -> dict[str, Any]:
    """Cells of the range, observed and computed."""
    computed = float(np.linalg.norm(predicted_km))
    cells: dict[str, Any] = {"computed_apparent_range_km": computed}
    if ranged:
        observed = float(np.linalg.norm(apparent_km))
        cells |= {"observed_apparent_range_km": observed, "o_minus_c_apparent_range_km": observed - computed}
    return cells


def _turn_cells(turn: BodyTurn | None) -> dict[str, Any]:
    """Cells of the turn of a body about the line of sight."""
    if turn is None:
        return {}
    pixel_px, line_px = turn.center_px.tolist()
    return {
        "turn_rad": turn.turn_rad,
        "turn_pixel_px": pixel_px,
        "turn_line_px": line_px,
        "turn_covariance": _flat(turn.covariance),
        "partial_turn_rotation": _flat(turn.by_rotation),
    }


def _covariance_cells(covariance: Float) -> dict[str, Any]:
    """Cells of a covariance (3, 3) of pixel, line and range, the last of which may be unknown."""
    sigmas = np.sqrt(np.diag(covariance))
    names = ("pixel", "line", "range")
    cells: dict[str, Any] = {"covariance": _flat(covariance)}
    for k, name in enumerate(("sigma_pixel_px", "sigma_line_px", "sigma_range_km")):
        cells[name] = float(sigmas[k]) if np.isfinite(sigmas[k]) else None
    for a, b in ((0, 1), (0, 2), (1, 2)):
        ratio = _ratio(float(covariance[a, b]), float(sigmas[a] * sigmas[b]))
        cells[f"correlation_{names[a]}_{names[b]}"] = ratio
    return cells


def _ratio(value: float, scale: float) -> float | None:
    """Quotient, None where it is not defined."""
    return value / scale if scale > 0.0 and np.isfinite(value) else None


def _pad_covariance(matrix: Float) -> Float:
    """A covariance (3, 3) of pixel, line and range; not a number where there is no range."""
    return np.pad(matrix, (0, 3 - len(matrix)), constant_values=np.nan)


def _padded_rows(matrix: Float) -> Float:
    """Derivatives (3, m) of pixel, line and range; not a number where there is no range."""
    return np.pad(matrix, ((0, 3 - len(matrix)), (0, 0)), constant_values=np.nan)


def _flat(matrix: Float | None) -> list[float] | None:
    """Elements by rows."""
    return None if matrix is None else matrix.ravel().tolist()
