"""Sums over the light of a body, against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import binary_dilation

from giantlike.relative.light.light_sums import kept_center, mix_laws
from giantlike.relative.light.separation import _dilate
from tests.tolerances import FLOAT64_ROOT

RANDOM = np.random.default_rng(4)
THRESHOLD_DN = 40.0


@pytest.mark.parametrize("width", [0.5, 1.0])
def test_light_counts_by_a_growing_share_around_the_threshold(width: float) -> None:
    image = RANDOM.uniform(-20.0, 120.0, size=(31, 47))
    low, high = (1.0 - 0.5 * width) * THRESHOLD_DN, (1.0 + 0.5 * width) * THRESHOLD_DN
    counted = image * np.interp(image, [low, high], [0.0, 1.0])
    rows, columns = np.indices(image.shape)
    x, y, total = kept_center(image, THRESHOLD_DN, width)
    assert_allclose([x, y], [np.average(each, weights=counted) for each in (columns, rows)], rtol=0, atol=FLOAT64_ROOT)
    assert_allclose(total, counted.sum(), rtol=FLOAT64_ROOT, atol=0)


def test_a_mixture_of_laws_has_no_light_below_zero() -> None:
    own, changes = RANDOM.uniform(0.0, 1.0, size=(20, 33)), RANDOM.normal(size=(3, 20, 33))
    shares = np.array([0.4, -0.2, 0.7])
    expected = np.maximum(own + sum(share * change for share, change in zip(shares, changes, strict=True)), 0.0)
    assert_allclose(mix_laws(own, changes, shares), expected, rtol=0, atol=FLOAT64_ROOT)
    assert (expected == 0.0).any()


@pytest.mark.parametrize("margin_px", [3, 11])
def test_a_region_grows_by_a_round_margin(margin_px: int) -> None:
    pixels = np.zeros((60, 70), dtype=bool)
    pixels[20:31, 15:22] = True
    pixels[2, 66] = pixels[45, 3] = True
    down, right = np.indices((2 * margin_px + 1, 2 * margin_px + 1)) - margin_px
    disk = np.hypot(down, right) <= margin_px
    assert (_dilate(pixels, margin_px) == binary_dilation(pixels, disk)).all()
    assert not _dilate(np.zeros((5, 6), dtype=bool), margin_px).any()
