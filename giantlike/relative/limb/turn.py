"""Rotation of a body about the line of sight, and its position, from its limb; it gives the roll of a camera.

The fix of a limb uses the declared orientation of the body, and leaves the effect of a rotation in the residuals. Here
the rotation is one more parameter, and the measurement of the limb is iterated to convergence.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, unit
from giantlike.core.causes import Cause, add_parts, sum_parts
from giantlike.core.outcomes import BodyTurn, Failure
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import robust_solution, solution_gain
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.relative.limb.fix import IteratedSearch, next_motion_px
from giantlike.relative.limb.solution import weight_points
from giantlike.relative.place import place_jacobian

_LEAST_LEVER = 1e-3
"""Minimum RMS motion of an outline by a rotation that a shift does not explain, radii per rad. Below it the outline is
round: its rotation is known to some degrees at best, within the errors of the normals of a mesh."""
_MOST_SIGMA_RAD = 0.3  # maximum standard deviation of a measured rotation, up to which outlines are linear in it


def limb_turn(
    measured: LimbMeasurement,
    again: Callable[[Float, Float], LimbMeasurement | Failure],
    camera: Camera,
    radius_px: float,
    *,
    search: IteratedSearch,
    min_length_px: float,
) -> BodyTurn | None:
    """Estimate the rotation of a body about the line of sight together with its position.

    Returns None where the outline is too round, or the iteration does not converge.
    """
    axis, turn_rad, before_px = unit(measured.position_camera_km), 0.0, math.inf
    for _ in range(search.max_iterations):
        step = _solve_step(measured, camera, radius_px, outlier_mad=search.outlier_mad, min_length_px=min_length_px)
        if step is None:
            return None
        turn_rad += step.found.turn_rad
        if next_motion_px(before_px, step.moved_px) < search.tolerance_px:
            return replace(step.found, turn_rad=turn_rad)
        before_px = step.moved_px
        remeasured = again(step.position_camera_km, turn_rad * axis)
        if isinstance(remeasured, Failure):
            return None
        measured = remeasured
    return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Step(Value):
    """Step by one measurement: position (3,), km, rotation, and the motion of the limb by the rotation, px."""

    position_camera_km: Float
    found: BodyTurn
    moved_px: float


def _solve_step(
    measured: LimbMeasurement, camera: Camera, radius_px: float, *, outlier_mad: float, min_length_px: float
) -> _Step | None:
    """Solve for position and rotation; None where the outline is too round.

    A limb point that slides along the surface as the body rotates slides along the limb too, so that to first order
    only its own motion counts across the limb.
    """
    by_rotation = measured.rotation_design
    if by_rotation is None:
        return None
    by_turn = by_rotation @ unit(measured.position_camera_km)
    design = np.concatenate([measured.design, by_turn[:, None]], axis=1)
    # Outliers are found with position and rotation free, so that points shifted by the rotation are kept.
    keep = robust_solution(measured.shift_px, design, measured.sigma_px, outlier_mad=outlier_mad)[1]
    measured, design, by_rotation = replace(measured, keep=keep), design[keep], by_rotation[keep]
    lever_px = design[:, 3] - design[:, :3] @ (measured.even_gain @ design[:, 3])
    lever_rms_px = float(np.sqrt(np.mean(lever_px**2)))
    if lever_rms_px < _LEAST_LEVER * radius_px:
        return None
    solved = weight_points(measured, design, radius_px, min_length_px=min_length_px)
    gain = solved.gain @ solved.means
    step = gain @ measured.shift_px[keep]
    even_gain = solution_gain(design, np.zeros((0, 0)), weights=np.ones(len(design)))
    covariance = sum_parts(add_parts(solved.own, measured.smooth_covariances(even_gain)), tuple(Cause))
    covariance[3, 3] += _camera_variance(measured, camera, gain[3])
    if not covariance[3, 3] < _MOST_SIGMA_RAD**2:
        return None
    position_km = measured.position_camera_km + step[:3]
    by_solution = np.zeros((3, 4))
    by_solution[:2, :3], by_solution[2, 3] = place_jacobian(camera.model, position_km)[:2], 1.0
    covariance = by_solution @ covariance @ by_solution.T
    found = BodyTurn(
        turn_rad=float(step[3]),
        center_px=camera.model.project(position_km),
        covariance=(covariance + covariance.T) / 2.0,
        by_rotation=by_solution @ gain @ by_rotation,
    )
    return _Step(position_camera_km=position_km, found=found, moved_px=abs(float(step[3])) * lever_rms_px)


def _camera_variance(measured: LimbMeasurement, camera: Camera, gain: Float) -> float:
    """Variance, by the camera model, of the shifts of the kept points multiplied by a gain (m,)."""
    known, model = camera.uncertainty, camera.model
    if known is None or not known.estimated:
        return 0.0
    keep, names = measured.keep, model.parameter_names
    chosen = [names.index(name) for name in known.estimated]
    by_parameters = model.parameter_jacobian(model.unproject(measured.predicted_px[keep]))[:, :, chosen]
    response = gain @ np.einsum("ni,nik->nk", measured.normals_px[keep], by_parameters)
    return float(response @ known.covariance @ response)
