"""Independent parts of the work on one image at once."""

from __future__ import annotations

import threading
from functools import partial

import pytest

from giantlike._system.threads import at_once, threads
from giantlike.core.errors import InputError

WAIT_S = 20.0


def _wait(together: threading.Barrier, value: int) -> int:
    together.wait(WAIT_S)
    return value


def test_two_threads_do_two_jobs_at_once() -> None:
    together = threading.Barrier(2)  # broken unless both jobs are at work
    with threads(2), at_once({"a": partial(_wait, together, 1), "b": partial(_wait, together, 2)}) as result:
        assert (result("b"), result("a")) == (2, 1)


def test_one_thread_does_what_is_asked_for_and_nothing_else() -> None:
    done = list[str]()
    with at_once({name: partial(done.append, name) for name in "abc"}) as result:
        result("b")
    assert done == ["b"]


def test_no_more_threads_work_than_are_allowed_and_none_of_them_starts_others() -> None:
    at_work, most, turn = 0, 0, threading.Lock()
    pause = threading.Event()

    def job(depth: int) -> None:
        nonlocal at_work, most
        if depth:
            with at_once({name: partial(job, depth - 1) for name in "abc"}) as result:
                [result(name) for name in "abc"]
            return
        with turn:
            at_work += 1
            most = max(most, at_work)
        pause.wait(0.02)
        with turn:
            at_work -= 1

    with threads(2):
        job(2)
    assert most == 2


def test_an_error_is_raised_where_the_result_is_asked_for() -> None:
    def bad() -> int:
        raise InputError("no such thing")

    jobs = {"good": lambda: 1, "bad": bad}
    with threads(2):
        with at_once(jobs) as result:
            assert result("good") == 1
        with pytest.raises(InputError, match="no such thing"), at_once(jobs) as result:
            result("bad")


def test_threads_end_with_their_context() -> None:
    done = list[str]()
    with threads(3), pytest.raises(InputError, match=">= 1"), threads(0):
        pass
    with at_once({name: partial(done.append, name) for name in "ab"}):
        pass
    assert not done
