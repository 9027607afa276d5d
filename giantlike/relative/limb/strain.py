"""Strain test of a limb: residuals by an error of shape or orientation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.processing.outline_errors import averages, outline_errors
from giantlike.relative.budget import STRAIN_TENSION
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import inflation
from giantlike.relative.limb.fix import IteratedSearch, LimbSolution, limb_fix

_LEAST_FREEDOM = 3  # minimum degrees of freedom of residuals beyond position and strain, to estimate errors from them
_STRAINS = 2


def fix_of_strained(
    inputs: EstimatorInputs, measured: LimbMeasurement, solution: LimbSolution, search: IteratedSearch
) -> PositionFix | Failure:
    """Return the fix of a limb, with the factor by which its variances are too small for a strain of the outline."""
    fix = limb_fix(inputs, measured, solution, search, allowed_rms_px=search.allowed_rms_px(measured))
    tension = strain_tension(measured, inputs)
    if isinstance(fix, Failure) or tension == 1.0:
        return fix
    return replace(fix, findings=replace(fix.findings, checks={**fix.findings.checks, STRAIN_TENSION: tension}))


def strain_tension(measured: LimbMeasurement, inputs: EstimatorInputs) -> float:
    """Factor by which the variances of a limb are too small for its strain; at least 1.

    Errors of the declared pole, roll or axes, and a smear of the image, stretch an outline along one direction. So do
    the longest waves of relief, whose amplitude is estimated from shorter ones in the residuals.

    The area-preserving strain s (2,) is fitted with the position by generalized least squares; the factor follows from
    ``s.C^-1.s`` (:func:`~giantlike.relative.judge.inflation`). Where noise alone explains the strain, other errors are
    not tested for.
    """
    if inputs.place_alone or measured.relief is not None or measured.terrain is not None:
        return 1.0
    keep, (_, altitude_km) = measured.keep, inputs.geometry.limb_altitude_km
    known = altitude_km / inputs.geometry.target.shape.mean_radius_km
    means = averages(measured.predicted_px[keep], measured.sigma_px[keep])
    freedom = len(means) - measured.design.shape[1] - _STRAINS
    if freedom < _LEAST_FREEDOM:
        return 1.0
    shift_px, sigma_px, points = measured.shift_px[keep], measured.sigma_px[keep], measured.predicted_px[keep]
    design = np.concatenate([measured.design[keep], _model_strain(points, measured.normals_px[keep])], axis=1)
    by_noise = means**2 @ sigma_px**2
    if _squared_strain(means @ shift_px, means @ design, np.diag(by_noise), known) <= _STRAINS:
        return 1.0
    radius_px = measured.perimeter_px / (2.0 * np.pi)
    errors = outline_errors(shift_px, design, sigma_px, points, radius=radius_px, least_length=measured.spacing_px)
    own = errors.covariances(np.sqrt(by_noise), means @ points)
    covariance = own.noise + own.relief
    for common_px in measured.common_px.values():
        shared_px = means @ common_px[keep]
        covariance = covariance + shared_px @ shared_px.T
    for error in measured.smooth_errors:
        covariance = covariance + error.covariance_px2(means @ points)
    return inflation(_squared_strain(means @ shift_px, means @ design, covariance, known), _STRAINS)


def _model_strain(points_px: Float, normals_px: Float) -> Float:
    """Outward motion (n, 2), px, of points with a strain: growth along x with shrinking along y, and along diagonals.

    Of other centers than the mean of the points a strain differs by a motion, which is fitted beside it.
    """
    x, y = (points_px - points_px.mean(axis=0)).T
    by_x, by_y = normals_px.T
    return np.stack([x * by_x - y * by_y, x * by_y + y * by_x], axis=-1)


def _squared_strain(shift_px: Float, design: Float, covariance: Float, known: float) -> float:
    """Squared strain over its covariance in a fit of shifts (b,) with a covariance (b, b).

    ``known`` is the standard deviation of the strain of a correct body.
    """
    scale = np.linalg.norm(design, axis=0)
    x = design / scale
    weighted = np.linalg.solve(covariance, x)
    inverse = np.linalg.inv(x.T @ weighted) / np.outer(scale, scale)
    strain = (inverse @ (scale * (weighted.T @ shift_px)))[-_STRAINS:]
    of_strain = inverse[-_STRAINS:, -_STRAINS:] + known**2 * np.eye(_STRAINS)
    return float(strain @ np.linalg.solve(of_strain, strain))
