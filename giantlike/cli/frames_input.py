"""``--frames`` and ``--sequence``: calibration frames, or a fixed pattern removed, for images without a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from giantlike.campaign.file.frame_files import FrameFiles, frames_of
from giantlike.campaign.file.schema import CalibrationFramesSection
from giantlike.campaign.file.toml_file import TomlSection, read_toml
from giantlike.cli.outcome import say
from giantlike.core.arrays import require
from giantlike.core.detector import Detector
from giantlike.core.errors import OpNavError
from giantlike.core.outcomes import Failure
from giantlike.image import Image
from giantlike.processing.calibration_frames import CalibrationFrames
from giantlike.processing.detection.frame import saturation_of
from giantlike.processing.detection.sequence import FixedPattern, enough_images, fixed_pattern


class _FramesFile(TomlSection):
    """A TOML file with a table ``[calibration_frames]``."""

    calibration_frames: CalibrationFramesSection


class ImageReader:
    """Opens images, and takes bias, dark current and response off them where frames are given."""

    def __init__(self, frames: Path | None, *, hdu: int | str | None, bottom_up: bool = False) -> None:
        self._hdu, self._bottom_up = hdu, bottom_up
        self._files: FrameFiles | None = None
        if frames is not None:
            self._files = frames_of(frames, _section(frames), bottom_up=bottom_up)

    def open(self, path: Path, detector: Detector) -> Image:
        """Open an image."""
        image = Image.open(path, hdu=self._hdu, bottom_up=self._bottom_up)
        if self._files is None:
            return image
        return image.calibrated(_load_frames(self._files, image.rows, image.columns), detector)


def frames_table(frames: Path) -> dict[str, Any]:
    """Table ``[calibration_frames]`` for a campaign file in another folder."""
    table, folder = _section(frames).model_dump(exclude_unset=True), frames.resolve().parent
    for kind in ("bias", "dark", "flat"):
        if kind in table:
            table[kind] = [str(folder / name) for name in table[kind]]
    if table.get("bad_pixels") is not None:
        table["bad_pixels"] = str(folder / table["bad_pixels"])
    return {key: value for key, value in table.items() if value is not None}


def _section(frames: Path) -> CalibrationFramesSection:
    content, _ = read_toml(frames, _FramesFile, "file of calibration frames", complete=_only_frames)
    return content.calibration_frames


def _only_frames(path: Path, table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: table[key] for key in ("calibration_frames",) if key in table}


@cache
def _load_frames(files: FrameFiles, rows: int, columns: int) -> CalibrationFrames:
    """Frames of a size, combined once for all images."""
    return files.load(rows=rows, columns=columns)


BOTH_PATTERNS = "--frames takes the fixed pattern of the detector off; give it or --sequence, not both"


def sequence_pattern(
    paths: Sequence[Path], *, hdu: int | str | None, detector: Detector, bottom_up: bool = False
) -> FixedPattern | Failure:
    """Fixed pattern of the readable images among ``paths``; a failure is also said on stderr."""
    arrays = []
    for k in enough_images(len(paths)):
        try:
            arrays.append(Image.open(paths[k], hdu=hdu, bottom_up=bottom_up).pixels)
        except OpNavError:
            continue  # it is named where the image itself is processed
    require(len(arrays) >= 2, f"--sequence needs at least two readable images, got {len(arrays)}")
    pattern = fixed_pattern(arrays, detector=detector)
    if isinstance(pattern, Failure):
        say(f"giantlike: no fixed pattern is removed: {pattern.detail}")
    return pattern


def without_pattern(image: Image, detector: Detector, pattern: FixedPattern | Failure | None) -> tuple[Image, Detector]:
    """Return an image without the pattern and its hot pixels, and a detector with the saturation of its pixels."""
    if not isinstance(pattern, FixedPattern):
        return image, detector
    limit = saturation_of(image.pixels.dtype, detector.saturation_dn)
    pixels = pattern.removed_from(image.pixels, saturation_dn=detector.saturation_dn)
    return replace(image, pixels=pixels, mask=image.mask | pattern.hot), replace(detector, saturation_dn=limit)
