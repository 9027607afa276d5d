"""Rejection of measures: limits, and other measures of a point that might be the wrong ones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.statistics import MEDIAN_CHI2
from giantlike.network.problem import POSE, Problem, State, sums_by


def squares_of(problem: Problem, state: State) -> Float:
    """Squared residuals (n,) of all measures in units of their variance; infinite where a point is not seen."""
    residuals = problem.tracks.points_px - problem.predict(state)
    return np.asarray(np.nan_to_num(np.sum(residuals**2, axis=1) / problem.tracks.sigma_px**2, nan=np.inf))


def noise_of(problem: Problem, state: State, used: Mask) -> float:
    """Robust standard deviation of the measures in use, in units of the stated one."""
    count = 2 * int(used.sum())
    solved = np.unique(problem.tracks.point[used])
    unknowns = int((~problem.points.known & ~problem.points.held)[solved].sum()) + POSE * len(problem.photos)
    freedom = max(count - unknowns, 1)
    return math.sqrt(float(np.median(squares_of(problem, state)[used])) / MEDIAN_CHI2 * count / freedom)


def find_agreeing(problem: Problem, state: State, used: Mask) -> NDArray[np.bool_]:
    """Measures (n,) within the limit, which is wider where the noise found exceeds the stated one."""
    limit = problem.options.outlier_sigmas * max(noise_of(problem, state, used), 1.0)
    return np.asarray(squares_of(problem, state) <= limit**2)


def find_alternatives(problem: Problem, state: State, used: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp], Float]:
    """Rejected and used measures (q,) of one point, and how much chi-square (q,) grows with their roles exchanged."""
    tracks = problem.tracks
    found = problem.linearize(state)
    left = (tracks.points_px - found.pixels) / tracks.sigma_px[:, None]
    sound: Mask = np.asarray(np.isfinite(left).all(axis=1))
    left, design = np.where(sound[:, None], left, 0.0), found.by_point / tracks.sigma_px[:, None, None]
    design = np.where(sound[:, None, None], design, 0.0)
    transposed = np.swapaxes(design, 1, 2)
    normals, pulls, squares = transposed @ design, transposed @ left[..., None], np.sum(left**2, axis=1)
    pairs = [
        (bad, good)
        for bad in np.flatnonzero(np.asarray(~used & sound))
        for good in range(problem.first[tracks.point[bad]], problem.first[tracks.point[bad] + 1])
        if used[good]
    ]
    if not pairs:
        nothing = np.zeros(0, dtype=np.intp)
        return nothing, nothing, np.zeros(0)
    bad, good = (np.array(each, dtype=np.intp) for each in zip(*pairs, strict=True))
    at, size = tracks.point[good], len(tracks.names)
    mine = [sums_by(each[used], tracks.point[used], size)[at] for each in (normals, pulls, squares)]
    prior = np.where(problem.points.known[:, :, None], problem.points.inverse, 0.0)[at]
    matrix = mine[0] - normals[good] + normals[bad] + np.swapaxes(prior, 1, 2) @ prior
    pull = mine[1] - pulls[good] + pulls[bad] + np.swapaxes(prior, 1, 2) @ problem.prior_points(state)[at, :, None]
    ridge = 1e-12 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    gained = np.sum(pull * np.linalg.solve(matrix + ridge, pull), axis=(1, 2))
    return bad, good, squares[bad] - squares[good] - gained


def exchange(problem: Problem, state: State, used: Mask) -> Mask:
    """Measures (n,) in use after the best exchange of each point that fits better with another measure rejected."""
    bad, good, excess = find_alternatives(problem, state, used)
    result = used.copy()
    done: set[int] = set()
    for k in np.argsort(excess):
        point = int(problem.tracks.point[bad[k]])
        if excess[k] >= 0.0:
            break
        if point not in done:
            result[bad[k]], result[good[k]] = True, False
            done.add(point)
    return result
