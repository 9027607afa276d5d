"""Functions that users call do their linear algebra with one thread, however many are allowed outside."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NoReturn

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from giantlike.calibration.alignment import align
from giantlike.calibration.calibrate import calibrate
from giantlike.calibration.star_images import calibrate_stars, identify_first
from giantlike.cislunar.batch import estimate_batch
from giantlike.passes.estimator import estimate_pass
from giantlike.processing import detect_sources
from giantlike.stars.apriori import identify_apriori
from giantlike.stars.attitude import fit_attitude
from giantlike.stars.lost_in_space import identify_lost_in_space
from giantlike.stars.refine import refine_attitude
from giantlike.stars.transfer import carry_attitude

FUNCTIONS: list[Callable[..., Any]] = [
    fit_attitude,
    refine_attitude,
    identify_apriori,
    identify_lost_in_space,
    carry_attitude,
    calibrate,
    calibrate_stars,
    identify_first,
    align,
    estimate_batch,
    estimate_pass,
    detect_sources,
]


class LookedAtError(Exception):
    """The function has begun to work."""


class Input:
    """An input that counts the threads when a function first asks anything of it, and ends that function."""

    threads: frozenset[int] = frozenset()

    def look(self, *_: object) -> NoReturn:
        Input.threads = frozenset(each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas")
        raise LookedAtError

    __len__ = __iter__ = __array__ = __getattr__ = look


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_linear_algebra_takes_one_thread(function: Callable[..., Any]) -> None:
    needed = [each for each in inspect.signature(function).parameters.values() if each.default is each.empty]
    first = [Input() for each in needed if each.kind is not each.KEYWORD_ONLY]
    named = {each.name: Input() for each in needed if each.kind is each.KEYWORD_ONLY}
    Input.threads = frozenset()
    with threadpool_limits(2), pytest.raises(LookedAtError):
        function(*first, **named)
    assert Input.threads == {1}
