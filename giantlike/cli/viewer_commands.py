"""Commands that look into a run: ``show``, ``explain``, ``backplanes``, ``view`` and ``dossier``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from giantlike._system.atomic import make_folder, replacing
from giantlike.cli.arguments import Json, Run, Workers
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.core.extras import require_extra
from giantlike.viewer import Session, backplanes_of, layers_of
from giantlike.viewer import explain as explained
from giantlike.viewer.dossier import check_dossier, reproduce, write_dossier
from giantlike.viewer.layers import LAYERS
from giantlike.viewer.planes import with_terminators, write_backplanes
from giantlike.viewer.session import verdict_of

Names = Annotated[
    list[str],
    typer.Argument(
        metavar="[RUN] IMAGE", help="Run folder, unless --run names it, and an image: its name or the beginning."
    ),
]
RunOption = Annotated[
    Path | None, typer.Option("--run", metavar="RUN", help="Run folder, instead of the first argument.")
]
_SHOWN = tuple(name for name in LAYERS if name != "terminator")  # layers that need nothing but the run
CampaignFile = Annotated[
    Path | None,
    typer.Option("--campaign", help="Campaign file, if it is not where the run found it.", metavar="CAMPAIGN.toml"),
]


def _open_session(names: list[str], run: Path | None, campaign: Path | None) -> tuple[Session, str]:
    """The run and the image that the arguments name; the image may be left out where the run has only one."""
    require(len(names) + (run is not None) <= 2, f"a RUN and an IMAGE are needed, got {' '.join(names)}")
    if run is None:
        run, names = Path(names[0]), names[1:]
        if not names and not run.exists():
            raise InputError(f"{run}: there is no such run folder; give the run first: RUN IMAGE, or IMAGE --run RUN")
    session = Session(run, campaign)
    if not names:
        files = session.files
        require(
            len(files) == 1, f"{run}: an IMAGE is needed; there are {len(files)}, the first is {', '.join(files[:1])}"
        )
        return session, files[0]
    return session, session.find(names[0])


def show(
    names: Names,
    output: Annotated[Path, typer.Option(help="Picture to write; by its ending PNG, SVG or PDF.", metavar="PNG")],
    layers: Annotated[
        str, typer.Option(help=f"Of {', '.join(LAYERS)}; default: all but terminator.", metavar="A,B")
    ] = ",".join(_SHOWN),
    box: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Part of the image to show, px.", metavar="LEFT TOP RIGHT BOTTOM"),
    ] = None,
    run: RunOption = None,
    campaign: CampaignFile = None,
) -> ExitCode:
    """Draw an image of a run with its results."""
    from giantlike.viewer.pictures import picture_of

    shown = [name.strip() for name in layers.split(",") if name.strip()]
    unknown = [name for name in shown if name not in LAYERS]
    require(not unknown, f"there is no layer {', '.join(unknown)}; there are {', '.join(LAYERS)}")
    session, file = _open_session(names, run, campaign)
    seen = session.seen(file)
    if "terminator" in shown:
        seen = with_terminators(session, seen, backplanes_of(session, file))
    figure = picture_of(session, file, layers_of(seen, shown), box=box)
    make_folder(output.parent)
    with replacing(output) as part:
        figure.savefig(part, format=output.suffix.removeprefix(".") or "png")
    typer.echo(f"wrote {output}")
    return ExitCode.DONE


def explain(names: Names, run: RunOption = None, json: Json = False) -> ExitCode:
    """Explain in words the prediction, results and rejections of an image, and which check decided.

    With --json the records themselves, too: attitude, targets, fixes with the statistics of their checks, edits.
    """
    session, file = _open_session(names, run, None)
    seen = session.seen(file)
    text, records = explained(seen), {"targets": seen.targets, "fixes": seen.observations, "edits": seen.edits}
    summary: dict[str, object] = {"file": file, "verdict": verdict_of(seen.record, seen.observations), "text": text}
    summary["image"] = seen.record.model_dump(mode="json", exclude_none=True)
    summary |= {
        name: [one.model_dump(mode="json", exclude_none=True) for one in several] for name, several in records.items()
    }
    return show_result(summary, text, json=json)


def backplanes(
    names: Names,
    output: Annotated[Path, typer.Option(help="FITS file to write.", metavar="FITS")],
    estimator: Annotated[
        str | None, typer.Option(help="Body where this estimator found it; default: the best fix.")
    ] = None,
    predicted: Annotated[bool, typer.Option("--predicted", help="Body where it was predicted.")] = False,
    run: RunOption = None,
    campaign: CampaignFile = None,
) -> ExitCode:
    """Write range, angles, latitude and longitude of every pixel as a FITS cube with world coordinates."""
    session, file = _open_session(names, run, campaign)
    write_backplanes(output, session, file, estimator=estimator, predicted=predicted)
    typer.echo(f"wrote {output}")
    return ExitCode.DONE


def view(
    folder: Run,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; default: a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in your browser.")] = True,
    campaign: CampaignFile = None,
    other: Annotated[
        Path | None, typer.Option("--with", help="Another run, to blink against image by image.", metavar="RUN")
    ] = None,
) -> ExitCode:
    """Look into a run in a browser: images, layers, templates, residuals, fixes; reject, restore and solve again.

    The page is served to this machine alone, at an address with a secret token, until you interrupt the command.
    """
    for module in ("starlette", "uvicorn"):
        require_extra(module, extra="view", purpose="giantlike view")
    from giantlike.viewer.server import serve

    def announce(address: str) -> None:
        typer.echo(address)
        if browser:
            import webbrowser

            webbrowser.open(address)

    serve(folder, campaign=campaign, port=port, announce=announce, other=other)
    return ExitCode.DONE


_MOST_LINES = 20  # lines of differences that are printed; with --json all are


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
