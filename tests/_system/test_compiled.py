"""Tests of functions that are compiled when they are called first."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROCESSES = 3
CALL = """
import numpy as np

from giantlike.core.elimination import solve_symmetric

solve_symmetric(np.eye(2), np.ones((2, 1)))
print(sum(solve_symmetric.stats.cache_misses.values()))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="each process compiles there")
def test_of_processes_that_need_a_function_at_once_one_compiles_it_and_the_others_load_its_code(tmp_path: Path) -> None:
    variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", CALL]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=variables) for _ in range(PROCESSES)]

    compiled = [int(process.communicate()[0]) for process in started]

    assert sorted(compiled) == [0] * (PROCESSES - 1) + [1]
