"""A campaign file, checked and resolved."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from giantlike._system.reading import resolving
from giantlike.calibration.star_images import start_model
from giantlike.camera import Camera
from giantlike.campaign.file.frame_files import FrameFiles, frames_of
from giantlike.campaign.file.inputs import (
    SpiceSetup,
    TargetSetup,
    camera_of,
    catalog_of,
    existing_file,
    geometry_of,
    matching_files,
    preset_of,
    spice_of,
    targets_of,
)
from giantlike.campaign.file.mission_defaults import with_mission
from giantlike.campaign.file.schema import CalibrationSection, CampaignFile, NetworkSection, StarsSection
from giantlike.campaign.file.toml_file import prefix_errors, read_toml
from giantlike.campaign.file.viewing import viewing_of
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.core.units import RAD_PER_DEG
from giantlike.io.geometry_table import GeometryTable, ImageGeometry
from giantlike.photometry import FluxOptions
from giantlike.processing.detection.options import DetectionOptions
from giantlike.stars.options import StarOptions
from giantlike.stars.rates import read_rates
from giantlike.stars.transfer import TransferMethod, TransferOptions


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """An image file of a campaign."""

    index: int  # position in input order, from 0
    key: str  # name in the tables: its base name or, where two files share one, its path relative to the campaign file
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class StarsSetup:
    """Star processing of a campaign."""

    catalog: str  # ``default`` or the path of a catalog
    options: StarOptions
    detection: DetectionOptions
    long_exposure_s: float | None  # at or above, an image is a star image; None: all are
    transfer: TransferOptions  # of attitudes from star images to the others
    rates: Path | None  # table of angular rates for the transfer


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSetup:
    """The step ``network``: the target with the shape of the landmarks, and the section."""

    target: TargetSetup
    section: NetworkSection


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """A campaign whose file has been checked: every path exists, every name and option is known.

    Parameters
    ----------
    path : Path; the campaign file
    table : mapping; its content, for provenance
    name : str
    output : Path; the run folder
    images : tuple of ImageEntry; in input order: patterns as given, files of a pattern by name
    hdu : int or str or None; FITS extension to read
    bottom_up : bool; True if the rows of image files are reversed on reading
    label_geometry : bool; True if the geometry in labels is used
    geometry_file : Path or None
    geometry : mapping of str to ImageGeometry; rows of the geometry table and tables ``[geometry]``, by image key
    camera : Camera
    camera_file : Path or None
    spice : SpiceSetup or None
    stars : StarsSetup or None
    calibration : CalibrationSection or None
    targets : tuple of TargetSetup
    network : NetworkSetup or None
    max_overlays : int; number of images shown in the report
    warnings : tuple of str; oddities that are not errors
    apriori_sigma_rad : float or None, rad; standard deviation of a priori attitudes about each camera axis
    frames : FrameFiles or None; calibration frames that are applied to every image
    empty_images : frozenset of str; keys of the images that are expected to hold nothing
    fluxes : FluxOptions; how ``giantlike photometry`` measures
    """

    path: Path
    table: Mapping[str, Any]
    name: str
    output: Path
    images: tuple[ImageEntry, ...]
    hdu: int | str | None
    bottom_up: bool
    label_geometry: bool
    geometry_file: Path | None
    geometry: Mapping[str, ImageGeometry]
    camera: Camera
    camera_file: Path | None
    spice: SpiceSetup | None
    stars: StarsSetup | None
    calibration: CalibrationSection | None
    targets: tuple[TargetSetup, ...]
    max_overlays: int
    network: NetworkSetup | None = None
    warnings: tuple[str, ...] = field(default=())
    apriori_sigma_rad: float | None = None
    frames: FrameFiles | None = None
    empty_images: frozenset[str] = frozenset()
    fluxes: FluxOptions = field(default_factory=FluxOptions)

    @classmethod
    def load(cls, path: str | Path) -> Campaign:
        """Read and check a campaign file and the files it names; DataError says file, key and what was expected."""
        path = Path(path)
        content, table = read_toml(path, CampaignFile, "campaign file", complete=with_mission)
        with resolving(path, "a campaign file"):
            return _resolve(path, content, table)

    def with_network(self, section: NetworkSection) -> Campaign:
        """Return the campaign with the step ``network``.

        Raises InputError where the target is unknown, its shape is not a mesh, or fewer than two images may show it.
        """
        anywhere = self.spice is not None or self.label_geometry
        seen = Counter(name for known in self.geometry.values() for name in {*known.targets, *known.seen})
        names = ", ".join(target.name for target in self.targets)
        require(bool(self.targets), "network: the campaign has no target")
        require(section.target is not None or len(self.targets) == 1, f"network.target: name one of {names}")
        found = [target for target in self.targets if section.target in (None, target.name)]
        require(bool(found), f"network.target: unknown target {section.target!r}; the campaign has {names}")
        target, count = found[0], len(self.images) if anywhere else seen[found[0].name]
        require(count >= 2, f"network: needs at least two images of {target.name}, the campaign has {count}")
        if section.shape is not None:
            target = replace(target, shape=existing_file(self.path, "network.shape", section.shape))
        require(isinstance(target.shape, Path), f"network.shape: landmarks need a mesh, {target.name} is an ellipsoid")
        return replace(self, network=NetworkSetup(target=target, section=section))

    def apriori_covariance_rad2(self, key: str) -> Float | None:
        """Covariance (3, 3), rad^2, camera axes, of an a priori attitude, as declared or in its SUMFILE; else None."""
        known = self.geometry.get(key)
        if self.apriori_sigma_rad is not None:
            return self.apriori_sigma_rad**2 * np.eye(3)
        return None if known is None else known.covariance_attitude_rad2

    def path_from_output(self, path: Path) -> str:
        """Path of a file relative to the run folder, so that both can be moved together."""
        return Path(os.path.relpath(path, self.output)).as_posix()

    def is_star_image(self, exposure_s: float | None) -> bool:
        """Return True if an image of this exposure gets its attitude from its own stars."""
        if self.stars is None:
            return False
        limit = self.stars.long_exposure_s
        return limit is None or (exposure_s is not None and exposure_s >= limit)

    def is_body_image(self, exposure_s: float | None) -> bool:
        """Return True if estimators run on an image of this exposure: bodies are usually saturated in star images."""
        if self.stars is None or self.stars.long_exposure_s is None:
            return True
        return not self.is_star_image(exposure_s)


def _resolve(path: Path, content: CampaignFile, table: Mapping[str, Any]) -> Campaign:
    folder = path.parent
    images = images_of(path, content.images.files)
    camera, camera_file = camera_of(path, content.camera)
    spice = spice_of(path, content.spice)
    targets, guessed = targets_of(path, content.targets, spice)
    views = viewing_of(content.geometry, images, targets, camera)
    preset = preset_of(content.camera)
    bottom_up = content.images.bottom_up or (preset is not None and preset.bottom_up)
    geometry_file = None
    geometry: dict[str, ImageGeometry] = {}
    unmatched: list[str] = []
    if content.images.geometry is not None:
        paths, size = [image.path for image in images], (camera.columns, camera.rows)
        geometry_table = geometry_of(path, "images.geometry", content.images.geometry, content.targets, paths, size)
        geometry_file = geometry_table.path
        by_path = geometry_table.match(paths, folder)
        geometry = {image.key: by_path[image.path] for image in images if image.path in by_path}
        unseen = [image for image in images if image.key not in views]
        unmatched = _find_unmatched(geometry_table, unseen, geometry, folder, with_spice=content.spice is not None)
        for key in sorted(set(views) & set(geometry)):
            raise InputError(f"geometry: {key!r} has a row in images.geometry too: leave one of them out")
    with prefix_errors("photometry: "):
        known, (circle, *ring) = content.photometry.value, content.photometry.apertures_px
        fluxes = FluxOptions(aperture_px=circle, annulus_px=(ring[0], ring[1]), method=content.photometry.method)
        camera = camera if known is None else replace(camera, photometry=known)
    stars, calibration, sigma_deg = content.stars, content.calibration, content.images.attitude_sigma_deg
    if calibration is not None:
        stars = stars or StarsSection(lost_in_space=True)
        start = start_model(camera.model, calibration.estimate, calibration.model, 1.0)
        for name in calibration.options.prior_sigma:
            require(name in start.parameter_names, f"calibration.options.prior_sigma: the model has no {name!r}")
    campaign = Campaign(
        path=path,
        table=table,
        name=content.campaign.name,
        output=folder / content.campaign.output,
        images=images,
        hdu=content.images.hdu,
        bottom_up=bottom_up,
        label_geometry=content.images.label_geometry,
        geometry_file=geometry_file,
        geometry=geometry | views,
        camera=camera,
        camera_file=camera_file,
        spice=spice,
        stars=None if stars is None else stars_of(path, stars),
        calibration=calibration,
        targets=targets,
        max_overlays=content.report.max_overlays,
        warnings=(*guessed, *unmatched, *_oddities(geometry_file, geometry | views, targets, spice)),
        apriori_sigma_rad=None if sigma_deg is None else sigma_deg * RAD_PER_DEG,
        frames=frames_of(path, content.calibration_frames, bottom_up=bottom_up),
        empty_images=_empty_images(images, content.images.expect),
        fluxes=fluxes,
    )
    return campaign if content.network is None else campaign.with_network(content.network)


def _empty_images(images: Sequence[ImageEntry], expect: str | Mapping[str, str] | None) -> frozenset[str]:
    """Keys of the images that are expected to hold nothing."""
    patterns = () if expect is None else ("*",) if isinstance(expect, str) else tuple(expect)
    found = {pattern: [image.key for image in images if fnmatch(image.key, pattern)] for pattern in patterns}
    for pattern, keys in found.items():
        require(bool(keys), f"images.expect: no image has the name {pattern!r}")
    return frozenset(key for keys in found.values() for key in keys)


def images_of(path: Path, patterns: Sequence[str]) -> tuple[ImageEntry, ...]:
    """Image files of a campaign, each once, in order."""
    folder = path.parent
    found = matching_files(path, "images.files", patterns)
    shared = Counter(file.name for file in found)
    keys = [file.name if shared[file.name] == 1 else _relative(file, folder) for file in found]
    return tuple(ImageEntry(index, key, file) for index, (key, file) in enumerate(zip(keys, found, strict=True)))


def _relative(file: Path, folder: Path) -> str:
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else file.as_posix()


def stars_of(path: Path, section: StarsSection) -> StarsSetup:
    """Star processing of a ``[stars]`` section."""
    with prefix_errors("[stars]: "):
        options = replace(section.options, max_magnitude=section.max_magnitude, lost_in_space=section.lost_in_space)
        transfer = TransferOptions(
            method=section.transfer,
            max_gap_s=section.max_gap_s,
            drift_arcsec_per_sqrt_s=section.drift_arcsec_per_sqrt_s,
            max_disagreement_deg=section.max_disagreement_deg,
        )
    return StarsSetup(
        catalog=catalog_of(path, section.catalog),
        options=options,
        detection=section.detection,
        long_exposure_s=section.long_exposure_s,
        transfer=transfer,
        rates=_rates(path, section),
    )


def _rates(path: Path, section: StarsSection) -> Path | None:
    """Table of angular rates; refused where the transfer method does not use one."""
    if section.rates is None:
        return None
    propagates = section.transfer is TransferMethod.PROPAGATE
    require(propagates, f"stars.rates: goes with transfer = 'propagate', not {str(section.transfer)!r}")
    file = existing_file(path, "stars.rates", section.rates)
    with prefix_errors("stars.rates: "):
        read_rates(file)
    return file


def _find_unmatched(
    table: GeometryTable,
    images: Sequence[ImageEntry],
    geometry: Mapping[str, ImageGeometry],
    folder: Path,
    *,
    with_spice: bool,
) -> list[str]:
    """Warnings of rows of a geometry table without image, and of images without row (SPICE may cover those)."""
    if not geometry:
        return [f"{table.path}: no row names an image of the campaign"]
    paths = [image.path for image in images if image.key in geometry]
    known = {path.name for path in paths} | {os.path.abspath(path) for path in paths}
    files = dict.fromkeys(row.file for row in table.rows)
    unused = [file for file in files if file not in known and os.path.abspath(folder / file) not in known]
    texts = []
    if unused:
        texts.append(f"{table.path}: no image of the campaign has the name {_some(unused)}; these rows are not used")
    without = [image.key for image in images if image.key not in geometry]
    if without and not with_spice:
        texts.append(
            f"{table.path}: no row for {_some(without)}, and no [spice]: the geometry of these images is unknown"
        )
    return texts


def _some(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _oddities(
    geometry_file: Path | None,
    geometry: Mapping[str, ImageGeometry],
    targets: Sequence[TargetSetup],
    spice: SpiceSetup | None,
) -> list[str]:
    """Warnings of settings that are allowed but probably not intended."""
    named = {name for image in geometry.values() for name in (*image.targets, *image.seen)}
    texts = [
        f"{geometry_file}: target {name!r} is not in the campaign, its rows are not used"
        for name in sorted(named - {target.name for target in targets})
    ]
    if spice is None:
        source = f"no row in {geometry_file}" if geometry_file else "no images.geometry"
        texts += [
            f"target {target.name!r}: {source} and no [spice], so its position is unknown: it is looked for in no image"
            for target in targets
            if target.name not in named
        ]
    return texts
