"""Nearest neighbors within a distance are those that looking at all pairs finds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from giantlike.core.arrays import Float
from giantlike.stars.matching import nearest
from tests.tolerances import FLOAT64

STEP = np.array([1.0, 0.0])


def by_all_pairs(among: Float, of: Float, count: int, reach: float) -> Float:
    """Distances (m, count), infinite where there is none within reach."""
    distance = np.sqrt(np.sum((of[:, None] - among[None]) ** 2, axis=-1))
    distance = np.sort(np.where(distance <= reach, distance, np.inf), axis=1)
    return np.pad(distance, ((0, 0), (0, count)), constant_values=np.inf)[:, :count]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 60),
    m=st.integers(0, 60),
    count=st.sampled_from([1, 2]),
    reach=st.floats(0.05, 3000.0),
    spread=st.floats(0.5, 3000.0),
)
def test_neighbors_are_those_of_all_pairs(seed: int, n: int, m: int, count: int, reach: float, spread: float) -> None:
    rng = np.random.default_rng(seed)
    among, of = spread * rng.normal(size=(n, 2)), 1.5 * spread * rng.normal(size=(m, 2))
    distance, index = nearest(among, of, count, reach)
    assert_allclose(distance, by_all_pairs(among, of, count, reach), rtol=0, atol=FLOAT64 * spread)
    found = np.isfinite(distance)
    assert (index[~found] == n).all()
    of_each = np.broadcast_to(of[:, None], (m, count, 2))[found]
    assert_allclose(
        np.linalg.norm(of_each - among[index[found]], axis=-1), distance[found], rtol=0, atol=FLOAT64 * spread
    )


@pytest.mark.parametrize("reach", [1.0, 1.5, 40.0])
def test_of_equally_near_points_the_first_is_taken_and_those_at_the_very_reach_count(reach: float) -> None:
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(20.0)), axis=-1).reshape(-1, 2)
    distance, index = nearest(grid, grid + STEP, 2, reach)
    last = grid[:, 0] == 29.0
    assert_array_equal(distance[~last, 0], 0.0)
    assert_array_equal(distance[:, 1][~last], 1.0)
    expected = np.array([np.flatnonzero(np.abs(grid - at).sum(axis=1) == 1.0)[0] for at in grid + STEP])
    assert_array_equal(index[~last, 1], expected[~last])
    assert_array_equal(nearest(grid[:1], grid[:1], 2, reach)[0], [[0.0, np.inf]])
