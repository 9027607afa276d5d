"""``giantlike replay``: comparison of the results of a paper on a flight system with ours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from giantlike._system.atomic import make_folder
from giantlike._system.processes import process_count
from giantlike.cli.arguments import Json, Overwrite, Workers
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.cli.progress import progress_bar
from giantlike.core.errors import InputError
from giantlike.missions import REPLAYS, ReplaySettings, run_replay, save_replay

_MANY_JOBS = 1000  # A replay has more jobs than any machine has cores


def replay(
    name: Annotated[str, typer.Argument(metavar="NAME", help=f"One of {', '.join(REPLAYS)}.")],
    output: Annotated[Path, typer.Option(help="Folder for report.html and replay.json.", metavar="DIR")],
    small: Annotated[bool, typer.Option("--small", help="Fewer images and draws, in seconds.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 1,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder with kernels and shapes of the mission, where you have them.", metavar="DATA"),
    ] = None,
    change: Annotated[
        str, typer.Option(help="Alter an assumption, to see what depends on it: docs/replays.md.", metavar="NAME")
    ] = "",
    workers: Workers = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Replay a paper on a flight system, and compare each of its figures, tables and numbers with ours.

    docs/replays.md describes each replay, and the assumptions where its paper gives no value.
    """
    if (output / "replay.json").exists() and not overwrite:
        raise InputError(f"{output} holds a replay already: use --overwrite or another folder")
    make_folder(output)
    with progress_bar() as progress:
        settings = ReplaySettings(
            output=output,
            small=small,
            workers=process_count(workers, _MANY_JOBS),
            seed=seed,
            data=data,
            change=change,
            progress=progress,
        )
        summary = save_replay(run_replay(name, settings), settings)
    return show_result(summary, _lines(summary, output), json=json)


def _lines(summary: Mapping[str, Any], output: Path) -> Iterator[str]:
    """A line per comparison."""
    for each in summary["comparisons"]:
        mark = {True: "agrees", False: "DIFFERS", None: "not compared"}[each["agrees"]]
        yield (f"{mark:<13}{each['kind']:<12}{each['reference']:<10} {each['what']}: {each['paper']} | {each['ours']}")
    counts = summary["counts"]
    told = ", ".join(f"{count['agree']} of {count['comparisons']} {kind}" for kind, count in counts.items())
    yield f"agree: {told}; see {output / 'report.html'}"
