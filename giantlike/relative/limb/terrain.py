"""Terrain in a measured limb: its predicted altitude subtracted from every point, and its errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from giantlike.core.arrays import Float, unit
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate, turn_between
from giantlike.processing.correlated_fit import robust_solution
from giantlike.processing.limb.measurement import LimbMeasurement, SmoothError, TerrainShift
from giantlike.processing.outline_errors import averages
from giantlike.relative.inputs import EstimatorInputs
from giantlike.shapes import Ellipsoid
from giantlike.terrain import limb_profile

ERROR_LENGTH = 0.3  # correlation length, radii, along the limb of the errors of a map, as for relief
SLOPE_ERROR, CELL_SLOPE_ERROR = 0.2, 0.4
"""Error of a limb by light on the slopes of its relief, which a profile of smooth ground does not have, over the root
mean square of that relief along it; alike over a radius. By lines and edges, and by cells.

On 12 passes of a made-up Moon of 40 to 200 px (seed 1 of benchmarks/terrain.py), with 0.05 to 0.17 px of relief, radii
were off by 0.014 px (lines) and 0.022 px (cells); with 0.3 px, on rougher ground, by 0.015 px and 0.16 px.
"""
_POINTS_PER_PX = 2.0  # position angles of a profile to a pixel of limb: a measurement averages over some pixels
_SEEN_PX = 3.0  # length of limb, px, that a measurement sees together at least: pixels, and the point spread function


def with_terrain(
    measured: LimbMeasurement, inputs: EstimatorInputs, outlier_mad: float, *, slope_error: float = SLOPE_ERROR
) -> LimbMeasurement:
    """Take the relief of the height map of a target off the points of its measured limb.

    The profile is computed for the predicted geometry. A shift of the body in the image is attributed to the attitude
    of the camera, which leaves the visible side unchanged.
    """
    target, geometry, model = inputs.geometry.target, inputs.geometry, inputs.camera.model
    if target.terrain is None or not isinstance(target.shape, Ellipsoid):
        return measured
    body_from_camera = geometry.camera_from_body.inv()
    profile = limb_profile(
        target.terrain,
        target.shape.radii_km,
        rotate(body_from_camera, -geometry.position_camera_km),
        angles=math.ceil(_POINTS_PER_PX * 2.0 * math.pi * inputs.radius_px),
    )
    step, _ = robust_solution(measured.shift_px, measured.design, measured.sigma_px, outlier_mad=outlier_mad)
    found = unit(measured.position_camera_km + step)
    turn = body_from_camera * turn_between(found, unit(geometry.position_camera_km))
    altitude_km = profile.at(
        rotate(turn, model.unproject(measured.predicted_px)),
        width_rad=max(measured.spacing_px, _SEEN_PX) / inputs.radius_px,
    )
    px_per_km = np.linalg.norm(measured.design, axis=1)
    terrain_px = altitude_km * px_per_km
    shift_px = measured.shift_px - terrain_px
    keep = robust_solution(shift_px, measured.design, measured.sigma_px, outlier_mad=outlier_mad)[1]
    scale = float(np.mean(px_per_km))
    by_slopes_px = slope_error * float(np.std(terrain_px))
    errors = (
        SmoothError(cause=Cause.RELIEF, sigma_px=profile.sigma_km * scale, length_px=ERROR_LENGTH * inputs.radius_px),
        SmoothError(cause=Cause.RELIEF, sigma_px=by_slopes_px, length_px=inputs.radius_px),
    )
    shared = [px_per_km[:, None] * profile.common_sigma_km]
    if Cause.RELIEF in measured.common_px:
        shared.append(measured.common_px[Cause.RELIEF])
    after = replace(measured, shift_px=shift_px, keep=keep)
    known_px = math.hypot(profile.sigma_km * scale, SLOPE_ERROR * float(np.std(terrain_px)))
    log_odds, misfit = judge_relief(after, terrain_px, known_px=known_px, scatter_px=profile.scatter_km * scale)
    return replace(
        after,
        common_px={**measured.common_px, Cause.RELIEF: np.concatenate(shared, axis=1)},
        smooth_errors=(*measured.smooth_errors, *errors),
        terrain=TerrainShift(
            shift_px=terrain_px,
            log_odds=log_odds,
            misfit=misfit,
            name=target.terrain.name,
            sha256=target.terrain.sha256,
            mean_km=float(np.mean(altitude_km[keep])),
        ),
    )


def judge_relief(
    measured: LimbMeasurement, terrain_px: Float, *, known_px: float, scatter_px: float
) -> tuple[float, float]:
    """Compare a limb with and without its relief.

    ``terrain_px`` (n,); returns ``log_odds`` and ``misfit``.

    Residuals are averaged over some two dozen parts of the limb, each of which counts as one independent error of a
    variance that is not known: the likelihoods are as the residual squares to the power of half the degrees of freedom.
    """
    keep = measured.keep
    points, sigma = measured.predicted_px[keep], measured.sigma_px[keep]
    means = averages(points, sigma)
    design = means @ measured.design[keep]
    freedom = len(design) - design.shape[1]
    if freedom < 1:
        return 0.0, 0.0
    values = means @ np.stack([measured.shift_px[keep], (measured.shift_px + terrain_px)[keep]], axis=1)
    left = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    with_map, without = (max(float(each @ each), 1e-300) for each in left.T)
    expected = float(np.mean(means**2 @ sigma**2)) + known_px**2 + scatter_px**2
    misfit = math.sqrt(with_map / (freedom * max(expected, 1e-300)))
    return 0.5 * freedom * math.log(with_map / without), misfit
