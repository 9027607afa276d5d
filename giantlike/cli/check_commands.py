"""Commands on campaign files: ``check`` and ``init``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from giantlike.campaign.check import check_campaign
from giantlike.campaign.init import CameraChoice, write_campaign_file
from giantlike.cli.arguments import Json, Overwrite
from giantlike.cli.outcome import ExitCode, print_json, show_result


def check(
    path: Annotated[Path, typer.Argument(metavar="CAMPAIGN.toml", help="Campaign file.")],
    all_images: Annotated[
        bool, typer.Option("--images", help="Open every image, not only up to the first without error.")
    ] = False,
    json: Json = False,
) -> ExitCode:
    """Show all errors of a campaign file and of the files that it names, without running it."""
    found = check_campaign(path, all_images=all_images)
    fatal = sum(mistake.fatal for mistake in found)
    if json:
        print_json({"mistakes": fatal, "found": [asdict(mistake) for mistake in found]})
    else:
        for mistake in found:
            typer.echo(str(mistake))
        counts = ((fatal, "mistake"), (len(found) - fatal, "warning"))
        typer.echo(f"{path}: " + ", ".join(f"{count} {word}{'s' * (count != 1)}" for count, word in counts))
    return ExitCode.BAD_INPUT if fatal else ExitCode.DONE


def init(
    images: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of images.")],
    camera: Annotated[Path | None, typer.Option(help="Camera file.", metavar="FILE")] = None,
    preset: Annotated[str | None, typer.Option(help="Camera that comes with the package.", metavar="NAME")] = None,
    mission: Annotated[str | None, typer.Option(help="Camera, images and SPICE of a mission.", metavar="NAME")] = None,
    fov: Annotated[float | None, typer.Option(help="Rough field of view along x.", metavar="DEG")] = None,
    output: Annotated[Path, typer.Option(help="File to write.", metavar="FILE")] = Path("campaign.toml"),
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Write a commented campaign file for a folder of images."""
    choice = CameraChoice(file=camera, preset=preset, mission=mission, fov_deg=fov)
    path = write_campaign_file(images, output, choice, overwrite=overwrite)
    return show_result({"campaign": path}, f"wrote {path}; complete it, then giantlike check {path}", json=json)
