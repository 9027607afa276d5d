r"""Centroids of stars: a noise-weighted Gaussian fitted to all of them at once.

The model of a pixel (i, j) is :math:`b + s_x i + s_y j + F\,P_x P_y` with
:math:`P_x = \frac12[\mathrm{erf}(u_{+}) - \mathrm{erf}(u_{-})]` and
:math:`u_{\pm} = (i \pm \frac12 - x) / (\sqrt2\,\sigma)`: a round Gaussian integrated over the pixel, so that the
centroid does not depend on where in its pixel the star falls, on a background that is a plane. Unknown per star: x, y,
flux F, background b and its slopes s, and ln sigma, the last with a loose prior around the point spread function. The
slopes add 2 % to the error of a centroid; without them a background that rises across the image moves all stars the
same way, and the attitude with them.

Gauss-Newton with weights :math:`1 / (\mathrm{noise}^2 + F P_x P_y / \mathrm{gain})` from the model, updated at every
step. Saturated pixels are lower bounds: they count only while the model is below them.

The covariance is the inverse of the Fisher information (background noise, shot noise, the pixels really used) times
two factors. The first, :math:`1 + 3 \mathrm{var}(F) / F^2`, is the second order of the fit; it matters below a
signal to noise ratio of 20. The second is the reduced chi-square of the residuals where that is above
:math:`1 + 4 \sqrt{2 / \mathrm{dof}}`, more than noise explains: the star is then not the model (a real PSF, an
unseen neighbor, a wrong gain), and the noise is not the error. Correlation between blended stars is not modeled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.processing.detection.gauss_newton import fit_patches, last_steps, subtract, windowed_moments
from giantlike.processing.detection.patches import MIN_PSF_SIGMA_PX, PIXEL_VARIANCE_PX2, Patches, chi2_inflation

_MAX_STEPS = 16  # a star that has not converged after so many gets FIT_FAILED
_STEPS_ALONE = 4  # before neighbors are subtracted: unconverged stars continue together with those that have neighbors
_N_UNKNOWNS = 7
_PLANE = [3, 5, 6]  # level of the background and its slopes, of these unknowns
_MAX_SHIFT_WIDTHS = 0.5  # a star may be so many PSF widths (and 1 px) off its peak: more is another source
_NEIGHBOR_ROUNDS = 3  # of subtracting neighbors and fitting again
_SECOND_ORDER = 3.0  # by Monte Carlo, sigma 0.5 to 2.5 px, background and shot noise: between 1 and 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarFits(Value):
    """Fitted Gaussians of n stars."""

    points_px: Float  # (n, 2)
    covariance_px2: Float  # (n, 2, 2)
    flux_dn: Float  # flux_dn, background_dn, width_px: (n,); width before pixel integration, px
    background_dn: Float
    width_px: Float
    planes: Float  # (n, 3) DN, DN/px, DN/px; background: level of the central pixel, and slopes along x and y
    reduced_chi2: Float  # (n,); weighted square residual per degree of freedom
    converged: Mask  # (n,); within ``1 + psf / 2`` px of the central pixel, on more pixels than unknowns


def fit_stars(
    patches: Patches,
    *,
    flux_dn: Float,
    psf_sigma_px: float,
    points_px: Float | None = None,
    width_prior: float = 0.25,
    isolated: bool = False,
) -> StarFits:
    r"""Fit a round, pixel-integrated Gaussian to each of n patches.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eq. 1.
    """
    psf = max(psf_sigma_px, MIN_PSF_SIGMA_PX)
    flux_dn, log_width = np.maximum(flux_dn, patches.noise_dn), np.full(len(flux_dn), math.log(psf))
    slopes = np.zeros((len(flux_dn), 2))
    places = patches.centers_px if points_px is None else points_px
    level_dn = patches.border_level_dn()
    start = np.column_stack([places, flux_dn, level_dn, log_width, slopes])
    problem = _StarFitProblem(patches, psf, width_prior)
    if isolated:
        return _assess_fits(patches, problem.solve(start, _MAX_STEPS))
    solution = problem.solve(start, _STEPS_ALONE)
    pairs = neighbor_pairs(patches.centers_px.astype(np.float64), patches.reach_px)
    changed = np.ones(len(start), dtype=bool)
    for done in range(_NEIGHBOR_ROUNDS):
        near = pairs[solution.good[pairs[:, 1]]]  # a fit that ran away must not be subtracted from its neighbors
        again = np.zeros(len(start), dtype=bool)
        again[near[changed[near[:, 1]], 0]] = True
        if done:
            again &= solution.good  # fits that did not converge without their neighbors never will
        restarted = again & ~solution.good
        which = np.flatnonzero(again if done else again | solution.unsettled)
        if not which.size:
            break
        before = solution.parameters[which]
        first = np.where(restarted[which, None], start[which], before)
        found = problem.without(solution.parameters, near, which).solve(first, _MAX_STEPS)
        solution.replace(which, found)
        changed[:] = False
        changed[which] = ~last_steps(found.parameters - before, before, found.covariance, found.reduced_chi2)
    return _assess_fits(patches, solution)


def windowed_shape(patches: Patches, points_px: Float, background_dn: Float, psf_sigma_px: float) -> Float:
    """Second moments (n, 2), longest and shortest axis, in a Gaussian window as wide as a star, in units of it.

    Corrected by the moment of a star at the same sub-pixel position: 0.5 for stars, 1 along an edge, 0 for hot pixels.
    """
    return windowed_moments(
        patches.values_dn,
        patches.valid,
        patches.corner_px,
        np.array(points_px),
        np.array(background_dn),
        math.sqrt(psf_sigma_px**2 + PIXEL_VARIANCE_PX2),
        max(psf_sigma_px, MIN_PSF_SIGMA_PX),
    )


def neighbor_pairs(points_px: Float, reach_px: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of indices, in both orders, of points (n, 2) closer than ``reach_px``."""
    tree = cKDTree(points_px, balanced_tree=False, compact_nodes=False)  # for one use: faster to build
    pairs = tree.query_pairs(reach_px, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


@dataclass(slots=True)
class _StarFitSolution:
    """Parameters (n, 7), their covariances (n, 7, 7), chi-squares (n,), pixels used (n,), converged near the peak (n,).

    Covariance and chi-square are from before the last step, a tenth of a sigma at most. ``unsettled`` (n,) marks stars
    that need more steps.
    """

    parameters: Float
    covariance: Float
    chi2: Float
    count: NDArray[np.int64]
    good: Mask
    unsettled: Mask

    @property
    def reduced_chi2(self) -> Float:
        """Chi-squares (n,) over the pixels used."""
        reduced: Float = self.chi2 / self.count.clip(1)
        return reduced

    def replace(self, which: NDArray[np.integer], other: _StarFitSolution) -> None:
        """Copy the solution of the stars of these indices (k,)."""
        for field in fields(self):
            getattr(self, field.name)[which] = getattr(other, field.name)


@dataclass(frozen=True, slots=True, eq=False)
class _StarFitProblem(Value):
    """Least squares of all stars: parameters (n, 7) are x, y, flux, background, ln sigma, slopes along x and y."""

    patches: Patches
    psf_sigma_px: float
    width_prior: float

    def without(self, parameters: Float, pairs: NDArray[np.int64], which: NDArray[np.int64]) -> _StarFitProblem:
        """Stars ``which`` (k,), ascending, minus the fitted stars that each of them is paired with."""
        chosen = self.patches.select(which)
        of, neighbor = pairs[np.isin(pairs[:, 0], which)].T
        values = chosen.values_dn.copy()
        subtract(values, chosen.corner_px, np.searchsorted(which, of), parameters[neighbor])
        return replace(self, patches=replace(chosen, values_dn=values))

    def solve(self, start: Float, steps: int) -> _StarFitSolution:
        """Gauss-Newton from ``start`` (n, 7)."""
        patches, psf = self.patches, self.psf_sigma_px
        parameters, covariance, chi2, count, settled = fit_patches(
            patches.values_dn,
            patches.valid,
            patches.saturated,
            patches.noise_dn**2,
            patches.corner_px,
            start,
            steps,
            patches.gain_e_per_dn,
            patches.relative_noise,
            math.log(psf),
            self.width_prior,
        )
        away = np.hypot(*(parameters[:, :2] - patches.centers_px).T)
        good = settled & (away <= 1.0 + _MAX_SHIFT_WIDTHS * psf)
        return _StarFitSolution(parameters, covariance, chi2, count, good, ~settled)


def _assess_fits(patches: Patches, solution: _StarFitSolution) -> StarFits:
    """Covariances and quality of the solution."""
    parameters, covariance = solution.parameters, solution.covariance
    freedom = np.maximum(solution.count - _N_UNKNOWNS, 1)
    inflation = chi2_inflation(solution.chi2, freedom)
    inflation *= 1.0 + _SECOND_ORDER * covariance[:, 2, 2] / parameters[:, 2] ** 2
    return StarFits(
        points_px=parameters[:, :2],
        covariance_px2=covariance[:, :2, :2] * inflation[:, None, None],
        flux_dn=parameters[:, 2],
        background_dn=patches.level_dn(parameters[:, _PLANE], parameters[:, :2]),
        width_px=np.exp(parameters[:, 4]),
        planes=parameters[:, _PLANE],
        reduced_chi2=solution.chi2 / freedom,
        converged=solution.good & (solution.count > _N_UNKNOWNS),
    )
