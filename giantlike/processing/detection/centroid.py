r"""Centroids of stars: a noise-weighted Gaussian fitted to all of them at once.

The model of a pixel is :math:`b + F\,P_x P_y` with :math:`P_x = \frac12[\mathrm{erf}(u_{+}) - \mathrm{erf}(u_{-})]`,
:math:`u_{\pm} = (i \pm \frac12 - x) / (\sqrt2\,\sigma)`: a round Gaussian integrated over the pixel, so that the
centroid does not depend on where in its pixel the star falls. Unknown per star: x, y, flux F, background b and
ln sigma, the last with a loose prior around the point spread function.

Gauss-Newton with weights :math:`1 / (\mathrm{noise}^2 + F P_x P_y / \mathrm{gain})` from the model, renewed at every
step. Saturated pixels are lower bounds: they pull only while the model is below them.

The covariance is the inverse of the Fisher information (background noise, shot noise, the pixels really used) times
two factors. The first, :math:`1 + 3 \mathrm{var}(F) / F^2`, is what the linearization leaves out; it matters below a
signal to noise ratio of 20. The second is the reduced chi-square of the residuals where that is above
:math:`1 + 4 \sqrt{2 / \mathrm{dof}}`, more than noise explains: the star is then not the model (a real PSF, an
unseen neighbor, a wrong gain), and the noise is not the error. Correlation between blended stars is not modeled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import erf

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value

MIN_PSF_SIGMA_PX = 0.25
"""A narrower point spread function cannot be told from one pixel, and a fit of it has no gradient."""

_MAX_STEPS = 16
_CONVERGED_PX = 1e-4
_CONVERGED_SIGMAS = 0.02
_NONLINEAR = [0, 1, 4]  # x, y, ln sigma: the model is linear in the others
_LOG_WIDTH_LIMIT = math.log(4.0)
_MAX_SHIFT_WIDTHS = 0.5
_NEIGHBOR_ROUNDS = 3
_CHI2_SIGMAS = 4.0
_SECOND_ORDER = 3.0  # by Monte Carlo, sigma 0.5 to 2.5 px, background and shot noise: between 1 and 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patches(Value):
    """Square cut-outs of an image, one around each of n stars.

    Parameters
    ----------
    values_dn : (n, w, w) float64, DN
    valid : (n, w, w) bool
        Inside the image and not a bad pixel.
    saturated : (n, w, w) bool
    corner_px : (n, 2) int64, px
        (x, y) of the first pixel of each.
    """

    values_dn: Float
    valid: Mask
    saturated: Mask
    corner_px: NDArray[np.int64]

    @property
    def half_px(self) -> int:
        """Half side without the central pixel, px."""
        return int(self.values_dn.shape[1]) // 2

    @property
    def reach_px(self) -> float:
        """Distance within which a neighbor's light falls into a patch, px."""
        return 1.5 * self.half_px + 1.0

    def select(self, which: NDArray[np.integer]) -> Patches:
        """Return the patches of some stars."""
        return Patches(
            values_dn=self.values_dn[which],
            valid=self.valid[which],
            saturated=self.saturated[which],
            corner_px=self.corner_px[which],
        )

    def offsets_px(self, points_px: Float) -> tuple[Float, Float]:
        """Distances (n, w) of the columns and of the rows of each patch from a point (n, 2), px."""
        steps = np.arange(self.values_dn.shape[1])
        dx = self.corner_px[:, 0, None] + steps - points_px[:, 0, None]
        dy = self.corner_px[:, 1, None] + steps - points_px[:, 1, None]
        return dx, dy

    def longest_axis(self, points_px: Float, background_dn: Float, psf_sigma_px: float) -> Float:
        """Largest second moment (n,) in a Gaussian window as wide as a star, in units of the window's.

        Shifted by what a star at the same place in its pixel gives, so that stars give 0.5. A line or an edge
        gives 1, a hot pixel 0.
        """
        dx, dy = self.offsets_px(points_px)
        psf = np.full(len(points_px), max(psf_sigma_px, MIN_PSF_SIGMA_PX))
        window = math.sqrt(psf_sigma_px**2 + 1.0 / 12.0)
        window_x, window_y = np.exp(-0.5 * (dx / window) ** 2), np.exp(-0.5 * (dy / window) ** 2)
        light = np.where(self.valid, self.values_dn - background_dn[:, None, None], 0.0)
        size = light.shape[1]
        share_x = pixel_shares(self.corner_px[:, 0], size, points_px[:, 0], psf)[0]
        share_y = pixel_shares(self.corner_px[:, 1], size, points_px[:, 1], psf)[0]
        star = np.where(self.valid, share_y[:, :, None] * share_x[:, None, :], 0.0)
        moments = []
        for image in (light, star):
            seen = image * window_y[:, :, None] * window_x[:, None, :]
            xx = np.einsum("nij,nj->n", seen, dx**2)
            yy = np.einsum("nij,ni->n", seen, dy**2)
            xy = np.einsum("nij,ni,nj->n", seen, dy, dx)
            moments.append(np.stack([xx, yy, xy]) / np.maximum(seen.sum(axis=(1, 2)), 1e-300))
        xx, yy, xy = moments[0] - moments[1]
        longest: Float = ((xx + yy) / 2.0 + np.hypot((xx - yy) / 2.0, xy)) / window**2 + 0.5
        return longest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarFits(Value):
    """Fitted Gaussians of n stars.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    covariance_px2 : (n, 2, 2) float64, px^2
    flux_dn, background_dn, width_px : (n,) float64
        Integral, DN; level underneath, DN; standard deviation before pixel integration, px.
    reduced_chi2 : (n,) float64
        Weighted square residual per degree of freedom.
    converged : (n,) bool
        Came to rest less than ``1 + psf / 2`` px from the central pixel, on more pixels than unknowns.
    """

    points_px: Float
    covariance_px2: Float
    flux_dn: Float
    background_dn: Float
    width_px: Float
    reduced_chi2: Float
    converged: Mask


def cut_patches(
    pixels: NDArray[np.generic],
    bad: Mask | None,
    points_px: NDArray[np.integer],
    half_px: int,
    saturation_dn: float = math.inf,
) -> Patches:
    """Cut squares of ``2 half_px + 1`` pixels around integer points (n, 2) out of an image of any real dtype."""
    offsets = np.arange(-half_px, half_px + 1)
    columns = points_px[:, 0, None] + offsets
    rows = points_px[:, 1, None] + offsets
    height, breadth = pixels.shape
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < breadth))[:, None, :]
    index = (np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, breadth - 1)[:, None, :])
    valid = inside if bad is None else inside & ~bad[index]
    values = np.where(valid, pixels[index].astype(np.float64), 0.0)
    return Patches(
        values_dn=values,
        valid=valid,
        saturated=valid & (values >= saturation_dn),
        corner_px=np.asarray(points_px - half_px, dtype=np.int64),
    )


def fit_stars(
    patches: Patches,
    *,
    flux_dn: Float,
    noise_dn: Float,
    psf_sigma_px: float,
    gain_e_per_dn: float,
    width_prior: float = 0.25,
    isolated: bool = False,
) -> StarFits:
    r"""Fit a pixel-integrated Gaussian to each patch, starting at the middle of its central pixel.

    Parameters
    ----------
    patches : Patches
    flux_dn : (n,) float64, DN
        First guess.
    noise_dn : (n,) float64, DN
        Background noise of a pixel; the shot noise of the star itself is added.
    psf_sigma_px : float, px
        Expected width; start and prior of the fitted one. At least ``MIN_PSF_SIGMA_PX``.
    gain_e_per_dn : float, electron/DN
    width_prior : float
        Standard deviation of the prior on ln sigma: it keeps faint fits in bounds and does not touch bright ones.
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
    start = np.empty((len(flux_dn), 5))
    start[:, :2] = patches.corner_px + patches.half_px
    start[:, 2] = np.maximum(flux_dn, noise_dn)
    start[:, 3] = border_level(patches)
    start[:, 4] = math.log(psf)
    problem = _Problem(patches, noise_dn, psf, gain_e_per_dn, width_prior)
    parameters, good = problem.solve(start)
    pairs = neighbor_pairs(start[:, :2], patches.reach_px)
    for _ in range(0 if isolated else _NEIGHBOR_ROUNDS):
        near = pairs[good[pairs[:, 1]]]  # a fit that ran away must not be subtracted from its neighbors
        if not len(near):
            break
        blended = np.unique(near[:, 0])
        problem = _Problem(without_neighbors(patches, parameters, near), noise_dn, psf, gain_e_per_dn, width_prior)
        parameters[blended], good[blended] = problem.select(blended).solve(
            np.where(good[blended, None], parameters[blended], start[blended])
        )
    return problem.finish(parameters, good)


def neighbor_pairs(points_px: Float, reach_px: float) -> NDArray[np.int64]:
    """Ordered pairs (m, 2), each both ways, of points closer than ``reach_px``."""
    pairs = cKDTree(points_px).query_pairs(reach_px, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


def without_neighbors(patches: Patches, parameters: Float, pairs: NDArray[np.int64]) -> Patches:
    """Subtract from each patch the fitted stars that it is paired with."""
    of, neighbor = pairs.T
    share_x, share_y = (
        pixel_shares(patches.corner_px[of, k], patches.values_dn.shape[1], parameters[neighbor, k],
                      np.exp(parameters[neighbor, 4]))[0]
        for k in (0, 1)
    )  # fmt: skip
    values = patches.values_dn.copy()
    np.subtract.at(values, of, parameters[neighbor, 2, None, None] * share_y[:, :, None] * share_x[:, None, :])
    return Patches(values_dn=values, valid=patches.valid, saturated=patches.saturated, corner_px=patches.corner_px)


def border_level(patches: Patches) -> Float:
    """Median (n,) of the valid pixels on the rim of each patch, or of all valid ones."""
    rim = np.ones(patches.valid.shape[1:], dtype=bool)
    rim[1:-1, 1:-1] = False
    usable = patches.valid & rim
    usable = np.where(usable.any(axis=(1, 2), keepdims=True), usable, patches.valid)
    values = np.where(usable, patches.values_dn, np.inf).reshape(len(usable), -1)
    middle = np.maximum(usable.sum(axis=(1, 2)) - 1, 0) // 2
    level: Float = np.take_along_axis(np.sort(values, axis=1), middle[:, None], axis=1)[:, 0]
    return np.where(np.isfinite(level), level, 0.0)


def pixel_shares(first: NDArray[np.integer], size: int, center: Float, width: Float) -> tuple[Float, Float, Float]:
    """Share (n, size) of a unit Gaussian in each pixel along one axis, and d/d center, d/d ln width."""
    edges = first[:, None] - 0.5 + np.arange(size + 1)
    u = (edges - center[:, None]) / (math.sqrt(2.0) * width[:, None])
    bell = np.exp(-(u**2)) / math.sqrt(math.pi)
    share = 0.5 * np.diff(erf(u), axis=1)
    by_center = -np.diff(bell, axis=1) / (math.sqrt(2.0) * width[:, None])
    by_log_width = -np.diff(bell * u, axis=1)
    return share, by_center, by_log_width


@dataclass(frozen=True, slots=True)
class _Problem:
    """Least squares of all stars: parameters (n, 5) are x, y, flux, background, ln sigma."""

    patches: Patches
    noise_dn: Float
    psf_sigma_px: float
    gain_e_per_dn: float
    width_prior: float

    def select(self, which: NDArray[np.integer]) -> _Problem:
        return _Problem(
            self.patches.select(which), self.noise_dn[which], self.psf_sigma_px, self.gain_e_per_dn, self.width_prior
        )

    def solve(self, start: Float) -> tuple[Float, Mask]:
        """Gauss-Newton from ``start`` (n, 5); returns parameters and which (n,) came to rest near the peak."""
        parameters = start.copy()
        active = np.arange(len(start))
        last, pace = np.zeros_like(start), np.ones(len(start))
        problem = self
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            now = parameters[active]
            normal, right, chi2, count = problem.linearize(now)
            covariance = np.linalg.inv(normal)
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
        middle = self.patches.corner_px + self.patches.half_px
        reach = 1.0 + _MAX_SHIFT_WIDTHS * self.psf_sigma_px
        good = np.hypot(*(parameters[:, :2] - middle).T) <= reach
        good[active] = False
        return parameters, good

    def linearize(self, parameters: Float) -> tuple[Float, Float, Float, NDArray[np.int64]]:
        """Normal matrices (n, 5, 5), right sides (n, 5), chi-squares (n,) and numbers of pixels (n,)."""
        patches = self.patches
        n, size = patches.values_dn.shape[:2]
        x, y, flux, background, log_width = parameters.T
        width = np.exp(log_width)
        px, px_center, px_width = pixel_shares(patches.corner_px[:, 0], size, x, width)
        py, py_center, py_width = pixel_shares(patches.corner_px[:, 1], size, y, width)
        jacobian = np.empty((n, 5, size, size))
        scale = flux[:, None, None]
        star = py[:, :, None] * px[:, None, :]
        jacobian[:, 0] = scale * py[:, :, None] * px_center[:, None, :]
        jacobian[:, 1] = scale * py_center[:, :, None] * px[:, None, :]
        jacobian[:, 2] = star
        jacobian[:, 3] = 1.0
        jacobian[:, 4] = scale * (py[:, :, None] * px_width[:, None, :] + py_width[:, :, None] * px[:, None, :])
        model = background[:, None, None] + scale * star
        used = patches.valid & ~(patches.saturated & (model >= patches.values_dn))
        residual = np.where(used, patches.values_dn - model, 0.0).reshape(n, -1)
        variance = self.noise_dn[:, None, None] ** 2 + np.maximum(scale * star, 0.0) / self.gain_e_per_dn
        weight = (used / variance).reshape(n, -1)
        rows = jacobian.reshape(n, 5, -1)
        weighted = rows * weight[:, None, :]
        normal = weighted @ rows.swapaxes(1, 2)
        right = (weighted @ residual[:, :, None])[:, :, 0]
        normal[:, 4, 4] += self.width_prior**-2
        right[:, 4] += (math.log(self.psf_sigma_px) - log_width) * self.width_prior**-2
        # A star without pixels has no information: keep the matrix regular, its covariance says so.
        diagonal = np.arange(4)
        normal[:, diagonal, diagonal] += np.stack(
            [np.full(n, 1e-6), np.full(n, 1e-6), (1e-6 / flux) ** 2, 1e-12 / self.noise_dn**2], axis=-1
        )
        chi2 = np.sum(weight * residual**2, axis=1)
        return normal, right, chi2, used.reshape(n, -1).sum(axis=1)

    def limited(self, parameters: Float, step: Float) -> Float:
        """Shorten steps that leave the region where the linearization means something."""
        reach = 0.7 * np.exp(parameters[:, 4]) + 0.2
        length = np.hypot(step[:, 0], step[:, 1])
        result = step.copy()
        result[:, :2] *= np.minimum(1.0, reach / np.maximum(length, 1e-300))[:, None]
        flux = parameters[:, 2]
        result[:, 2] = np.clip(step[:, 2], -0.7 * flux, 4.0 * flux)
        middle = math.log(self.psf_sigma_px)
        wanted = np.clip(parameters[:, 4] + np.clip(step[:, 4], -0.4, 0.4), middle - _LOG_WIDTH_LIMIT,
                         middle + _LOG_WIDTH_LIMIT)  # fmt: skip
        result[:, 4] = np.maximum(wanted, math.log(0.6 * MIN_PSF_SIGMA_PX)) - parameters[:, 4]
        return result

    def finish(self, parameters: Float, good: Mask) -> StarFits:
        """Covariances and quality of the solution."""
        normal, _, chi2, count = self.linearize(parameters)
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        freedom = np.maximum(count - 5, 1)
        reduced = chi2 / freedom
        inflation = np.where(reduced > 1.0 + _CHI2_SIGMAS * np.sqrt(2.0 / freedom), reduced, 1.0)
        inflation *= 1.0 + _SECOND_ORDER * covariance[:, 2, 2] / parameters[:, 2] ** 2
        return StarFits(
            points_px=parameters[:, :2].copy(),
            covariance_px2=covariance[:, :2, :2] * inflation[:, None, None],
            flux_dn=parameters[:, 2].copy(),
            background_dn=parameters[:, 3].copy(),
            width_px=np.exp(parameters[:, 4]),
            reduced_chi2=reduced,
            converged=good & (count > 5),
        )
