"""Error budget of a fix: errors of its inputs, propagated by the response of the fix.

The camera model, the attitude, the scale of the shape, the orientation of the body and its ephemeris are inputs of an
estimator with declared uncertainties. Every cause adds a separate part to the fix. Where the response has no closed
form, it is a numerical derivative: the body is moved by one sigma or half a pixel, whichever is more, and the fix
recomputed on the same pixels, so that the noise cancels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel, ifov_rad
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.frames import rotate, skew
from giantlike.core.outcomes import AttitudeErrors, CenterFix, Failure, PositionFix
from giantlike.core.statistics import excess
from giantlike.image import Image
from giantlike.relative.place import apparent_radius_px, place_jacobian
from giantlike.scene import TargetGeometry
from giantlike.shapes import Ellipsoid

AnyFix = TypeVar("AnyFix", bound=CenterFix)

_OUTLINE_POINTS = 72
"""Points of an outline over which a distortion is averaged, every 5 deg: distortions are smooth polynomials."""
_LEAST_RADIUS_PX = 1.0
"""Radius of the circle used for a body without a usable outline, px: it gives the scale of the camera there."""
_TURNED = 0.2
"""Minimum ratio of the motion of the surface by the attitude error to the smallest sigma of the center to propagate it.

In 44 views of the gauntlet (seed 4000, all three axes) fixes move by a median of 0.16 to 0.25 of that motion and at
most 0.84, those of ``moment`` by 0.7 and 1.1, so that a sigma without it is at most 2 % too small; ``moment`` of two
crescents moves 6 to 11 times as far. With attitudes from stars the ratio is below 0.14 in 26 fixes of the
demonstration.
"""
STRAIN_TENSION = "strain_tension"
"""Name of the factor by which variances of a limb are too small for a strain of the outline, among the checks."""
DECLARED = (Cause.POLE, Cause.SPIN, Cause.SUN, Cause.ORIENTATION)
"""Causes of the declared errors of the orientation of the body and of its Sun."""
_LEAST_STEP_PX = 0.5
"""Minimum motion of the surface, px, for a derivative by a rotation: errors of renders and convergence, some hundredths
of a pixel, are then a few percent of it."""
_MOST_STEP_RAD = 0.01
"""Largest such rotation where the declared error is smaller: up to it illumination is linear in the rotation."""
_AXES = 6  # of an icosahedron
_WORST_CONDITION = 100.0
"""Maximum condition number of an arc of an outline to separate center and radius: 30 deg of a circle have about 60, and
a shorter arc amplifies any distortion of the camera without limit."""


def with_budget(
    fix: AnyFix,
    image: Image,
    camera: Camera,
    geometry: TargetGeometry,
    motion: Callable[[TargetGeometry], Float | Failure],
    *,
    by_outline: bool = False,
) -> AnyFix | Failure:
    """Add the causes of error that an estimator cannot see in its image to a fix.

    Causes that the fix already has are kept. An attitude from stars is correlated with the errors of its camera, so
    that the direction of a body in inertial axes is less affected than in camera axes: the part ``CAMERA`` is the
    former, ``covariance_camera_km2`` contains the latter. A poorly known attitude also rotates body and Sun in camera
    axes, which moves the fix: the part ``ORIENTATION``. The sigmas are ``camera.uncertainty``,
    ``image.attitude_covariance_rad2`` and ``geometry.target.uncertainty``; one that is not given adds nothing. An
    outline does not move with the Sun, which only says where it is lit: other points of the limb would scatter with
    any Sun. A rotation of the body that is estimated from the image leaves nothing of the declared errors of pole and
    spin; one that the residuals only suggest counts as far as it exceeds these.
    """
    size = 3 if isinstance(fix, PositionFix) else 2
    model = camera.model
    position_km = (
        fix.position_camera_km if isinstance(fix, PositionFix) else model.unproject(fix.center_px) * geometry.range_km
    )
    place_per_km = place_jacobian(model, position_km)
    parts = dict(fix.parts) or {Cause.NOISE: _own_covariance(fix, place_per_km)}
    estimated, undeclared = fix.corrections.turn is not None, np.zeros((size, size))
    if not estimated:
        undeclared = parts.pop(Cause.SPIN, undeclared)
    missing = set(Cause) - set(parts) - ({Cause.POLE, Cause.SPIN} if estimated else set())
    radius_px = apparent_radius_px(camera, fix.center_px, geometry.target.shape.mean_radius_km, geometry.range_km)
    least_rad = _least_step_rad(radius_px)
    by_body = _body_partials(fix, geometry, motion, least_rad, missing=missing, by_outline=by_outline)
    if isinstance(by_body, Failure):
        return by_body
    body = _body_parts(by_body, geometry)
    if geometry.target.uncertainty.pole_unknown and Cause.POLE in missing:
        unknown = _unknown_pole_part(geometry, motion, size)
        if isinstance(unknown, Failure):
            return unknown
        body[Cause.POLE] = unknown
    if Cause.ORIENTATION not in parts and image.attitude_covariance_rad2 is not None:
        turned = _orientation_part(fix, image.attitude_covariance_rad2, geometry, motion, radius_px)
        if isinstance(turned, Failure):
            return turned
        body[Cause.ORIENTATION] = turned
    if undeclared.any():
        declared = sum_parts({Cause.SPIN: np.zeros((size, size)), **body}, (Cause.POLE, Cause.SPIN))
        beyond = excess(declared, undeclared) if declared.any() else undeclared
        body[Cause.SPIN] = body.get(Cause.SPIN, 0.0) + beyond
    turn = (place_per_km @ -skew(position_km))[:size]
    partials = by_body | {Cause.ATTITUDE: turn}
    added, in_camera = (
        body | _attitude_parts(image, camera, turn),
        sum_parts({**body, Cause.NOISE: -undeclared}),
    )
    known = camera.uncertainty
    if known is not None and known.estimated and Cause.CAMERA not in parts:
        radius_km = geometry.target.shape.mean_radius_km
        response = camera_response(camera, position_km, radius_km, geometry.sun_direction_camera, size=size)
        in_camera = in_camera + _propagate(response, known.covariance)
        partials[Cause.CAMERA] = response + turn @ _d_attitude_d_camera(image, camera)
        added[Cause.CAMERA] = _propagate(partials[Cause.CAMERA], known.covariance)
    if geometry.target.uncertainty.ephemeris_km > 0.0:
        added[Cause.EPHEMERIS] = _propagate(place_per_km[:size], geometry.covariance_ephemeris_km2)
    new = {cause: part for cause, part in added.items() if cause not in parts}
    changes: dict[str, object] = {"parts": parts | new, "partials": partials | dict(fix.partials)}
    if body:
        changes["covariance_px2"] = fix.covariance_px2 + (sum_parts(body) - undeclared)[:2, :2]
    if isinstance(fix, PositionFix) and in_camera.any():
        added_km2 = position_covariance(model, position_km, in_camera)
        changes["covariance_camera_km2"] = fix.covariance_camera_km2 + added_km2
    return replace(fix, **changes)  # type: ignore[arg-type]


def with_larger_errors(fix: AnyFix, model: CameraModel, factor: float, causes: Iterable[Cause]) -> AnyFix:
    """Return a fix with larger errors by some causes, unless the declared errors of its body cover them.

    With the covariance ``own`` of the causes, the sum of its parts is at least ``factor * own``, and at least ``own``
    and the parts of pole, spin and orientation.
    """
    if factor == 1.0:
        return fix
    if not fix.parts:
        return replace(fix, covariance_px2=factor * fix.covariance_px2)
    own = {cause: fix.parts[cause] for cause in causes if cause in fix.parts and cause not in DECLARED}
    if not own:
        return fix
    total = sum_parts(own, own)
    declared = sum_parts(fix.parts, DECLARED)
    if declared.any():
        added, whole = excess(declared, (factor - 1.0) * total), np.trace(total[:2, :2])
        grown = {cause: part + np.trace(part[:2, :2]) / whole * added for cause, part in own.items()}
    else:
        added, grown = (factor - 1.0) * total, {cause: factor * part for cause, part in own.items()}
    parts = {**fix.parts, **grown}
    changes: dict[str, object] = {"parts": parts, "covariance_px2": fix.covariance_px2 + added[:2, :2]}
    if isinstance(fix, PositionFix):
        added_km2 = position_covariance(model, fix.position_camera_km, added)
        changes["covariance_camera_km2"] = fix.covariance_camera_km2 + added_km2
    return replace(fix, **changes)  # type: ignore[arg-type]


def with_error(fix: AnyFix, model: CameraModel, cause: Cause, covariance: Float) -> AnyFix:
    """Return a fix with one more error.

    ``covariance`` (k, k), of x, y in px and, of a position, of the natural logarithm of the range.
    """
    parts = {**fix.parts, cause: fix.parts.get(cause, np.zeros_like(covariance)) + covariance}
    changes: dict[str, object] = {"parts": parts, "covariance_px2": fix.covariance_px2 + covariance[:2, :2]}
    if isinstance(fix, PositionFix):
        added_km2 = position_covariance(model, fix.position_camera_km, covariance)
        changes["covariance_camera_km2"] = fix.covariance_camera_km2 + added_km2
    return replace(fix, **changes)  # type: ignore[arg-type]


def place_difference(one: CenterFix, other: CenterFix) -> Float:
    """Difference of the positions of two fixes: x and y, px, and the logarithm of the range where it is estimated."""
    center_px = one.center_px - other.center_px
    if isinstance(one, PositionFix) and isinstance(other, PositionFix):
        return np.append(center_px, math.log(one.range_km / other.range_km))
    return center_px


def position_covariance(model: CameraModel, position_camera_km: Float, covariance: Float) -> Float:
    """Covariance of a position in space from an image covariance, such as a sum of the parts of a fix.

    ``covariance``: of x, y in px and of the natural logarithm of the range; returns (3, 3) km^2, camera axes.
    """
    km_per_place = np.asarray(np.linalg.inv(place_jacobian(model, position_camera_km)), dtype=np.float64)
    return _propagate(km_per_place, covariance)


def camera_response(
    camera: Camera, position_camera_km: Float, radius_km: float, sun_direction_camera: Float, *, size: int
) -> Float:
    """Derivative of the position of a body by each parameter of the camera.

    A change of the camera shifts each point of the outline; the position follows from a fit of the outline of a sphere,
    where lit and in the frame, to the normal components of these shifts. If too little of the body is seen, a small
    circle around its center is used.

    Returns (size, k), of x, y in px and of the natural logarithm of the range, per unit of each parameter.
    """
    assert camera.uncertainty is not None
    model = camera.model
    names = model.parameter_names
    chosen = [names.index(name) for name in camera.uncertainty.estimated]
    range_km = float(np.linalg.norm(position_camera_km))
    axis = position_camera_km / range_km
    half_angle = math.asin(min(radius_km / range_km, 1.0))
    rays, outward = _circle(axis, half_angle)
    lit = outward @ sun_direction_camera >= 0.0
    seen = lit & np.nan_to_num(camera.contains(model.project(rays))).astype(bool)
    response = _fit_motion(model, chosen, axis, half_angle, (rays[seen], outward[seen]), size)
    if response is None:
        nearest_px = np.clip(model.project(axis), -0.5, [camera.columns - 0.5, camera.rows - 0.5])
        axis = model.unproject(nearest_px)
        half_angle = _LEAST_RADIUS_PX * float(ifov_rad(model, nearest_px))
        response = _fit_motion(model, chosen, axis, half_angle, _circle(axis, half_angle), size)
        assert response is not None
    return response


def _fit_motion(
    model: CameraModel, chosen: list[int], axis: Float, half_angle: float, outline: tuple[Float, Float], size: int
) -> Float | None:
    """Motion (size, k) of a circle of rays fitted to the shifts of its points; None where the arc is too short."""
    rays, outward = outline
    if len(rays) < size:
        return None
    per_ray = model.project_jacobian(rays)
    normals = np.einsum("nij,nj->ni", per_ray, outward)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    per_px = model.unproject_jacobian(model.project(axis))
    # Rays turn with the axis: by axis x d(axis) for each pixel that the center moves.
    turned = np.stack([np.cross(np.cross(axis, per_px[:, k]), rays) for k in (0, 1)], axis=-1)
    grown = -math.tan(half_angle) * outward[:, :, None]
    moved = np.einsum("ni,nij,njk->nk", normals, per_ray, np.concatenate([turned, grown], axis=2)[:, :, :size])
    shifted = np.einsum("ni,nik->nk", normals, model.parameter_jacobian(rays)[:, :, chosen])
    scale = np.linalg.norm(moved, axis=0)
    if not np.isfinite(scale).all() or np.linalg.cond(moved / scale) > _WORST_CONDITION:
        return None
    solution: Float = np.linalg.lstsq(moved / scale, shifted, rcond=None)[0] / scale[:, None]
    return solution


def _circle(axis: Float, half_angle: float) -> tuple[Float, Float]:
    """Unit rays (n, 3) at an angle from an axis, and the directions (n, 3) away from the axis across them."""
    angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_POINTS, endpoint=False)[:, None]
    around = np.hstack([np.cos(angles), np.sin(angles)]) @ _across(axis)
    cosine, sine = math.cos(half_angle), math.sin(half_angle)
    return cosine * axis + sine * around, cosine * around - sine * axis


def attitude_parts_rad2(covariance_rad2: Float | None, errors: AttitudeErrors, camera: Camera) -> dict[Cause, Float]:
    """Covariance of an attitude by cause, without errors shared with the camera and with other attitudes.

    ``covariance_rad2``: of the small rotation about the camera axes; returns dict of Cause to (3, 3) rad^2, empty where
    it is unknown.
    """
    if covariance_rad2 is None:
        return {}
    if camera.uncertainty is not None:
        covariance_rad2 = errors.apart_from_camera(covariance_rad2)
    apart = {cause: errors.parts[cause] for cause in (Cause.ABERRATION, Cause.EPOCH) if cause in errors.parts}
    return {Cause.ATTITUDE: covariance_rad2 - (sum_parts(apart, apart) if apart else 0.0), **apart}


def _attitude_parts(image: Image, camera: Camera, turn: Float) -> dict[Cause, Float]:
    """Parts of the attitude by the derivative of the position by a rotation of the camera."""
    parts = attitude_parts_rad2(image.attitude_covariance_rad2, image.attitude_errors, camera)
    return {cause: _propagate(turn, part) for cause, part in parts.items()}


def _d_attitude_d_camera(image: Image, camera: Camera) -> Float:
    """Derivative (3, k) of the attitude by the uncertain parameters of the camera; zero where it is not from stars."""
    assert camera.uncertainty is not None
    names, by_camera = camera.model.parameter_names, image.attitude_errors.by_camera
    if by_camera is None or by_camera.shape[1] != len(names):
        return np.zeros((3, len(camera.uncertainty.estimated)))
    return by_camera[:, [names.index(name) for name in camera.uncertainty.estimated]]


def _body_partials(
    fix: CenterFix,
    geometry: TargetGeometry,
    motion: Callable[[TargetGeometry], Float | Failure],
    least_rad: float,
    *,
    missing: set[Cause],
    by_outline: bool,
) -> dict[Cause, Float] | Failure:
    """Derivatives (k, m) of the position by the true scale, pole, spin and Sun of the body, where missing.

    The scale is relative; pole and spin are small rotations of the body about its axes, rad, and the Sun is a small
    rotation of its direction about the camera axes (k, 3).
    """
    size = 3 if isinstance(fix, PositionFix) else 2
    columns = dict[Cause, list[Float]]()
    if size == 3 and Cause.SHAPE_SCALE in missing:
        # A body scaled in size and distance alike gives the same image.
        columns[Cause.SHAPE_SCALE] = [np.array([0.0, 0.0, -1.0])]
    for cause, step, moved in _moved_bodies(geometry, least_rad):
        if cause not in missing or (cause is Cause.SHAPE_SCALE and size == 3):
            continue
        shift = np.zeros(size) if by_outline and cause is Cause.SUN else _response(moved, motion)
        if isinstance(shift, Failure):
            return Failure(shift.reason, f"no fix with the {cause} of the body off by one sigma: {shift.detail}")
        columns.setdefault(cause, []).append(-shift / step)
    partials = {cause: np.stack(each, axis=1) for cause, each in columns.items()}
    if Cause.SUN in partials:
        partials[Cause.SUN] = partials[Cause.SUN] @ _across(geometry.sun_direction_camera)
    return partials


def _body_parts(partials: Mapping[Cause, Float], geometry: TargetGeometry) -> dict[Cause, Float]:
    """Parts by scale, orientation and Sun of the body, where these are not declared exact."""
    known = geometry.target.uncertainty
    sigmas = {
        Cause.SHAPE_SCALE: known.scale,
        Cause.POLE: known.pole_rad,
        Cause.SPIN: known.spin_rad,
        Cause.SUN: known.sun_rad,
    }
    return {
        cause: _propagate(partial, sigmas[cause] ** 2 * np.eye(partial.shape[1]))
        for cause, partial in partials.items()
        if sigmas[cause] > 0.0
    }


def _moved_bodies(
    geometry: TargetGeometry, least_rad: float
) -> Iterator[tuple[Cause, float, tuple[TargetGeometry, TargetGeometry]]]:
    """Yield each independent error of the body, the step for its derivative, and the geometry at plus and minus it."""
    known = geometry.target.uncertainty
    if known.scale > 0.0:
        nearer, farther = (geometry.position_camera_km / (1.0 + sign * known.scale) for sign in (1, -1))
        yield (
            Cause.SHAPE_SCALE,
            known.scale,
            (replace(geometry, position_camera_km=nearer), replace(geometry, position_camera_km=farther)),
        )
    sigmas_rad = ((Cause.POLE, known.pole_rad), (Cause.POLE, known.pole_rad), (Cause.SPIN, known.spin_rad))
    for axis, (cause, sigma_rad) in zip(np.eye(3), sigmas_rad, strict=True):
        if sigma_rad > 0.0:
            step_rad = max(sigma_rad, least_rad)
            turn = Rotation.from_rotvec(step_rad * axis)
            before = geometry.camera_from_body
            yield (
                cause,
                step_rad,
                (
                    replace(geometry, camera_from_body=before * turn),
                    replace(geometry, camera_from_body=before * turn.inv()),
                ),
            )
    sun = geometry.sun_direction_camera
    for axis in _across(sun) if known.sun_rad > 0.0 else ():
        step_rad = max(known.sun_rad, least_rad)
        plus, minus = (rotate(Rotation.from_rotvec(sign * step_rad * axis), sun) for sign in (1.0, -1.0))
        yield (
            Cause.SUN,
            step_rad,
            (replace(geometry, sun_direction_camera=plus), replace(geometry, sun_direction_camera=minus)),
        )


def _across(direction: Float) -> Float:
    """Two orthogonal unit vectors (2, 3) perpendicular to a direction (3,)."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _unknown_pole_part(
    geometry: TargetGeometry, motion: Callable[[TargetGeometry], Float | Failure], size: int
) -> Float | Failure:
    """Mean square motion of the position over the orientations of a body that is nearly a sphere.

    To first order in the flattening, the outline depends on products of two components of the pole, whose means over
    all directions are those over the six axes of an icosahedron. The declared orientation is one of the six.
    """
    shape = geometry.target.shape
    part = np.zeros((size, size))
    if not isinstance(shape, Ellipsoid) or np.ptp(shape.radii_km) == 0.0:
        return part
    for turn in _icosahedron()[1:]:
        shift = motion(replace(geometry, camera_from_body=geometry.camera_from_body * turn))
        if isinstance(shift, Failure):
            return Failure(shift.reason, f"no fix with another pole of the body, which is unknown: {shift.detail}")
        part += np.outer(shift, shift) / _AXES
    return part


@cache
def _icosahedron() -> tuple[Rotation, ...]:
    """Rotations of the z axis to the six axes of an icosahedron through its vertices, the first none."""
    polar, steps = math.atan(2.0), range(_AXES - 1)
    tilted = (Rotation.from_euler("yz", [polar, math.tau * step / len(steps)]) for step in steps)
    return Rotation.identity(), *tilted


def _orientation_part(
    fix: CenterFix,
    covariance_rad2: Float,
    geometry: TargetGeometry,
    motion: Callable[[TargetGeometry], Float | Failure],
    radius_px: float,
) -> Float | Failure:
    """Covariance of the position by an attitude error that rotates body and Sun in camera axes."""
    size = 3 if isinstance(fix, PositionFix) else 2
    part = np.zeros((size, size))
    variances, axes = np.linalg.eigh(covariance_rad2)
    least_rad = _TURNED * math.sqrt(max(float(np.linalg.eigvalsh(fix.covariance_px2)[0]), 0.0)) / max(radius_px, 1e-300)
    for sigma_rad, axis in zip(np.sqrt(np.clip(variances, 0.0, None)), axes.T, strict=True):
        if sigma_rad < least_rad:
            continue
        step_rad = max(sigma_rad, _least_step_rad(radius_px))
        turns = [Rotation.from_rotvec(sign * step_rad * axis) for sign in (1.0, -1.0)]
        plus, minus = (
            replace(
                geometry,
                camera_from_body=turn * geometry.camera_from_body,
                sun_direction_camera=rotate(turn, geometry.sun_direction_camera),
            )
            for turn in turns
        )
        shift = _response((plus, minus), motion)
        if isinstance(shift, Failure):
            return Failure(shift.reason, f"no fix with the attitude off by one sigma: {shift.detail}")
        part += (sigma_rad / step_rad) ** 2 * np.outer(shift, shift)
    return part


def _response(
    moved: tuple[TargetGeometry, TargetGeometry], motion: Callable[[TargetGeometry], Float | Failure]
) -> Float | Failure:
    """Motion of the position with the body moved one step ahead; where that fails, minus that with one step back."""
    ahead = motion(moved[0])
    if not isinstance(ahead, Failure):
        return ahead
    back = motion(moved[1])
    return back if isinstance(back, Failure) else -back


def _least_step_rad(radius_px: float) -> float:
    """Smallest rotation by which derivatives are taken."""
    return min(_LEAST_STEP_PX / max(radius_px, 1e-300), _MOST_STEP_RAD)


def _own_covariance(fix: CenterFix, place_per_km: Float) -> Float:
    """Covariance reported by the estimator, as a part."""
    if isinstance(fix, PositionFix):
        return _propagate(place_per_km, fix.covariance_camera_km2)
    return fix.covariance_px2


def _propagate(jacobian: Float, covariance: Float) -> Float:
    """Covariance through a linear map, symmetric to the last digit."""
    result: Float = jacobian @ covariance @ jacobian.T
    return (result + result.T) / 2.0
