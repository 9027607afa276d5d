"""Commands on several runs: ``compare`` and ``merge``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from giantlike.campaign.compare.external import ExternalOptions, compare_external
from giantlike.campaign.compare.runs import compare_runs
from giantlike.campaign.merge import merge_runs
from giantlike.cli.arguments import Json, Run
from giantlike.cli.outcome import ExitCode, print_json, show_result

_WIDTH = 140  # width, columns, of a table in a file: wide enough for all numbers


def compare(
    folder: Run,
    other: Annotated[
        Path,
        typer.Argument(
            metavar="OTHER",
            help="Another run; attitudes or observables (.csv), angles (.tdm), a C-kernel (.bc), a trajectory (.bsp).",
        ),
    ],
    kernels: Annotated[
        list[str] | None, typer.Option("--kernel", help="bc, bsp: further kernels; may be repeated.", metavar="FILE")
    ] = None,
    frame: Annotated[str | None, typer.Option(help="bc: frame of the camera in the kernels.", metavar="NAME")] = None,
    camera_from_frame: Annotated[
        tuple[float, float, float, float],
        typer.Option(help="bc: quaternion, scalar last, from that frame to camera axes.", metavar="X Y Z W"),
    ] = (0.0, 0.0, 0.0, 1.0),
    spacecraft: Annotated[str | None, typer.Option(help="bsp: NAIF name or code.", metavar="ID")] = None,
    body: Annotated[str | None, typer.Option(help="bsp: the target, where it has another name.", metavar="ID")] = None,
    output: Annotated[Path | None, typer.Option(help="Table of all differences.", metavar="FILE.csv")] = None,
    json: Json = False,
) -> ExitCode:
    """Compare the results of a run with those of another run or another team.

    Differences, first minus second, are divided by the combined sigma. Errors common to both are in neither; they are
    named.
    """
    if other.is_dir():
        comparison = compare_runs(folder, other)
    else:
        options = ExternalOptions(
            kernels=tuple(kernels or ()),
            frame=frame,
            camera_from_frame_xyzw=camera_from_frame,
            spacecraft=spacecraft,
            body=body,
        )
        comparison = compare_external(folder, other, options)
    if output is not None:
        comparison.write_csv(output)
    summary = comparison.summary()
    if json:
        print_json(summary)
    else:
        _show(summary)
    return ExitCode.DONE


def merge(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Finished runs, in the order of the tables.")],
    output: Annotated[Path, typer.Option(help="New run folder.", metavar="DIR")],
    json: Json = False,
) -> ExitCode:
    """Make one run of several runs of parts of a campaign, from several machines or days.

    Nothing is computed again; the runs must have the same camera, targets and options.
    """
    result = merge_runs(runs, output)
    return show_result(result.summary(), f"{output}: {len(result.attitudes)} images of {len(runs)} runs", json=json)


def _show(summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = f"{summary['first']} minus {summary['second']}"
    table = Table("", "axis", "n", "mean", "rms", "largest", "sigma", "rms/sigma", "> 3 sigma", title=escape(title))
    for row in summary["differences"]:
        numbers = [row[name] for name in ("mean", "rms", "largest", "median_sigma", "rms_over_sigma")]
        cells = ["" if number is None else f"{number:.3g}" for number in numbers]
        table.add_row(
            escape(row["what"]), f"{row['axis']}, {row['unit']}", str(row["n"]), *cells, str(row["beyond_3_sigma"])
        )
    console = Console()
    (console if console.is_terminal else Console(width=_WIDTH)).print(table)
    for name in summary["shared_errors"]:
        typer.echo(f"both share: {name}")
    for note in summary["notes"]:
        typer.echo(note)
    typer.echo(f"without counterpart: {summary['only_first']} of the first, {summary['only_second']} of the second")
