"""Fixes of two estimators beside each other: the difference over its whole covariance, and what both share."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from giantlike.campaign.store.fix_differences import difference_of
from giantlike.campaign.store.records import ObservationRecord
from giantlike.core.causes import Cause

SLANTED = np.array([[1.0, 0.99], [0.99, 1.0]])


def _fix(place: ArrayLike, covariance: ArrayLike, **more: object) -> ObservationRecord:
    fix = ObservationRecord(index=0, file="a.fits", target="ROCK", estimator="limb_matching", status="ok")
    return fix.replace(center_px=np.array(place).tolist(), covariance_px2=np.array(covariance).tolist(), **more)


def test_a_difference_is_measured_along_its_own_direction() -> None:
    exact = 1e-12 * np.eye(2)
    along = difference_of(_fix([1.0, 1.0], SLANTED), _fix([0.0, 0.0], exact))
    across = difference_of(_fix([1.0, -1.0], SLANTED), _fix([0.0, 0.0], exact))
    assert along is not None
    assert across is not None
    np.testing.assert_allclose(along.squared_distance, 2.0 / 1.99, rtol=1e-9)
    np.testing.assert_allclose(across.squared_distance, 2.0 / 0.01, rtol=1e-9)
    assert along.chance > 0.5
    assert across.chance < 1e-40


def test_right_fixes_differ_as_often_as_the_chance_says() -> None:
    rng = np.random.default_rng(8)
    root = np.linalg.cholesky(SLANTED + np.eye(2))
    chances = []
    for _ in range(2000):
        apart = difference_of(_fix(root @ rng.normal(size=2), SLANTED), _fix([0.0, 0.0], np.eye(2)))
        assert apart is not None
        chances.append(apart.chance)
    for share in (0.1, 0.5, 0.9):
        assert abs(np.mean(np.array(chances) < share) - share) < 4.0 * np.sqrt(share * (1 - share) / 2000)


def test_what_a_wrong_scale_does_to_both_fixes_alike_is_in_no_difference() -> None:
    noise, by_scale = 1e-4 * np.eye(3), np.array([[30.0], [0.0], [1.0]])
    scale = 1e-4 * by_scale @ by_scale.T

    def fix(place: ArrayLike, partial: ArrayLike | None) -> ObservationRecord:
        partials = {} if partial is None else {Cause.SHAPE_SCALE: np.array(partial).tolist()}
        parts = {Cause.NOISE: noise.tolist(), Cause.SHAPE_SCALE: scale.tolist()}
        total = (noise + scale)[:2, :2]
        return _fix(place, total, parts=parts, partials=partials, range_km=100.0, sigma_range_km=1.0)

    both = difference_of(fix([0.1, 0.0], by_scale), fix([0.0, 0.0], by_scale))
    unknown = difference_of(fix([0.1, 0.0], None), fix([0.0, 0.0], None))
    half = difference_of(fix([0.1, 0.0], by_scale), fix([0.0, 0.0], 0.5 * by_scale))
    assert both is not None
    assert unknown is not None
    assert half is not None
    np.testing.assert_allclose(both.covariance, 2e-4 * np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(unknown.covariance, 2e-4 * np.eye(3) + 2.0 * scale, rtol=0, atol=1e-15)
    np.testing.assert_allclose(half.covariance, 2e-4 * np.eye(3) + 0.25 * scale, rtol=0, atol=1e-15)
    assert both.sigmas > 5.0 * unknown.sigmas


def test_a_fix_without_range_is_compared_by_its_center_and_a_failure_not_at_all() -> None:
    whole = _fix([1.0, 2.0], np.eye(2), range_km=10.0, sigma_range_km=0.1)
    apart = difference_of(whole, _fix([1.0, 2.0], np.eye(2)))
    assert apart is not None
    assert apart.offset.shape == (2,)
    ranged = difference_of(whole, whole.replace(range_km=10.1))
    assert ranged is not None
    assert ranged.offset[2] == pytest.approx(-np.log(1.01))
    nothing = ObservationRecord(index=0, file="a.fits", target="ROCK", estimator="moment", status="failed")
    assert difference_of(whole, nothing) is None
