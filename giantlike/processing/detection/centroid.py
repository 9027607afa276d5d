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

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value, select_rows
from giantlike.processing.detection.matched_filter import Image32
from giantlike.processing.detection.patches import (
    MIN_PSF_SIGMA_PX,
    Patches,
    chi2_inflation,
    inverses,
    pixel_shares,
    shares_by_pixel,
)

_MAX_STEPS = 16  # a star that has not converged after so many gets FIT_FAILED
_STEPS_ALONE = 4  # before neighbors are subtracted: what has not converged goes on together with what has neighbors
_CONVERGED_PX = 1e-4  # last step: a hundredth of the best centroid error of a bright star
_CONVERGED_SIGMAS = 0.35  # last step over its error: the next is a fifth of it, 0.5 % of the variance
_CONVERGED_FLUX = 0.02  # the same over the flux, where that is more: the covariance is that before it
_CONVERGED_WIDTH = 0.05  # the same of ln sigma: flags ask for widths off by a third
_N_UNKNOWNS = 7
_ROUNDING = 3e-6  # of the diagonal: above what single precision may take off an eigenvalue of fits to a few pixels
_BLOCK = 512  # stars fitted together: derivatives by patches of 9 x 9 pixels are then 1.3 MB
_PLANE = [3, 5, 6]  # level of the background and its slopes, of these unknowns
_FACTORS = ((0, 1), (1, 0), (0, 0), (3, 3), (2, 0), (3, 4), (4, 3), (0, 2))
"""Functions of row and column whose product is the derivative of a pixel by each unknown, the second term of ln sigma
last. Functions: share of the light, its derivatives by place and by ln sigma, one, and the distance from the middle."""
_PAIR = {pair: k for k, pair in enumerate((i, j) for i in range(5) for j in range(i, 5))}
_TERMS = np.array([15 * _PAIR[min(a, 3), max(a, 3)] + _PAIR[min(b, 3), max(b, 3)] for a, b in _FACTORS])
_PAIRS = np.array(
    [15 * _PAIR[min(a, c), max(a, c)] + _PAIR[min(b, d), max(b, d)] for a, b in _FACTORS for c, d in _FACTORS]
)
"""Sums of products of all pairs of derivatives, among those of all pairs of functions of rows and of columns."""
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
    level_dn = patches.border_level_dn()
    start = np.column_stack([places, flux_dn, level_dn, log_width, slopes])
    problem = _Problem.of(patches, level_dn, psf, width_prior)
    if isolated:
        return _finished(patches, problem.solve(start, _MAX_STEPS))
    solution = problem.solve(start, _STEPS_ALONE)
    pairs = neighbor_pairs(patches.centers_px.astype(np.float64), patches.reach_px)
    changed = np.ones(len(start), dtype=bool)
    for done in range(_NEIGHBOR_ROUNDS):
        near = pairs[solution.good[pairs[:, 1]]]  # a fit that ran away must not be subtracted from its neighbors
        again = np.zeros(len(start), dtype=bool)
        again[near[changed[near[:, 1]], 0]] = True
        if done:
            again &= solution.good  # what did not converge without its neighbors never will
        restarted = again & ~solution.good
        which = np.flatnonzero(again if done else again | solution.unsettled)
        if not which.size:
            break
        before = solution.parameters[which]
        first = np.where(restarted[which, None], start[which], before)
        found = problem.without(solution.parameters, near, which).solve(first, _MAX_STEPS)
        solution.replace(which, found)
        changed[:] = False
        changed[which] = ~_is_last(found.parameters - before, before, found.covariance, found.reduced_chi2)
    return _finished(patches, solution)


def neighbor_pairs(points_px: Float, reach_px: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of indices, in both orders, of points (n, 2) closer than ``reach_px``."""
    tree = cKDTree(points_px, balanced_tree=False, compact_nodes=False)  # for one use: faster to build
    pairs = tree.query_pairs(reach_px, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


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

    Covariance and chi-square are those before the last step, a tenth of a sigma at most. ``unsettled`` (n,) are those
    that want more steps.
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

    def replace(self, which: NDArray[np.integer], other: _Solution) -> None:
        """Take over the solution of the stars of these indices (k,)."""
        for field in fields(self):
            getattr(self, field.name)[which] = getattr(other, field.name)


@dataclass(frozen=True, slots=True, eq=False)
class _Problem(Value):
    """Least squares of all stars: parameters (n, 7) are x, y, flux, background, ln sigma, slopes along x and y.

    Pixels are in single precision, above a level of their own: this moves a solution by 1e-5 sigma.

    Parameters
    ----------
    values_dn : (n, w, w) float32, DN
        Above the level.
    level_dn : (n,) float64, DN
    valid : (n, w, w) float32
        One for pixels that count, zero for others.
    saturated : (n, w, w) bool
        Lower bounds: they count only where the model is below them.
    variance_dn2 : (n, 1, 1) float32, DN^2
        Of the background of a pixel.
    corner_px : (n, 2) int64, px
    gain_e_per_dn, relative_noise, psf_sigma_px, width_prior : float
    any_saturated : bool
    """

    values_dn: Image32
    level_dn: Float
    valid: Image32
    saturated: Mask
    variance_dn2: Image32
    corner_px: NDArray[np.int64]
    gain_e_per_dn: float
    relative_noise: float
    psf_sigma_px: float
    width_prior: float
    any_saturated: bool

    @classmethod
    def of(cls, patches: Patches, level_dn: Float, psf_sigma_px: float, width_prior: float) -> _Problem:
        """Fit of ``patches``, whose backgrounds lie near ``level_dn`` (n,)."""
        return cls(
            values_dn=(patches.values_dn - level_dn[:, None, None]).astype(np.float32),
            level_dn=level_dn,
            valid=patches.valid.astype(np.float32),
            saturated=patches.saturated,
            variance_dn2=(patches.noise_dn[:, None, None] ** 2).astype(np.float32),
            corner_px=patches.corner_px,
            gain_e_per_dn=patches.gain_e_per_dn,
            relative_noise=patches.relative_noise,
            psf_sigma_px=psf_sigma_px,
            width_prior=width_prior,
            any_saturated=bool(patches.saturated.any()),
        )

    def select(self, which: NDArray[np.integer] | slice) -> _Problem:
        return select_rows(self, which)

    def without(self, parameters: Float, pairs: NDArray[np.int64], which: NDArray[np.int64]) -> _Problem:
        """Stars ``which`` (k,), ascending, minus the fitted stars that each of them is paired with."""
        chosen = self.select(which)
        of, neighbor = pairs[np.isin(pairs[:, 0], which)].T
        if not of.size:
            return chosen
        size, corner = self.values_dn.shape[1], self.corner_px[of]
        places, width = parameters[neighbor, :2], np.exp(parameters[neighbor, 4])
        across, down = (pixel_shares(corner[:, k], size, places[:, k], width)[0].astype(np.float32) for k in (0, 1))
        light = (parameters[neighbor, 2, None, None].astype(np.float32) * down[:, :, None]) * across[:, None, :]
        values = chosen.values_dn.copy()
        np.subtract.at(values, np.searchsorted(which, of), light)
        return replace(chosen, values_dn=values)

    def solve(self, start: Float, steps: int) -> _Solution:
        """Gauss-Newton from ``start`` (n, 7)."""
        n = len(start)
        solution = _Solution(
            parameters=start.copy(),
            covariance=np.empty((n, _N_UNKNOWNS, _N_UNKNOWNS)),
            chi2=np.empty(n),
            count=np.empty(n, dtype=np.int64),
            good=np.ones(n, dtype=bool),
            unsettled=np.zeros(n, dtype=bool),
        )
        active, problem, now = np.arange(n), self, start
        last, pace = np.zeros_like(start), np.ones(n)
        for done in range(1, steps + 1):
            covariance, step, chi2, count = problem.stepped(now)
            # A step back is a step too far: undersampled stars overshoot for ever at full length.
            back = np.einsum("nk,nk->n", step[:, _NONLINEAR], last[:, _NONLINEAR]) < 0.0
            pace = np.where(back, 0.5 * pace, np.minimum(1.0, 1.5 * pace))
            after = now + pace[:, None] * step
            still = _is_last(step, now, covariance, chi2 / np.maximum(count, 1))
            ended, more = np.flatnonzero(still | (done == steps)), np.flatnonzero(~still)
            which = active[ended]
            solution.parameters[which], solution.covariance[which] = after[ended], covariance[ended]
            solution.chi2[which], solution.count[which] = chi2[ended], count[ended]
            active, last, pace, now = active[more], step[more], pace[more], after[more]
            if done == steps or not more.size:
                break
            if ended.size:
                problem = problem.select(more)
        reach = 1.0 + _MAX_SHIFT_WIDTHS * self.psf_sigma_px
        away = solution.parameters[:, :2] - (self.corner_px + self.values_dn.shape[1] // 2)
        solution.good[:] = np.hypot(*away.T) <= reach
        solution.good[active], solution.unsettled[active] = False, True
        return solution

    def stepped(self, parameters: Float) -> tuple[Float, Float, Float, NDArray[np.int64]]:
        """Covariances (n, 7, 7), steps (n, 7), chi-squares (n,), pixels (n,): a block of stars at a time.

        The pixels of a block stay in the cache.
        """
        parts = []
        for first in range(0, len(parameters), _BLOCK):
            which = slice(first, first + _BLOCK)
            block = self if len(parameters) <= _BLOCK else self.select(which)
            normal, right, chi2, count = block.linearize(parameters[which])
            covariance = inverses(normal)
            step = block.limited(parameters[which], (covariance @ right[:, :, None])[:, :, 0])
            parts.append((covariance, step, chi2, count))
        if len(parts) == 1:
            return parts[0]
        covariances, steps, chi2s, counts = (np.concatenate(part) for part in zip(*parts, strict=True))
        return covariances, steps, chi2s, counts

    def linearize(self, parameters: Float) -> tuple[Float, Float, Float, NDArray[np.int64]]:
        """Normal matrices (n, 7, 7), right sides (n, 7), chi-squares (n,) and numbers of pixels (n,)."""
        n, flux = len(parameters), parameters[:, 2]
        columns, rows = self._products(parameters)
        residual, weight = self._residuals(parameters, columns[:, :, _PAIR[0, 3]], rows[:, _PAIR[0, 3]])
        weighted = weight * residual
        chi2 = np.einsum("nij,nij->n", weighted, residual).astype(np.float64)
        # Every derivative is a product of a function of the row and one of the column, so that sums over pixels are
        # products of matrices: for pairs of derivatives with products of two functions each.
        sums, single = ((rows @ (part @ columns)).reshape(n, -1) for part in (weight, weighted))
        gram = sums.take(_PAIRS, axis=1).astype(np.float64).reshape(n, _N_UNKNOWNS + 1, -1)
        right = single.take(_TERMS, axis=1).astype(np.float64)
        gram[:, 4] += gram[:, 7]  # the derivative by ln sigma has two terms
        gram[:, :, 4] += gram[:, :, 7]
        right[:, 4] += right[:, 7]
        gram[:, 2] /= flux[:, None]  # the factors hold the flux: so far the derivative was by its logarithm
        gram[:, :, 2] /= flux[:, None]
        right[:, 2] /= flux
        normal, right = gram[:, :-1, :-1], right[:, :-1]
        normal[:, 4, 4] += self.width_prior**-2
        right[:, 4] += (math.log(self.psf_sigma_px) - parameters[:, 4]) * self.width_prior**-2
        # A star without pixels has no information: keep the matrix regular, its covariance says so.
        level = 1e-12 / self.variance_dn2[:, 0, 0].astype(np.float64)
        diagonal = np.einsum("nii->ni", normal)
        diagonal[:, :2] += 1e-6
        diagonal[:, 2] += (1e-6 / flux) ** 2
        diagonal[:, _PLANE] += level[:, None]
        diagonal *= 1.0 + _ROUNDING
        return normal, right, chi2, np.count_nonzero(weight, axis=(1, 2))

    def _products(self, parameters: Float) -> tuple[Image32, Image32]:
        """Products (n, w, 15) and (n, 15, w) of pairs of functions of the column and of the row, those times the flux.

        They are made for one pixel and pair after the other, of all stars, and turned around.
        """
        n, size = len(parameters), self.values_dn.shape[1]
        width = np.exp(parameters[:, 4])
        shares = shares_by_pixel((self.corner_px - parameters[:, :2]).T, size, width)
        factors = np.empty((2, 5, size, n), dtype=np.float32)
        for k, part in enumerate(shares):
            factors[0, k], factors[1, k] = part[:, 0], part[:, 1] * parameters[:, 2]
        factors[:, 3] = 1.0
        factors[:, 4] = np.arange(size)[:, None] - size // 2
        columns, rows = np.empty((size, 15, n), dtype=np.float32), np.empty((15, size, n), dtype=np.float32)
        for k in range(5):
            pairs = slice(_PAIR[k, k], _PAIR[k, 4] + 1)
            np.multiply(factors[1, k:], factors[1, k], out=rows[pairs])
            np.multiply(factors[0, k:], factors[0, k], out=columns.swapaxes(0, 1)[pairs])
        turned = [np.asarray(cv2.transpose(part.reshape(-1, n)), dtype=np.float32) for part in (columns, rows)]
        return turned[0].reshape(n, size, 15), turned[1].reshape(n, 15, size)

    def _residuals(self, parameters: Float, across: Image32, down: Image32) -> tuple[Image32, Image32]:
        """Residuals and inverse variances (n, w, w): shares (n, w) of columns times light (n, w) of rows."""
        slope_x, slope_y = (parameters[:, k, None].astype(np.float32) for k in (5, 6))
        base = (parameters[:, 3] - self.level_dn).astype(np.float32)
        steps = np.arange(across.shape[1], dtype=np.float32) - across.shape[1] // 2
        light = down[:, :, None] @ across[:, None, :]
        residual = self.values_dn - light
        residual -= (base[:, None] + slope_x * steps)[:, None, :]
        residual -= (slope_y * steps)[:, :, None]
        light *= np.float32(1.0 / self.gain_e_per_dn)
        if self.relative_noise:
            light += (np.float32(self.relative_noise * self.gain_e_per_dn) * light) ** 2
        light += self.variance_dn2
        weight = np.divide(self.valid, light, out=light)
        if self.any_saturated:
            weight[self.saturated & (residual <= 0.0)] = 0.0
        return residual, weight

    def limited(self, parameters: Float, step: Float) -> Float:
        """Limit steps (n, 7) to the region in which the linearization is valid."""
        flux, log_width = parameters[:, 2], parameters[:, 4]
        reach = 0.7 * np.exp(log_width) + 0.2
        length = np.hypot(step[:, 0], step[:, 1])
        result = step.copy()
        result[:, :2] *= np.minimum(1.0, reach / np.maximum(length, 1e-300))[:, None]
        result[:, 2] = np.minimum(np.maximum(step[:, 2], -0.7 * flux), 4.0 * flux)
        usual = math.log(self.psf_sigma_px)
        least = max(usual - _LOG_WIDTH_LIMIT, math.log(0.6 * MIN_PSF_SIGMA_PX))
        wanted = log_width + np.minimum(np.maximum(step[:, 4], -0.4), 0.4)
        result[:, 4] = np.minimum(np.maximum(wanted, least), usual + _LOG_WIDTH_LIMIT) - log_width
        return result


def _finished(patches: Patches, solution: _Solution) -> StarFits:
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
