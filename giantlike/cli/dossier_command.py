"""``giantlike dossier``: the data of a run for a verification report, and its check."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from giantlike.cli.arguments import Json, Workers
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.core.arrays import require
from giantlike.viewer.dossier import write_dossier
from giantlike.viewer.dossier_check import check_dossier, reproduce

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
        Path | None, typer.Option(help="Campaign file, if it is not where the run found it.", metavar="CAMPAIGN.toml")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Say which input of a dossier changed since.")] = False,
    again: Annotated[
        Path | None,
        typer.Option("--reproduce", help="Run a dossier again into this new folder, and compare.", metavar="NEW_RUN"),
    ] = None,
    workers: Workers = None,
    json: Json = False,
) -> ExitCode:
    """Collect the data of a run for a verification report.

    One folder with the hashes of all inputs, versions, options, decisions of users with their reasons, outcomes,
    figures, tables and exports. The run must be up to date with its inputs and edits.
    """
    require(not (check and again), "give --check or --reproduce, not both")
    if check:
        found = check_dossier(folder)
        kinds = (("changed", found.changed), ("missing", found.missing), ("version", found.versions))
        lines = [f"{kind}: {name}" for kind, names in kinds for name in names] + [f"{found.same} files are the same"]
        return show_result(asdict(found), lines, json=json, failed=not found.holds)
    if again is not None:
        return _reproduce(folder, again, workers, json=json)
    written = write_dossier(folder, output, campaign)
    return show_result({"dossier": written}, f"wrote {written}; look at {written / 'dossier.html'}", json=json)


def _reproduce(folder: Path, output: Path, workers: int | None, *, json: bool) -> ExitCode:
    different = reproduce(folder, output, workers=workers)
    lines = [f"different: {line}" for line in different[:_MOST_LINES]]
    if len(different) > _MOST_LINES:
        lines.append(f"and {len(different) - _MOST_LINES} more")
    lines.append("the tables are the same" if not different else f"{len(different)} lines of the tables differ")
    return show_result({"run": output, "different": different}, lines, json=json, failed=bool(different))
