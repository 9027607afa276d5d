"""Least squares of one cell of a horizon after the other, compiled: fits of :mod:`giantlike.relative.horizon.cells`."""

from __future__ import annotations

import math

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask
from giantlike.core.elimination import RIDGE, solve_normal, solve_symmetric
from giantlike.relative.horizon.profile import Indices

_REFITS = 2  # fits with the noise of the brightness fitted before; one or four change ellipsoid_cra by up to 0.06 sigma
_CLIPS, _CLIP_SIGMAS = 3, 5.0
"""Most fits without the pixels that lie far from the one before; and noise that is allowed for, in sigmas."""
_MIN_FREEDOM = 5  # pixels in a cell beyond the number of its parameters; with fewer, its chi-square says nothing
_TINY = float(np.finfo(np.float64).tiny)


@compiled
def fit_profiles(
    first: Indices,
    data_dn: Float,
    along: Float,
    value: Float,
    slope: Float,
    curve: Float,
    largest_left: float,
    dark_dn2: float,
    gain_e_per_dn: float,
    relative_noise: float,
) -> tuple[Float, Float, Float]:
    """Fit the profiles of each cell, leaving out pixels that are far from the fit.

    ``first`` (c + 1,), the first pixel of each cell, and n; ``data_dn``, ``along`` (n,); ``value`` (n, p + q);
    ``slope``, ``curve`` (n, p); returns ``information`` (c, 1 + s, 1 + s), ``pull`` (c, 1 + s) and ``rest`` (5, c).
    """
    cells, free = len(first) - 1, slope.shape[1] - 1
    inner = free + 2  # parameters of a cell: the powers that are free, growth along it, background
    outer = 2 + value.shape[1] - free  # shift, blur, and the other profiles
    information, pull, rest = np.empty((cells, outer, outer)), np.empty((cells, outer)), np.empty((5, cells))
    for cell in range(cells):
        some = slice(first[cell], first[cell + 1])
        data, n = data_dn[some], first[cell + 1] - first[cell]
        terms, kept, left = np.empty((n, inner + outer)), np.ones(n, np.bool_), np.empty(n)
        for k in range(n):
            pixel = first[cell] + k
            for power in range(free):
                terms[k, power] = value[pixel, power]
            terms[k, free] = along[pixel] * value[pixel, 0]
            terms[k, free + 1] = 1.0
        for _ in range(_CLIPS):
            weights, solution = _brightness(terms[:, :inner], data, kept, dark_dn2, gain_e_per_dn, relative_noise)
            inside, gain = _other_terms(value[some], slope[some], curve[some], kept, solution, terms)
            count = 0
            for k in range(n):
                count += kept[k]
            freedom = count - inner - outer
            remains = _eliminate_profile(terms, inner, data, weights, freedom, information[cell], pull[cell], left)
            step = max(inside, _TINY)  # not 0, for the largest may be infinite
            far = 0
            for k in range(n):
                noise = math.sqrt(_variance(data[k] - left[k], dark_dn2, gain_e_per_dn, relative_noise))
                if kept[k] and abs(left[k]) > _CLIP_SIGMAS * noise + largest_left * step:
                    kept[k] = False
                    far += 1
            rms = math.sqrt(remains / max(weights.sum(), RIDGE))
            rest[0, cell] = np.inf if freedom < _MIN_FREEDOM else remains / max(freedom, 1)
            rest[1, cell] = gain
            rest[2, cell] = inside * math.sqrt(weights.max())
            rest[3, cell] = rms / inside if inside > 0.0 else np.inf
            rest[4, cell] = (count - far) / n
            if far == 0:
                break
    return information, pull, rest


@compiled
def _brightness(
    columns: Float, data: Float, kept: Mask, dark_dn2: float, gain_e_per_dn: float, relative_noise: float
) -> tuple[Float, Float]:
    """Weights (n,) by the noise of the fitted brightness and the solution (m,) for the columns (n, m) of a cell."""
    n, inner = columns.shape
    weights, solution, normal = np.empty(n), np.empty((inner, 1)), np.empty((inner, inner))
    for done in range(_REFITS + 1):
        for k in range(n):
            light = data[k]
            if done > 0:
                light = 0.0
                for i in range(inner):
                    light += columns[k, i] * solution[i, 0]
            weights[k] = kept[k] / _variance(light, dark_dn2, gain_e_per_dn, relative_noise)
        normal[:] = 0.0
        solution[:] = 0.0
        for k in range(n):
            for i in range(inner):
                weighted = weights[k] * columns[k, i]
                solution[i, 0] += weighted * data[k]
                for j in range(i, inner):
                    normal[i, j] += weighted * columns[k, j]
        solve_normal(normal, solution)
    return weights, solution[:, 0]


@compiled
def _other_terms(
    value: Float, slope: Float, curve: Float, kept: Mask, solution: Float, terms: Float
) -> tuple[float, float]:
    """Fill in the columns of the shared parameters; return the brightness inside and the gain, DN, of a cell.

    Profiles that may be mixed in are made as bright as what is free in the cell.
    """
    n, count = value.shape
    free = slope.shape[1] - 1
    inside, largest, gains = 0.0, np.zeros(count), np.empty(count)
    for k in range(n):
        if not kept[k]:
            continue
        light = 0.0
        for power in range(free):
            light += value[k, power] * solution[power]
        inside = max(inside, light)
        for profile in range(count):
            largest[profile] = max(largest[profile], value[k, profile])
    for profile in range(count):
        gains[profile] = inside / max(largest[profile], RIDGE)
    gains[free] = gains[0]
    shift = free + 2
    for k in range(n):
        by_shift, by_blur = 0.0, 0.0
        for power in range(free):
            by_shift -= slope[k, power] * solution[power]
            by_blur += 0.5 * curve[k, power] * solution[power]
        terms[k, shift], terms[k, shift + 1] = by_shift, by_blur
        for profile in range(free, count):
            terms[k, shift + 2 + profile - free] = value[k, profile] * gains[profile]
    return inside, gains[0]


@compiled
def _eliminate_profile(
    terms: Float, inner: int, data: Float, weights: Float, freedom: int, information: Float, pull: Float, left: Float
) -> float:
    """Weighted squares that a cell leaves with all free; fill in what it says of the last of its terms and residuals.

    ``terms`` (n, i + o); ``data`` (n,) DN; ``weights`` (n,) 1/DN^2; ``information`` (o, o), ``pull`` (o,); ``left``
    (n,) DN.
    """
    n, total = terms.shape
    outer = total - inner
    sums, right = np.zeros((total, total)), np.zeros(total)
    for k in range(n):
        for i in range(total):
            weighted = weights[k] * terms[k, i]
            right[i] += weighted * data[k]
            for j in range(i, total):
                sums[i, j] += weighted * terms[k, j]
    own = np.empty((inner, 1 + outer))  # solution, and what of it the shared terms take
    for m in range(inner):
        own[m, 0] = right[m]
        for i in range(outer):
            own[m, 1 + i] = sums[m, inner + i]
    solve_normal(sums[:inner, :inner].copy(), own)
    trace = 0.0
    for i in range(outer):
        pull[i] = right[inner + i]
        for m in range(inner):
            pull[i] -= sums[m, inner + i] * own[m, 0]
        for j in range(i, outer):
            gained = sums[inner + i, inner + j]
            for m in range(inner):
                gained -= sums[m, inner + i] * own[m, 1 + j]
            if freedom < _MIN_FREEDOM:
                gained = RIDGE if i == j else 0.0
            information[i, j] = information[j, i] = gained
        trace += information[i, i]
    estimate = np.empty((outer, 1))
    for i in range(outer):
        information[i, i] += RIDGE * max(trace, 1e-30)
        estimate[i, 0] = pull[i]
    solve_symmetric(information.copy(), estimate)
    remains = 0.0
    for m in range(inner):
        for i in range(outer):
            own[m, 0] -= own[m, 1 + i] * estimate[i, 0]
    for k in range(n):
        left[k] = data[k]
        for m in range(inner):
            left[k] -= terms[k, m] * own[m, 0]
        for i in range(outer):
            left[k] -= terms[k, inner + i] * estimate[i, 0]
        remains += weights[k] * left[k] ** 2
    return remains


@compiled
def _variance(light_dn: float, dark_dn2: float, gain_e_per_dn: float, relative_noise: float) -> float:
    """Noise variance of a pixel, DN^2: ``Detector.variance_dn2``."""
    light = max(light_dn, 0.0)
    return dark_dn2 + light / gain_e_per_dn + (relative_noise * light) ** 2
