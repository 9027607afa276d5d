"""Fixtures shared by all tests."""

from __future__ import annotations

import json
import os
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from giantlike.campaign.demo import DemoReport

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
DATA = Path(os.environ.get("GIANTLIKE_TEST_DATA", BESIDE))


TOOK = "giantlike/took_s"
"""Key of pytest's cache: how long each test took when it last ran, s."""
took_s: defaultdict[str, float] = defaultdict(float)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add an option for the time between two edits."""
    parser.addoption("--longest", type=float, help="leave out tests that took longer, s, when they last ran")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests that took longer than ``--longest``."""
    limit_s, cache = config.getoption("--longest"), getattr(config, "cache", None)
    if limit_s is not None and cache is not None:
        before = cache.get(TOOK, {})
        longer = [item for item in items if before.get(item.nodeid, 0.0) > limit_s]
        config.hook.pytest_deselected(items=longer)
        items[:] = [item for item in items if before.get(item.nodeid, 0.0) <= limit_s]


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add up what a test and its fixtures took."""
    took_s[report.nodeid] += report.duration


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Remember how long each test took; of several workers the controlling process does."""
    cache = getattr(session.config, "cache", None)
    if cache is not None and not hasattr(session.config, "workerinput"):
        cache.set(TOOK, cache.get(TOOK, {}) | took_s)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run Monte Carlo tests with ``few`` draws always, and with all of them among the slow tests."""
    marker = metafunc.definition.get_closest_marker("monte_carlo")
    if marker is not None:
        few, full = marker.kwargs["few"], marker.kwargs["full"]
        metafunc.parametrize("draws", [few, pytest.param(full, marks=pytest.mark.slow)])


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real images, kernels and shapes; skips where it is missing (it is not part of the project)."""
    if not DATA.is_dir():
        pytest.skip(f"real data not found at {DATA}")
    return DATA


@pytest.fixture(scope="session")
def demo_report(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> DemoReport:
    """The demonstration, made once for all workers; what is in its folder is not to be changed."""
    from giantlike.campaign.demo import run_demo  # here, as importing it takes seconds that few folders need

    root = tmp_path_factory.mktemp("demo") if worker_id == "master" else tmp_path_factory.getbasetemp().parent
    folder, seconds = root / "demo-output", root / "demo-seconds.json"
    try:
        (root / "demo-begun").mkdir()
    except FileExistsError:  # another worker is at it
        while not seconds.is_file():
            time.sleep(0.2)
        return _report_of(folder, seconds)
    times = {}
    try:
        report = run_demo(folder, workers=2)
        times = {"simulate_s": report.simulate_s, "run_s": report.run_s}
    finally:  # an empty file tells the others that the demonstration failed
        written = seconds.with_suffix(".part")
        written.write_text(json.dumps(times))
        written.replace(seconds)
    return report


def _report_of(folder: Path, seconds: Path) -> DemoReport:
    from giantlike.camera import Camera
    from giantlike.campaign.demo import DemoReport
    from giantlike.simulation.compare import compare_run
    from giantlike.simulation.write import TRUTH_FILE

    times = json.loads(seconds.read_text())
    assert times, "the demonstration failed in another worker"
    comparison = compare_run(folder / "run", folder / TRUTH_FILE, Camera.load(folder / "camera.toml"))
    return DemoReport(output=folder, comparison=comparison, **times)
