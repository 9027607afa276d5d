"""Runs among many damaged images, and runs that are killed at any moment: the good results are those of a quiet run."""

from __future__ import annotations

import csv
import json
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from tests.campaign_files import campaign_table, write_campaign
from tests.hostile_damage import mutated

N_BAD, N_KILLS = 60, 4
LONGEST_RUN_S = 300.0
FULL_KB = 120  # less than the results of the campaign, more than its first

pytestmark = pytest.mark.slow


def _tables(run: Path, names: set[str] | None = None) -> dict[str, list[list[str]]]:
    """Rows of both tables, without the last column, the time; of the images of these names, all if there are none."""
    tables = {}
    for table in ("attitudes", "observations"):
        with (run / f"{table}.csv").open(newline="") as file:
            rows = list(csv.reader(file))[1:]
        tables[table] = [row[:-1] for row in rows if names is None or row[0] in names]
    return tables


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small campaign that ran undisturbed."""
    path, _ = write_campaign(tmp_path_factory.mktemp("quiet"), visits=2)
    run_campaign(Campaign.load(path), workers=1)
    return path.parent


def test_bad_images_among_good_ones_change_no_good_result(quiet: Path, tmp_path: Path) -> None:
    path, truth = write_campaign(tmp_path / "mixed", visits=2)
    images, table = path.parent / "images", path.parent / "geometry.csv"
    lines = table.read_text().splitlines()
    rows = {re.split(",", line, maxsplit=1)[0]: line for line in lines[1:]}
    random, good = np.random.default_rng(20261122), sorted(truth)
    shorts = [name for name in good if "short" in name]
    for k in range(N_BAD):
        source = shorts[
            k % len(shorts)
        ]  # a long one that can still be read would have a say in attitudes between stars
        content = (images / source).read_bytes()
        kinds = (mutated(content, random), content[: int(random.integers(len(content)))], random.bytes(5000), b"")
        (images / f"z_bad_{k:03d}.fits").write_bytes(kinds[k % 4])
        lines.append(rows[source].replace(source, f"z_bad_{k:03d}.fits"))
    table.write_text("\n".join(lines) + "\n")
    result = run_campaign(Campaign.load(path), workers=2)
    assert _tables(result.folder, set(good)) == _tables(quiet / "run")
    assert len(result.attitudes) == len(good) + N_BAD
    log = [json.loads(line) for line in (result.folder / "log.jsonl").read_text().splitlines()]
    assert not [line for line in log if "traceback" in line or line.get("reason") == "internal_error"]


def test_a_run_killed_at_any_moment_and_continued_gives_the_tables_of_a_quiet_one(quiet: Path, tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path / "killed", visits=2)
    path.write_text(tomli_w.dumps(campaign_table()))
    random, deadline = np.random.default_rng(7), time.monotonic() + LONGEST_RUN_S
    command = [sys.executable, "-m", "giantlike", "run", str(path), "--workers", "1", "--resume"]
    kills = 0
    while True:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            code = process.wait(random.uniform(0.5, 3.0) if kills < N_KILLS else LONGEST_RUN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
            assert time.monotonic() < deadline
            continue
        assert code == 0
        break
    assert kills > 0
    assert _tables(path.parent / "run") == _tables(quiet / "run")


def test_eight_processes_give_the_tables_of_one(quiet: Path, tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path / "eight", visits=2)
    result = run_campaign(Campaign.load(path), workers=8)
    assert _tables(result.folder) == _tables(quiet / "run")
    ours, theirs = ((folder / "observables.parquet").read_bytes() for folder in (result.folder, quiet / "run"))
    assert ours == theirs


def test_a_run_on_a_full_disk_says_so_keeps_what_is_there_and_goes_on(quiet: Path, tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path / "full", visits=2)
    table, disk = campaign_table(), tmp_path / "disk"
    table["campaign"]["output"] = str(disk / "run")
    path.write_text(tomli_w.dumps(table))
    disk.mkdir()
    run = shlex.join([sys.executable, "-m", "giantlike", "run", str(path), "--workers", "1"])
    script = f"""
        mount -t tmpfs -o size={FULL_KB}k none {disk} || exit 77
        {run} > {tmp_path}/first.txt 2>&1; echo $? > {tmp_path}/code
        mount -o remount,size=200m {disk}
        {run} --json > {tmp_path}/second.json 2> {tmp_path}/second.txt; cp -r {disk}/run {tmp_path}/kept
    """
    # a file system of its own, in a name space that ends with the script
    shell = subprocess.run(["unshare", "-Urm", "sh", "-c", script], capture_output=True, text=True)
    if shell.returncode == 77 or not (tmp_path / "code").exists():
        pytest.skip(f"no file system can be made here: {shell.stderr}")
    said = (tmp_path / "first.txt").read_text()
    assert (tmp_path / "code").read_text().strip() == "2", said
    assert "full" in said or "No space left" in said
    assert "Traceback" not in said
    steps = json.loads((tmp_path / "second.json").read_text())["steps"]
    assert sum(count["kept"] for count in steps.values()) > 0
    assert _tables(tmp_path / "kept") == _tables(quiet / "run")
