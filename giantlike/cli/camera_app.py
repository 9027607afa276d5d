"""``giantlike camera``: the arguments of its commands; what they need is imported when they run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from giantlike.cli.outcome import ExitCode, command

camera_app = typer.Typer(
    name="camera",
    help="Look at camera files, and turn them from and to those of other programs.",
    no_args_is_help=True,
    epilog="Exit codes: 0 done, 2 bad input, 130 interrupted.",
)


class BoresightOption(StrEnum):
    """Sense of the z axis of a mission's camera frame."""

    FORWARD = "+z"
    BACKWARD = "-z"


Source = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="TOML; OpenCV YAML or XML; GIANT XML; SPICE IK (.ti); FITS with TAN-SIP."),
]
Name = Annotated[str | None, typer.Option(help="Which camera of a GIANT file.")]
Instrument = Annotated[int | None, typer.Option(metavar="ID", help="NAIF code, for an instrument kernel.")]
FirstPixel = Annotated[
    float | None, typer.Option(metavar="0|0.5|1", help="What an instrument kernel calls the center of the first pixel.")
]
Boresight = Annotated[BoresightOption | None, typer.Option(help="Where the z axis of the mission's frame points.")]
Size = Annotated[str | None, typer.Option(metavar="COLUMNSxROWS", help="Size, where the file does not tell it.")]
Json = Annotated[bool, typer.Option("--json", help="Write JSON to stdout, for machines.")]


@camera_app.command("info")
@command
def info(
    file: Source,
    name: Name = None,
    instrument: Instrument = None,
    first_pixel: FirstPixel = None,
    boresight: Boresight = None,
    size: Size = None,
    json: Json = False,
) -> ExitCode:
    """Show the model of a camera file, its field of view and the scale of its pixels."""
    from giantlike.cli.camera_command import CameraSource, camera_info

    sense = None if boresight is None else boresight.value
    return camera_info(CameraSource(file, name, instrument, first_pixel, sense, size), json=json)


@camera_app.command("convert")
@command
def convert(
    file: Source,
    output: Annotated[Path, typer.Argument(metavar="OUT", help="New file: .toml is ours, .yml and .xml are OpenCV's.")],
    model: Annotated[str | None, typer.Option(help="Type of the new model; default: as it is.", metavar="TYPE")] = None,
    name: Name = None,
    instrument: Instrument = None,
    first_pixel: FirstPixel = None,
    boresight: Boresight = None,
    size: Size = None,
    json: Json = False,
) -> ExitCode:
    """Write a camera in another file format or as another model, and say what is lost.

    A model of another type is fitted over the whole frame; the largest and the rms difference are shown.
    """
    from giantlike.cli.camera_command import CameraSource, camera_convert

    sense = None if boresight is None else boresight.value
    source = CameraSource(file, name, instrument, first_pixel, sense, size)
    return camera_convert(source, output, type_name=model, json=json)
