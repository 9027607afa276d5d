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
from giantlike.processing.detection.patches import (
    MIN_PSF_SIGMA_PX,
    Patches,
    chi2_inflation,
    inverses,
    pixel_shares,
)

_MAX_STEPS = 16  # a star that has not converged after so many gets FIT_FAILED
_CONVERGED_PX = 1e-4  # last step: a hundredth of the best centroid error of a bright star
_CONVERGED_SIGMAS = 0.35  # last step over its error: the next is a fifth of it, 0.5 % of the variance
_CONVERGED_FLUX = 0.02  # the same over the flux, where that is more: the covariance is that before it
_CONVERGED_WIDTH = 0.05  # the same of ln sigma: flags ask for widths off by a third
_N_UNKNOWNS = 7
_ROUNDING = 3e-6  # of the diagonal: above what single precision may take off an eigenvalue of fits to a few pixels
_BLOCK = 512  # stars fitted together: derivatives by patches of 9 x 9 pixels are then 1.3 MB
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
    points_px: Float | None = None,
    width_prior: float = 0.25,
    isolated: bool = False,
) -> StarFits:
    r"""Fit a pixel-integrated Gaussian to each patch.

    Parameters
    ----------
    patches : Patches
    flux_dn : (n,) float64, DN
        First guess.
    psf_sigma_px : float, px
        Expected width; start and prior of the fitted one. At least ``MIN_PSF_SIGMA_PX``.
    points_px : (n, 2) float64, px, optional
        First guess; default: the middle of the central pixel of each patch.
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
    places = patches.centers_px if points_px is None else points_px
    start = np.column_stack([places, flux_dn, patches.border_level_dn(), log_width, slopes])
    problem = _Problem(patches, psf, width_prior)
    solution = problem.solve(start)
    pairs = neighbor_pairs(patches.centers_px.astype(np.float64), patches.reach_px)
    changed = np.ones(len(start), dtype=bool)
    for done in range(0 if isolated else _NEIGHBOR_ROUNDS):
        near = pairs[solution.good[pairs[:, 1]]]  # a fit that ran away must not be subtracted from its neighbors
        blended = np.unique(near[changed[near[:, 1]], 0])
        if done:
            blended = blended[solution.good[blended]]  # what did not converge without its neighbors never will
        if not blended.size:
            break
        alone = _without_neighbors(patches, solution.parameters, near, blended)
        before = solution.parameters[blended]
        again = np.where(solution.good[blended, None], before, start[blended])
        found = replace(problem, patches=alone).solve(again)
        solution.replace(blended, found)
        changed[:] = False
        changed[blended] = ~_is_last(found.parameters - before, before, found.covariance, found.reduced_chi2)
    return problem.finish(solution)


def neighbor_pairs(points_px: Float, reach_px: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of indices, in both orders, of points (n, 2) closer than ``reach_px``."""
    pairs = cKDTree(points_px).query_pairs(reach_px, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


def _without_neighbors(
    patches: Patches, parameters: Float, pairs: NDArray[np.int64], which: NDArray[np.int64]
) -> Patches:
    """Patches ``which`` (k,), ascending, minus the fitted stars that each of them is paired with."""
    of, neighbor = pairs[np.isin(pairs[:, 0], which)].T
    shares = patches.select(of).star_shares(parameters[neighbor, :2], np.exp(parameters[neighbor, 4]))
    chosen = patches.select(which)
    values = chosen.values_dn.copy()
    np.subtract.at(values, np.searchsorted(which, of), parameters[neighbor, 2, None, None] * shares)
    return replace(chosen, values_dn=values)


def _is_last(step: Float, parameters: Float, covariance: Float, reduced_chi2: Float) -> Mask:
    """True (n,) for steps (n, 7) after which another would not matter."""
    variance = np.einsum("nii->ni", covariance)
    across = np.sqrt((variance[:, 0] + variance[:, 1]) * np.maximum(1.0, reduced_chi2))
    flux, width = np.sqrt(variance[:, 2]), np.sqrt(variance[:, 4])
    still = np.hypot(step[:, 0], step[:, 1]) <= np.maximum(_CONVERGED_PX, _CONVERGED_SIGMAS * across)
    still &= np.abs(step[:, 2]) <= np.maximum(_CONVERGED_FLUX * parameters[:, 2], _CONVERGED_SIGMAS * flux)
    still &= np.abs(step[:, 4]) <= np.maximum(_CONVERGED_WIDTH, _CONVERGED_SIGMAS * width)
    return np.asarray(still)


@dataclass(slots=True)
class _Solution:
    """Parameters (n, 7), their covariances (n, 7, 7), chi-squares (n,), pixels used (n,), converged near the peak (n,).

    Covariance and chi-square are those before the last step, a tenth of a sigma at most.
    """

    parameters: Float
    covariance: Float
    chi2: Float
    count: NDArray[np.int64]
    good: Mask

    @property
    def reduced_chi2(self) -> Float:
        """Chi-squares (n,) over the pixels used."""
        reduced: Float = self.chi2 / self.count.clip(1)
        return reduced

    def replace(self, which: NDArray[np.integer], other: _Solution) -> None:
        """Take over the solution of the stars of these indices (k,)."""
        for field in fields(self):
            getattr(self, field.name)[which] = getattr(other, field.name)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Least squares of all stars: parameters (n, 7) are x, y, flux, background, ln sigma, slopes along x and y."""

    patches: Patches
    psf_sigma_px: float
    width_prior: float

    def select(self, which: NDArray[np.integer] | slice) -> _Problem:
        return replace(self, patches=self.patches.select(which))

    def solve(self, start: Float) -> _Solution:
        """Gauss-Newton from ``start`` (n, 7)."""
        n = len(start)
        solution = _Solution(
            parameters=start.copy(),
            covariance=np.empty((n, _N_UNKNOWNS, _N_UNKNOWNS)),
            chi2=np.empty(n),
            count=np.empty(n, dtype=np.int64),
            good=np.ones(n, dtype=bool),
        )
        active = np.arange(n)
        last, pace = np.zeros_like(start), np.ones(n)
        problem = self
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            now = solution.parameters[active]
            covariance, step, chi2, count = problem.stepped(now)
            # A step back is a step too far: undersampled stars overshoot for ever at full length.
            back = np.sum((step * last[active])[:, _NONLINEAR], axis=1) < 0.0
            pace[active] = np.where(back, 0.5 * pace[active], np.minimum(1.0, 1.5 * pace[active]))
            last[active] = step
            solution.parameters[active] = now + pace[active, None] * step
            solution.covariance[active], solution.chi2[active], solution.count[active] = covariance, chi2, count
            still = _is_last(step, now, covariance, chi2 / count.clip(1))
            if still.any():
                active, problem = active[~still], problem.select(np.flatnonzero(~still))
        reach = 1.0 + _MAX_SHIFT_WIDTHS * self.psf_sigma_px
        solution.good[:] = np.hypot(*(solution.parameters[:, :2] - self.patches.centers_px).T) <= reach
        solution.good[active] = False
        return solution

    def stepped(self, parameters: Float) -> tuple[Float, Float, Float, NDArray[np.int64]]:
        """Covariances (n, 7, 7), steps (n, 7), chi-squares (n,), pixels (n,): a block of stars at a time.

        The derivatives of a block stay in the cache.
        """
        parts = []
        for first in range(0, len(parameters), _BLOCK):
            which = slice(first, first + _BLOCK)
            block = self if len(parameters) <= _BLOCK else self.select(which)
            normal, right, chi2, count = block.linearize(parameters[which])
            covariance = inverses(normal)
            step = block.limited(parameters[which], (covariance @ right[:, :, None])[:, :, 0])
            parts.append((covariance, step, chi2, count))
        covariances, steps, chi2s, counts = (np.concatenate(part) for part in zip(*parts, strict=True))
        return covariances, steps, chi2s, counts

    def linearize(self, parameters: Float) -> tuple[Float, Float, Float, NDArray[np.int64]]:
        """Normal matrices (n, 7, 7), right sides (n, 7), chi-squares (n,) and numbers of pixels (n,)."""
        patches, n, size = self.patches, len(parameters), self.patches.size_px
        flux, log_width = parameters[:, 2], parameters[:, 4]
        width = np.exp(log_width)
        places, corners = parameters[:, :2].T.ravel(), patches.corner_px.T.ravel()
        shares, by_place, by_width = pixel_shares(corners, size, places, np.concatenate([width, width]))
        across = [part[:n, None, :] for part in (shares, by_place, by_width)]
        down = [part[n:, :, None] for part in (shares, by_place, by_width)]
        light = (flux[:, None, None] * down[0]) * across[0]
        residual, weight = patches.residuals(light, parameters[:, _PLANE])
        # Single precision moves the solution by 1e-5 sigma: the residuals themselves are rounded after the difference.
        table = np.empty((n, _N_UNKNOWNS + 1, size, size), dtype=np.float32)
        root = np.sqrt(weight.astype(np.float32)).reshape(n, size, size)
        np.multiply(root, residual.astype(np.float32).reshape(root.shape), out=table[:, _N_UNKNOWNS])
        px, dx, wx = (part.astype(np.float32) for part in across)
        py, dy, wy = (part.astype(np.float32) for part in down)
        np.multiply(root * px, py, out=table[:, 2])
        for index, term in zip(_PLANE, patches.plane_terms().astype(np.float32), strict=True):
            np.multiply(root, term, out=table[:, index])
        root *= flux.astype(np.float32)[:, None, None]
        np.multiply(root * py, dx, out=table[:, 0])
        np.multiply(root * px, dy, out=table[:, 1])
        np.multiply(root, py * wx + wy * px, out=table[:, 4])
        flat = table.reshape(n, _N_UNKNOWNS + 1, -1)
        products = (flat @ flat.swapaxes(1, 2)).astype(np.float64)
        normal, right = products[:, :-1, :-1], products[:, :-1, -1]
        normal[:, 4, 4] += self.width_prior**-2
        right[:, 4] += (math.log(self.psf_sigma_px) - log_width) * self.width_prior**-2
        # A star without pixels has no information: keep the matrix regular, its covariance says so.
        tiny, level = np.full(n, 1e-6), 1e-12 / patches.noise_dn**2
        diagonal = [0, 1, 2, *_PLANE]
        normal[:, diagonal, diagonal] += np.stack([tiny, tiny, (1e-6 / flux) ** 2, level, level, level], axis=-1)
        every = np.arange(_N_UNKNOWNS)
        normal[:, every, every] *= 1.0 + _ROUNDING
        return normal, right, products[:, -1, -1], np.count_nonzero(weight, axis=1)

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

    def finish(self, solution: _Solution) -> StarFits:
        """Covariances and quality of the solution."""
        parameters, covariance = solution.parameters, solution.covariance
        freedom = np.maximum(solution.count - _N_UNKNOWNS, 1)
        inflation = chi2_inflation(solution.chi2, freedom)
        inflation *= 1.0 + _SECOND_ORDER * covariance[:, 2, 2] / parameters[:, 2] ** 2
        return StarFits(
            points_px=parameters[:, :2],
            covariance_px2=covariance[:, :2, :2] * inflation[:, None, None],
            flux_dn=parameters[:, 2],
            background_dn=self.patches.level_dn(parameters[:, _PLANE], parameters[:, :2]),
            width_px=np.exp(parameters[:, 4]),
            planes=parameters[:, _PLANE],
            reduced_chi2=solution.chi2 / freedom,
            converged=solution.good & (solution.count > _N_UNKNOWNS),
        )
