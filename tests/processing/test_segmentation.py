"""Thresholds and blobs, beside OpenCV and sep, and which blob is which body."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.limb.segmentation import (
    Blobs,
    ExpectedBlob,
    background_of,
    connected_blobs,
    identify_blobs,
    otsu_threshold,
)
from tests.tolerances import FLOAT32, FLOAT64_SUM, PLACE_PX


def disks(*spots: tuple[float, float, float, float], size: int = 200) -> Float:
    """Disks of (x, y, radius, level) on black."""
    rows, columns = np.indices((size, size))
    image = np.zeros((size, size))
    for x, y, radius, level in spots:
        image[np.hypot(columns - x, rows - y) < radius] += level
    return image


def blobs_of(image: Float) -> Blobs:
    return connected_blobs(image, image > 5.0)


@given(
    st.lists(st.integers(0, 255), min_size=2, max_size=300).filter(lambda values: len(set(values)) > 1),
)
@settings(max_examples=60, deadline=None)
def test_otsu_parts_whole_numbers_as_well_as_any_cut(values: list[int]) -> None:
    data = np.array(values, dtype=np.float64)

    def between(threshold: float) -> float:
        low, high = data[data <= threshold], data[data > threshold]
        return low.size * high.size * (high.mean() - low.mean()) ** 2 if low.size and high.size else 0.0

    best = max(between(cut) for cut in np.unique(data)[:-1])
    assert_allclose(between(otsu_threshold(data, bins=int(np.ptp(data)) * 4)), best, rtol=FLOAT64_SUM)


def test_otsu_agrees_with_opencv() -> None:
    rng = np.random.default_rng(1)
    image = np.clip(np.concatenate([rng.normal(40, 10, 3000), rng.normal(150, 25, 1000)]), 0, 255).astype(np.uint8)
    theirs, _ = cv2.threshold(image[None], 0, 255, cv2.THRESH_OTSU)
    ours = otsu_threshold(image.astype(np.float64), bins=int(np.ptp(image)) + 1)
    assert np.count_nonzero((image > theirs) != (image > ours)) == 0


def test_a_gap_between_the_classes_is_cut_in_its_middle() -> None:
    assert_allclose(otsu_threshold(np.array([0.0, 1.0, 9.0, 10.0])), 5.0, rtol=0, atol=0.02)


def test_background_is_that_of_the_dark_pixels() -> None:
    rng = np.random.default_rng(2)
    values = np.concatenate([rng.normal(100.0, 4.0, 20_000), rng.uniform(150.0, 900.0, 8_000)])
    found = background_of(values)
    assert_allclose(found.level_dn, 100.0, rtol=0, atol=0.3)  # six standard errors of a median
    assert_allclose(found.sigma_dn, 4.0, rtol=0, atol=0.3)
    assert found.threshold_dn(5.0) == found.level_dn + 5.0 * found.sigma_dn


def test_blobs_agree_with_sep() -> None:
    rng = np.random.default_rng(3)
    spots = [(30.0, 40.0, 8.0, 50.0), (120.0, 60.0, 15.0, 30.0), (90.0, 150.0, 5.5, 80.0)]
    image = disks(*spots) * rng.uniform(0.8, 1.2, (200, 200))
    ours = blobs_of(image)
    sep = pytest.importorskip("sep")
    theirs = sep.extract(np.ascontiguousarray(image), 5.0, minarea=1, filter_kernel=None, deblend_cont=1.0)
    order = np.argsort(-theirs["npix"])
    assert_array_equal(ours.areas_px, theirs["npix"][order])
    assert_allclose(ours.flux_dn, theirs["flux"][order], rtol=FLOAT32)
    assert_allclose(ours.centroids_px, np.stack([theirs["x"], theirs["y"]], axis=-1)[order], rtol=0, atol=PLACE_PX)
    low = np.stack([theirs["xmin"], theirs["ymin"]], axis=-1)[order]
    assert_array_equal(ours.boxes_px[:, :2], low)
    assert not ours.touch_frame.any()


def test_a_blob_at_the_edge_is_told_and_small_ones_can_be_left_out() -> None:
    image = disks((2.0, 100.0, 9.0, 50.0), (100.0, 100.0, 9.0, 50.0))
    image[10, 60] = 99.0
    assert len(blobs_of(image)) == 3
    found = connected_blobs(image, image > 5.0, min_area_px=4)
    assert len(found) == 2
    assert found.touch_frame.sum() == 1
    assert set(np.unique(found.labels)) == {0, 1, 2}
    assert found.labels[10, 60] == 0


def test_several_bodies_are_told_apart_whatever_the_order_and_a_common_shift() -> None:
    spots = [(40.0, 50.0, 14.0, 30.0), (80.0, 55.0, 6.0, 60.0), (140.0, 120.0, 6.0, 60.0)]
    found = blobs_of(disks(*spots))
    for order in itertools.permutations(range(3)):
        wanted = [spots[index] for index in order]
        expected = [ExpectedBlob(center_px=(x + 22.0, y - 9.0), area_px=np.pi * r**2) for x, y, r, _ in wanted]
        chosen = identify_blobs(found, expected, search_px=40.0)
        assert not isinstance(chosen, Failure), chosen
        assert_allclose(found.centroids_px[chosen], [one[:2] for one in wanted], rtol=0, atol=0.6)


def test_brightness_decides_between_bodies_of_one_size_where_the_camera_is_calibrated() -> None:
    found = blobs_of(disks((70.0, 100.0, 10.0, 300.0), (130.0, 100.0, 10.0, 60.0)))
    place, area = (100.0, 100.0), np.pi * 100.0
    undecided = identify_blobs(found, [ExpectedBlob(center_px=place, area_px=area)], search_px=40.0)
    assert isinstance(undecided, Failure)
    assert undecided.reason is Reason.AMBIGUOUS
    for level in (300.0, 60.0):
        body = ExpectedBlob(center_px=place, area_px=area, flux_dn=1.2 * area * level)
        chosen = identify_blobs(found, [body], search_px=40.0)
        assert not isinstance(chosen, Failure)
        assert_allclose(found.flux_dn[chosen[0]], area * level, rtol=0.05)


def test_what_is_not_there_is_not_found() -> None:
    found = blobs_of(disks((100.0, 100.0, 10.0, 300.0)))
    for expected in (
        [ExpectedBlob(center_px=(30.0, 30.0), area_px=314.0)],  # too far
        [ExpectedBlob(center_px=(100.0, 100.0), area_px=8000.0)],  # too large
        [ExpectedBlob(center_px=(90.0, 100.0), area_px=314.0), ExpectedBlob(center_px=(110.0, 100.0), area_px=314.0)],
    ):
        chosen = identify_blobs(found, expected, search_px=30.0)
        assert isinstance(chosen, Failure)
        assert chosen.reason is Reason.NO_SIGNAL
    assert isinstance(identify_blobs(blobs_of(np.zeros((9, 9))), expected, search_px=30.0), Failure)


def test_misuse_is_refused() -> None:
    with pytest.raises(InputError, match="no threshold"):
        otsu_threshold(np.full(9, 3.0))
    with pytest.raises(InputError, match="finite"):
        otsu_threshold(np.array([1.0, np.nan]))
    with pytest.raises(InputError, match="no pixels"):
        background_of(np.zeros(0))
    with pytest.raises(InputError, match="differ in shape"):
        connected_blobs(np.zeros((3, 3)), np.zeros((3, 4), dtype=bool))
    with pytest.raises(InputError, match="area_px"):
        ExpectedBlob(center_px=(0.0, 0.0), area_px=0.0)
    with pytest.raises(InputError, match="at least one"):
        identify_blobs(blobs_of(np.zeros((9, 9))), [], search_px=30.0)
