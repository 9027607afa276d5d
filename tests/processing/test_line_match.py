"""Compiled matches of lines beside least squares of one line by numpy, and images along lines beside scipy."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from giantlike.core.arrays import Float
from giantlike.processing.limb.line_match import fit_lines, refine_shifts
from giantlike.processing.limb.scan import sample_lines
from tests.tolerances import FLOAT64_SUM

LINES, HALF, MOST, STEP_PX = 5, 8, 3, 0.5
MIDDLE = HALF + MOST + 2
PLACES: Float = np.arange(-MIDDLE, MIDDLE + 1, dtype=np.float64) * STEP_PX
INNER = slice(MIDDLE - HALF, MIDDLE + HALF + 1)
SOLVED = 1e-7  # relative: a ridge of 1e-12 on columns that are nearly alike


def cubic(line: int, at: Float) -> Float:
    """Profiles that cubics through four samples move exactly."""
    powers = np.random.default_rng(line).normal(size=4) * [1.0, 0.3, 0.1, 0.03]
    return np.asarray(np.polynomial.polynomial.polyval(at, powers))


def columns_of(line: int, shift_px: float) -> Float:
    at = PLACES[INNER]
    profile = cubic(line, at - shift_px)
    outward = (cubic(line, at - shift_px - STEP_PX) - cubic(line, at - shift_px + STEP_PX)) / (2.0 * STEP_PX)
    return np.stack([profile, np.ones_like(at), outward, at * profile], axis=-1)


def problem() -> tuple[Float, Float, Float, Float]:
    """Values, expected profiles, weights and shifts."""
    random = np.random.default_rng(3)
    values = random.normal(size=(LINES, PLACES.size))
    expected = np.array([cubic(line, PLACES) for line in range(LINES)])
    return values, expected, random.uniform(0.5, 2.0, (LINES, 2 * HALF + 1)), np.linspace(-0.4, 0.4, LINES)


def test_a_line_held_at_its_place_gets_the_least_squares_fit_there() -> None:
    values, expected, weights, shifts = problem()
    lag, fixed = np.full(LINES, MOST), np.ones(LINES, dtype=bool)
    stayed, free, slope_variance, without = refine_shifts(
        values, expected, lag, shifts, fixed, weights, STEP_PX, HALF, MOST
    )
    assert np.array_equal(stayed, shifts)
    for line in range(LINES):
        root = np.sqrt(weights[line])[:, None]
        columns, data = columns_of(line, shifts[line]), values[line, INNER]
        solution = np.linalg.lstsq(columns * root, data * root[:, 0], rcond=None)[0]
        assert_allclose(free[line], solution, rtol=SOLVED, atol=SOLVED)
        inverse = np.linalg.inv((columns * root).T @ (columns * root))
        assert_allclose(slope_variance[line], inverse[3, 3], rtol=SOLVED)
        slopeless = np.linalg.lstsq(columns[:, :3] * root, data * root[:, 0], rcond=None)[0]
        assert_allclose(without[line], slopeless[[0, 2]], rtol=SOLVED, atol=SOLVED)


def test_a_fit_counts_what_is_known_of_slopes_and_says_what_it_tells_of_shared_parameters() -> None:
    values, expected, weights, shifts = problem()
    random = np.random.default_rng(9)
    stiffness, lag = np.logspace(-1, 3, LINES), np.array([2, 3, 4, 3, 2])
    powers = random.normal(size=(2, 4)) * [1.0, 0.3, 0.1, 0.03]
    others = np.stack([np.polynomial.polynomial.polyval(PLACES, power) for power in powers], axis=-1)
    variance, noise = random.uniform(0.5, 2.0, weights.shape), random.uniform(-0.1, 0.1, (2 * HALF + 1,) * 2)
    correlation = np.eye(2 * HALF + 1) + 0.5 * (noise + noise.T)
    solution, noises, rms, taken, information, pull = fit_lines(
        values,
        expected,
        np.repeat(others[None], LINES, axis=0),
        lag,
        shifts,
        weights,
        variance,
        stiffness,
        correlation,
        STEP_PX,
        HALF,
        MOST,
    )
    for line in range(LINES):
        columns = columns_of(line, shifts[line])
        data = values[line, MIDDLE - HALF + lag[line] - MOST :][: 2 * HALF + 1]
        at = PLACES[INNER] - shifts[line]
        changes = np.stack([np.polynomial.polynomial.polyval(at, power) for power in powers], axis=-1)
        normal = columns.T @ (columns * weights[line][:, None])
        normal[3, 3] += stiffness[line]
        operator = np.linalg.solve(normal, columns.T * weights[line])
        assert_allclose(solution[line], operator @ data, rtol=SOLVED, atol=SOLVED)
        changes *= solution[line, 0]
        left = data - columns @ solution[line]
        assert_allclose(rms[line], np.sqrt(np.mean(left**2)), rtol=SOLVED)
        assert_allclose(taken[line], operator @ changes, rtol=SOLVED, atol=SOLVED)
        told = (changes * weights[line][:, None]).T @ (changes - columns @ (operator @ changes))
        assert_allclose(information[line], 0.5 * (told + told.T), rtol=SOLVED, atol=SOLVED)
        assert_allclose(pull[line], (changes * weights[line][:, None]).T @ left, rtol=SOLVED, atol=SOLVED)
        by_noise = operator[2] * np.sqrt(variance[line])
        assert_allclose(noises[line], np.sqrt(by_noise @ correlation @ by_noise), rtol=SOLVED)


def test_images_along_lines_are_those_of_scipy_also_beyond_their_borders() -> None:
    random = np.random.default_rng(1)
    images, points = random.normal(size=(2, 40, 50)), random.uniform(-4.0, 54.0, (60, 2))
    angles, offsets = random.uniform(0.0, 2.0 * np.pi, 60), np.arange(-4.0, 4.5, 0.5)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    places = points[:, None] + offsets[None, :, None] * normals[:, None]
    coordinates = np.moveaxis(places[..., ::-1], -1, 0)
    for found, image in zip(sample_lines(images, points, normals, offsets), images, strict=True):
        expected = map_coordinates(image, coordinates, order=3, mode="nearest", prefilter=False)
        assert_allclose(found, expected, rtol=0, atol=FLOAT64_SUM)
