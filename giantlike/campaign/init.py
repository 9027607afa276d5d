"""A commented campaign file for a folder of images, to be completed by the user."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from giantlike._system.atomic import write_text_atomic
from giantlike.camera import Camera
from giantlike.campaign.file.inputs import camera_of, reduce_camera
from giantlike.campaign.file.mission_defaults import with_mission
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.image import Image
from giantlike.presets import camera_preset

_TEMPLATE = Path(__file__).parent / "pages" / "campaign.toml.template"
_LOOKED_AT = 20  # images opened, evenly over the folder: shows two kinds of exposure, a mixture of sizes
_LONG_S = 1.0  # exposure, s, from which an image is proposed as one of stars, where a folder has shorter ones too


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraChoice:
    """Camera of a new campaign: a file, a preset, a mission, or a rough field of view."""

    file: Path | None = None
    preset: str | None = None
    mission: str | None = None
    fov_deg: float | None = None  # along x

    def __post_init__(self) -> None:
        given = [name for name in (self.file, self.preset, self.mission, self.fov_deg) if name is not None]
        require(
            len(given) == 1,
            "give one of --camera FILE, --preset NAME, --mission NAME and --fov DEG (rough field of view along x)",
        )


def write_campaign_file(images: Path, output: Path, camera: CameraChoice, *, overwrite: bool = False) -> Path:
    """Look at a folder of images and write a campaign file for them."""
    require(images.is_dir(), f"{images}: is no folder")
    require(overwrite or not output.exists(), f"{output}: is there already; use --overwrite, or --output another file")
    suffix, opened = _looked_at(images)
    sizes = Counter((image.columns, image.rows) for image in opened)
    (size, _), *others = sizes.most_common()
    pattern = Path(os.path.relpath(images, output.parent), f"*{suffix}").as_posix()
    text = _TEMPLATE.read_text(encoding="utf-8").format(
        name=json.dumps(images.resolve().name),
        pattern=json.dumps(pattern),
        camera=_camera(camera, size, output.parent),
        sizes="" if not others else f"# Images of other sizes, which this camera refuses: {dict(others)}\n",
        stars=_stars(opened),
        found=_found(opened),
    )
    write_text_atomic(output, text)
    return output


def _looked_at(folder: Path) -> tuple[str, list[Image]]:
    """The most frequent suffix of image files, and some of the images."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    for suffix, _ in Counter(path.suffix for path in files).most_common():
        of_kind = [path for path in files if path.suffix == suffix]
        opened = []
        for path in of_kind[:: max(1, len(of_kind) // _LOOKED_AT)]:
            try:
                opened.append(Image.open(path))
            except DataError:
                continue
        if opened:
            return suffix, opened
    raise InputError(f"{folder}: holds no image of a readable format")


def _camera(choice: CameraChoice, size: tuple[int, int], base: Path) -> str:
    """Section of the camera; one that does not fit the images is refused, as a run would."""
    if choice.fov_deg is not None:
        return (
            f"[camera]\ncolumns = {size[0]}\nrows = {size[1]}\nfov_deg = {choice.fov_deg}        "
            "# rough, along x: give a camera file, or a [calibration] below"
        )
    if choice.file is not None:
        binned = _binning(str(choice.file), Camera.load(choice.file), size)
        return f"[camera]\nfile = {json.dumps(Path(os.path.relpath(choice.file, base)).as_posix())}{binned}"
    if choice.preset is not None:
        binned = _binning(choice.preset, camera_preset(choice.preset).camera, size)
        return f"[camera]\npreset = {json.dumps(choice.preset)}{binned}"
    table = with_mission(base, {"mission": {"name": choice.mission}})
    binned = _binning(str(choice.mission), camera_of(base, table["camera"])[0], size)
    return (
        "[mission]                   # defaults of camera, reading of images and SPICE\n"
        f"name = {json.dumps(choice.mission)}\n"
        f'# kernels = "kernels"       # a folder: its SPICE kernels are found by their names\n\n[camera]{binned}'
    )


def _binning(name: str, camera: Camera, size: tuple[int, int]) -> str:
    """Line for images that are summed or resampled; nothing where they are as large as the camera's."""
    full = camera.columns, camera.rows
    if full == size:
        return ""
    factor = full[0] // size[0]
    if factor > 1 and full == (factor * size[0], factor * size[1]):
        return f"\nbinned = {factor}"
    try:
        reduce_camera(camera, list(size))
    except InputError as error:
        raise InputError(
            f"{name}: the camera has {full[0]} x {full[1]} pixels and the images {size[0]} x {size[1]}, which are no "
            "reduction of them: give a camera file of such images, or --fov"
        ) from error
    return f"\nbinned = [{size[0]}, {size[1]}]      # of the whole frame"


def _stars(images: Sequence[Image]) -> str:
    exposures = sorted(image.exposure_s for image in images if image.exposure_s is not None)
    if exposures and exposures[0] < _LONG_S <= exposures[-1]:
        return (
            f"long_exposure_s = {_LONG_S}       # exposures here: {exposures[0]:g} to {exposures[-1]:g} s; longer ones "
            "are star images,\n                            # shorter ones take their attitude from them"
        )
    return "# long_exposure_s = 1.0     # longer exposures are star images, shorter ones take their attitude from them"


def _found(images: Sequence[Image]) -> str:
    counts = {
        "an epoch": sum(image.epoch is not None for image in images),
        "an exposure time": sum(image.exposure_s is not None for image in images),
        "an attitude": sum(image.camera_from_inertial is not None for image in images),
        "a place of the spacecraft": sum(image.observer is not None for image in images),
    }
    found = ", ".join(f"{name} in {count}" for name, count in counts.items())
    return f"{len(images)} images looked at; headers have {found}"
