"""Functions that users call do their linear algebra with one thread, however many are allowed outside."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NoReturn

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from giantlike import calibration, navigation, stars
from giantlike.processing import detect_sources

FUNCTIONS: list[Callable[..., Any]] = [
    stars.fit_attitude,
    stars.refine_attitude,
    stars.identify_apriori,
    stars.identify_lost_in_space,
    stars.carry_attitude,
    calibration.calibrate,
    calibration.calibrate_stars,
    calibration.identify_first,
    calibration.align,
    navigation.estimate_batch,
    navigation.estimate_pass,
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
