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
_WORST_CONDITION = 1e12
"""Condition number of the information about the three angles beyond which one of them is not determined.

Roll about a body 10 px from the middle, known to a thousandth of its lever, has some 1e8.
"""
_ONE_BY_ONE = (
    Cause.NOISE, Cause.BACKGROUND, Cause.PSF, Cause.EDGE, Cause.REFLECTANCE, Cause.ALBEDO, Cause.RELIEF, Cause.ALTITUDE,
)  # fmt: skip
"""Causes of which only a covariance of each row is known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pointing(Value):
    """Attitude of a camera from bodies, and from what was known of it before.

    Parameters
    ----------
    camera_from_inertial : Rotation
    covariance_rad2 : (3, 3) float64, rad^2, camera axes
        Of the small rotation about the camera axes; the errors of ephemeris, size, pole and camera are in it.
    targets : tuple of str
        Bodies used.
    n_used : int
        Number of bodies and landmarks.
    chi2 : float
        Squared residuals over their covariance; of 2 n_used degrees of freedom with an a priori attitude, of 3 less
        without.
    """

    camera_from_inertial: Rotation
    covariance_rad2: Float
    targets: tuple[str, ...]
    n_used: int
    chi2: float


def pointing_from_bodies(camera: Camera, rows: Sequence[ObservableRow]) -> Pointing | Failure:
    """Attitude of an image from the bodies and landmarks in it.

    Parameters
    ----------
    camera : Camera
    rows : sequence of ObservableRow
        Of one image, with one attitude. The preferred fix of each target is used or, where a target has landmarks,
        they are: two bodies, or landmarks far from each other, give all three angles. The attitude of the rows with
        its covariance is the a priori one; where it is that of stars, stars and bodies are thus taken together.

    Returns
    -------
    Pointing or Failure
        Reasons: ``NO_SIGNAL`` without a body, ``DEGENERATE_GEOMETRY`` where an angle is not determined: one body says
        nothing of the roll about it, and the covariance of the a priori attitude is not known.

    Notes
    -----
    With ``C`` the covariance of all measured places, in which errors of ephemeris, size, pole, spin and camera are
    common to the rows of a body, and ``e`` the small rotation about the camera axes that is looked for, the weighted
    squares of ``o - project(Exp(e) A d)`` and of ``e`` over its a priori covariance are least; ``d`` are the apparent
    directions by the ephemeris.
    """
    used = _used(rows)
    if not used:
        return Failure(Reason.NO_SIGNAL, "no body with a preferred fix and a computed place")
    model, before = camera.model, Rotation.from_quat(_numbers(used[0].camera_from_icrf_xyzw))
    observed = np.array([[row.observed_pixel_px, row.observed_line_px] for row in used])
    computed = np.array([[row.computed_pixel_px, row.computed_line_px] for row in used], dtype=np.float64)
    directions = rotate(before.inv(), model.unproject(computed))
    weights = np.linalg.inv(_covariance(used, camera))
    prior: Float = np.zeros((3, 3))
    if used[0].attitude_covariance_rad2 is not None:
        prior = np.asarray(np.linalg.inv(_numbers(used[0].attitude_covariance_rad2).reshape(3, 3)))
    attitude = before
    for _ in range(_STEPS):
        seen = rotate(attitude, directions)
        design = (-model.project_jacobian(seen) @ skew(seen)).reshape(-1, 3)
        residuals = (observed - model.project(seen)).ravel()
        information = design.T @ weights @ design + prior
        if not np.linalg.cond(information) < _WORST_CONDITION:
            return Failure(
                Reason.DEGENERATE_GEOMETRY,
                f"{len(used)} places do not give all three angles: see another body, use landmarks, or declare the "
                "uncertainty of the a priori attitude (images.attitude_sigma_deg)",
            )
        turned = (attitude * before.inv()).as_rotvec()
        step = np.linalg.solve(information, design.T @ weights @ residuals - prior @ turned)
        attitude = Rotation.from_rotvec(step) * attitude
        if float(np.abs(step).max()) < _SETTLED_RAD:
            break
    covariance = np.linalg.inv(information)
    turned = (attitude * before.inv()).as_rotvec()
    return Pointing(
        camera_from_inertial=attitude,
        covariance_rad2=(covariance + covariance.T) / 2.0,
        targets=tuple(dict.fromkeys(row.target or "" for row in used)),
        n_used=len(used),
        chi2=float(residuals @ weights @ residuals + turned @ prior @ turned),
    )


def _used(rows: Sequence[ObservableRow]) -> list[ObservableRow]:
    """Landmarks that are not suspect, and preferred fixes of the targets without any."""
    known = [row for row in rows if row.computed_pixel_px is not None and row.computed_line_px is not None]
    landmarks = [row for row in known if row.kind == "landmark" and row.status == "ok"]
    with_landmarks = {row.target for row in landmarks}
    bodies = [row for row in known if row.kind == "body" and row.preferred and row.target not in with_landmarks]
    return bodies + landmarks


def _covariance(rows: Sequence[ObservableRow], camera: Camera) -> Float:
    """Covariance (2n, 2n) of the measured places less the computed ones, px^2, without the attitude."""
    total: Float = np.asarray(block_diag(*(_own(row) for row in rows)), dtype=np.float64)
    known = camera.uncertainty
    if known is not None and known.estimated:
        by_camera = np.vstack([_rows_of(row.partial_camera_parameters, len(known.estimated)) for row in rows])
        total = total + by_camera @ known.covariance @ by_camera.T
    for target in dict.fromkeys(row.target for row in rows):
        chosen = [row if row.target == target else None for row in rows]
        sigmas = next(row for row in rows if row.target == target)
        for name, size, sigma in (
            ("partial_target_position", 3, sigmas.sigma_ephemeris_km),
            ("partial_shape_scale", 1, sigmas.sigma_shape_scale),
            ("partial_pole", 2, sigmas.sigma_pole_rad),
            ("partial_spin", 1, sigmas.sigma_spin_rad),
        ):
            if sigma:
                by_cause = np.vstack([_rows_of(getattr(row, name, None), size) for row in chosen])
                total = total + sigma**2 * by_cause @ by_cause.T
    return total


def _own(row: ObservableRow) -> Float:
    """Covariance (2, 2) of a place by what is its own, px^2."""
    parts = (getattr(row, f"part_{cause}") for cause in _ONE_BY_ONE)
    return np.asarray(
        sum((_numbers(part).reshape(3, 3)[:2, :2] for part in parts if part is not None), np.zeros((2, 2)))
    )


def _rows_of(partial: Sequence[float] | None, size: int) -> Float:
    """Derivatives (2, size) of pixel and line; zero where there are none."""
    return np.zeros((2, size)) if partial is None else _numbers(partial).reshape(3, size)[:2]


def _numbers(values: object) -> Float:
    return np.asarray(values, dtype=np.float64)
