"""Worker processes: their number, the server that they are forked from, their threads."""

from __future__ import annotations

import gc
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from giantlike._system.processes import importing, one_thread, one_thread_each, process_count

_EARLY = """
import os, sys
from concurrent.futures import ProcessPoolExecutor
from giantlike._system.processes import start_server, worker_context

def state():
    return "colorsys" in sys.modules, os.environ.get("OMP_NUM_THREADS")

if __name__ == "__main__":
    os.environ.pop("OMP_NUM_THREADS", None)
    start_server("colorsys")
    assert state() == (False, None), state()
    with ProcessPoolExecutor(1, worker_context("colorsys")) as pool:
        print(*pool.submit(state).result())
"""

_FREED = """
import resource, sys
import numpy as np
from giantlike._system.processes import keep_memory

if sys.argv[1] == "keep":
    keep_memory()
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(2**17) for _ in range(30)]  # of 1 MB
    del arrays
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked from a server on Linux only")
def test_a_server_started_early_has_the_modules_and_the_variables_that_this_process_has_not(tmp_path: Path) -> None:
    script = tmp_path / "early.py"
    script.write_text(_EARLY)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert (done.stdout.split(), done.stderr) == (["True", "1"], "")


def test_variables_of_threads_that_are_set_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with one_thread_each():
        assert (os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]) == ("3", "1")
    assert os.environ["OMP_NUM_THREADS"] == "3"
    assert "MKL_NUM_THREADS" not in os.environ


def _threads() -> set[int]:
    """Numbers of threads of the libraries of linear algebra."""
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_one_thread_within_and_as_many_as_before_after_it() -> None:
    with threadpool_limits(2):
        with one_thread():
            with one_thread():
                assert _threads() == {1}
            assert _threads() == {1}
        assert _threads() == {2}


@pytest.mark.parametrize(("workers", "jobs", "expected"), [(4, 2, 2), (2, 9, 2), (3, 0, 1)])
def test_no_more_processes_than_jobs(workers: int, jobs: int, expected: int) -> None:
    assert process_count(workers, jobs) == expected


def test_what_is_imported_is_left_alone_by_the_collector_which_then_goes_on_less_often() -> None:
    before, threshold = gc.get_freeze_count(), gc.get_threshold()
    gc.set_threshold(700, 10, 10)  # a test before may have imported so
    try:
        with importing():
            assert not gc.isenabled()
        assert gc.isenabled()
        assert gc.get_freeze_count() > before
        assert gc.get_threshold()[0] > 700
    finally:
        gc.unfreeze()
        gc.set_threshold(*threshold)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_memory_that_arrays_freed_is_not_asked_for_again() -> None:
    faults = [
        int(subprocess.run([sys.executable, "-c", _FREED, how], capture_output=True, text=True, check=True).stdout)
        for how in ("keep", "as it is")
    ]
    assert faults[0] < 0.1 * faults[1]
