"""Sums over the cells around a body, compiled: for the fit of the body, and for bodies lit from other sides."""

from __future__ import annotations

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask

EXACT = 1e-9  # share of the largest variance below which the sums of a window hold nothing but rounding


@compiled
def design_of(
    light: Float, others: Float, scattered: Float, x: float, y: float, radius: float
) -> tuple[Float, Float, Float, Float, Float, Float, Float]:
    """Columns that the light of cells may be a sum of.

    ``light`` (n, n); ``others`` (k, n, n); ``scattered`` (n, n); ``x``, ``y``: column and row of its center; returns
    ``laws`` (k, n, n); ``background`` (3, n, n), a plane, places in radii; ``stray`` (3, n, n), stray light, along
    columns, along rows, and around the body; ``place``, ``strain``, ``blur`` (3, n, n), derivatives, places in radii;
    ``slope`` (n, n).
    """
    size, laws, slope = len(light), np.empty_like(others), np.empty_like(light)
    background, stray = np.empty((3, size, size)), np.empty((3, size, size))
    place, strain, blur = np.empty((3, size, size)), np.empty((3, size, size)), np.empty((3, size, size))
    by_row, by_column = np.empty((size, size)), np.empty((size, size))
    across, down, total = np.zeros(size), np.zeros(size), 0.0
    for row in range(size):
        for column in range(size):
            by_row[row, column] = _difference(light[:, column], row)
            by_column[row, column] = _difference(light[row], column)
            across[column] += light[row, column]
            down[row] += light[row, column]
        total += down[row]
    for law in range(len(others)):
        whole = 0.0
        for row in range(size):
            for column in range(size):
                whole += others[law, row, column]
        share = total / max(whole, 1e-30)
        for row in range(size):
            for column in range(size):
                laws[law, row, column] = others[law, row, column] * share - light[row, column]
    for row in range(size):
        place_y = (row - y) / radius
        for column in range(size):
            place_x = (column - x) / radius
            right, low = -radius * by_column[row, column], -radius * by_row[row, column]
            background[0, row, column] = 1.0
            background[1, row, column] = place_x
            background[2, row, column] = place_y
            stray[0, row, column] = across[column] / size
            stray[1, row, column] = down[row] / size
            stray[2, row, column] = scattered[row, column]
            place[0, row, column] = right
            place[1, row, column] = low
            place[2, row, column] = right * place_x + low * place_y
            strain[0, row, column] = right * place_y
            strain[1, row, column] = low * place_x
            strain[2, row, column] = right * place_x - low * place_y
            blur[0, row, column] = 0.5 * _difference(by_column[row], column)
            blur[1, row, column] = _difference(by_column[:, column], row)
            blur[2, row, column] = 0.5 * _difference(by_row[:, column], row)
            slope[row, column] = np.sqrt(by_row[row, column] ** 2 + by_column[row, column] ** 2)
    return laws, background, stray, place, strain, blur, slope


@compiled
def _difference(line: Float, at: int) -> float:
    """Slope of a line (n,) at one of its places, by neighbors on both sides or at an end by the one."""
    first, last = max(at - 1, 0), min(at + 1, len(line) - 1)
    slope: float = (line[last] - line[first]) / (last - first)
    return slope


@compiled
def least_unexplained(values: Float, good: Mask, lights: Float) -> Float:
    """Share of the variance of an image that bodies leave at their best shift, with a gain and a level fitted.

    ``values`` (n, n) DN; ``good`` (n, n); ``lights`` (k, m, m); returns (k,), 1 where only a negative gain would
    explain anything.

    As :class:`~giantlike.relative.verification.shifts.ShiftedMatches`, which transforms images for many shifts; here
    only cells that hold light are multiplied.
    """
    size, kinds = lights.shape[1], len(lights)
    shifts = len(values) - size + 1
    whole, mean, count = True, 0.0, 0.0
    for row in range(len(values)):
        for column in range(len(values)):
            if good[row, column]:
                mean += values[row, column]
                count += 1.0
            else:
                whole = False
    mean /= max(count, 1.0)
    number, total, squares = np.zeros((shifts, shifts)), np.zeros((shifts, shifts)), np.zeros((shifts, shifts))
    above, counted = np.zeros(values.shape), np.zeros(values.shape)
    for row in range(len(values)):
        for column in range(len(values)):
            if good[row, column]:
                above[row, column] = values[row, column] - mean
                counted[row, column] = 1.0
    _window_sums(counted, size, number)
    _window_sums(above, size, total)
    _window_sums(above * above, size, squares)
    variance = squares - total**2 / np.maximum(number, 1.0)
    least_variance = EXACT * variance.max()
    left = np.ones(kinds)
    light, light_squares = np.zeros((shifts, shifts)), np.zeros((shifts, shifts))
    product, spread = np.zeros((shifts, shifts)), np.zeros((shifts, shifts))
    for kind in range(kinds):
        for down in range(shifts):
            for across in range(shifts):
                light[down, across] = light_squares[down, across] = product[down, across] = 0.0
        sum_of, sum_of_squares = 0.0, 0.0
        for row in range(size):
            for column in range(size):
                one = lights[kind, row, column]
                if one == 0.0:
                    continue
                sum_of += one
                sum_of_squares += one * one
                for down in range(shifts):
                    for across in range(shifts):
                        product[down, across] += one * above[row + down, column + across]
                    if not whole:
                        for across in range(shifts):
                            seen = one * counted[row + down, column + across]
                            light[down, across] += seen
                            light_squares[down, across] += one * seen
        most = 0.0
        for down in range(shifts):
            for across in range(shifts):
                if whole:
                    light[down, across], light_squares[down, across] = sum_of, sum_of_squares
                n = max(number[down, across], 1.0)
                spread[down, across] = light_squares[down, across] - light[down, across] ** 2 / n
                most = max(most, spread[down, across])
        for down in range(shifts):
            for across in range(shifts):
                n = max(number[down, across], 1.0)
                common = product[down, across] - total[down, across] * light[down, across] / n
                if common > 0.0 and variance[down, across] > least_variance and spread[down, across] > EXACT * most:
                    share = common * common / (spread[down, across] * variance[down, across])
                    left[kind] = min(left[kind], 1.0 - min(share, 1.0))
    return left


@compiled
def _window_sums(values: Float, size: int, sums: Float) -> None:
    """Sum up squares of cells of an array (n, n) into ``sums`` (k, k), by the first cell of each."""
    shifts, lines = len(sums), np.zeros((len(values), len(sums)))
    for row in range(len(values)):
        for step in range(size):
            for across in range(shifts):
                lines[row, across] += values[row, across + step]
    for down in range(shifts):
        for step in range(size):
            for across in range(shifts):
                sums[down, across] += lines[down + step, across]
