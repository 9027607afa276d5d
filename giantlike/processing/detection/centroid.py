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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.processing.detection.patches import (
    MIN_PSF_SIGMA_PX,
    Patches,
    chi2_inflation,
    inverses,
    normal_equations,
    pixel_shares,
)

_MAX_STEPS = 16  # a star that has not converged after so many gets FIT_FAILED
_CONVERGED_PX = 1e-4  # last step: a hundredth of the best centroid error of a bright star
_CONVERGED_SIGMAS = 0.02  # last step over the error of the centroid: adds 0.02 % to its variance
_N_UNKNOWNS = 7
_PLANE = [3, 5, 6]  # level of the background and its slopes, of these unknowns
_NONLINEAR = [0, 1, 4]  # x, y, ln sigma: the model is linear in the others
_LOG_WIDTH_LIMIT = math.log(4.0)  # largest change of ln sigma from that of the PSF: flags need no more than a factor 3
_MAX_SHIFT_WIDTHS = 0.5  # a star may be so many PSF widths (and 1 px) off its peak: more is another source
_NEIGHBOR_ROUNDS = 3  # of subtracting neighbors and fitting again
_SECOND_ORDER = 3.0  # by Monte Carlo, sigma 0.5 to 2.5 px, background and shot noise: between 1 and 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarFits(Value):
    """Fitted Gaussians of n stars.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    covariance_px2 : (n, 2, 2) float64, px^2
    flux_dn, background_dn, width_px : (n,) float64
        Integral, DN; level underneath, DN; standard deviation before pixel integration, px.
    planes : (n, 3) float64, DN, DN/px, DN/px
        Background of each patch: level of its central pixel, and slopes along x and y.
    reduced_chi2 : (n,) float64
        Weighted square residual per degree of freedom.
    converged : (n,) bool
        True if the fit converged less than ``1 + psf / 2`` px from the central pixel, on more pixels than unknowns.
    """

    points_px: Float
    covariance_px2: Float
    flux_dn: Float
    background_dn: Float
    width_px: Float
    planes: Float
    reduced_chi2: Float
    converged: Mask


def fit_stars(
    patches: Patches,
    *,
    flux_dn: Float,
    psf_sigma_px: float,
    width_prior: float = 0.25,
    isolated: bool = False,
) -> StarFits:
    r"""Fit a pixel-integrated Gaussian to each patch, starting at the middle of its central pixel.

    Parameters
    ----------
    patches : Patches
    flux_dn : (n,) float64, DN
        First guess.
    psf_sigma_px : float, px
        Expected width; start and prior of the fitted one. At least ``MIN_PSF_SIGMA_PX``.
    width_prior : float
        Standard deviation of the prior on ln sigma, by default 25 %: it keeps the fits of faint stars in bounds and
        does not touch those of bright ones.
    isolated : bool
        True to ignore neighbors; by default close stars are fitted again with the fitted neighbors subtracted.

    Returns
    -------
    StarFits

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eq. 1 (a general
       Gaussian; here it is round and integrated over pixels).
    """
    psf = max(psf_sigma_px, MIN_PSF_SIGMA_PX)
    flux_dn, log_width = np.maximum(flux_dn, patches.noise_dn), np.full(len(flux_dn), math.log(psf))
    slopes = np.zeros((len(flux_dn), 2))
    start = np.column_stack([patches.centers_px, flux_dn, patches.border_level_dn(), log_width, slopes])
    problem = _Problem(patches, psf, width_prior)
    parameters, good = problem.solve(start)
    pairs = neighbor_pairs(start[:, :2], patches.reach_px)
    for _ in range(0 if isolated else _NEIGHBOR_ROUNDS):
        near = pairs[good[pairs[:, 1]]]  # a fit that ran away must not be subtracted from its neighbors
        if not len(near):
            break
        blended = np.unique(near[:, 0])
        problem = replace(problem, patches=_without_neighbors(patches, parameters, near))
        parameters[blended], good[blended] = problem.select(blended).solve(
            np.where(good[blended, None], parameters[blended], start[blended])
        )
    return problem.finish(parameters, good)


def neighbor_pairs(points_px: Float, reach_px: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of indices, in both orders, of points (n, 2) closer than ``reach_px``."""
    pairs = cKDTree(points_px).query_pairs(reach_px, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


def _without_neighbors(patches: Patches, parameters: Float, pairs: NDArray[np.int64]) -> Patches:
    """Patches minus the fitted stars that each of them is paired with."""
    of, neighbor = pairs.T
    shares = patches.select(of).star_shares(parameters[neighbor, :2], np.exp(parameters[neighbor, 4]))
    values = patches.values_dn.copy()
    np.subtract.at(values, of, parameters[neighbor, 2, None, None] * shares)
    return replace(patches, values_dn=values)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Least squares of all stars: parameters (n, 7) are x, y, flux, background, ln sigma, slopes along x and y."""

    patches: Patches
    psf_sigma_px: float
    width_prior: float

    def select(self, which: NDArray[np.integer]) -> _Problem:
        return replace(self, patches=self.patches.select(which))

    def solve(self, start: Float) -> tuple[Float, Mask]:
        """Gauss-Newton from ``start`` (n, 7): parameters (n, 7), and a mask (n,) of fits converged near the peak."""
        parameters = start.copy()
        active = np.arange(len(start))
        last, pace = np.zeros_like(start), np.ones(len(start))
        problem = self
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            now = parameters[active]
            normal, right, chi2, count = problem.linearize(now)
            covariance = inverses(normal)
            step = problem.limited(now, (covariance @ right[:, :, None])[:, :, 0])
            # A step back is a step too far: undersampled stars overshoot for ever at full length.
            back = np.sum((step * last[active])[:, _NONLINEAR], axis=1) < 0.0
            pace[active] = np.where(back, 0.5 * pace[active], np.minimum(1.0, 1.5 * pace[active]))
            last[active] = step
            parameters[active] = now + pace[active, None] * step
            error = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) * np.maximum(1.0, chi2 / count.clip(1)))
            still = np.hypot(step[:, 0], step[:, 1]) <= np.maximum(_CONVERGED_PX, _CONVERGED_SIGMAS * error)
            if still.any():
                active, problem = active[~still], problem.select(np.flatnonzero(~still))
        reach = 1.0 + _MAX_SHIFT_WIDTHS * self.psf_sigma_px
        good = np.hypot(*(parameters[:, :2] - self.patches.centers_px).T) <= reach
        good[active] = False
        return parameters, good

    def linearize(self, parameters: Float) -> tuple[Float, Float, Float, NDArray[np.int64]]:
        """Normal matrices (n, 7, 7), right sides (n, 7), chi-squares (n,) and numbers of pixels (n,)."""
        patches, n, size = self.patches, len(parameters), self.patches.size_px
        x, y, flux, _, log_width, *_ = parameters.T
        width = np.exp(log_width)
        px, px_center, px_width = pixel_shares(patches.corner_px[:, 0], size, x, width)
        py, py_center, py_width = pixel_shares(patches.corner_px[:, 1], size, y, width)
        scale = flux[:, None, None]
        star = py[:, :, None] * px[:, None, :]
        jacobian = np.empty((n, _N_UNKNOWNS, size, size))
        jacobian[:, 0] = scale * py[:, :, None] * px_center[:, None, :]
        jacobian[:, 1] = scale * py_center[:, :, None] * px[:, None, :]
        jacobian[:, 2] = star
        jacobian[:, _PLANE] = patches.plane_terms()
        jacobian[:, 4] = scale * (py[:, :, None] * px_width[:, None, :] + py_width[:, :, None] * px[:, None, :])
        residual, weight = patches.residuals(scale * star, parameters[:, _PLANE])
        normal, right = normal_equations(jacobian.reshape(n, _N_UNKNOWNS, -1), residual, weight)
        normal[:, 4, 4] += self.width_prior**-2
        right[:, 4] += (math.log(self.psf_sigma_px) - log_width) * self.width_prior**-2
        # A star without pixels has no information: keep the matrix regular, its covariance says so.
        tiny, level = np.full(n, 1e-6), 1e-12 / patches.noise_dn**2
        diagonal = [0, 1, 2, *_PLANE]
        normal[:, diagonal, diagonal] += np.stack([tiny, tiny, (1e-6 / flux) ** 2, level, level, level], axis=-1)
        return normal, right, np.sum(weight * residual**2, axis=1), np.count_nonzero(weight, axis=1)

    def limited(self, parameters: Float, step: Float) -> Float:
        """Limit steps (n, 7) to the region in which the linearization is valid."""
        reach = 0.7 * np.exp(parameters[:, 4]) + 0.2
        length = np.hypot(step[:, 0], step[:, 1])
        result = step.copy()
        result[:, :2] *= np.minimum(1.0, reach / np.maximum(length, 1e-300))[:, None]
        flux = parameters[:, 2]
        result[:, 2] = np.clip(step[:, 2], -0.7 * flux, 4.0 * flux)
        limits = math.log(self.psf_sigma_px) + np.array([-_LOG_WIDTH_LIMIT, _LOG_WIDTH_LIMIT])
        wanted = np.clip(parameters[:, 4] + np.clip(step[:, 4], -0.4, 0.4), *limits)
        result[:, 4] = np.maximum(wanted, math.log(0.6 * MIN_PSF_SIGMA_PX)) - parameters[:, 4]
        return result

    def finish(self, parameters: Float, good: Mask) -> StarFits:
        """Covariances and quality of the solution."""
        normal, _, chi2, count = self.linearize(parameters)
        covariance = inverses(normal)
        freedom = np.maximum(count - _N_UNKNOWNS, 1)
        inflation = chi2_inflation(chi2, freedom)
        inflation *= 1.0 + _SECOND_ORDER * covariance[:, 2, 2] / parameters[:, 2] ** 2
        return StarFits(
            points_px=parameters[:, :2],
            covariance_px2=covariance[:, :2, :2] * inflation[:, None, None],
            flux_dn=parameters[:, 2],
            background_dn=self.patches.level_dn(parameters[:, _PLANE], parameters[:, :2]),
            width_px=np.exp(parameters[:, 4]),
            planes=parameters[:, _PLANE],
            reduced_chi2=chi2 / freedom,
            converged=good & (count > _N_UNKNOWNS),
        )
