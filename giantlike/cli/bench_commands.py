"""Commands that look into a run: ``show``, ``explain``, ``backplanes`` and ``view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from giantlike.bench import LAYERS, Session, backplanes_of, layers_of, verdict_of, with_terminators, write_backplanes
from giantlike.bench import explain as explained
from giantlike.cli.arguments import Json, Run, RunOption
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.core.arrays import require
from giantlike.core.atomic import make_folder, replacing
from giantlike.core.extras import require_extra

ImageName = Annotated[str, typer.Argument(metavar="IMAGE", help="Name of an image of the run, or its beginning.")]
_SHOWN = tuple(name for name in LAYERS if name != "terminator")
"""Layers that need nothing but the run."""
CampaignFile = Annotated[
    Path | None,
    typer.Option("--campaign", help="Campaign file, if it is not where the run found it.", metavar="CAMPAIGN.toml"),
]


def show(
    image: ImageName,
    run: RunOption,
    output: Annotated[Path, typer.Option(help="Picture to write; by its ending PNG, SVG or PDF.", metavar="PNG")],
    layers: Annotated[
        str, typer.Option(help=f"Of {', '.join(LAYERS)}; default: all but terminator.", metavar="A,B")
    ] = ",".join(_SHOWN),
    box: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Part of the image to show, px.", metavar="LEFT TOP RIGHT BOTTOM"),
    ] = None,
    campaign: CampaignFile = None,
) -> ExitCode:
    """Draw an image of a run with its results."""
    from giantlike.bench.pictures import picture_of

    names = [name.strip() for name in layers.split(",") if name.strip()]
    unknown = [name for name in names if name not in LAYERS]
    require(not unknown, f"there is no layer {', '.join(unknown)}; there are {', '.join(LAYERS)}")
    session = Session(run, campaign)
    file = session.find(image)
    seen = session.seen(file)
    if "terminator" in names:
        seen = with_terminators(session, seen, backplanes_of(session, file))
    figure = picture_of(session, file, layers_of(seen, names), box=box)
    make_folder(output.parent)
    with replacing(output) as part:
        figure.savefig(part, format=output.suffix.removeprefix(".") or "png")
    typer.echo(f"wrote {output}")
    return ExitCode.DONE


def explain(image: ImageName, run: RunOption, json: Json = False) -> ExitCode:
    """Explain in words the prediction, results and rejections of an image, and which check decided."""
    session = Session(run)
    file = session.find(image)
    seen = session.seen(file)
    text = explained(seen)
    summary = {"file": file, "verdict": verdict_of(seen.record, seen.observations), "text": text}
    return show_result(summary, text, json=json)


def backplanes(
    image: ImageName,
    run: RunOption,
    output: Annotated[Path, typer.Option(help="FITS file to write.", metavar="FITS")],
    estimator: Annotated[
        str | None, typer.Option(help="Body where this estimator found it; default: the best fix.")
    ] = None,
    predicted: Annotated[bool, typer.Option("--predicted", help="Body where it was predicted.")] = False,
    campaign: CampaignFile = None,
) -> ExitCode:
    """Write range, angles, latitude and longitude of every pixel as a FITS cube with world coordinates."""
    session = Session(run, campaign)
    write_backplanes(output, session, session.find(image), estimator=estimator, predicted=predicted)
    typer.echo(f"wrote {output}")
    return ExitCode.DONE


def view(
    folder: Run,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; default: a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in your browser.")] = True,
    campaign: CampaignFile = None,
) -> ExitCode:
    """Look into a run in a browser: images, layers, templates, residuals, fixes; reject, restore and solve again.

    The page is served to this machine alone, at an address with a secret token, until you interrupt the command.
    """
    for module in ("starlette", "uvicorn"):
        require_extra(module, extra="view", purpose="giantlike view")
    from giantlike.bench.server import serve

    def announce(address: str) -> None:
        typer.echo(address)
        if browser:
            import webbrowser

            webbrowser.open(address)

    serve(folder, campaign=campaign, port=port, announce=announce)
    return ExitCode.DONE
