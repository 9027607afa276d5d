"""Hashes of the inputs of each step of a run: a result is kept as long as its hash is unchanged."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.time import Time
from pydantic import BaseModel
from scipy.spatial.transform import Rotation

from giantlike._system.reading import file_sha256
from giantlike.campaign.file.config import ImageEntry
from giantlike.campaign.file.limb_inputs import LimbSetup
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.records import Attitude
from giantlike.core.version import VERSION

_DIGITS = 20  # hexadecimal digits of a hash, 80 bits: two of a million results coincide with a chance of 1e-12


class Steps:
    """Hashes of the steps; a change of the program's version, a kernel or the reading of image files reaches all."""

    def __init__(self, bench: Workbench) -> None:
        campaign, navigation = bench.campaign, bench.navigation
        self._geometry = campaign.geometry
        self._overlays = digest(campaign.max_overlays > 0)
        kernels = None if bench.kernels is None else sorted(bench.kernels.sha256().values())
        setup = campaign.calibration
        keyword = None if setup is None else setup.temperature_keyword
        spice = None if campaign.spice is None else dataclasses.replace(campaign.spice, kernels=())
        frames = None if campaign.frames is None else campaign.frames.identity()
        reading = digest(VERSION, campaign.hdu, campaign.bottom_up, campaign.label_geometry, kernels, spice, frames)
        self._camera = digest(reading, dataclasses.replace(campaign.camera, photometry=None).to_mapping(), keyword)
        self._apriori = digest(self._camera, campaign.apriori_sigma_rad)
        stars = campaign.stars
        self._stars = ""
        if stars is not None and navigation is not None:
            self._stars = digest(self._camera, stars.options, stars.detection, navigation.catalog.version)
        self._targets = {
            target.name: digest(
                self._camera,
                bench.shapes[target.name].sha256,
                *(target.units, target.reflectance, target.uncertainty, target.spice_body, target.frame, target.name),
                *(() if target.limb == LimbSetup() else (target.limb,)),
                *(() if target.orbit is None else (target.orbit,)),
            )
            for target in campaign.targets
        }
        self._options = {
            (target.name, estimator.name): digest(estimator.options)
            for target in campaign.targets
            for estimator in target.estimators
        }

    def first_stars(self, entry: ImageEntry, sha256: str, limits: object, decided: Sequence[object]) -> str:
        """Hash of the first identification of the stars of an image, for calibration."""
        return digest(self._stars, sha256, self._pose(entry), limits, decided)

    def attitude(self, entry: ImageEntry, sha256: str, decided: Sequence[object], *, star_image: bool) -> str:
        """Hash of the attitude of an image, before attitudes of its neighbors are propagated to it."""
        if star_image and self._stars:
            return digest(self._stars, sha256, self._pose(entry), decided)
        return digest(self._apriori, sha256, self._pose(entry))

    def observation(
        self,
        entry: ImageEntry,
        sha256: str,
        target: str,
        estimator: str,
        attitude: Attitude | None,
        decided: Sequence[object] = (),
    ) -> str:
        """Hash of the result of an estimator, or of a target's a priori record, with what users ``decided`` on it."""
        known = self._geometry.get(entry.key)
        row = None if known is None else known.targets.get(target)
        row = None if row is None else dataclasses.replace(row, file="", line=0, epoch=None)
        options = self._options[target, estimator] if estimator else self._overlays
        return digest(self._targets[target], sha256, self._pose(entry), row, estimator, options, attitude, *decided)

    def _pose(self, entry: ImageEntry) -> str:
        """Hash of the row of the geometry table for an image, for all targets."""
        known = self._geometry.get(entry.key)
        return "" if known is None else digest(dataclasses.replace(known, targets={}))


def digest(*values: Any) -> str:
    """Short hash of values: numbers to the bit, files by their content."""
    text = json.dumps([_plain(value) for value in values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def _plain(value: Any) -> Any:
    """Value as JSON has it, different for different values."""
    if isinstance(value, enum.Enum):
        return [type(value).__name__, value.name]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, BaseModel):
        return {name: _plain(getattr(value, name)) for name in type(value).model_fields}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return [type(value).__name__, {name: _plain(getattr(value, name)) for name in names}]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Rotation):
        return value.as_quat().tolist()
    if isinstance(value, Time):
        return [value.scale, float(value.jd1), float(value.jd2)]
    if isinstance(value, Path):
        return file_sha256(value) if value.is_file() else [(one.name, file_sha256(one)) for one in _files(value)]
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, set | frozenset):
        return sorted((_plain(inner) for inner in value), key=json.dumps)
    return repr(value)


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())
