"""A search for patterns of stars ends at its time limit; time is counted in looks at the clock."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
import pytest

from giantlike.camera import Camera
from giantlike.catalogs import MemoryCatalog, load_catalog
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import Image
from giantlike.stars import StarNavigation, StarOptions
from giantlike.stars.lost_in_space import identify_lost_in_space
from giantlike.stars.navigation import sky_of
from giantlike.stars.pattern_search import find_candidates
from tests.stars.test_star_identification import EPOCH, _detections

CAMERA = Camera.from_fov(30.0, 1024, 1024)
SPURIOUS = 3000


@pytest.fixture(scope="module")
def catalog() -> MemoryCatalog:
    return load_catalog("default")


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIANTLIKE_CACHE", str(tmp_path))


def _image() -> Image:
    return Image(pixels=np.zeros((1024, 1024), np.uint8), epoch=EPOCH, name="spurious")


def _points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.uniform(0.0, 1023.0, (SPURIOUS, 2)), np.tile(0.01 * np.eye(2), (SPURIOUS, 1, 1))


@pytest.mark.parametrize("free", [False, True])
def test_a_search_ends_within_its_limit_and_says_so(
    free: bool, catalog: MemoryCatalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds, calls = itertools.count(), list[Any]()
    monkeypatch.setattr(time, "thread_time", lambda: float(next(seconds)))

    def counted(*given: Any) -> Any:
        calls.append(given)
        return find_candidates(*given)

    monkeypatch.setattr("giantlike.stars.lost_in_space.find_candidates", counted)
    points, covariance = _points()
    options = StarOptions(lost_in_space=True, estimate_scale=free, time_limit_s=5.0)
    outcome = identify_lost_in_space(points, covariance, CAMERA, sky_of(_image(), catalog, options), options=options)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.TIME_LIMIT
    assert "time limit of 5 s" in outcome.detail
    assert len(calls) <= 5


def test_one_limit_holds_for_all_searches_of_an_image(catalog: MemoryCatalog, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = itertools.count()
    monkeypatch.setattr(time, "thread_time", lambda: float(next(seconds)))
    points, covariance = _points()
    navigation = StarNavigation(CAMERA, catalog, StarOptions(lost_in_space=True, time_limit_s=5.0))
    outcome = navigation.solve_detections(_image(), _detections(points, covariance, np.full(SPURIOUS, 100.0)))
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.TIME_LIMIT
    assert next(seconds) <= 12  # looks at the clock, one second each: no second search was begun


def test_a_limit_must_be_positive() -> None:
    with pytest.raises(InputError, match="time_limit_s"):
        StarOptions(time_limit_s=0.0)
