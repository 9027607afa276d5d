"""Groups and peaks of lit pixels against scipy, on random frames of all densities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from giantlike.processing.detection.candidates import label_groups, peaks_among

FRAMES = [(1, 1), (1, 9), (9, 1), (2, 2), (17, 23), (60, 41)]


@pytest.mark.parametrize("shape", FRAMES)
@pytest.mark.parametrize("density", [0.05, 0.3, 0.45, 0.7, 1.0])
def test_pixels_that_touch_are_one_group(shape: tuple[int, int], density: float) -> None:
    for seed in range(5):
        mask = np.random.default_rng(seed).random(shape) < density
        group, count = label_groups(np.flatnonzero(mask), shape[1])
        labels, expected = ndimage.label(mask, structure=np.ones((3, 3)))
        assert count == expected
        pairs = set(zip(group.tolist(), labels[mask].tolist(), strict=True))
        assert len(pairs) == count  # one to one


@pytest.mark.parametrize("shape", FRAMES)
def test_of_equal_neighbors_the_first_is_a_peak(shape: tuple[int, int]) -> None:
    response = np.random.default_rng(3).integers(0, 4, shape).astype(np.float32)
    places = np.arange(response.size, dtype=np.float64).reshape(shape)
    ordered = response - 1e-6 * places  # earlier pixels are higher
    highest = ordered == ndimage.maximum_filter(ordered, size=3, mode="constant", cval=-1e9)
    lit = np.flatnonzero(response > 0)
    assert lit[peaks_among(response, lit)].tolist() == np.flatnonzero(highest & (response > 0)).tolist()
