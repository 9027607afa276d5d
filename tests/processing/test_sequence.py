"""Images of one sequence: fixed pattern, hot pixels and particles by comparison."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure
from giantlike.processing import DetectionFlag, Detections
from giantlike.processing.detection.sequence import FixedPattern, compare_sequence, fixed_pattern
from tests.processing.test_detection import detected, exposed, flux_of_snr, nearest, spread_points, star_image

SHAPE = (240, 240)
DRIFT_PX = np.array([9.0, -6.0])
PATTERN_DN = 80.0
HOT_PX, HIT_SNR = (70, 90), 60.0
LEFT_DN = 8.0  # photon and read noise of 7.6 DN: the median of seven images adds a tenth in variance


def places(k: int) -> Float:
    return np.asarray(spread_points(SHAPE, 40, 3) + k * DRIFT_PX)


def taken(k: int, pattern: Float) -> NDArray[np.float32]:
    """Image of stars that drift, a pattern that stays, and a star-like flash in the fourth image alone."""
    points = places(k)
    flux = np.full(len(points), flux_of_snr(150.0, 0.8))
    if k == 3:
        points, flux = np.vstack([points, [[121.3, 17.6]]]), np.append(flux, flux_of_snr(HIT_SNR, 0.8))
    return (exposed(star_image(points, flux, 0.8, SHAPE) + 500.0, k) + pattern).astype(np.float32)


def pattern_of(seed: int = 1) -> Float:
    pattern = np.random.default_rng(seed).normal(0.0, PATTERN_DN, SHAPE)
    pattern[HOT_PX[1], HOT_PX[0]] = 5000.0
    return pattern


def test_the_median_of_a_sequence_is_its_pattern_and_holds_no_stars() -> None:
    pattern = pattern_of()
    found = fixed_pattern([taken(k, pattern) for k in range(7)])
    assert isinstance(found, FixedPattern)
    assert found.n_images == 7
    assert found.hot[HOT_PX[1], HOT_PX[0]]
    assert found.hot.mean() < 1e-3
    off = found.level_dn - pattern + np.median(pattern)
    assert np.abs(np.median(off)) < 1.0
    assert np.quantile(np.abs(off), 0.99) < 5.0 * LEFT_DN
    left = found.removed_from(taken(2, pattern))
    sigma = np.diff(np.quantile(left, (0.25, 0.75)))[0] / 1.349
    assert sigma < 0.25 * PATTERN_DN


def test_saturated_pixels_stay_as_they_are() -> None:
    found = FixedPattern(level_dn=np.full((4, 4), 50.0, dtype=np.float32), hot=np.zeros((4, 4), dtype=bool), n_images=2)
    image = np.full((4, 4), 200, dtype=np.uint8)
    image[1, 1] = 255
    cleaned = found.removed_from(image)
    assert cleaned[1, 1] == 255
    assert cleaned[0, 0] == 150
    assert found.removed_from(image, saturation_dn=190.0)[0, 0] == 200
    with pytest.raises(InputError, match="pixels"):
        found.removed_from(np.zeros((3, 4)))


def test_stars_that_stay_are_not_taken_for_a_pattern() -> None:
    found = fixed_pattern([taken(0, np.zeros(SHAPE)) for _ in range(3)])
    assert isinstance(found, Failure)
    assert "one pointing" in found.detail


@pytest.mark.parametrize("images", [[], [np.zeros((4, 4))], [np.zeros((4, 4)), np.zeros((4, 5))]])
def test_a_sequence_is_several_images_of_one_size(images: list[Any]) -> None:
    with pytest.raises(InputError):
        fixed_pattern(images)


def flags_at(found: Detections, x: float, y: float) -> DetectionFlag:
    distance, index = nearest(found, np.array([[x, y]]))
    assert distance[0] < 1.0
    return DetectionFlag(int(found.flags[index[0]]))


def test_what_stays_is_hot_what_comes_once_is_a_particle_and_stars_are_neither() -> None:
    pattern = np.zeros(SHAPE)
    pattern[HOT_PX[1], HOT_PX[0]] = 3000.0
    alone = [detected(taken(k, pattern)) for k in range(6)]
    together = compare_sequence(alone)
    assert len(together) == 6
    for k, found in enumerate(together):
        assert DetectionFlag.HOT_PIXEL in flags_at(found, *HOT_PX)
        points = places(k)
        points = points[((points > 5) & (points < 235)).all(axis=1)]
        distance, index = nearest(found, points)
        assert distance.max() < 1.0
        assert found.clean[index].all()
        assert_allclose(found.points_px, alone[k].points_px, rtol=0, atol=0)
    assert DetectionFlag.COSMIC_RAY not in flags_at(alone[3], 121.3, 17.6)  # it looks like a star
    assert DetectionFlag.COSMIC_RAY in flags_at(together[3], 121.3, 17.6)


def test_one_image_or_none_is_returned_as_it_is() -> None:
    found = detected(taken(0, np.zeros(SHAPE)))
    (same,) = compare_sequence([found])
    assert_array_equal(same.flags, found.flags)
    assert compare_sequence([]) == []
    empty = Detections.empty(psf_sigma_px=0.8, noise_dn=3.0)
    first, second = compare_sequence([found, empty])
    assert_array_equal(first.flags, found.flags)
    assert len(second) == 0
