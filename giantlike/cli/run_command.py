"""``giantlike run`` and ``giantlike report``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.results import RunResult, load_result
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.cli.progress import progress_bar


def run_command(path: Path, *, workers: int | None, resume: bool, json: bool) -> ExitCode:
    """Run a campaign file."""
    campaign = Campaign.load(path)
    for warning in campaign.warnings:
        say(f"giantlike: {warning}")
    with progress_bar() as progress:
        result = run_campaign(campaign, workers=workers, resume=resume, progress=progress)
    return _show(result, json=json)


def report_command(folder: Path, *, json: bool) -> ExitCode:
    """Write the report of a run folder again."""
    result = load_result(folder)
    path = write_report(result)
    if json:
        print_json({"report": str(path)})
    else:
        typer.echo(f"wrote {path}")
    return ExitCode.DONE


def _show(result: RunResult, *, json: bool) -> ExitCode:
    summary = result.summary()
    if json:
        print_json(summary)
    else:
        _print_tables(summary)
    return ExitCode.SOME_IMAGES_FAILED if result.failed_images else ExitCode.DONE


def _print_tables(summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        "", "ok", "suspect", "failed", "reasons", title=escape(f"{summary['campaign']}: {summary['images']} images")
    )
    rows = [("attitude", summary["attitudes"])]
    rows += [(f"{row['target']}: {row['estimator']}", row) for row in summary["observations"]]
    for name, row in rows:
        reasons = ", ".join(f"{reason} ({count})" for reason, count in row["reasons"].items())
        table.add_row(escape(name), str(row["ok"]), str(row["suspect"]), str(row["failed"]), reasons)
    Console().print(table)
    failed = summary["failed_images"]
    names = ", ".join(failed[:5]) + (", ..." if len(failed) > 5 else "")
    typer.echo(f"{len(failed)} images failed" + (f": {names}" if failed else ""))
    typer.echo(f"{summary['output']}/report.html ({summary['time_s']:.1f} s)")
