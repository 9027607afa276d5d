"""Position of a body from a converged limb, with a covariance from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause, add_parts
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import solution_gain
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.processing.outline_errors import averages, outline_errors
from giantlike.relative.limb.fix import LimbSolution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weighted(Value):
    """Generalized least squares of k parameters by the points of a limb."""

    means: Float  # (b, n); averages n points to b
    gain: Float  # (k, b); takes the shifts of these, px, to the parameters
    own: dict[Cause, Float]  # mapping of Cause to (k, k); covariances by the errors of each point: noise, and relief


def weight_points(measured: LimbMeasurement, design: Float, radius_px: float, *, min_length_px: float) -> Weighted:
    """Weight the points that are kept by the errors that their residuals show.

    ``design`` (n, k), outward motion of the n points that are kept with each parameter, px per unit.
    """
    keep = measured.keep
    shift_px, sigma_px, points = measured.shift_px[keep], measured.sigma_px[keep], measured.predicted_px[keep]
    errors = outline_errors(shift_px, design, sigma_px, points, radius=radius_px, least_length=min_length_px)
    means = averages(points, sigma_px)
    by_points = errors.covariances(np.sqrt(means**2 @ sigma_px**2), means @ points)
    gain = solution_gain(means @ design, by_points.for_weights)
    own = {
        Cause.NOISE: gain @ by_points.noise @ gain.T,
        Cause.RELIEF: gain @ by_points.relief @ gain.T,
    }
    return Weighted(means=means, gain=gain, own=own)


def solve_limb(measured: LimbMeasurement, radius_px: float, *, min_length_px: float = 1.5) -> LimbSolution:
    """Take the last step of the iteration, with the covariance that the residuals show."""
    keep = measured.keep
    shift_px, design = measured.shift_px[keep], measured.design[keep]
    solved = weight_points(measured, design, radius_px, min_length_px=min_length_px)
    step_km = solved.gain @ (solved.means @ shift_px)
    return LimbSolution(
        position_camera_km=measured.position_camera_km + step_km,
        covariances_km2=add_parts(solved.own, measured.smooth_covariances(measured.even_gain)),
        residuals_px=shift_px - design @ step_km,
        limb_px=measured.seen_px[keep],
    )
