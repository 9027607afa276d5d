r"""Streaks: fits of point sources that moved during the exposure, as lines convolved with the point spread function.

The model of a pixel (i, j) is
:math:`b + s_x i + s_y j + \frac{F}{2} \int_{-1}^{1} P_x(x + t h_x)\,P_y(y + t h_y)\,dt` with the pixel shares :math:`P`
of a round Gaussian (:mod:`giantlike.processing.detection.centroid`) and half the streak :math:`(h_x, h_y)`: a source of
constant brightness that moves evenly, blurred and then integrated over the pixels, on a background that is a plane. The
middle (x, y) is where the source was at mid-exposure. The integral is a Gauss-Legendre sum, exact to 1e-6 of the flux.

Unknown per source: x, y, h_x, h_y, F, b and the slopes s of the background. The width is that of the point spread
function and given. Levenberg-Marquardt with weights :math:`1 / (\mathrm{noise}^2 + \mathrm{light} / \mathrm{gain})`
from the model, updated at every step; the covariance is the inverse Fisher information, times the reduced chi-square
where this exceeds its noise limit.

The same line with a width far below a pixel is the track of a charged particle in the detector
(:mod:`giantlike.processing.detection.particles`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, frozen
from giantlike.core.values import Value, select_rows
from giantlike.processing.detection.patches import Patches, chi2_inflation, normal_equations, pixel_shares

_N_UNKNOWNS = 8
_MAX_STEPS = 40  # Levenberg-Marquardt steps; a line that needs more gets FIT_FAILED
_SETTLED = 1e-3  # predicted decrease of chi-square at convergence: steps of 0.03 sigma
_NODE_SPACING = 1.5  # between the nodes of the integral, in widths of the line: with the spare ones exact to 1e-6
_SPARE_NODES = 4  # nodes of a line of no length
_DAMPING_START, _DAMPING_LEAST, _DAMPING_MOST = 1e-2, 1e-6, 1e8  # relative to the diagonal of the normal matrix

_LONGEST = 2.0
"""Maximum half length of a line, in half sides of its patch: a corner is at 1.4, and ends of longer lines cannot be
measured. It bounds fits of bodies, which otherwise diverge to thousands of px."""


@dataclass(frozen=True, slots=True, eq=False)
class StreakGuesses(Value):
    """Lines of light, n of them: a first guess."""

    centers_px: Float  # (n, 2); middle of each
    halves_px: Float  # (n, 2); vector from the middle to one end
    flux_dn: Float  # flux_dn, background_dn: (n,); light of each, and level underneath
    background_dn: Float

    def select(self, which: NDArray[np.integer]) -> StreakGuesses:
        """Lines of the given indices (k,)."""
        return select_rows(self, which)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineFits(Value):
    """Fitted lines of n sources."""

    centers_px: Float  # (n, 2); middle of each
    halves_px: Float  # (n, 2); vector from the middle to one end, of the two the one with x (or else y) not negative
    covariance_px2: Float  # (n, 4, 4); of center x, y and half x, y
    flux_dn: Float  # flux_dn, background_dn: (n,); light, and level of the background in the middle
    background_dn: Float
    planes: Float  # (n, 3) DN, DN/px, DN/px; background: level of the central pixel, and slopes along x and y
    chi2: Float  # (n,); weighted square residual
    n_pixels: NDArray[np.int64]  # (n,); pixels used
    converged: Mask  # (n,)

    @property
    def lengths_px(self) -> Float:
        """Distance (n,) between the ends, px."""
        return 2.0 * np.hypot(self.halves_px[:, 0], self.halves_px[:, 1])

    @property
    def ends_px(self) -> Float:
        """Both ends (n, 2, 2), px, in no order of time; coordinate last."""
        return np.stack([self.centers_px - self.halves_px, self.centers_px + self.halves_px], axis=1)

    @property
    def length_sigma_px(self) -> Float:
        """Standard deviation (n,) of :attr:`lengths_px`, px."""
        along = self.halves_px / np.maximum(self.lengths_px / 2.0, 1e-12)[:, None]
        variance = np.einsum("ni,nij,nj->n", along, self.covariance_px2[:, 2:, 2:], along)
        result: Float = 2.0 * np.sqrt(variance)
        return result


@lru_cache(maxsize=256)
def _gauss_legendre(count: int) -> tuple[Float, Float]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return frozen(nodes), frozen(weights)


def line_shares(patches: Patches, centers_px: Float, halves_px: Float, sigma_px: float) -> tuple[Float, Float]:
    """Fraction (n, w, w) of a unit line in each pixel; derivatives (n, 4, w, w) by center x, y and half x, y."""
    size, n = patches.size_px, len(centers_px)
    longest = 2.0 * float(np.hypot(*halves_px.T).max(initial=0.0))
    nodes, weights = _gauss_legendre(math.ceil(longest / (_NODE_SPACING * sigma_px)) + _SPARE_NODES)
    k = len(nodes)
    along = centers_px[:, None, :] + nodes[:, None] * halves_px[:, None, :]
    corner = np.repeat(patches.corner_px, k, axis=0)
    width = np.full(n * k, sigma_px)
    px, dpx = (v.reshape(n, k, size) for v in pixel_shares(corner[:, 0], size, along[..., 0].ravel(), width)[:2])
    py, dpy = (v.reshape(n, k, size) for v in pixel_shares(corner[:, 1], size, along[..., 1].ravel(), width)[:2])
    down = (py * (0.5 * weights)[:, None]).swapaxes(1, 2)
    slope = (dpy * (0.5 * weights)[:, None]).swapaxes(1, 2)
    moved = nodes[:, None]
    shares = down @ px
    derivatives = np.stack([down @ dpx, slope @ px, down @ (moved * dpx), slope @ (moved * px)], axis=1)
    return shares, derivatives


def fit_lines(patches: Patches, start: StreakGuesses, sigma_px: float) -> LineFits:
    """Fit a line to each patch."""
    problem = _StreakFitProblem(patches, sigma_px)
    slopes = np.zeros((len(start.flux_dn), 2))
    parameters = np.column_stack([start.centers_px, start.halves_px, start.flux_dn, start.background_dn, slopes])
    return problem.finish(*problem.solve(parameters))


@dataclass(frozen=True, slots=True)
class _StreakFitProblem:
    """Least squares of all lines: parameters (n, 8) are x, y, half x, half y, flux, background level, slopes."""

    patches: Patches
    sigma_px: float

    def select(self, which: NDArray[np.integer]) -> _StreakFitProblem:
        return _StreakFitProblem(self.patches.select(which), self.sigma_px)

    def linearize(self, parameters: Float) -> tuple[Float, Float, Float]:
        """Normal matrices (n, 8, 8), right sides (n, 8), and costs (n,): -2 ln likelihood up to a constant."""
        n, flux = len(parameters), parameters[:, 4, None, None]
        shares, derivatives = line_shares(self.patches, parameters[:, :2], parameters[:, 2:4], self.sigma_px)
        plane = np.broadcast_to(self.patches.plane_terms(), (n, 3, *shares.shape[1:]))
        jacobian = np.concatenate([flux[:, None] * derivatives, shares[:, None], plane], axis=1)
        jacobian = jacobian.reshape(n, _N_UNKNOWNS, -1)
        residual, weight = self.patches.residuals(flux * shares, parameters[:, 5:])
        normal, right = normal_equations(jacobian, residual, weight)
        cost = np.sum(weight * residual**2 - np.log(np.where(weight > 0.0, weight, 1.0)), axis=1)
        return normal, right, cost

    def solve(self, start: Float) -> tuple[Float, Mask]:
        """Levenberg-Marquardt from ``start`` (n, 8): parameters (n, 8), and a mask (n,) of fits converged inside."""
        best = start.copy()
        damping = np.full(len(start), _DAMPING_START)
        active = np.arange(len(start))
        normal, right, cost = self.linearize(best)
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            diagonal = np.einsum("nii->ni", normal[active])
            floor = 1e-9 * diagonal.max(axis=1, keepdims=True)
            damped = normal[active] + np.eye(_N_UNKNOWNS) * (damping[active, None] * diagonal + floor)[:, None, :]
            step = np.linalg.solve(damped, right[active, :, None])[:, :, 0]
            trial = best[active] + step
            trial[:, 4] = np.maximum(trial[:, 4], 0.1 * best[active, 4])
            lengths = np.hypot(trial[:, 2], trial[:, 3])
            trial[:, 2:4] *= np.minimum(1.0, _LONGEST * self.patches.half_px / np.maximum(lengths, 1e-12))[:, None]
            t_normal, t_right, t_cost = self.select(active).linearize(trial)
            better = np.isfinite(t_cost) & (t_cost <= cost[active])
            settled = (np.einsum("ni,ni->n", step, right[active]) < _SETTLED) & (better | (damping[active] > 1.0))
            taken = active[better]
            best[taken], cost[taken] = trial[better], t_cost[better]
            normal[taken], right[taken] = t_normal[better], t_right[better]
            damping[active] = np.clip(damping[active] * np.where(better, 0.2, 8.0), _DAMPING_LEAST, _DAMPING_MOST)
            active = active[~settled]
        off = np.abs(best[:, :2] - self.patches.centers_px)
        inside = np.asarray((off < self.patches.half_px + 1.0).all(axis=1))
        inside[active] = False
        return best, inside

    def finish(self, parameters: Float, good: Mask) -> LineFits:
        """Covariances and quality of the solution."""
        normal, _, _ = self.linearize(parameters)
        shares, _ = line_shares(self.patches, parameters[:, :2], parameters[:, 2:4], self.sigma_px)
        residual, weight = self.patches.residuals(parameters[:, 4, None, None] * shares, parameters[:, 5:])
        chi2, count = np.sum(weight * residual**2, axis=1), np.count_nonzero(weight, axis=1)
        inflation = chi2_inflation(chi2, np.maximum(count - _N_UNKNOWNS, 1))
        inverse = np.linalg.pinv(normal, hermitian=True)[:, :4, :4]
        covariance = (inverse + inverse.swapaxes(1, 2)) / 2.0 * inflation[:, None, None]
        half = parameters[:, 2:4]
        turned = (half[:, 0] < 0) | ((half[:, 0] == 0) & (half[:, 1] < 0))
        sign = np.where(turned, -1.0, 1.0)
        flip = np.stack([np.ones_like(sign), np.ones_like(sign), sign, sign], axis=1)
        return LineFits(
            centers_px=parameters[:, :2],
            halves_px=half * sign[:, None],
            covariance_px2=covariance * flip[:, :, None] * flip[:, None, :],
            flux_dn=parameters[:, 4],
            background_dn=self.patches.level_dn(parameters[:, 5:], parameters[:, :2]),
            planes=parameters[:, 5:],
            chi2=chi2,
            n_pixels=count,
            converged=good & (count > _N_UNKNOWNS) & (parameters[:, 4] > 0),
        )
