"""Calibration frames that a campaign file names: found, read and combined."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giantlike._system.reading import file_sha256
from giantlike.campaign.file.inputs import existing_file, matching_files
from giantlike.campaign.file.schema import CalibrationFramesSection
from giantlike.campaign.file.toml_file import prefix_errors
from giantlike.core.arrays import require
from giantlike.image import Image
from giantlike.processing.calibration_frames import CalibrationFrames, combine_frames, flat_from

_KEY = "calibration_frames"
_SAME_EXPOSURE = 0.01  # relative difference up to which darks count as of one exposure, as of shutters


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFiles:
    """Files of the calibration frames of a campaign."""

    bias: tuple[Path, ...]  # bias, dark, flat: empty where there are none
    dark: tuple[Path, ...]
    flat: tuple[Path, ...]
    bad_pixels: Path | None
    dark_exposure_s: float | None  # None where headers have it
    dark_has_bias: bool  # dark_has_bias, flat_has_bias: False where bias (and dark current) were subtracted
    flat_has_bias: bool
    hdu: int | str | None  # FITS extension
    bottom_up: bool  # True if rows are reversed on reading

    def load(self, *, rows: int, columns: int) -> CalibrationFrames:
        """Read and combine the files."""
        known: dict[str, Any] = {"dark_has_bias": self.dark_has_bias}
        if self.bias:
            with prefix_errors(f"{_KEY}.bias: "):
                known["bias"] = combine_frames(*_arrays(self._open(self.bias)))
        if self.dark:
            with prefix_errors(f"{_KEY}.dark: "):
                images = self._open(self.dark)
                known["dark"] = combine_frames(*_arrays(images))
                known["dark_exposure_s"] = self.dark_exposure_s or _common_exposure_s(images)
        if self.flat:
            with prefix_errors(f"{_KEY}.flat: "):
                images = self._open(self.flat)
                offsets = CalibrationFrames(**known) if self.flat_has_bias and len(known) > 1 else None
                known["flat"] = flat_from(
                    *_arrays(images), offsets=offsets, exposures_s=[image.exposure_s for image in images]
                )
        if self.bad_pixels is not None:
            image = self._open([self.bad_pixels])[0]
            known["bad"] = image.mask | (image.pixels != 0)
        with prefix_errors(f"{_KEY}: "):
            frames = CalibrationFrames(**known)
            require(
                frames.bad.shape == (rows, columns),
                f"the frames have {frames.bad.shape} rows and columns, the camera {(rows, columns)}: "
                "use frames of the same window and binning",
            )
        return frames

    def sha256(self, folder: Path) -> dict[str, dict[str, str]]:
        """Hash of each file by its kind and its path from a folder."""
        return {
            kind: {Path(os.path.relpath(path, folder)).as_posix(): file_sha256(path) for path in paths}
            for kind, paths in self._kinds().items()
            if paths
        }

    def identity(self) -> tuple[Any, ...]:
        """Inputs of corrected pixels: the content of the files, and how they are read."""
        hashes = {kind: [file_sha256(path) for path in paths] for kind, paths in self._kinds().items()}
        return hashes, self.dark_exposure_s, self.dark_has_bias, self.flat_has_bias, self.hdu, self.bottom_up

    def _kinds(self) -> dict[str, tuple[Path, ...]]:
        bad = () if self.bad_pixels is None else (self.bad_pixels,)
        return {"bias": self.bias, "dark": self.dark, "flat": self.flat, "bad_pixels": bad}

    def _open(self, paths: Iterable[Path]) -> list[Image]:
        return [Image.open(path, hdu=self.hdu, bottom_up=self.bottom_up) for path in paths]


def frames_of(path: Path, section: CalibrationFramesSection | None, *, bottom_up: bool) -> FrameFiles | None:
    """Files of a ``[calibration_frames]`` section."""
    if section is None:
        return None
    bias, dark, flat = (
        matching_files(path, f"{_KEY}.{kind}", patterns)
        for kind, patterns in (("bias", section.bias), ("dark", section.dark), ("flat", section.flat))
    )
    bad = None if section.bad_pixels is None else existing_file(path, f"{_KEY}.bad_pixels", section.bad_pixels)
    require(bool(bias or dark or flat or bad), f"{_KEY}: give at least one of bias, dark, flat and bad_pixels")
    return FrameFiles(
        bias=bias,
        dark=dark,
        flat=flat,
        bad_pixels=bad,
        dark_exposure_s=section.dark_exposure_s,
        dark_has_bias=section.dark_has_bias,
        flat_has_bias=section.flat_has_bias,
        hdu=section.hdu,
        bottom_up=bottom_up,
    )


def _arrays(images: list[Image]) -> tuple[list[Any], list[Any]]:
    return [image.pixels for image in images], [image.mask for image in images]


def _common_exposure_s(images: list[Image]) -> float | None:
    """Exposure of all images, s; None where a header does not have it."""
    found = [image.exposure_s for image in images if image.exposure_s is not None]
    if len(found) < len(images):
        return None
    alike = np.ptp(found) <= _SAME_EXPOSURE * max(found)
    require(bool(alike), f"exposures from {min(found):g} to {max(found):g} s: name darks of one exposure")
    return float(np.mean(found))
