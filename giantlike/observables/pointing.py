"""Attitudes from bodies: the ephemeris is trusted, and the camera turned until the bodies lie where they were seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate, skew
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.io.observables_file import ObservableRow

_STEPS = 10
_SETTLED_RAD = 1e-12  # of a step: below the rounding of unit vectors times a focal length in px
_WORST_CONDITION = 1e12  # condition number of the information about three angles that fails to determine one
_ONE_BY_ONE = (
    Cause.NOISE, Cause.BACKGROUND, Cause.PSF, Cause.EDGE, Cause.REFLECTANCE, Cause.ALBEDO, Cause.RELIEF, Cause.ALTITUDE,
    Cause.SUN, Cause.ORIENTATION,
)  # fmt: skip
"""Causes of which only a covariance of each row is known."""
_BODY_AXES = {"partial_pole": slice(0, 2), "partial_spin": slice(2, 3)}
"""Axes of a body about which an error of its pole, and of its spin, rotates it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pointing(Value):
    """Attitude of a camera from bodies and the a priori attitude."""

    camera_from_inertial: Rotation
    # in camera axes; of the small rotation about the camera axes; the errors of ephemeris, size, pole and camera are in
    # it
    covariance_rad2: Float
    targets: tuple[str, ...]  # bodies used
    n_used: int  # number of bodies and landmarks
    n_turns: int  # number of bodies whose turn about the line of sight was measured
    # squared residuals over their covariance; of 2 n_used + n_turns degrees of freedom with an a priori attitude, of 3
    # less without
    chi2: float


def pointing_from_bodies(camera: Camera, rows: Sequence[ObservableRow]) -> Pointing | Failure:
    """Attitude of an image from the bodies and landmarks in it.

    With ``C`` the covariance of all measured places, in which errors of ephemeris, size, pole, spin and camera are
    common to the rows of a body, and ``e`` the small rotation about the camera axes, the weighted squares of ``o -
    project(Exp(e) A d)``, ``d`` the apparent directions by the ephemeris, and of ``e`` over its a priori covariance are
    least. A turn, and the place found with it, follow ``e`` by their derivatives by a rotation of the body.
    """
    choices = [_select_used(rows, turned=turned) for turned in (False, True)]
    found = [_pointing(camera, used) for used in choices if used]
    if not found:
        return Failure(Reason.NO_SIGNAL, "no body with a preferred fix and a computed place")
    attitudes = [one for one in found if isinstance(one, Pointing)]
    return min(attitudes, key=lambda one: float(np.trace(one.covariance_rad2))) if attitudes else found[0]


def _pointing(camera: Camera, used: Sequence[_Measured]) -> Pointing | Failure:
    """Attitude by least squares."""
    model, before = camera.model, Rotation.from_quat(_numbers(used[0].row.camera_from_icrf_xyzw))
    computed = np.array([[one.row.computed_pixel_px, one.row.computed_line_px] for one in used], dtype=np.float64)
    directions = rotate(before.inv(), model.unproject(computed))
    measured = np.concatenate([one.measured for one in used])
    by_rotation = np.concatenate([one.by_rotation for one in used])
    in_image = np.concatenate([np.arange(one.measured.size) < 2 for one in used])
    weights = np.linalg.inv(_covariance(used, camera))
    prior: Float = np.zeros((3, 3))
    if used[0].row.attitude_covariance_rad2 is not None:
        prior = np.asarray(np.linalg.inv(_numbers(used[0].row.attitude_covariance_rad2).reshape(3, 3)))
    attitude = before
    for _ in range(_STEPS):
        seen = rotate(attitude, directions)
        turned = (attitude * before.inv()).as_rotvec()
        design, residuals = by_rotation.copy(), measured - by_rotation @ turned
        design[in_image] += (-model.project_jacobian(seen) @ skew(seen)).reshape(-1, 3)
        residuals[in_image] -= model.project(seen).ravel()
        information = design.T @ weights @ design + prior
        if not np.linalg.cond(information) < _WORST_CONDITION:
            return Failure(
                Reason.DEGENERATE_GEOMETRY,
                f"{len(used)} places do not give all three angles: see another body, use landmarks or the limb of one "
                "that is not round, or declare the uncertainty of the a priori attitude (images.attitude_sigma_deg)",
            )
        step = np.linalg.solve(information, design.T @ weights @ residuals - prior @ turned)
        attitude = Rotation.from_rotvec(step) * attitude
        if float(np.abs(step).max()) < _SETTLED_RAD:
            break
    covariance = np.linalg.inv(information)
    turned = (attitude * before.inv()).as_rotvec()
    return Pointing(
        camera_from_inertial=attitude,
        covariance_rad2=(covariance + covariance.T) / 2.0,
        targets=tuple(dict.fromkeys(one.row.target or "" for one in used)),
        n_used=len(used),
        n_turns=int((~in_image).sum()),
        chi2=float(residuals @ weights @ residuals + turned @ prior @ turned),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Measured(Value):
    """Pixel and line, and turn if any, of a row, k numbers; ``by_rotation`` (k, 3) by the rotation of a turned body."""

    row: ObservableRow
    measured: Float
    own: Float
    by_rotation: Float

    @classmethod
    def from_row(cls, row: ObservableRow) -> _Measured:
        """Take them from a row; of a landmark, and of a body without a turn, pixel and line alone."""
        if row.turn_rad is None:
            place = _numbers([row.observed_pixel_px, row.observed_line_px])
            return cls(row=row, measured=place, own=_own(row), by_rotation=np.zeros((2, 3)))
        return cls(
            row=row,
            measured=_numbers([row.turn_pixel_px, row.turn_line_px, row.turn_rad]),
            own=_numbers(row.turn_covariance).reshape(3, 3),
            by_rotation=_numbers(row.partial_turn_rotation).reshape(3, 3),
        )

    def partial(self, name: str, size: int) -> Float:
        """Derivatives (k, size) by what a column is named after; zero where there are none."""
        if self.row.turn_rad is not None and name in _BODY_AXES:
            turn = Rotation.from_quat(_numbers(self.row.camera_from_icrf_xyzw))
            camera_from_body = turn * Rotation.from_quat(_numbers(self.row.icrf_from_body_xyzw))
            return self.by_rotation @ camera_from_body.as_matrix()[:, _BODY_AXES[name]]
        values, result = getattr(self.row, name, None), np.zeros((self.measured.size, size))
        if values is not None:
            result[:2] = _numbers(values).reshape(3, size)[:2]
        return result


def _select_used(rows: Sequence[ObservableRow], *, turned: bool) -> list[_Measured]:
    """Usable landmarks; of the targets without any, the preferred fix, or rather one with a turn."""
    known = [row for row in rows if row.computed_pixel_px is not None and row.computed_line_px is not None]
    landmarks = [row for row in known if row.kind == "landmark" and row.is_usable]
    with_landmarks = {row.target for row in landmarks}
    bodies: dict[str | None, ObservableRow] = {}
    for row in sorted(known, key=lambda row: (turned and row.turn_rad is None, not row.preferred)):
        good = row.preferred or (turned and row.turn_rad is not None and row.is_usable)
        if row.kind == "body" and good and row.target not in with_landmarks:
            bodies.setdefault(row.target, row)
    return [_Measured.from_row(row) for row in [*bodies.values(), *landmarks]]


def _covariance(used: Sequence[_Measured], camera: Camera) -> Float:
    """Covariance (m, m) of all that was measured less what is computed, without the attitude."""
    total: Float = np.asarray(block_diag(*(one.own for one in used)), dtype=np.float64)
    known = camera.uncertainty
    if known is not None and known.estimated:
        by_camera = np.vstack([one.partial("partial_camera_parameters", len(known.estimated)) for one in used])
        total = total + by_camera @ known.covariance @ by_camera.T
    for target in dict.fromkeys(one.row.target for one in used):
        sigmas = next(one.row for one in used if one.row.target == target)
        if sigmas.covariance_ephemeris_icrf_km2 is not None:
            by_place = np.vstack(
                [(one.row.target == target) * one.partial("partial_target_position", 3) for one in used]
            )
            total = total + by_place @ _numbers(sigmas.covariance_ephemeris_icrf_km2).reshape(3, 3) @ by_place.T
        for name, size, sigma in (
            ("partial_shape_scale", 1, sigmas.sigma_shape_scale),
            ("partial_pole", 2, sigmas.sigma_pole_rad),
            ("partial_spin", 1, sigmas.sigma_spin_rad),
        ):
            if sigma:
                by_cause = np.vstack([(one.row.target == target) * one.partial(name, size) for one in used])
                total = total + sigma**2 * by_cause @ by_cause.T
    return total


def _own(row: ObservableRow) -> Float:
    """Covariance (2, 2) of a place by what is its own, px^2."""
    # An unknown pole has a part, but no sigma and no derivative.
    causes = _ONE_BY_ONE if row.sigma_pole_rad else (*_ONE_BY_ONE, Cause.POLE)
    parts = (getattr(row, f"part_{cause}") for cause in causes)
    return np.asarray(
        sum((_numbers(part).reshape(3, 3)[:2, :2] for part in parts if part is not None), np.zeros((2, 2)))
    )


def _numbers(values: object) -> Float:
    return np.asarray(values, dtype=np.float64)
