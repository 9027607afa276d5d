"""Numba kernels for Gaussians and their pixels, star by star: least squares, and pixel statistics for flags."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask
from giantlike.processing.detection.patches import MIN_PSF_SIGMA_PX

_CONVERGED_PX = 1e-4  # last step: a hundredth of the best centroid error of a bright star
_CONVERGED_SIGMAS = 0.35  # last step over its error: the next is a fifth of it, 0.5 % of the variance
_CONVERGED_FLUX = 0.02  # as above, relative to the flux, where that is larger: the covariance is from before it
_CONVERGED_WIDTH = 0.05  # as above, for ln sigma: flags test for width errors of a third
_REGULAR_PX, _REGULAR_PLANE = 1e-6, 1e-12
"""Information added on positions and flux, and on the plane, so that a star without pixels has a regular matrix."""
_LOG_WIDTH_LIMIT = math.log(4.0)  # largest change of ln sigma from the PSF: flags need no more than a factor 3
_LEAST_LOG_WIDTH = math.log(0.6 * MIN_PSF_SIGMA_PX)
_ROOT_2, _ROOT_PI = math.sqrt(2.0), math.sqrt(math.pi)


@compiled
def fit_patches(
    values_dn: Float,
    valid: Mask,
    saturated: Mask,
    variance_dn2: Float,
    corner_px: NDArray[np.int64],
    start: Float,
    max_steps: int,
    gain_e_per_dn: float,
    relative_noise: float,
    log_psf: float,
    width_prior: float,
) -> tuple[Float, Float, Float, NDArray[np.int64], Mask]:
    """Fit every star from its start, by Gauss-Newton.

    ``values_dn``, ``valid``, ``saturated`` (n, w, w); ``start`` (n, 7): x, y, flux, background, ln sigma, slopes of the
    background along x and y; ``log_psf``, ``width_prior``: mean and standard deviation of ln sigma a priori; returns
    ``parameters`` (n, 7), ``covariance`` (n, 7, 7), ``chi2``, ``count`` and ``settled`` (n,), False for stars that need
    more steps. The covariance is from before the last step, of a third of a sigma at most; not finite where singular.
    """
    n, size = values_dn.shape[0], values_dn.shape[1]
    parameters, covariances = start.copy(), np.empty((n, 7, 7))
    chi2s, counts, settled = np.empty(n), np.empty(n, np.int64), np.zeros(n, np.bool_)
    columns, rows = np.empty((size, 3)), np.empty((size, 3))
    sums, covariance, last, step = np.empty((8, 8)), np.empty((7, 7)), np.empty(7), np.empty(7)
    for star in range(n):
        now, pace = parameters[star], 1.0
        last[:] = 0.0
        for done in range(max_steps):
            _shares(corner_px[star, 0] - now[0], now[4], columns)
            _shares(corner_px[star, 1] - now[1], now[4], rows)
            counts[star] = _add_up(
                values_dn[star],
                valid[star],
                saturated[star],
                variance_dn2[star],
                now,
                columns,
                rows,
                gain_e_per_dn,
                relative_noise,
                sums,
            )
            sums[4, 4] += width_prior**-2
            sums[4, 7] += (log_psf - now[4]) * width_prior**-2
            for k in range(7):
                least = _REGULAR_PX if k < 2 else _REGULAR_PLANE / variance_dn2[star]
                if k == 2:
                    least = (_REGULAR_PX / now[2]) ** 2
                sums[k, k] += 0.0 if k == 4 else least
            _invert(sums, covariance)
            for k in range(7):
                step[k] = 0.0
                for m in range(7):
                    step[k] += covariance[k, m] * sums[m, 7]
            _limit(now, step, log_psf)
            # A step back is a step too far: undersampled stars overshoot for ever at full length.
            back = step[0] * last[0] + step[1] * last[1] + step[4] * last[4] < 0.0
            pace = 0.5 * pace if back else min(1.0, 1.5 * pace)
            settled[star] = _is_last(step, now, covariance, sums[7, 7] / max(counts[star], 1))
            for k in range(7):
                last[k] = step[k]
                now[k] += pace * step[k]
            if settled[star] or done == max_steps - 1:
                for k in range(7):
                    for m in range(7):
                        covariances[star, k, m] = covariance[k, m]
                chi2s[star] = sums[7, 7]
                break
    return parameters, covariances, chi2s, counts, settled


@compiled
def last_steps(steps: Float, parameters: Float, covariance: Float, reduced_chi2: Float) -> Mask:
    """True (n,) for steps (n, 7) after which another would not matter."""
    result = np.empty(len(steps), np.bool_)
    for star in range(len(steps)):
        result[star] = _is_last(steps[star], parameters[star], covariance[star], reduced_chi2[star])
    return result


@compiled
def subtract(values_dn: Float, corner_px: NDArray[np.int64], stars: NDArray[np.int64], neighbors: Float) -> None:
    """Subtract neighbors, of parameters (m, 7), from the pixels (n, w, w) of stars (m,)."""
    size = values_dn.shape[1]
    columns, rows = np.empty((size, 3)), np.empty((size, 3))
    for pair in range(len(stars)):
        star, other = stars[pair], neighbors[pair]
        _shares(corner_px[star, 0] - other[0], other[4], columns)
        _shares(corner_px[star, 1] - other[1], other[4], rows)
        for j in range(size):
            for i in range(size):
                values_dn[star, j, i] -= other[2] * rows[j, 0] * columns[i, 0]


@compiled
def star_light(
    values_dn: Float,
    valid: Mask,
    saturated: Mask,
    variance_dn2: Float,
    corner_px: NDArray[np.int64],
    points_px: Float,
    widths_px: Float,
    background_dn: Float,
    radius_px: float,
    gain_e_per_dn: float,
    model_error: float,
) -> tuple[Float, Mask, Float]:
    """Light of the stars that fit best where only their fluxes are unknown, never negative.

    ``values_dn``, ``valid``, ``saturated`` (n, w, w); returns ``light_dn``, ``used`` (n, w, w) and ``left`` (n,).
    """
    n, size = values_dn.shape[0], values_dn.shape[1]
    light, used, left = np.empty(values_dn.shape), np.zeros(values_dn.shape, np.bool_), np.zeros(n)
    columns, rows = np.empty((size, 3)), np.empty((size, 3))
    for star in range(n):
        offset_x, offset_y = corner_px[star, 0] - points_px[star, 0], corner_px[star, 1] - points_px[star, 1]
        _shares(offset_x, math.log(widths_px[star]), columns)
        _shares(offset_y, math.log(widths_px[star]), rows)
        flux = 0.0
        for _ in range(2):  # the weights depend on the flux
            seen = expected = 0.0
            for j in range(size):
                for i in range(size):
                    near = (offset_x + i) ** 2 + (offset_y + j) ** 2 <= radius_px**2
                    used[star, j, i] = near and valid[star, j, i] and not saturated[star, j, i]
                    if used[star, j, i]:
                        share = rows[j, 0] * columns[i, 0]
                        weight = share / (variance_dn2[star] + flux * share / gain_e_per_dn)
                        seen += weight * (values_dn[star, j, i] - background_dn[star])
                        expected += weight * share
            flux = max(seen / max(expected, 1e-30), 0.0)
        for j in range(size):
            for i in range(size):
                expected = light[star, j, i] = flux * rows[j, 0] * columns[i, 0]
                if used[star, j, i]:
                    variance = variance_dn2[star] + expected / gain_e_per_dn + (model_error * expected) ** 2
                    left[star] += (values_dn[star, j, i] - background_dn[star] - expected) ** 2 / variance
    return light, used, left


@compiled
def windowed_moments(
    values_dn: Float,
    valid: Mask,
    corner_px: NDArray[np.int64],
    points_px: Float,
    background_dn: Float,
    window_px: float,
    width_px: float,
) -> Float:
    """Second moments (n, 2) in Gaussian windows, see ``centroid.windowed_shape``."""
    n, size = values_dn.shape[0], values_dn.shape[1]
    result, of_light, of_star = np.empty((n, 2)), np.empty(4), np.empty(4)
    columns, rows = np.empty((size, 3)), np.empty((size, 3))
    window_x, window_y = np.empty(size), np.empty(size)
    for star in range(n):
        offset_x, offset_y = corner_px[star, 0] - points_px[star, 0], corner_px[star, 1] - points_px[star, 1]
        _shares(offset_x, math.log(width_px), columns)
        _shares(offset_y, math.log(width_px), rows)
        for k in range(size):
            window_x[k] = math.exp(-0.5 * ((offset_x + k) / window_px) ** 2)
            window_y[k] = math.exp(-0.5 * ((offset_y + k) / window_px) ** 2)
        of_light[:] = 0.0
        of_star[:] = 0.0
        for j in range(size):
            for i in range(size):
                if valid[star, j, i]:
                    window, x, y = window_y[j] * window_x[i], offset_x + i, offset_y + j
                    _add_moments(window * (values_dn[star, j, i] - background_dn[star]), x, y, of_light)
                    _add_moments(window * rows[j, 0] * columns[i, 0], x, y, of_star)
        seen, expected = max(of_light[0], 1e-300), max(of_star[0], 1e-300)
        xx, yy, xy = (
            of_light[1] / seen - of_star[1] / expected,
            of_light[2] / seen - of_star[2] / expected,
            of_light[3] / seen - of_star[3] / expected,
        )
        mean, apart = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
        result[star, 0], result[star, 1] = (mean + apart) / window_px**2 + 0.5, (mean - apart) / window_px**2 + 0.5
    return result


@compiled
def _add_moments(light: float, x: float, y: float, sums: Float) -> None:
    """Add the signal at a position to sums (4,) of it times 1, xx, yy and xy."""
    sums[0] += light
    sums[1] += light * x * x
    sums[2] += light * y * y
    sums[3] += light * x * y


@compiled
def _shares(offset: float, log_width: float, result: Float) -> None:
    """Fraction (w, 3) of the flux in each pixel along one axis, and its derivatives by position and ln sigma."""
    scale = math.exp(-log_width) / _ROOT_2
    u = (offset - 0.5) * scale
    below, bell = math.erf(u), math.exp(-u * u) / _ROOT_PI
    for k in range(len(result)):
        v = (offset + k + 0.5) * scale
        above, next_bell = math.erf(v), math.exp(-v * v) / _ROOT_PI
        result[k, 0] = 0.5 * (above - below)
        result[k, 1] = (bell - next_bell) * scale
        result[k, 2] = u * bell - v * next_bell
        u, below, bell = v, above, next_bell


@compiled
def _add_up(
    values_dn: Float,
    valid: Mask,
    saturated: Mask,
    variance_dn2: float,
    now: Float,
    columns: Float,
    rows: Float,
    gain_e_per_dn: float,
    relative_noise: float,
    sums: Float,
) -> int:
    """Upper triangle of sums (8, 8) of products of the derivatives of pixels by the unknowns, and of the residual."""
    size, half, flux, count = len(columns), len(columns) // 2, now[2], 0
    terms = np.empty(8)
    sums[:] = 0.0
    for j in range(size):
        share, by_place, by_width = rows[j, 0], rows[j, 1], rows[j, 2]
        for i in range(size):
            if not valid[j, i]:
                continue
            light = flux * share * columns[i, 0]
            residual = values_dn[j, i] - light - now[3] - now[5] * (i - half) - now[6] * (j - half)
            if saturated[j, i] and residual <= 0.0:
                continue
            weight = 1.0 / (variance_dn2 + light / gain_e_per_dn + (relative_noise * light) ** 2)
            count += weight != 0.0
            terms[0] = flux * share * columns[i, 1]
            terms[1] = flux * by_place * columns[i, 0]
            terms[2] = share * columns[i, 0]
            terms[3] = 1.0
            terms[4] = flux * (share * columns[i, 2] + by_width * columns[i, 0])
            terms[5] = i - half
            terms[6] = j - half
            terms[7] = residual
            for a in range(8):
                weighted = weight * terms[a]
                for b in range(a, 8):
                    sums[a, b] += weighted * terms[b]
    return count


@compiled
def _invert(sums: Float, result: Float) -> None:
    """Inverse (7, 7) of the first unknowns of sums, by Cholesky's factors, with unknowns scaled to unit information."""
    units, factor = np.empty(7), np.zeros((7, 7))
    for k in range(7):
        units[k] = 1.0 / math.sqrt(sums[k, k])
    for k in range(7):  # the inverse of the factor grows in the same loop: rows of a lower triangle
        for m in range(k + 1):
            total = sums[m, k] * units[k] * units[m]
            for other in range(m):
                total -= factor[k, other] * factor[m, other]
            factor[k, m] = math.sqrt(total) if k == m else total / factor[m, m]
    inverse = np.zeros((7, 7))
    for m in range(7):
        inverse[m, m] = 1.0 / factor[m, m]
        for k in range(m + 1, 7):
            total = 0.0
            for other in range(m, k):
                total -= factor[k, other] * inverse[other, m]
            inverse[k, m] = total / factor[k, k]
    for k in range(7):
        for m in range(k + 1):
            total = 0.0
            for other in range(k, 7):
                total += inverse[other, k] * inverse[other, m]
            result[k, m] = result[m, k] = total * units[k] * units[m]


@compiled
def _limit(now: Float, step: Float, log_psf: float) -> None:
    """Limit a step (7,) to the region in which the linearization is valid."""
    shorter = min(1.0, (0.7 * math.exp(now[4]) + 0.2) / max(math.hypot(step[0], step[1]), 1e-300))
    step[0] *= shorter
    step[1] *= shorter
    step[2] = min(max(step[2], -0.7 * now[2]), 4.0 * now[2])
    least = max(log_psf - _LOG_WIDTH_LIMIT, _LEAST_LOG_WIDTH)
    wanted = now[4] + min(max(step[4], -0.4), 0.4)
    step[4] = min(max(wanted, least), log_psf + _LOG_WIDTH_LIMIT) - now[4]


@compiled
def _is_last(step: Float, now: Float, covariance: Float, reduced_chi2: float) -> bool:
    """True for a step (7,) after which another would not matter."""
    across = math.sqrt((covariance[0, 0] + covariance[1, 1]) * max(1.0, reduced_chi2))
    flux, width = math.sqrt(covariance[2, 2]), math.sqrt(covariance[4, 4])
    return (
        math.hypot(step[0], step[1]) <= max(_CONVERGED_PX, _CONVERGED_SIGMAS * across)
        and abs(step[2]) <= max(_CONVERGED_FLUX * now[2], _CONVERGED_SIGMAS * flux)
        and abs(step[4]) <= max(_CONVERGED_WIDTH, _CONVERGED_SIGMAS * width)
    )
