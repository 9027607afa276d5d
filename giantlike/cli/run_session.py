"""Implementation of ``giantlike run``: a campaign from its file to its run folder, and its outcome on the console."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import typer

from giantlike.campaign import Campaign, RunResult, run_campaign
from giantlike.campaign.check import check_run
from giantlike.campaign.run.cluster import DaskPool
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.log import LOGGER
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import StatusCounts
from giantlike.campaign.store.run_folder import REPORT_PAGE
from giantlike.campaign.watch import watch_campaign
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.cli.progress import progress_bar
from giantlike.core.outcomes import Outcome, Quality

_MAX_DETAILS = 3  # maximum failures printed for each reason, enough to see a common cause; the tables, or -v, have all
_WITH_NOTE = set((Quality.WRONG_APRIORI | Quality.LARGE_RESIDUALS).names())
"""Flags of star attitudes that come with a note on the cause."""


def run_and_print(
    path: Path, *, workers: int | None, verbose: bool, watch_every_s: float | None, dask: str | None, json: bool
) -> ExitCode:
    """Run a campaign and print its outcome."""
    if dask is not None:
        path = path.absolute()  # workers have other working folders

    def run_once(campaign: Campaign) -> RunResult:
        announced = dict.fromkeys(campaign.warnings)

        def check(bench: Workbench) -> list[str]:
            warnings = check_run(bench)
            announced.update(dict.fromkeys(warnings))
            for warning in announced:
                _announce(warning)
            return warnings

        pool = None if dask is None else partial(_cluster, address=dask)
        with _events(verbose), progress_bar(lines=True) as progress:
            result = run_campaign(
                campaign, workers=workers, progress=progress, announce=_announce, pool=pool, check=check
            )
        for warning in result.warnings:
            if warning not in announced:
                _announce(warning)
        return result

    if watch_every_s is not None:
        watch_campaign(path, run_once, every_s=watch_every_s, announce=_announce)
    result = run_once(Campaign.load(path))
    if json:
        print_json(result.summary())
    else:
        _print_tables(result)
    return ExitCode.SOME_IMAGES_FAILED if result.failed_images else ExitCode.DONE


def _cluster(bench: Workbench, _: int, *, address: str) -> DaskPool:
    return DaskPool(bench, address)


def _announce(text: str) -> None:
    say(f"giantlike: {text}")


class _Telling(logging.Handler):
    """Prints each event of a run."""

    def emit(self, record: logging.LogRecord) -> None:
        line = getattr(record, "line", {})
        if "status" in line:
            names = [line.get(name) for name in ("file", "target", "estimator")]
            why = f": {line['reason']}: {line['detail']}" if "reason" in line else ""
            say(f"{' '.join(name for name in names if name)}: {line['status']}{why}")


@contextlib.contextmanager
def _events(wanted: bool) -> Iterator[None]:
    if not wanted:
        yield
        return
    handler, level = _Telling(), LOGGER.level
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(level)


def _print_tables(result: RunResult) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = f"{result.name}: {len(result.attitudes)} images"
    table = Table("", "ok", "suspect", "failed", "other", "reasons", title=escape(title))
    rows = {"attitude": StatusCounts.from_records(result.attitudes)}
    for (target, estimator), records in result.by_estimator.items():
        rows[f"{target}: {estimator}"] = StatusCounts.from_records(records)
    for name, counts in rows.items():
        reasons = ", ".join(f"{reason} ({count})" for reason, count in counts.reasons.items())
        other = ", ".join(f"{count} {words}" for words, count in counts.other_counts.items())
        table.add_row(escape(name), str(counts.ok), str(counts.suspect), str(counts.failed), other, reasons)
    Console().print(table)
    _print_reasons(result)
    failed = result.failed_images
    names = ", ".join(failed[:5]) + (", ..." if len(failed) > 5 else "")
    typer.echo(f"{len(failed)} image{'s' * (len(failed) != 1)} failed" + (f": {names}" if failed else ""))
    redone = sum(count.redone for count in result.steps.values())
    kept = sum(count.kept for count in result.steps.values())
    typer.echo(f"{result.folder}/{REPORT_PAGE} ({redone} results made, {kept} kept, {result.time_s:.1f} s)")


def _print_reasons(result: RunResult) -> None:
    """The first failures of each reason, and the flags of suspect results, in full."""
    details: dict[str, dict[str, None]] = {}
    flags: dict[str, int] = {}
    records: list[AttitudeRecord | ObservationRecord] = [*result.attitudes, *result.observations]
    for record in records:
        if record.problem is not None:
            details.setdefault(str(record.problem.reason), {})[record.problem.detail] = None
        if record.outcome is Outcome.SUSPECT:
            for flag in record.flags:
                flags[flag] = flags.get(flag, 0) + 1
    for reason, texts in details.items():
        typer.echo(f"{reason}:")
        for text in list(texts)[:_MAX_DETAILS]:
            typer.echo(f"  {text}")
        if len(texts) > _MAX_DETAILS:
            typer.echo(f"  and {len(texts) - _MAX_DETAILS} more, in the column reason of the tables and with -v")
    notes = [note for record in result.attitudes if _WITH_NOTE & set(record.flags) for note in record.notes]
    for text in list(dict.fromkeys(notes))[:_MAX_DETAILS]:
        typer.echo(text)
    if flags:
        typer.echo("flags of what is suspect: " + ", ".join(f"{flag} ({count})" for flag, count in flags.items()))
