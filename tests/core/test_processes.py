"""Worker processes: their number, the server that they are forked from, their threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from giantlike.core.processes import one_thread_each, process_count

_EARLY = """
import os, sys
from concurrent.futures import ProcessPoolExecutor
from giantlike.core.processes import start_server, worker_context

def state():
    return "colorsys" in sys.modules, os.environ.get("OMP_NUM_THREADS")

if __name__ == "__main__":
    os.environ.pop("OMP_NUM_THREADS", None)
    start_server("colorsys")
    assert state() == (False, None), state()
    with ProcessPoolExecutor(1, worker_context("colorsys")) as pool:
        print(*pool.submit(state).result())
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


@pytest.mark.parametrize(("workers", "jobs", "expected"), [(4, 2, 2), (2, 9, 2), (3, 0, 1)])
def test_no_more_processes_than_jobs(workers: int, jobs: int, expected: int) -> None:
    assert process_count(workers, jobs) == expected
