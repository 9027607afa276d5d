"""Runs that end by a signal, and other commands on a run at work: one line each."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.border import attempt
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.lock import hold_lock
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.cli.app import app
from giantlike.cli.outcome import ExitCode
from tests.campaign_files import write_campaign
from tests.sizes import slow

START_S = 60.0


def end_run(folder: Path, number: signal.Signals, after_s: float = 0.0) -> tuple[int, str]:
    """Exit code and errors of a run of two workers that a signal ends as they start."""
    write_campaign(folder, visits=1)
    command = [sys.executable, "-m", "giantlike", "run", str(folder / "campaign.toml"), "--workers", "2", "--watch"]
    ignored = signal.signal(number, signal.SIG_DFL)  # under nohup HUP is ignored, and children inherit that
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    signal.signal(number, ignored)
    until = time.monotonic() + START_S
    while not (folder / "run" / ".lock.json").exists() and time.monotonic() < until:
        time.sleep(0.002)
    time.sleep(after_s)
    process.send_signal(number)
    _, errors = process.communicate(timeout=START_S)
    return process.returncode, errors


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, ExitCode.TERMINATED), slow(signal.SIGHUP, ExitCode.HUNG_UP)]
)
def test_a_signal_ends_a_command_with_one_line(number: signal.Signals, code: ExitCode, tmp_path: Path) -> None:
    ended, errors = end_run(tmp_path, number)
    assert ended == code
    assert errors.splitlines()[-1] == f"giantlike: ended by the signal {number.name}; what is finished is kept"
    assert "Traceback" not in errors


@pytest.mark.slow
def test_workers_that_a_signal_finds_half_started_leave_no_traceback(tmp_path: Path) -> None:
    """One in four did, of the moments tried here, where the signal came between their start and their registration."""
    for step in range(16):
        folder = tmp_path / str(step)
        folder.mkdir()
        ended, errors = end_run(folder, signal.SIGTERM, 0.0125 * step)
        assert ended == ExitCode.TERMINATED
        assert "Traceback" not in errors, (step, errors)


def test_an_interrupt_in_compiled_code_is_no_failure_of_an_image() -> None:
    def interrupted() -> None:
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    with pytest.raises(KeyboardInterrupt):
        attempt(interrupted)


def test_other_commands_say_that_a_run_is_at_work(tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path, visits=1)
    campaign = Campaign.load(path)
    folder = run_campaign(campaign, workers=1).folder
    run = RunFolder.open(folder)
    run.write_provenance({name: value for name, value in run.provenance().items() if name != "run"})
    with hold_lock(folder):
        for command in (("run", path), ("report", folder), ("explain", folder), ("compare", folder, folder)):
            result = CliRunner().invoke(app, [*map(str, command)])
            assert result.exit_code == ExitCode.BAD_INPUT, command
            assert "a run is at work here (process" in result.stderr, (command, result.stderr)
