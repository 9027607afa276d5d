"""Versions, options and hashes that a run is made from, as JSON has them."""

from __future__ import annotations

import dataclasses
import platform
import re
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from giantlike._system import reading
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.database import KnownImage
from giantlike.campaign.store.run_folder import RunFolder, stamp_of
from giantlike.core.errors import DataError
from giantlike.core.version import VERSION


def inputs_of(campaign: Campaign, bench: Workbench) -> dict[str, Any]:
    """All inputs that determine the results of a run, except the images, as plain values."""
    stars = campaign.stars
    kernels = {} if bench.kernels is None else bench.kernels.sha256()
    return {
        "giantlike": VERSION,
        "campaign": dict(campaign.table),
        "image_files": [image.key for image in campaign.images],
        "camera": campaign.camera.to_mapping(),
        "geometry_sha256": _geometry_sha256(campaign.geometry_file),
        "calibration_frames_sha256": None if campaign.frames is None else campaign.frames.sha256(campaign.path.parent),
        "rates_sha256": None if stars is None or stars.rates is None else file_sha256(stars.rates),
        "kernels_sha256": {Path(path).name: digest for path, digest in kernels.items()},
        "shapes_sha256": {name: shape.sha256 for name, shape in bench.shapes.items()},
        "catalog": None if bench.navigation is None else bench.navigation.catalog.version,
        "options": {
            "stars": None if stars is None else _plain(stars),
            "targets": {
                target.name: {
                    "reflectance": repr(target.reflectance),
                    "estimators": {estimator.name: _plain(estimator.options) for estimator in target.estimators},
                }
                for target in campaign.targets
            },
        },
    }


def environment_of(campaign: Campaign) -> dict[str, Any]:
    """Hashes of files, Python and its packages, for information; they may change when a run continues."""
    return {
        "campaign_file": campaign.path_from_output(campaign.path),
        "campaign_sha256": file_sha256(campaign.path),
        "camera_sha256": None if campaign.camera_file is None else file_sha256(campaign.camera_file),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": package_versions(),
    }


def _geometry_sha256(path: Path | None) -> str | dict[str, str] | None:
    """Hash of a geometry table, or of each SUMFILE of a folder."""
    if path is None or path.is_file():
        return None if path is None else file_sha256(path)
    return {file.name: file_sha256(file) for file in sorted(path.iterdir()) if file.is_file()}


def file_sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    try:
        return reading.file_sha256(path)
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror or error}") from error


def _plain(options: Any) -> dict[str, Any]:
    """Option dataclasses as JSON has them; values that JSON lacks become text, files their names."""
    values = {
        key: value.name if isinstance(value, Path) else value for key, value in dataclasses.asdict(options).items()
    }
    return {key: value if isinstance(value, bool | int | str | None) else repr(value) for key, value in values.items()}


def package_versions() -> dict[str, str]:
    """Versions of the packages that this one needs."""
    found = {}
    for requirement in requires("giantlike") or []:
        if "extra ==" in requirement:
            continue
        match = re.match(r"[A-Za-z0-9._-]+", requirement)
        name = requirement if match is None else match.group()
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


class Identities:
    """Hashes of the contents of image files, where known, now and when they were read."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._known = folder.images()
        self._stamps: dict[str, str] = {}
        self._now: dict[str, str] = {}

    def find_hash(self, entry: ImageEntry) -> str:
        """Hash of the content, also of files copied or written again; empty if the file was never read."""
        if entry.key not in self._now:
            known = self._known.get(entry.key, KnownImage("", ""))
            stamp = self._stamps[entry.key] = stamp_of(entry.path)
            sha256 = known.sha256
            if sha256 and stamp != known.stamp:
                try:
                    sha256 = reading.file_sha256(entry.path)
                except OSError:
                    sha256 = ""
                if sha256 == known.sha256:
                    self._folder.set_image_state(entry.key, KnownImage(stamp, sha256))
            self._now[entry.key] = sha256
        return self._now[entry.key]

    def read(self, entry: ImageEntry, sha256: str) -> None:
        """Keep the hash of the file that a worker read."""
        self._now[entry.key] = sha256
        self._folder.set_image_state(entry.key, KnownImage(self._stamps.get(entry.key, ""), sha256))
