"""``giantlike dossier``: what a verification report of a run needs, and whether it still holds."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from giantlike.bench.dossier import write_dossier
from giantlike.bench.dossier_check import check_dossier, reproduce
from giantlike.cli.arguments import Json, Workers
from giantlike.cli.outcome import ExitCode, print_json
from giantlike.core.arrays import require

_MOST_LINES = 20
"""Lines of differences that are printed; with --json all are."""


def dossier(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Run folder; with --check or --reproduce a dossier.")
    ],
    output: Annotated[
        Path | None, typer.Option(help="Folder for the dossier; default: dossier in the run folder.", metavar="DIR")
    ] = None,
    campaign: Annotated[
        Path | None,
        typer.Option(help="Campaign file, if it is not where the run found it.", metavar="CAMPAIGN.toml"),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Say which input of a dossier changed since.")] = False,
    again: Annotated[
        Path | None,
        typer.Option("--reproduce", help="Run a dossier again into this new folder, and compare.", metavar="NEW_RUN"),
    ] = None,
    workers: Workers = None,
    json: Json = False,
) -> ExitCode:
    """Put together what a verification report of a run needs.

    One folder with the hashes of all inputs, versions, options, decisions of people with their reasons, verdicts,
    figures, tables and exports. The run must be up to date with its inputs and edits.
    """
    require(not (check and again), "give --check or --reproduce, not both")
    if check:
        return _check(folder, json=json)
    if again is not None:
        return _reproduce(folder, again, workers, json=json)
    written = write_dossier(folder, output, campaign)
    if json:
        print_json({"dossier": written})
    else:
        typer.echo(f"wrote {written}; look at {written / 'dossier.html'}")
    return ExitCode.DONE


def _check(folder: Path, *, json: bool) -> ExitCode:
    found = check_dossier(folder)
    if json:
        print_json(asdict(found))
    else:
        for kind, names in (("changed", found.changed), ("missing", found.missing), ("version", found.versions)):
            for name in names:
                typer.echo(f"{kind}: {name}")
        typer.echo(f"{found.same} files are the same")
    return ExitCode.DONE if found.holds else ExitCode.SOME_IMAGES_FAILED


def _reproduce(folder: Path, output: Path, workers: int | None, *, json: bool) -> ExitCode:
    different = reproduce(folder, output, workers=workers)
    if json:
        print_json({"run": output, "different": different})
    else:
        for line in different[:_MOST_LINES]:
            typer.echo(f"different: {line}")
        if len(different) > _MOST_LINES:
            typer.echo(f"and {len(different) - _MOST_LINES} more")
        typer.echo("the tables are the same" if not different else f"{len(different)} lines of the tables differ")
    return ExitCode.DONE if not different else ExitCode.SOME_IMAGES_FAILED
