"""``giantlike run``: a campaign from its file to its run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from giantlike._system.processes import available_cpus, importing, keep_memory, start_server
from giantlike.campaign.run import WORKER_MODULES
from giantlike.cli.arguments import Json, Resume, Workers
from giantlike.cli.outcome import ExitCode


def run(
    path: Annotated[Path, typer.Argument(metavar="CAMPAIGN.toml", help="Campaign file.")],
    workers: Workers = None,
    resume: Resume = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Say what came of each image, with reasons.")
    ] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Go on as images arrive, until interrupted.")] = False,
    every: Annotated[float, typer.Option(help="With --watch: seconds between two looks.", min=0.1)] = 10.0,
    dask: Annotated[
        str | None,
        typer.Option(help="Work on a dask.distributed cluster: its scheduler's address or file.", metavar="ADDRESS"),
    ] = None,
    json: Json = False,
) -> ExitCode:
    """Run a campaign: attitudes from stars, then every estimator on every image.

    Writes the run folder that the campaign names: tables, report.html, provenance.json, log.jsonl. In a folder with
    results, those with unchanged inputs are kept; the work to redo is announced first.
    """
    alone = (workers or available_cpus()) == 1
    if dask is None and path.is_file() and not alone:
        start_server(*WORKER_MODULES)  # it imports while this process does
    with importing():
        from giantlike.cli.run_session import run_and_print
    if alone:
        keep_memory()

    return run_and_print(
        path, workers=workers, verbose=verbose, watch_every_s=every if watch else None, dask=dask, json=json
    )
