"""Throughput of campaigns: images a CPU second, wall time over workers, memory of a worker, cost of the report; JSON.

Images are those of ``giantlike demo`` for as many visits as asked for, each a body between two star images: 85 visits
are 255 images, 170 of stars and 85 of the body, which three estimators measure. ``--copies`` lists every image several
times, under names of their own, for campaigns larger than is worth rendering. Each run is a process of its own,
``giantlike run``, from start to end; CPU is that of all its processes, and apart that of the process that was started,
of the server that workers are forked from, and of the workers. Modules are compiled before, as in an installed package.

Usage: python benchmarks/campaign_speed.py FOLDER [--visits 85] [--copies 1 4] [--workers 1 2]

The images stay in FOLDER and are not made again. With Linux the memory of processes is sampled.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from giantlike.catalogs import load_catalog
from giantlike.simulation.approach import ApproachOptions, Visit, plan_approach
from giantlike.simulation.write import write_approach

SAMPLE_S = 0.1  # between looks at memory and CPU of processes, of which that since the last look is lost
DIAMETERS_PX, PHASES_DEG = (1.0, 300.0), (20.0, 110.0)
MODULES = ("cli.run_session", "cli.report_command", "campaign.run.server", "campaign.report.cards")


def visits(count: int) -> tuple[Visit, ...]:
    """Visits of growing size, even in its logarithm, at all phases."""
    sizes = np.geomspace(*DIAMETERS_PX, count)
    phases = PHASES_DEG[0] + (PHASES_DEG[1] - PHASES_DEG[0]) * (np.arange(count) * 0.618034 % 1.0)
    return tuple(
        Visit(day=0.2 * number, diameter_px=float(size), phase_deg=float(phase))
        for number, (size, phase) in enumerate(zip(sizes, phases, strict=True))
    )


def made(folder: Path, count: int) -> Path:
    """Campaign file of so many visits; written unless it is there."""
    campaign = folder / f"visits-{count}" / "campaign.toml"
    if not campaign.is_file():
        options = ApproachOptions(approach=visits(count), moon=())
        write_approach(plan_approach(options), campaign.parent, load_catalog())
    return campaign


def enlarged(campaign: Path, copies: int) -> Path:
    """Campaign with every image that many times: links to the files, and rows of the geometry."""
    if copies == 1:
        return campaign
    folder = campaign.parent.with_name(f"{campaign.parent.name}-{copies}")
    if folder.is_dir():
        return folder / campaign.name
    (folder / "images").mkdir(parents=True)
    for name in ("shapes", "camera.toml", "campaign.toml"):
        source = campaign.parent / name
        shutil.copytree(source, folder / name) if source.is_dir() else shutil.copy(source, folder / name)
    with (campaign.parent / "geometry.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    column = head.index("file")
    with (folder / "geometry.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        for number in range(copies):
            for row in rows:
                writer.writerow([*row[:column], f"{number}_{row[column]}", *row[column + 1 :]])
    for number in range(copies):
        for image in sorted((campaign.parent / "images").iterdir()):
            (folder / "images" / f"{number}_{image.name}").hardlink_to(image)
    return folder / campaign.name


def measured(campaign: Path, workers: int) -> dict[str, Any]:
    """Run a campaign and its report."""
    run = campaign.parent / "run"
    shutil.rmtree(run, ignore_errors=True)
    cost = _cost("run", str(campaign), "--workers", str(workers))
    report = _cost("report", str(run))
    images = len(list((campaign.parent / "images").iterdir()))
    size = sum(path.stat().st_size for path in run.rglob("*") if path.is_file())
    return {
        "images": images,
        "workers": workers,
        **{name: round(value, 2) for name, value in cost.items()},
        "images_a_cpu_s": round(images / cost["cpu_s"], 2),
        "images_a_wall_s": round(images / cost["wall_s"], 2),
        "report_again_cpu_s": round(report["cpu_s"], 2),
        "run_folder_mb": round(size / 1e6, 1),
    }


def _cost(*arguments: str) -> dict[str, float]:
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "giantlike", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    most_mb: dict[int, float] = {}
    cpu: dict[int, float] = {}
    started: dict[int, list[int]] = {}
    while process.poll() is None:
        for pid, children in _descendants(process.pid).items():
            started.setdefault(pid, []).extend(children)
            most_mb[pid] = max(most_mb.get(pid, 0.0), _memory_mb(pid))
            cpu[pid] = max(cpu.get(pid, 0.0), _own_cpu_s(pid))
        time.sleep(SAMPLE_S)
    wall = time.perf_counter() - began
    _, errors = process.communicate()
    if process.returncode > 1:  # 1: some images have no fix
        raise RuntimeError(f"giantlike {' '.join(arguments)}: {errors.decode()[-2000:]}")
    parent_mb = most_mb.pop(process.pid, 0.0)
    named = _by_role(process.pid, cpu, started)
    return {
        "cpu_s": sum(cpu.values()),
        **named,
        "wall_s": wall,
        "parent_mb": parent_mb,
        "worker_mb": max(most_mb.values(), default=0.0),
    }


def _descendants(pid: int) -> dict[int, list[int]]:
    """Processes below one, and itself, with the children of each."""
    found, children = [pid], dict[int, list[int]]()
    for one in found:
        children[one] = []
        for path in Path(f"/proc/{one}/task").glob("*/children"):
            try:
                children[one] += [int(child) for child in path.read_text().split()]
            except OSError:  # it ended
                continue
        found += children[one]
    return children


def _by_role(first: int, cpu: dict[int, float], children: dict[int, list[int]]) -> dict[str, float]:
    """CPU of the first process, of those that it started (the server), and of those below (the workers), s."""
    below = {pid for pid in children.get(first, ()) if pid in cpu}
    return {
        "parent_cpu_s": cpu[first],
        "server_cpu_s": sum(cpu[pid] for pid in below),
        "workers_cpu_s": sum(each for pid, each in cpu.items() if pid != first and pid not in below),
    }


def _memory_mb(pid: int) -> float:
    """Largest memory of a process so far that is its own: without mapped files, MB."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(float(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024.0


def _own_cpu_s(pid: int) -> float:
    """CPU of a process without its children, s."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--visits", type=int, nargs="*", default=[85])
    parser.add_argument("--copies", type=int, nargs="*", default=[1])
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    chosen = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(chosen.folder.absolute() / "compiled")
    imports = "; ".join(f"import giantlike.{name}" for name in MODULES)
    subprocess.run([sys.executable, "-c", imports], check=True)
    for count in chosen.visits:
        for copies in chosen.copies:
            campaign = enlarged(made(chosen.folder, count), copies)
            for workers in chosen.workers:
                print(json.dumps(measured(campaign, workers)), flush=True)


if __name__ == "__main__":
    main()
