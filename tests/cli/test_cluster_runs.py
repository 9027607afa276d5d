"""Runs on a cluster of dask.distributed: the tables of a local run to the bit, also when a worker is killed."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomli_w

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.run_folder import RunFolder
from tests.campaign_files import campaign_table, write_campaign

pytestmark = pytest.mark.slow

LONGEST_S = 300.0
CLUSTER = """
import sys, time
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, *(worker.pid for worker in cluster.workers.values()), flush=True)
        sys.stdin.read()
"""


def tables(folder: Path) -> list[list[str]]:
    """Rows of both tables, without the last column, the time."""
    rows = []
    for name in ("attitudes", "observations"):
        with (folder / f"{name}.csv").open(newline="") as stream:
            rows += [row[:-1] for row in csv.reader(stream)]
    return rows


@pytest.fixture
def address(tmp_path: Path) -> Iterator[tuple[str, list[int]]]:
    """Address of a cluster of two workers, and the processes of the workers."""
    pytest.importorskip("distributed")
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as one:
        assert one.stdout is not None
        assert one.stdin is not None
        place, *processes = one.stdout.readline().split()
        yield place, [int(process) for process in processes]
        one.stdin.close()
        one.wait(60)


def test_a_cluster_gives_the_tables_of_one_process_and_a_killed_worker_loses_nothing(
    tmp_path: Path, address: tuple[str, list[int]]
) -> None:
    path, _ = write_campaign(tmp_path / "campaign", visits=3)
    local = run_campaign(Campaign.load(path), workers=1).folder
    expected = tables(local)
    for output, kill in (("whole", False), ("killed", True)):
        table = campaign_table()
        table["campaign"]["output"] = output
        path.write_text(tomli_w.dumps(table))
        folder = path.parent / output
        command = [sys.executable, "-m", "giantlike", "run", str(path), "--dask", address[0]]
        with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
            if kill:
                deadline = time.monotonic() + LONGEST_S
                while not RunFolder(folder).keys(AttitudeRecord) and time.monotonic() < deadline:
                    time.sleep(0.02)
                os.kill(address[1][0], signal.SIGKILL)
            _, told = run.communicate(timeout=LONGEST_S)
        assert run.returncode == 0, told
        assert tables(folder) == expected


def test_an_address_without_a_scheduler_is_a_mistake(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    path, _ = write_campaign(tmp_path / "campaign", visits=1)
    command = [sys.executable, "-m", "giantlike", "run", str(path), "--dask", str(tmp_path / "none.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LONGEST_S)
    assert done.returncode == 2
    assert "there is no such scheduler file" in done.stderr
    assert "Traceback" not in done.stderr
