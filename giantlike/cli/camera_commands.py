"""``giantlike camera``: look at camera files and convert them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

from giantlike.camera import Camera, MissionFrame
from giantlike.camera_models.convert import convert as convert_model
from giantlike.cli.arguments import Json, Overwrite
from giantlike.cli.outcome import ExitCode, say, show_result
from giantlike.core.arrays import finite_or_none, require
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure
from giantlike.io.camera_import import read_foreign_camera
from giantlike.io.camera_opencv import write_opencv_camera
from giantlike.io.mission_frame import Boresight

File = Annotated[
    Path,
    typer.Argument(
        metavar="FILE", help="TOML; OpenCV YAML or XML; GIANT XML; SPICE IK (.ti); FITS with TAN-SIP; SUMFILE."
    ),
]
Name = Annotated[str | None, typer.Option(help="Name of the camera in a GIANT file.")]
Instrument = Annotated[int | None, typer.Option(metavar="ID", help="NAIF code, for an instrument kernel.")]
FirstPixel = Annotated[
    float | None, typer.Option(metavar="0|0.5|1", help="Center of the first pixel as an instrument kernel counts.")
]
BoresightOption = Annotated[
    str | None, typer.Option("--boresight", metavar="+z|-z", help="Direction of the z axis of the mission's frame.")
]
Size = Annotated[str | None, typer.Option(metavar="COLUMNSxROWS", help="Size, if the file does not hold it.")]


def info(
    file: File,
    name: Name = None,
    instrument: Instrument = None,
    first_pixel: FirstPixel = None,
    boresight: BoresightOption = None,
    size: Size = None,
    json: Json = False,
) -> ExitCode:
    """Show the model of a camera file, its field of view and the scale of its pixels."""
    camera, notes = _read(file, name, instrument, first_pixel, boresight, size)
    return _show(_summary(camera), notes, json=json)


def convert(
    file: File,
    output: Annotated[Path, typer.Argument(metavar="OUT", help="New file: .toml is ours, .yml and .xml are OpenCV's.")],
    model: Annotated[str | None, typer.Option(help="Type of the new model; default: as it is.", metavar="TYPE")] = None,
    name: Name = None,
    instrument: Instrument = None,
    first_pixel: FirstPixel = None,
    boresight: BoresightOption = None,
    size: Size = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Write a camera in another file format or as another model, and list the losses.

    A model of another type is fitted over the whole frame; the largest and the rms difference are shown.
    """
    require(overwrite or not output.exists(), f"{output} exists: name another file, or give --overwrite")
    camera, notes = _read(file, name, instrument, first_pixel, boresight, size)
    lost: dict[str, Any] = {}
    if model is not None and model != camera.model.type_name:
        conversion = convert_model(camera.model, model, columns=camera.columns, rows=camera.rows)
        if isinstance(conversion, Failure):
            raise InputError(f"{file}: {conversion.detail}")
        camera = dataclasses.replace(camera, model=conversion.model, uncertainty=None)
        lost = {"max_px": conversion.max_px, "rms_px": conversion.rms_px, "coverage": conversion.coverage}
    if output.suffix == ".toml":
        camera.save(output)
    elif output.suffix in (".yml", ".yaml", ".xml"):
        write_opencv_camera(output, camera.model, columns=camera.columns, rows=camera.rows)
    else:
        raise InputError(f"{output}: the name of the new file must end in .toml, .yml, .yaml or .xml")
    lines = [f"wrote {output}"]
    if lost:
        lines.insert(
            0,
            f"differs from the original by {lost['rms_px']:.3g} px rms, at most {lost['max_px']:.3g} px, over "
            f"{100 * lost['coverage']:.4g} % of the frame",
        )
    return _show(_summary(camera) | {"file": str(output), "conversion": lost}, notes, lines, json=json)


def _read(
    path: Path,
    name: str | None,
    instrument_id: int | None,
    first_pixel: float | None,
    boresight: str | None,
    size: str | None,
) -> tuple[Camera, list[str]]:
    """Camera of a file, and remarks on fields that are not converted."""
    if path.suffix == ".toml":
        return Camera.load(path), []
    found = read_foreign_camera(
        path,
        name=name,
        instrument_id=instrument_id,
        first_pixel=first_pixel,
        boresight=cast("Boresight | None", boresight),
    )
    columns, rows = _size(size) if size else (found.columns, found.rows)
    if columns is None or rows is None:
        raise InputError(f"{path}: does not tell the size of the detector: give --size COLUMNSxROWS")
    turned = float(found.camera_from_mission.magnitude()) > 0
    notes = [f"not represented: {keyword}" for keyword in found.ignored]
    if turned:
        notes.append("the mission's axes differ from ours: see [mission_frame]")
    if found.rows_reversed:
        notes.append("the file describes mirrored images: rows are counted from the last stored one")
    frame = MissionFrame(name=found.name, camera_from_mission=found.camera_from_mission) if turned else None
    return Camera(name=found.name, columns=columns, rows=rows, model=found.model, mission_frame=frame), notes


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise InputError(f"--size must look like 1024x768, got {text!r}")
    return int(match[1]), int(match[2])


def _summary(camera: Camera) -> dict[str, Any]:
    return camera.to_mapping() | {
        "ifov_urad": finite_or_none(float(camera.ifov_rad()) * 1e6),
        "half_diagonal_deg": finite_or_none(float(np.degrees(camera.half_diagonal_rad))),
    }


def _show(summary: dict[str, Any], notes: list[str], more: Sequence[str] = (), *, json: bool) -> ExitCode:
    model = summary["model"]
    lines = [f"{summary['name']}: {summary['columns']} x {summary['rows']} px, {model['type']}"]
    lines += [f"  {key} = {value!r}" for key, value in model.items() if isinstance(value, int | float)]
    for key, unit in (("ifov_urad", "microradian a pixel"), ("half_diagonal_deg", "degrees from center to corner")):
        if summary[key] is not None:
            lines.append(f"  {summary[key]:.6g} {unit}")
    if not json:
        for note in notes:
            say(note)
    return show_result(summary | {"notes": notes}, [*lines, *more], json=json)
