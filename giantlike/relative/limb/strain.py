"""Whether residuals of a limb are those of a strained outline: of a body told with another figure or orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.core.values import Value
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.processing.outline_errors import averages, outline_errors
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.limb.fix import IteratedSearch, LimbSolution, limb_fix
from giantlike.relative.quality import UNLIKELY

_LEAST_FREEDOM = 3
"""Least degrees of freedom that residuals must have beside place and strain: errors are estimated from them."""
_STRAINS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Strain(Value):
    """How the limb of a body looks strained.

    Parameters
    ----------
    chance : float
        Probability that the limb of a right body looks strained by as much.
    tension : float
        Squared strain over what the errors of the limb let expect, as Birge's ratio; 1 where it is not unlikely.
    """

    chance: float = 1.0
    tension: float = 1.0

    def grown(self, solution: LimbSolution) -> LimbSolution:
        """Return a solution whose own errors explain the strain.

        Parameters
        ----------
        solution : LimbSolution

        Returns
        -------
        LimbSolution
        """
        parts = dict(solution.covariances_km2)
        own = {cause: self.tension * parts[cause] for cause in (Cause.NOISE, Cause.RELIEF) if cause in parts}
        return replace(solution, covariances_km2=parts | own)


def fix_of_strained(
    inputs: EstimatorInputs, measured: LimbMeasurement, solution: LimbSolution, search: IteratedSearch
) -> PositionFix | Failure:
    """Judge a position from a limb that may look strained, with errors that explain the strain.

    Parameters
    ----------
    inputs : EstimatorInputs
    measured : LimbMeasurement
        Settled.
    solution : LimbSolution
    search : IteratedSearch

    Returns
    -------
    PositionFix or Failure
    """
    strain, allowed_px = strain_of(measured, inputs), search.allowed_rms_px(measured)
    grown = strain.grown(solution)
    return limb_fix(inputs, measured, grown, search, allowed_rms_px=allowed_px, strain_chance=strain.chance)


def strain_of(measured: LimbMeasurement, inputs: EstimatorInputs) -> Strain:
    """Compare the strain of a limb with its errors.

    A pole, a roll or axes that are told wrong, and a smear of the image, stretch an outline along one direction. So do
    the longest waves of relief, but these come with shorter ones, which the strain leaves among the residuals: how much
    relief there is follows from them.

    Parameters
    ----------
    measured : LimbMeasurement
        Settled.
    inputs : EstimatorInputs
        No turn of the body, by its orientation as declared, strains it by more than the turn; haze may stand higher
        over some of the limb than over the rest by as much as its altitude is uncertain.

    Returns
    -------
    Strain
        None to speak of where too few points tell, where the outline is not that of the body (a stand-in, or one whose
        relief a height map tells), and where only the place is asked for.

    Notes
    -----
    The strain s (2,) of no area is fitted beside the place by generalized least squares, and ``s.C^-1.s / 2`` compared
    with the F distribution: the scale of C is estimated from as many averages as there are, less those parameters.
    Where noise alone explains the strain, other errors are not looked for. What contradicts a limb makes it suspect,
    what is merely unlikely makes it less certain.
    """
    if inputs.place_alone or measured.relief is not None or measured.terrain is not None:
        return Strain()
    keep, (_, altitude_km) = measured.keep, inputs.geometry.limb_altitude_km
    known = math.hypot(inputs.turn_rad, altitude_km / inputs.geometry.target.shape.mean_radius_km)
    means = averages(measured.predicted_px[keep], measured.sigma_px[keep])
    freedom = len(means) - measured.design.shape[1] - _STRAINS
    if freedom < _LEAST_FREEDOM:
        return Strain()
    shift_px, sigma_px, points = measured.shift_px[keep], measured.sigma_px[keep], measured.predicted_px[keep]
    design = np.concatenate([measured.design[keep], _strained(points, measured.normals_px[keep])], axis=1)
    by_noise = means**2 @ sigma_px**2
    by_noise_alone = _strain(means @ shift_px, means @ design, np.diag(by_noise), known, freedom)
    if by_noise_alone.chance > UNLIKELY:
        return by_noise_alone
    radius_px = measured.perimeter_px / (2.0 * np.pi)
    errors = outline_errors(shift_px, design, sigma_px, points, radius=radius_px, least_length=measured.spacing_px)
    own = errors.covariances(np.sqrt(by_noise), means @ points)
    covariance = own.noise + own.relief
    for common_px in measured.common_px.values():
        shared_px = means @ common_px[keep]
        covariance = covariance + shared_px @ shared_px.T
    for error in measured.smooth_errors:
        covariance = covariance + error.covariance_px2(means @ points)
    return _strain(means @ shift_px, means @ design, covariance, known, freedom)


def _strained(points_px: Float, normals_px: Float) -> Float:
    """Outward motion (n, 2), px, of points with a strain: growth along x with shrinking along y, and along diagonals.

    Of other centers than the mean of the points a strain differs by a motion, which is fitted beside it.
    """
    x, y = (points_px - points_px.mean(axis=0)).T
    by_x, by_y = normals_px.T
    return np.stack([x * by_x - y * by_y, x * by_y + y * by_x], axis=-1)


def _strain(shift_px: Float, design: Float, covariance: Float, known: float, freedom: int) -> Strain:
    """The last two parameters of a fit of shifts (b,), compared with their errors by a covariance (b, b).

    ``known`` is the standard deviation of a strain that a right body may have.
    """
    from scipy.special import fdtrc

    scale = np.linalg.norm(design, axis=0)
    x = design / scale
    weighted = np.linalg.solve(covariance, x)
    inverse = np.linalg.inv(x.T @ weighted) / np.outer(scale, scale)
    strain = (inverse @ (scale * (weighted.T @ shift_px)))[-_STRAINS:]
    of_strain = inverse[-_STRAINS:, -_STRAINS:] + known**2 * np.eye(_STRAINS)
    ratio = float(strain @ np.linalg.solve(of_strain, strain)) / _STRAINS
    chance = float(fdtrc(_STRAINS, freedom, ratio))
    return Strain(chance=chance, tension=ratio if chance < UNLIKELY else 1.0)
