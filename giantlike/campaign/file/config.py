"""A campaign file, checked and resolved: what a run is made of."""

from __future__ import annotations

import glob
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from giantlike.calibration import CalibrationCriteria, CalibrationOptions
from giantlike.calibration.star_images import start_model
from giantlike.camera import Camera
from giantlike.campaign.file.options import options_from_mapping, with_files_found
from giantlike.campaign.file.schema import (
    CalibrationSection,
    CampaignFile,
    SpiceSection,
    StarsSection,
    TargetSection,
)
from giantlike.campaign.file.toml_file import read_toml
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotation_from_xyzw
from giantlike.io.geometry_table import GeometryTable, ImageGeometry, read_geometry
from giantlike.io.spice import find_kernels
from giantlike.processing.detection.detect import DetectionOptions
from giantlike.ray_tracing import McEwen, Reflectance, reflectance_from_mapping
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.shapes import Ellipsoid, Shape, load_shape
from giantlike.shapes.files.formats import read_file
from giantlike.shapes.load import guessed_units
from giantlike.stars.options import StarOptions
from giantlike.stars.rates import read_rates
from giantlike.stars.transfer import TransferMethod, TransferOptions


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """An image file of a campaign.

    Parameters
    ----------
    index : int
        Position in input order, from 0.
    key : str
        How tables call it: its base name or, where two share one, its path relative to the campaign file.
    path : Path
    """

    index: int
    key: str
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class SpiceSetup:
    """Kernels in loading order, the spacecraft, its camera frame (None: no attitude from SPICE) and how it lies."""

    kernels: tuple[Path, ...]
    spacecraft: str
    frame: str | None
    camera_from_frame: Rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class StarsSetup:
    """Star processing: catalog name or path, options, and how star images serve the others (with which rates)."""

    catalog: str
    options: StarOptions
    detection: DetectionOptions
    long_exposure_s: float | None
    transfer: TransferOptions
    rates: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSetup:
    """Camera calibration: parameters to estimate, type of the model, and what it must reach."""

    estimate: tuple[str, ...]
    model_type: str | None
    min_snr: float
    scale_error: float
    temperature_keyword: str | None
    options: CalibrationOptions
    criteria: CalibrationCriteria


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetSetup:
    """A body as the campaign file gives it; the shape is loaded where it is needed."""

    name: str
    shape_file: Path | None
    units: str
    radii_km: tuple[float, float, float] | None
    reflectance: Reflectance
    estimators: tuple[Estimator, ...]
    spice_body: str
    frame: str

    def load_shape(self) -> Shape:
        """Read the mesh, or build the ellipsoid.

        Raises
        ------
        DataError
            The mesh file is damaged.
        """
        if self.shape_file is not None:
            return load_shape(self.shape_file, units=self.units)
        return Ellipsoid(radii_km=self.radii_km, name=self.name)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """A campaign whose file has been checked: every path exists, every name and option is known.

    Parameters
    ----------
    path : Path
        The campaign file.
    table : mapping
        Its content, for provenance.
    name : str
    output : Path
        The run folder.
    images : tuple of ImageEntry
        In input order: patterns as given, files of a pattern by name.
    hdu : int or str or None
    bottom_up : bool
    geometry_file : Path or None
    geometry : mapping of str to ImageGeometry
        What the geometry table says, by image key.
    camera : Camera
    camera_file : Path or None
    spice : SpiceSetup or None
    stars : StarsSetup or None
    calibration : CalibrationSetup or None
    targets : tuple of TargetSetup
    max_overlays : int
    warnings : tuple of str
        What is odd but no mistake.
    """

    path: Path
    table: Mapping[str, Any]
    name: str
    output: Path
    images: tuple[ImageEntry, ...]
    hdu: int | str | None
    bottom_up: bool
    geometry_file: Path | None
    geometry: Mapping[str, ImageGeometry]
    camera: Camera
    camera_file: Path | None
    spice: SpiceSetup | None
    stars: StarsSetup | None
    calibration: CalibrationSetup | None
    targets: tuple[TargetSetup, ...]
    max_overlays: int
    warnings: tuple[str, ...] = field(default=())

    @classmethod
    def load(cls, path: str | Path) -> Campaign:
        """Read and check a campaign file and what it names.

        Raises
        ------
        DataError
            Anything is wrong with it; one line that names file, key and what was expected.
        """
        path = Path(path)
        content, table = read_toml(path, CampaignFile, "campaign file")
        try:
            return _resolve(path, content, table)
        except DataError:
            raise
        except InputError as error:
            raise DataError(path, str(error)) from error

    def path_from_output(self, path: Path) -> str:
        """Path of a file relative to the run folder, so that both can be moved together."""
        return Path(os.path.relpath(path, self.output)).as_posix()

    def is_star_image(self, exposure_s: float | None) -> bool:
        """Whether an image of this exposure gets its attitude from its own stars."""
        if self.stars is None:
            return False
        limit = self.stars.long_exposure_s
        return limit is None or (exposure_s is not None and exposure_s >= limit)

    def is_body_image(self, exposure_s: float | None) -> bool:
        """Whether estimators run on an image of this exposure: bodies are usually saturated in star images."""
        if self.stars is None or self.stars.long_exposure_s is None:
            return True
        return not self.is_star_image(exposure_s)


def _resolve(path: Path, content: CampaignFile, table: Mapping[str, Any]) -> Campaign:
    folder = path.parent
    images = _images(path, content.images.files)
    camera, camera_file = camera_of(path, content.camera)
    geometry_file = None
    geometry: dict[str, ImageGeometry] = {}
    unmatched: list[str] = []
    if content.images.geometry is not None:
        geometry_file = existing_file(path, "images.geometry", content.images.geometry)
        only = content.targets[0].name if len(content.targets) == 1 else None
        geometry_table = read_geometry(geometry_file, default_target=only)
        by_path = geometry_table.match([image.path for image in images], folder)
        geometry = {image.key: by_path[image.path] for image in images if image.path in by_path}
        unmatched = _unmatched(geometry_table, images, geometry, folder, with_spice=content.spice is not None)
    spice = None if content.spice is None else spice_of(path, content.spice)
    targets = tuple(_target(path, f"targets[{k}]", section) for k, section in enumerate(content.targets))
    repeated = [name for name, count in Counter(target.name for target in targets).items() if count > 1]
    if repeated:
        raise InputError(f"targets: two targets have the name {repeated[0]!r}")
    targets, guessed = with_units_decided(targets)
    stars = content.stars
    if stars is None and content.calibration is not None:
        stars = StarsSection(lost_in_space=True)
    hdu = content.images.hdu
    if hdu is not None and (isinstance(hdu, bool) or not isinstance(hdu, int | str)):
        raise InputError(f"images.hdu: expected a number or a name, got {hdu!r}")
    return Campaign(
        path=path,
        table=table,
        name=content.campaign.name,
        output=folder / content.campaign.output,
        images=images,
        hdu=hdu,
        bottom_up=content.images.bottom_up,
        geometry_file=geometry_file,
        geometry=geometry,
        camera=camera,
        camera_file=camera_file,
        spice=spice,
        stars=None if stars is None else _stars(path, stars),
        calibration=None if content.calibration is None else _calibration(content.calibration, camera),
        targets=targets,
        max_overlays=content.report.max_overlays,
        warnings=(*guessed, *unmatched, *_oddities(geometry_file, geometry, targets, spice)),
    )


def existing_file(path: Path, key: str, name: str) -> Path:
    """Path of a file that a key of the file ``path`` names; refused (``InputError``) where there is none."""
    file = path.parent / name
    if not file.is_file():
        raise InputError(f"{key}: there is no file {name!r} ({file})")
    return file


def _matches(path: Path, key: str, patterns: Sequence[str]) -> list[Path]:
    """Files of all patterns, each once, in order; a pattern without a file is refused."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        literal = path.parent / pattern
        names = [pattern] if literal.is_file() else sorted(glob.glob(pattern, root_dir=path.parent, recursive=True))
        files = [path.parent / name for name in names if (path.parent / name).is_file()]
        if not files:
            raise InputError(f"{key}: no file matches {pattern!r} (looked in {path.parent.resolve()})")
        found.update(dict.fromkeys(files))
    return list(found)


def _images(path: Path, patterns: Sequence[str]) -> tuple[ImageEntry, ...]:
    files = _matches(path, "images.files", patterns)
    shared = Counter(file.name for file in files)
    keys = [file.name if shared[file.name] == 1 else _relative(file, path.parent) for file in files]
    return tuple(ImageEntry(index, key, file) for index, (key, file) in enumerate(zip(keys, files, strict=True)))


def _relative(file: Path, folder: Path) -> str:
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else file.as_posix()


def camera_of(path: Path, table: Mapping[str, Any]) -> tuple[Camera, Path | None]:
    """Camera of a ``[camera]`` table, and its file where it has one; ``InputError`` names the wrong key."""
    if "file" not in table:
        try:
            return Camera.from_mapping(table), None
        except InputError as error:
            raise InputError(f"[camera]: {error}") from error
    others = sorted(set(table) - {"file"})
    if others:
        raise InputError(f"[camera]: give either file or the keys of a camera, not both; found {others[0]!r}")
    if not isinstance(table["file"], str):
        raise InputError(f"camera.file: expected the name of a camera file, got {table['file']!r}")
    file = existing_file(path, "camera.file", table["file"])
    return Camera.load(file), file


def spice_of(path: Path, section: SpiceSection) -> SpiceSetup:
    """Kernels, spacecraft and camera frame of a ``[spice]`` section; ``InputError`` where a kernel is missing."""
    try:
        kernels = find_kernels(section.kernels, path.parent)
    except DataError as error:
        raise InputError(f"spice.kernels: {error}") from error
    turn = rotation_from_xyzw(section.camera_from_frame_xyzw, "spice.camera_from_frame_xyzw")
    return SpiceSetup(kernels=kernels, spacecraft=section.spacecraft, frame=section.frame, camera_from_frame=turn)


def _stars(path: Path, section: StarsSection) -> StarsSetup:
    catalog = section.catalog
    if catalog != "default":
        catalog = str(existing_file(path, "stars.catalog", catalog))
    keyed = {"max_magnitude": section.max_magnitude, "lost_in_space": section.lost_in_space}
    for name in section.options:
        if name in keyed:
            raise InputError(f"stars.options: {name} has a key of its own, stars.{name}")
    options = options_from_mapping(StarOptions, keyed | section.options, "stars.options")
    detection = options_from_mapping(DetectionOptions, section.detection, "stars.detection")
    gap = {} if section.max_gap_s is None else {"max_gap_s": section.max_gap_s}
    try:
        transfer = TransferOptions(
            method=section.transfer,
            drift_arcsec_per_sqrt_s=section.drift_arcsec_per_sqrt_s,
            max_disagreement_deg=section.max_disagreement_deg,
            **gap,
        )
    except InputError as error:
        raise InputError(f"[stars]: {error}") from error
    return StarsSetup(
        catalog=catalog,
        options=options,
        detection=detection,
        long_exposure_s=section.long_exposure_s,
        transfer=transfer,
        rates=_rates(path, section),
    )


def _rates(path: Path, section: StarsSection) -> Path | None:
    """Table of angular rates; refused where the transfer does not ask for one."""
    if section.rates is None:
        return None
    if section.transfer is not TransferMethod.PROPAGATE:
        raise InputError(f"stars.rates: goes with transfer = 'propagate', not {str(section.transfer)!r}")
    file = existing_file(path, "stars.rates", section.rates)
    try:
        read_rates(file)
    except DataError as error:
        raise InputError(f"stars.rates: {error}") from error
    return file


def _calibration(section: CalibrationSection, camera: Camera) -> CalibrationSetup:
    start = start_model(camera.model, section.estimate, section.model, 1.0)
    options = options_from_mapping(CalibrationOptions, section.options, "calibration.options")
    for name in options.prior_sigma:
        require(name in start.parameter_names, f"calibration.options.prior_sigma: the model has no {name!r}")
    return CalibrationSetup(
        estimate=tuple(section.estimate),
        model_type=section.model,
        min_snr=section.min_snr,
        scale_error=section.scale_error,
        temperature_keyword=section.temperature_keyword,
        options=options,
        criteria=options_from_mapping(CalibrationCriteria, section.criteria, "calibration.criteria"),
    )


def _target(path: Path, where: str, section: TargetSection) -> TargetSetup:
    shape_file, radii = shape_of(path, f"{where}.shape", section.shape)
    try:
        reflectance = McEwen() if section.reflectance is None else reflectance_from_mapping(section.reflectance)
    except InputError as error:
        raise InputError(f"{where}.{error}") from error
    for key, names in (("estimators", section.estimators), ("options", section.options)):
        for name in names:
            if name not in ESTIMATORS:
                there = ", ".join(sorted(ESTIMATORS))
                raise InputError(f"{where}.{key}: unknown estimator {name!r}; there are {there}")
    # Options of estimators that do not run are checked as well: they are there to be switched on.
    checked = {
        name: _estimator(path, name, section.options.get(name, {}), f"{where}.options.{name}")
        for name in (*section.estimators, *section.options)
    }
    if len(set(section.estimators)) < len(section.estimators):
        raise InputError(f"{where}.estimators: an estimator is named twice")
    return TargetSetup(
        name=section.name,
        shape_file=shape_file,
        units=section.units,
        radii_km=radii,
        reflectance=reflectance,
        estimators=tuple(checked[name] for name in section.estimators),
        spice_body=section.spice_body or section.name,
        frame=section.frame or section.spice_body or section.name,
    )


def _estimator(path: Path, name: str, table: Mapping[str, Any], where: str) -> Estimator:
    kind: Any = ESTIMATORS[name]  # each class takes options of a type of its own
    options = options_from_mapping(type(kind().options), table, where)
    estimator: Estimator = kind(with_files_found(options, path.parent, where))
    return estimator


def shape_of(path: Path, key: str, value: Any) -> tuple[Path | None, tuple[float, float, float] | None]:
    """Mesh file, or the radii of an ellipsoid, km, of a ``shape`` key; ``InputError`` for anything else."""
    if isinstance(value, str):
        return existing_file(path, key, value), None
    expected = f"{key}: expected a mesh file or {{ radii_km = [a, b, c] }}, got {value!r}"
    if not isinstance(value, Mapping) or set(value) != {"radii_km"}:
        raise InputError(expected)
    radii = value["radii_km"]
    if not isinstance(radii, list) or len(radii) != 3:
        raise InputError(expected)
    if any(isinstance(r, bool) or not isinstance(r, int | float) or not math.isfinite(r) or not r > 0 for r in radii):
        raise InputError(f"{key}: radii_km must be three positive and finite numbers, got {radii!r}")
    return None, (float(radii[0]), float(radii[1]), float(radii[2]))


def with_units_decided(targets: Sequence[TargetSetup]) -> tuple[tuple[TargetSetup, ...], list[str]]:
    """Targets with km or m for ``auto``, the same for all processes, and a warning for each that was guessed.

    Raises
    ------
    DataError
        A mesh file whose unit is to be guessed is damaged, or fits both.
    """
    decided, remarks = list[TargetSetup](), list[str]()
    for target in targets:
        units = target.units
        if target.shape_file is not None and units == "auto":
            surface = read_file(target.shape_file)
            units = "km"
            if not surface.in_km:
                units, remark = guessed_units(target.shape_file, surface)
                remarks.append(remark)
        decided.append(replace(target, units=units))
    return tuple(decided), remarks


def _unmatched(
    table: GeometryTable,
    images: Sequence[ImageEntry],
    geometry: Mapping[str, ImageGeometry],
    folder: Path,
    *,
    with_spice: bool,
) -> list[str]:
    """Rows of a geometry table without image, and images without row (SPICE may know all of those)."""
    if not geometry:
        return [f"{table.path}: no row names an image of the campaign"]
    known = {name for image in images if image.key in geometry for name in (image.path.name, _absolute(image.path))}
    files = dict.fromkeys(row.file for row in table.rows)
    unused = [file for file in files if file not in known and _absolute(folder / file) not in known]
    texts = []
    if unused:
        texts.append(f"{table.path}: no image of the campaign has the name {_some(unused)}; these rows are not used")
    without = [image.key for image in images if image.key not in geometry]
    if without and not with_spice:
        texts.append(f"{table.path}: no row for {_some(without)}, and no [spice]: no geometry is known of these images")
    return texts


def _some(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _absolute(path: Path) -> str:
    return os.path.abspath(path)


def _oddities(
    geometry_file: Path | None,
    geometry: Mapping[str, ImageGeometry],
    targets: Sequence[TargetSetup],
    spice: SpiceSetup | None,
) -> list[str]:
    """What is allowed but probably not meant."""
    named = {name for image in geometry.values() for name in image.targets}
    texts = [
        f"{geometry_file}: target {name!r} is not in the campaign, its rows are not used"
        for name in sorted(named - {target.name for target in targets})
    ]
    if spice is None:
        source = f"no row in {geometry_file}" if geometry_file else "no images.geometry"
        texts += [
            f"target {target.name!r}: {source} and no [spice], so nothing says where it is: it is in no image"
            for target in targets
            if target.name not in named
        ]
    return texts
