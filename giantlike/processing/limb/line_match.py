"""Numba kernels that match profiles of lines with expected ones: :func:`.scan.match_profiles` in three parts.

Between the parts, the noise follows from the brightness of all lines, and the prior of slopes from their slopes.
"""

from __future__ import annotations

import math

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Indices, Mask
from giantlike.core.elimination import solve_normal

_REFINEMENTS = 2  # linear steps before the last one, after the search in multiples of the sampling step
_DARK = 1e-100  # root of the information on a slope below which the expected profile is dark
_FLAT = 1e-9  # spread of the values of a window over their size, below which it is flat
_HELD = 1e12  # information relative to a line's: fixes a slope at zero
_COLUMNS = 4  # of a match: profile, offset, outward shift, slope


@compiled
def find_shifts(
    values: Float,
    usable: Mask,
    expected: Float,
    about_px: Float,
    step_px: float,
    half: int,
    most: int,
    rival_px: float,
    least: int,
    core: int,
) -> tuple[Indices, Float, Float, Float, Float, Mask, Mask]:
    """Find the shift of best correlation with the expected profile of each line, or start from a given one.

    ``values``, ``expected`` (n, m); ``about_px`` (n,), NaN for the best correlation; returns ``lag`` (n,), steps from
    the innermost position; ``shift_px`` (n,), from there to ``about_px``, or 0; ``best``, ``rival`` (n,), correlation
    there and at the best other position, or -1; ``light_dn``, ``used`` (n, w); ``complete`` (n,).
    """
    n, middle, width, lags = len(values), values.shape[1] // 2, 2 * half + 1, 2 * most + 1
    lag, shift, best, rival = np.empty(n, np.int64), np.zeros(n), np.empty(n), np.full(n, -1.0)
    light, columns, target, correlation = (
        np.empty((n, width)),
        np.empty((width, _COLUMNS)),
        np.empty(width),
        np.empty(lags),
    )
    every, complete = np.ones((n, width), np.bool_), np.ones(n, np.bool_)
    one, normal, right = np.ones(width), np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, 1))
    for line in range(n):
        profile = expected[line, middle - half : middle + half + 1]
        mean, length = profile.mean(), 0.0
        for i in range(width):
            target[i] = profile[i] - mean
            length += target[i] ** 2
        length = max(math.sqrt(length), 1e-300)
        for i in range(width):
            target[i] /= length
        for k in range(lags):
            total, square, product = 0.0, 0.0, 0.0
            for i in range(width):
                value = values[line, middle - half - most + k + i]
                total += value
                square += value * value
                product += value * target[i]
            spread = math.sqrt(max(square - total * total / width, 0.0))
            correlation[k] = product / spread if spread > _FLAT * math.sqrt(square) else 0.0
        good = usable[line, middle - half - most : middle + half + most + 1]
        whole = good.all()
        if not whole:
            for k in range(lags):
                data = values[line, middle - half - most + k :][:width]
                correlation[k] = _correlation(data, target, good[k : k + width], least)
        lag[line] = np.argmax(correlation)
        if np.isfinite(about_px[line]):
            lag[line] = min(max(int(np.rint(about_px[line] / step_px)) + most, 0), 2 * most)
            shift[line] = about_px[line] - (lag[line] - most) * step_px
        best[line] = correlation[lag[line]]
        for k in range(lags):
            highest = (k == 0 or correlation[k] >= correlation[k - 1]) and (
                k == lags - 1 or correlation[k] >= correlation[k + 1]
            )
            if highest and abs(k - lag[line]) * step_px > rival_px:
                rival[line] = max(rival[line], correlation[k])
        data = values[line, middle - half - most + lag[line] :][:width]
        one[:] = 1.0
        if not whole:
            there = good[lag[line] : lag[line] + width]
            complete[line] = there.sum() >= least and there[half - core : half + core + 1].all()
            if complete[line]:
                for i in range(width):
                    every[line, i] = there[i]
                    one[i] = there[i]
        _fill(expected[line], shift[line], step_px, half, columns)
        _fit(columns, data, one, normal, right)
        for i in range(width):
            light[line, i] = max(columns[i, 0] * right[0, 0] + right[1, 0], 0.0)
    return lag, shift, best, rival, light, every, complete


@compiled
def refine_shifts(
    values: Float,
    expected: Float,
    lag: Indices,
    shift_px: Float,
    fixed: Mask,
    weights: Float,
    step_px: float,
    half: int,
    most: int,
) -> tuple[Float, Float, Float, Float]:
    """Shift each line to its best position by linear steps, and fit it there with a free slope.

    ``values``, ``expected`` (n, m); ``lag`` (n,); ``shift_px`` (n,), as of :func:`find_shifts`; ``fixed`` (n,);
    ``weights`` (n, w) 1/DN^2; returns ``shift_px`` (n,); ``free`` (n, 4), gain, offset, gain times the remaining shift,
    gain times slope; ``slope_variance`` (n,), infinite where the expected profile is dark; ``without_slope`` (n, 2).
    """
    n, middle, width = len(values), values.shape[1] // 2, 2 * half + 1
    shifts, free, variance, without = shift_px.copy(), np.empty((n, _COLUMNS)), np.full(n, np.inf), np.empty((n, 2))
    columns, normal = np.empty((width, _COLUMNS)), np.empty((_COLUMNS, _COLUMNS))
    right, unit = np.empty((_COLUMNS, 1)), np.empty((_COLUMNS, 1))
    for line in range(n):
        data = values[line, middle - half - most + lag[line] :][:width]
        _fill(expected[line], shifts[line], step_px, half, columns)
        for _ in range(_REFINEMENTS):
            if fixed[line]:
                break
            _fit(columns, data, weights[line], normal, right)
            shifts[line] = min(max(shifts[line] + quotient(right[2, 0], right[0, 0]), -step_px), step_px)
            _fill(expected[line], shifts[line], step_px, half, columns)
        _fit(columns, data, weights[line], normal, right)
        for a in range(_COLUMNS):
            free[line, a] = right[a, 0]
        _sums(columns, data, weights[line], normal, right)
        if normal[3, 3] > _DARK**2:
            unit[:] = 0.0
            unit[3, 0] = 1.0
            solve_normal(normal, unit)
            variance[line] = unit[3, 0]
        _sums(columns, data, weights[line], normal, right)
        solve_normal(normal, right[: _COLUMNS - 1])
        without[line, 0], without[line, 1] = right[0, 0], right[2, 0]
    return shifts, free, variance, without


@compiled
def fit_lines(
    values: Float,
    expected: Float,
    others: Float,
    lag: Indices,
    shift_px: Float,
    weights: Float,
    variance_dn2: Float,
    stiffness: Float,
    correlation: Float,
    step_px: float,
    half: int,
    most: int,
) -> tuple[Float, Float, Float, Float, Float, Float]:
    """Fit each line with the prior of slopes, and find its information on parameters common to all lines.

    ``values``, ``expected`` (n, m); ``others`` (n, m, c); ``lag`` (n,); ``shift_px`` (n,), as of :func:`refine_shifts`;
    ``weights``, ``variance_dn2`` (n, w); ``stiffness`` (n,) 1/DN^2; ``correlation`` (w, w); returns ``solution`` (n,
    4), as ``free`` of :func:`refine_shifts`; ``noise`` (n,); ``left_rms`` (n,) DN; ``taken`` (n, 4, c), derivative of
    the solution by each shared parameter; ``information`` (n, c, c); ``pull`` (n, c).
    """
    n, middle, width, count = len(values), values.shape[1] // 2, 2 * half + 1, others.shape[2]
    solutions, noises, rms = np.empty((n, _COLUMNS)), np.empty(n), np.empty(n)
    taken, information, pull = np.zeros((n, _COLUMNS, count)), np.zeros((n, count, count)), np.zeros((n, count))
    columns, normal, right = np.empty((width, _COLUMNS)), np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, 1))
    inverse, operator, changes = np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, width)), np.empty((width, count))
    noise, own = np.empty(width), np.empty(count)
    for line in range(n):
        data = values[line, middle - half - most + lag[line] :][:width]
        _fill(expected[line], shift_px[line], step_px, half, columns)
        _sums(columns, data, weights[line], normal, right)
        normal[3, 3] += min(stiffness[line], _HELD * normal[3, 3])
        inverse[:] = 0.0
        for a in range(_COLUMNS):
            inverse[a, a] = 1.0
        solve_normal(normal, inverse)
        for a in range(_COLUMNS):
            solutions[line, a] = 0.0
            for i in range(width):
                total = 0.0
                for b in range(_COLUMNS):
                    total += inverse[a, b] * columns[i, b]
                operator[a, i] = total * weights[line, i]
                solutions[line, a] += operator[a, i] * data[i]
        near, shares = _cubic(shift_px[line] / step_px)
        gain = solutions[line, 0]
        for i in range(width):
            changes[i] = 0.0
            for k in range(4):
                at = min(max(middle - half + i + near + k - 1, 0), 2 * middle)
                for c in range(count):
                    changes[i, c] += gain * shares[k] * others[line, at, c]
            for a in range(_COLUMNS):
                for c in range(count):
                    taken[line, a, c] += operator[a, i] * changes[i, c]
        squares = 0.0
        for i in range(width):
            left = data[i]
            for a in range(_COLUMNS):
                left -= columns[i, a] * solutions[line, a]
            squares += left * left if weights[line, i] > 0.0 else 0.0
            noise[i] = operator[2, i] * math.sqrt(variance_dn2[line, i])
            for c in range(count):
                own[c] = changes[i, c]
                for a in range(_COLUMNS):
                    own[c] -= columns[i, a] * taken[line, a, c]
            for c in range(count):
                weighted = weights[line, i] * changes[i, c]
                pull[line, c] += weighted * left
                for d in range(count):
                    information[line, c, d] += weighted * own[d]
        for c in range(count):
            for d in range(c):
                both = 0.5 * (information[line, c, d] + information[line, d, c])
                information[line, c, d] = information[line, d, c] = both
        rms[line] = math.sqrt(squares / max((weights[line] > 0.0).sum(), 1))
        total = 0.0
        for i in range(width):
            for j in range(i):
                total += 2.0 * noise[i] * correlation[i, j] * noise[j]
            total += noise[i] * correlation[i, i] * noise[i]
        noises[line] = math.sqrt(total)
    return solutions, noises, rms, taken, information, pull


@compiled
def quotient(shifted: float, gain: float) -> float:
    """Shift of a solution: (gain times shift) / gain; 0 where there is no gain."""
    shift = shifted / gain
    return shift if np.isfinite(shift) else 0.0


@compiled
def _correlation(data: Float, target: Float, usable: Mask, least: int) -> float:
    """Normalized correlation of usable values (w,) with a target; 0 where they are too few or flat."""
    count = usable.sum()
    if count < least:
        return 0.0
    total, aim = (data * usable).sum() / count, (target * usable).sum() / count
    square, length, product, size = 0.0, 0.0, 0.0, 0.0
    for i in range(len(data)):
        if usable[i]:
            square += (data[i] - total) ** 2
            length += (target[i] - aim) ** 2
            product += (data[i] - total) * (target[i] - aim)
            size += data[i] ** 2
    spread = math.sqrt(square)
    return product / (spread * math.sqrt(length)) if spread > _FLAT * math.sqrt(size) and length > 0.0 else 0.0


@compiled
def _cubic(steps: float) -> tuple[int, tuple[float, float, float, float]]:
    """Whole steps and weights of four samples that shift a line towards larger indices, by cubic interpolation."""
    near = math.floor(-steps)
    t = -steps - near
    return near, (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )


@compiled
def _between(line: Float, at: int, shares: tuple[float, float, float, float]) -> float:
    """Value of a line (m,) by weights of four samples about a position; constant beyond the ends."""
    last = len(line) - 1
    result = 0.0
    for k in range(4):
        result += shares[k] * line[min(max(at + k - 1, 0), last)]
    return result


@compiled
def _fill(expected: Float, shift_px: float, step_px: float, half: int, columns: Float) -> None:
    """Fill in the columns (w, 4) of a match with a profile (m,) that is shifted."""
    middle = len(expected) // 2
    near, shares = _cubic(shift_px / step_px)
    before = _between(expected, middle - half - 1 + near, shares)
    here = _between(expected, middle - half + near, shares)
    for i in range(2 * half + 1):
        after = _between(expected, middle - half + i + 1 + near, shares)
        columns[i, 0], columns[i, 1] = here, 1.0
        columns[i, 2] = (before - after) / (2.0 * step_px)
        columns[i, 3] = (i - half) * step_px * here
        before, here = here, after


@compiled
def _sums(columns: Float, data: Float, weights: Float, normal: Float, right: Float) -> None:
    """Fill in normal equations, above the diagonal, of weighted least squares by columns (w, 4)."""
    normal[:] = 0.0
    right[:] = 0.0
    for i in range(len(data)):
        for a in range(_COLUMNS):
            weighted = weights[i] * columns[i, a]
            right[a, 0] += weighted * data[i]
            for b in range(a, _COLUMNS):
                normal[a, b] += weighted * columns[i, b]


@compiled
def _fit(columns: Float, data: Float, weights: Float, normal: Float, right: Float) -> None:
    """Fill in the solution ``right`` (4, 1) of weighted least squares by columns (w, 4)."""
    _sums(columns, data, weights, normal, right)
    solve_normal(normal, right)
