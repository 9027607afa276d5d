"""Arguments common to several commands."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

Frames = Annotated[
    Path | None,
    typer.Option(
        help="TOML file with a table [calibration_frames]: bias, dark, flat and bad pixels are applied first.",
        metavar="FRAMES.toml",
    ),
]
Images = Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Image files of any readable format.")]
Json = Annotated[bool, typer.Option("--json", help="Write JSON to stdout.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace output files that exist.")]
Resume = Annotated[bool, typer.Option("--resume", help="Accepted; a run always goes on with its folder.")]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")]
Sequence = Annotated[
    bool,
    typer.Option(
        "--sequence",
        help="Images of one camera and other stars each: remove their fixed pattern; detect compares them too.",
    ),
]
Workers = Annotated[int | None, typer.Option(min=1, help="Number of processes; default: one per CPU.")]


def _number_or_name(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


Hdu = Annotated[str | None, typer.Option("--hdu", help="Number or name of the FITS extension.", parser=_number_or_name)]


class Units(StrEnum):
    """Unit of the coordinates in a shape file."""

    KM = "km"
    M = "m"
    AUTO = "auto"


UnitsOption = Annotated[
    Units, typer.Option(help="Unit of coordinates; auto guesses from the size and says so. DSK and npz are always km.")
]
