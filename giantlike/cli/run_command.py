"""``giantlike run`` and ``giantlike report``."""

from __future__ import annotations

from pathlib import Path

import typer

from giantlike.campaign import Campaign, RunResult, load_result, run_campaign, write_report
from giantlike.campaign.store.results import StatusCounts
from giantlike.campaign.store.run_folder import REPORT_PAGE
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.cli.progress import progress_bar


def run_command(path: Path, *, workers: int | None, resume: bool, json: bool) -> ExitCode:
    """Run a campaign file and show the counts."""
    campaign = Campaign.load(path)
    for warning in campaign.warnings:
        say(f"giantlike: {warning}")
    with progress_bar() as progress:
        result = run_campaign(campaign, workers=workers, resume=resume, progress=progress)
    if json:
        print_json(result.summary())
    else:
        _print_tables(result)
    return ExitCode.SOME_IMAGES_FAILED if result.failed_images else ExitCode.DONE


def report_command(folder: Path, *, json: bool) -> ExitCode:
    """Write the report of a run folder again."""
    path = write_report(load_result(folder))
    if json:
        print_json({"report": str(path)})
    else:
        typer.echo(f"wrote {path}")
    return ExitCode.DONE


def _print_tables(result: RunResult) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = f"{result.name}: {len(result.attitudes)} images"
    table = Table("", "ok", "suspect", "failed", "reasons", title=escape(title))
    rows = {"attitude": StatusCounts.of(result.attitudes)}
    for (target, estimator), records in result.by_estimator.items():
        rows[f"{target}: {estimator}"] = StatusCounts.of(records)
    for name, counts in rows.items():
        reasons = ", ".join(f"{reason} ({count})" for reason, count in counts.reasons.items())
        table.add_row(escape(name), str(counts.ok), str(counts.suspect), str(counts.failed), reasons)
    Console().print(table)
    failed = result.failed_images
    names = ", ".join(failed[:5]) + (", ..." if len(failed) > 5 else "")
    typer.echo(f"{len(failed)} images failed" + (f": {names}" if failed else ""))
    typer.echo(f"{result.folder}/{REPORT_PAGE} ({result.time_s:.1f} s)")
