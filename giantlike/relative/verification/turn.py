"""Whether the face of a body is turned: how its light would change, fitted to the image beside everything else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.ray_tracing import Template, Trace
from giantlike.ray_tracing.daylight import Daylight
from giantlike.relative.verification.cells import Cells
from giantlike.relative.verification.coarse_fit import CoarseFit, fit_cells

_STEP_RAD = 0.02
"""Turn to both sides from which derivatives follow: 0.4 cells in the middle of the face. Differences from the trace
itself share its sampling with the residuals: right fixes then looked turned by 0.3 degrees and up to 7 sigma."""


def fit_turned(
    cells: Cells, trace: Trace, own: Template, sun_direction_camera: Float, *, albedo: float, turn_rad: float
) -> CoarseFit | None:
    """Fit a body as :func:`fit_cells` does, and its turn about two axes across the line of sight besides.

    A turn about the line of sight is a strain, which is fitted anyway.

    Parameters
    ----------
    cells : Cells
    trace : Trace
        Of the body at the place found.
    own : Template
    sun_direction_camera : (3,) float64, unitless, camera axes
    albedo : float
        Standard deviation of the brightness of its surface about its law.
    turn_rad : float, rad
        Standard deviation of the orientation of the body, about any axis.

    Returns
    -------
    CoarseFit or None
        Its ``further`` is the turn (2,), rad; None where too few cells hold the body.
    """
    sight, _ = Rotation.align_vectors(trace.body.position_camera_km[None], np.array([[0.0, 0.0, 1.0]]))
    changes, told = [], trace.daylight()
    for axis in sight.as_matrix()[:, :2].T:
        sides = [
            _turned_light(cells, trace, step * axis, sun_direction_camera, told) for step in (_STEP_RAD, -_STEP_RAD)
        ]
        if sides[0] is None or sides[1] is None:
            return None
        changes.append((sides[0] - sides[1]) / (2.0 * _STEP_RAD))
    return fit_cells(cells, trace, own, albedo=albedo, turn_rad=turn_rad, further=np.stack(changes))


def _turned_light(
    cells: Cells, trace: Trace, turn: Float, sun_direction_camera: Float, daylight: Daylight
) -> Float | None:
    """Light of the body when it is turned by a rotation vector (3,) in camera axes."""
    camera_from_body = Rotation.from_rotvec(turn) * trace.body.camera_from_body
    turned = cells.trace(replace(trace.body, camera_from_body=camera_from_body), sun_direction_camera, daylight)
    return None if turned is None else cells.light(turned)
