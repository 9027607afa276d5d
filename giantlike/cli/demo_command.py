"""``giantlike demo``."""

from __future__ import annotations

from pathlib import Path

import typer

from giantlike.campaign.demo import run_demo
from giantlike.cli.outcome import ExitCode
from giantlike.cli.progress import progress_bar


def demo_command(output: Path, *, workers: int | None, json: bool) -> ExitCode:
    """Run the demonstration and show its comparison with the truth."""
    with progress_bar() as progress:
        report = run_demo(output, workers=workers, progress=progress)
    typer.echo(report.to_json() if json else report.text())
    return ExitCode.DONE
