"""Light of cells and of their parts against matrices, sparse ones of scipy and full ones."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.sparse import csc_matrix

from giantlike.relative.template.spread_parts import spread, spread_along_axis
from tests.tolerances import FLOAT64_SUM

PARTS, COLUMNS, ROWS, REACH, WIDTH, LAWS, KINDS = 400, 30, 20, 7, 25, 3, 4


def test_parts_are_spread_as_by_a_sparse_matrix_and_lost_outside_of_the_image() -> None:
    rng = np.random.default_rng(5)
    light, shares = rng.normal(size=(PARTS, LAWS)), rng.normal(size=(KINDS, COLUMNS, REACH))
    columns, rows = rng.integers(0, COLUMNS, PARTS), rng.integers(0, ROWS, PARTS)
    first_px = np.arange(COLUMNS) - 4  # the first and the last reach over the edges
    found = spread(light, columns, rows, shares, first_px, ROWS, WIDTH)
    pixels = first_px[columns][:, None] + np.arange(REACH)
    inside = (pixels >= 0) & (pixels < WIDTH)
    of = np.broadcast_to(np.arange(PARTS)[:, None], pixels.shape)
    places = rows[:, None] * WIDTH + pixels
    for kind in range(KINDS):
        values = shares[kind][columns]
        matrix = csc_matrix((values[inside], (places[inside], of[inside])), shape=(ROWS * WIDTH, PARTS))
        assert_allclose(found[kind].reshape(-1, LAWS), matrix @ light, rtol=0, atol=FLOAT64_SUM)


def test_cells_of_a_band_are_spread_as_by_a_full_matrix_and_those_outside_hold_no_light() -> None:
    rng = np.random.default_rng(6)
    light, shares = rng.normal(size=(COLUMNS, LAWS)), rng.normal(size=(KINDS, WIDTH, REACH))
    first = np.linspace(-4, COLUMNS - 3, WIDTH).astype(np.int64)  # the first and the last reach over the ends
    full = np.zeros((KINDS, WIDTH, COLUMNS + 2 * REACH))
    for pixel in range(WIDTH):
        full[:, pixel, REACH + first[pixel] : 2 * REACH + first[pixel]] = shares[:, pixel]

    found = spread_along_axis(shares, first, light)

    assert_allclose(found, full[:, :, REACH:-REACH] @ light, rtol=0, atol=FLOAT64_SUM)
