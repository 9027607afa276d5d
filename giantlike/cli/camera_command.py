"""``giantlike camera``: look at camera files and convert them."""

from __future__ import annotations

import dataclasses
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from giantlike.camera import Camera, MissionFrame
from giantlike.camera_models.convert import convert
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure
from giantlike.io.camera_import import read_foreign_camera
from giantlike.io.camera_opencv import write_opencv_camera
from giantlike.io.mission_frame import Boresight


@dataclass(frozen=True, slots=True)
class CameraSource:
    """A camera file, and what its reader has to be told: the options of the command line."""

    path: Path
    name: str | None
    instrument_id: int | None
    first_pixel: float | None
    boresight: str | None
    size: str | None


def camera_info(source: CameraSource, *, json: bool) -> ExitCode:
    """Show a camera."""
    camera, notes = _read(source)
    if json:
        print_json(_summary(camera) | {"notes": notes})
    else:
        _tell(_summary(camera), notes)
    return ExitCode.DONE


def camera_convert(source: CameraSource, output: Path, *, type_name: str | None, json: bool) -> ExitCode:
    """Write a camera in another file format, or as another model."""
    camera, notes = _read(source)
    lost: dict[str, Any] = {}
    if type_name is not None and type_name != camera.model.type_name:
        conversion = convert(camera.model, type_name, columns=camera.columns, rows=camera.rows)
        if isinstance(conversion, Failure):
            raise InputError(f"{source.path}: {conversion.detail}")
        camera = dataclasses.replace(camera, model=conversion.model, uncertainty=None)
        lost = {"max_px": conversion.max_px, "rms_px": conversion.rms_px, "coverage": conversion.coverage}
    if output.suffix == ".toml":
        camera.save(output)
    elif output.suffix in (".yml", ".yaml", ".xml"):
        write_opencv_camera(output, camera.model, columns=camera.columns, rows=camera.rows)
    else:
        raise InputError(f"{output}: the name of the new file must end in .toml, .yml, .yaml or .xml")
    if json:
        print_json(_summary(camera) | {"notes": notes, "file": str(output), "conversion": lost})
        return ExitCode.DONE
    _tell(_summary(camera), notes)
    if lost:
        sys.stdout.write(
            f"differs from the original by {lost['rms_px']:.3g} px rms, at most {lost['max_px']:.3g} px, over "
            f"{100 * lost['coverage']:.4g} % of the frame\n"
        )
    sys.stdout.write(f"wrote {output}\n")
    return ExitCode.DONE


def _read(source: CameraSource) -> tuple[Camera, list[str]]:
    if source.path.suffix == ".toml":
        return Camera.load(source.path), []
    found = read_foreign_camera(
        source.path,
        name=source.name,
        instrument_id=source.instrument_id,
        first_pixel=source.first_pixel,
        boresight=cast("Boresight | None", source.boresight),
    )
    columns, rows = _size(source.size) if source.size else (found.columns, found.rows)
    if columns is None or rows is None:
        raise InputError(f"{source.path}: does not tell the size of the detector: give --size COLUMNSxROWS")
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
    ifov_urad = float(camera.ifov_rad()) * 1e6
    angle_deg = float(np.degrees(camera.half_diagonal_rad))
    return camera.to_mapping() | {
        "ifov_urad": ifov_urad if np.isfinite(ifov_urad) else None,
        "half_diagonal_deg": angle_deg if np.isfinite(angle_deg) else None,
    }


def _tell(summary: dict[str, Any], notes: list[str]) -> None:
    model = summary["model"]
    lines = [f"{summary['name']}: {summary['columns']} x {summary['rows']} px, {model['type']}"]
    lines += [f"  {key} = {value!r}" for key, value in model.items() if isinstance(value, int | float)]
    for key, unit in (("ifov_urad", "microradian a pixel"), ("half_diagonal_deg", "degrees from center to corner")):
        if summary[key] is not None:
            lines.append(f"  {summary[key]:.6g} {unit}")
    sys.stdout.write("\n".join(lines) + "\n")
    for note in notes:
        say(note)
