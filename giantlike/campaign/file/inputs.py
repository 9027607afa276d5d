"""Cameras, kernels and bodies that a campaign file or a scene file names: found, checked and resolved."""

from __future__ import annotations

import glob
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.file.limb_inputs import LimbSetup
from giantlike.campaign.file.options import options_from_mapping, with_files_found
from giantlike.campaign.file.schema import BodySection, Radii, SpiceSection, TargetSection
from giantlike.campaign.file.toml_file import nearest, prefix_errors
from giantlike.core.arrays import Float, require
from giantlike.core.detector import Detector
from giantlike.core.errors import DataError
from giantlike.core.frames import INERTIAL_FRAME, FrameRotation, rotate, rotation_from_xyzw
from giantlike.core.units import RAD_PER_DEG, SPEED_OF_LIGHT_KM_S
from giantlike.ephemeris import BARYCENTER
from giantlike.image import ObserverState
from giantlike.io.epic_metadata import read_epic
from giantlike.io.geometry_table import GeometryTable, read_geometry
from giantlike.io.orbit_covariance import OrbitCovariance, read_orbit_covariance
from giantlike.io.spc_geometry import read_sumfiles
from giantlike.io.spice import ellipsoid_from_pck, find_kernels, orientation, spk_state
from giantlike.io.spice_pointing import LabelClock, nearest_attitude
from giantlike.presets import CameraPreset, camera_preset
from giantlike.ray_tracing import McEwen, Reflectance, reflectance_from_mapping
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.scene import TargetUncertainty
from giantlike.shapes import Ellipsoid, Shape, load_shape
from giantlike.shapes.files.formats import read_file
from giantlike.shapes.load import guessed_units

CAMERA_CHANGES = frozenset({"binned", "psf", "detector", "photometry"})
"""Keys of ``[camera]`` that refine a camera from a file, a preset or a mission; other keys declare another camera."""

_RATE_STEP_S = 0.5  # half the time over which a rate is taken from a CK: 1e-15 rad of rounding, rates of seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class SpiceSetup:
    """SPICE kernels, the spacecraft and its camera frame."""

    kernels: tuple[Path, ...]  # in loading order
    spacecraft: str  # NAIF name or code
    camera_from_frame: FrameRotation | None  # from the frame of the kernels to camera axes; None: no attitude
    ck_tolerance_s: float = 0.0  # largest distance in time to a single attitude of a CK
    clock: LabelClock | None = None  # clock count in labels that have no epoch

    def camera_from_inertial(self, et: float) -> FrameRotation | None:
        """Attitude of the camera by SPICE. Returns None without a camera frame."""
        turn = self.camera_from_frame
        if turn is None:
            return None
        pointing = nearest_attitude(turn.source, et, self.ck_tolerance_s)
        return turn * FrameRotation(rotation=pointing, target=turn.source, source=INERTIAL_FRAME)

    def camera_rate_rad_s(self, et: float) -> Float | None:
        """Rotation rate (3,) of the camera about its axes by a continuous CK. Returns None where it has none."""
        turn = self.camera_from_frame
        if turn is None or self.ck_tolerance_s > 0.0:
            return None
        try:
            before, after = (
                nearest_attitude(turn.source, et + step_s, 0.0) for step_s in (-_RATE_STEP_S, _RATE_STEP_S)
            )
        except DataError:
            return None
        return rotate(turn.rotation, -(after * before.inv()).as_rotvec() / (2.0 * _RATE_STEP_S))

    def observer(self, et: float) -> ObserverState:
        """State of the spacecraft relative to the barycenter of the Solar System."""
        position, velocity = spk_state(self.spacecraft, et, observer=BARYCENTER)
        return ObserverState(position_km=position, velocity_km_s=velocity)

    def sun_from(self, position_inertial_km: Float, et: float) -> Float:
        """Vector (3,), km, to the Sun from a position relative to the spacecraft, inertial axes, for shading."""
        return spk_state("SUN", et, observer=self.spacecraft)[0] - position_inertial_km


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetSetup:
    """A body with its names resolved; the shape is loaded later, by each process that needs it."""

    name: str
    shape: Path | Radii  # mesh file, or the radii of an ellipsoid, km
    units: str  # of the mesh file: km, m or auto
    reflectance: Reflectance
    estimators: tuple[Estimator, ...]  # empty in a scene file
    spice_body: str  # spice_body, frame: NAIF name and body-fixed frame
    frame: str
    uncertainty: TargetUncertainty = field(default_factory=TargetUncertainty)
    limb: LimbSetup = field(default_factory=LimbSetup)  # height map, atmosphere and rings
    orbit: OrbitCovariance | None = None  # covariance of the predicted position by epoch

    def inertial_from_body(self, position_inertial_km: Float, et: float) -> Rotation:
        """Orientation by SPICE at the emission time of the observed light."""
        return orientation(self.frame, et - float(np.linalg.norm(position_inertial_km)) / SPEED_OF_LIGHT_KM_S)

    def load_shape(self) -> Shape:
        """Read the mesh, or build the ellipsoid."""
        if isinstance(self.shape, Path):
            return load_shape(self.shape, units=self.units)
        return Ellipsoid(radii_km=np.array(self.shape), name=self.name)


def existing_file(path: Path, key: str, name: str) -> Path:
    """Path of a file that a key of a campaign or scene file names."""
    file = path.parent / name
    require(file.is_file(), f"{key}: there is no file {name!r} ({file})")
    return file


def matching_files(path: Path, key: str, patterns: Sequence[str]) -> tuple[Path, ...]:
    """Files that a key of a campaign file names, each once: patterns as given, files of a pattern by name."""
    folder = path.parent
    found: dict[Path, None] = {}
    for pattern in patterns:
        literal = (folder / pattern).is_file()
        names = [pattern] if literal else sorted(glob.glob(pattern, root_dir=folder, recursive=True))
        files = [folder / name for name in names if (folder / name).is_file()]
        require(bool(files), f"{key}: no file matches {pattern!r} (looked in {folder.resolve()})")
        found.update(dict.fromkeys(files))
    return tuple(found)


def catalog_of(path: Path, name: str) -> str:
    """Star catalog that a file names."""
    return name if name == "default" else str(existing_file(path, "stars.catalog", name))


def geometry_of(
    path: Path,
    key: str,
    name: str,
    targets: Sequence[BodySection],
    images: Sequence[Path] = (),
    size: tuple[int, int] | None = None,
) -> GeometryTable:
    """Read a geometry table, EPIC metadata or a folder of SUMFILEs; rows without a target belong to a single target."""
    if (path.parent / name).is_dir():
        return read_sumfiles(path.parent / name, images, [target.name for target in targets], size)
    file = existing_file(path, key, name)
    if file.suffix.lower() == ".json":
        names = {(target.spice_body or target.name).upper(): target.name for target in targets}
        return read_epic(file, images, {body: names[body] for body in ("EARTH", "MOON") if body in names})
    return read_geometry(file, default_target=targets[0].name if len(targets) == 1 else None)


def require_unique(names: Iterable[str], problem: str) -> None:
    """Raise :class:`InputError` with a problem and the name that occurs twice, if one does."""
    for name, count in Counter(names).items():
        require(count == 1, f"{problem} {name!r}")


def camera_of(path: Path, table: Mapping[str, Any]) -> tuple[Camera, Path | None]:
    """Camera of a ``[camera]`` table, and its file where it has one."""
    preset, file = preset_of(table), None
    if preset is not None:
        camera = preset.camera
    elif "file" not in table:
        with prefix_errors("[camera]: "):
            return Camera.from_mapping(table), None
    else:
        others = sorted(set(table) - {"file"} - CAMERA_CHANGES)
        require(not others, f"[camera]: give either file or the keys of a camera, not both; found {others[:1]}")
        name = table["file"]
        require(isinstance(name, str), f"camera.file: expected the name of a camera file, got {name!r}")
        file = existing_file(path, "camera.file", name)
        camera = Camera.load(file)
    camera = reduce_camera(camera, table.get("binned", 1))
    changes = {key: table[key] for key in ("psf", "detector", "photometry") if key in table}
    for key, change in changes.items():
        require(isinstance(change, Mapping), f"camera.{key}: expected a table, got {change!r}")
    if changes:
        known = camera.to_mapping()
        with prefix_errors("[camera]: "):
            merged = {key: {**known.get(key, {}), **changes[key]} for key in changes if key != "photometry"}
            changed = Camera.from_mapping(known | changes | merged)
        camera = replace(camera, psf=changed.psf, detector=changed.detector, photometry=changed.photometry)
    return camera, file


def preset_of(table: Mapping[str, Any]) -> CameraPreset | None:
    """Preset that a ``[camera]`` table names."""
    if "preset" not in table:
        return None
    alone = set(table) <= {"preset"} | CAMERA_CHANGES
    require(alone, "[camera]: give either preset, or file, or the keys of a camera")
    with prefix_errors("camera.preset: "):
        return camera_preset(str(table["preset"]))


def reduce_camera(camera: Camera, binned: object) -> Camera:
    """Camera of summed or resampled images, whose noise and saturation are unknown.

    ``binned``: pixels along one side of a block (2), the scale of a reduced picture (0.625), or its size [640, 640].
    """
    size = None
    if isinstance(binned, list) and len(binned) == 2:
        size = [number for number in binned if isinstance(number, int) and number >= 1]
        require(len(size) == 2, f"camera.binned: expected the columns and rows of the picture, got {binned!r}")
        factors = [camera.columns / size[0], camera.rows / size[1]]
        require(
            abs(factors[0] / factors[1] - 1.0) <= 1.0 / min(size),  # sizes are rounded to a pixel
            f"camera.binned: {size[0]} x {size[1]} pixels are no reduction of {camera.columns} x {camera.rows}: the "
            "picture was cut; give its camera with columns, rows and [model]",
        )
        factor = math.sqrt(factors[0] * factors[1])
    else:
        numeric = isinstance(binned, int | float) and not isinstance(binned, bool) and 0 < binned < math.inf
        require(numeric, f"camera.binned: expected a number above 0 or [columns, rows], got {binned!r}")
        assert isinstance(binned, int | float)
        factor = float(binned) if binned >= 1 else 1.0 / binned  # nothing is binned by less than a pixel: a scale
    if factor == 1.0:
        return camera
    reduced = camera.binned(factor, detector=Detector(estimated=True, gamma=camera.detector.gamma))
    return reduced if size is None else replace(reduced, columns=size[0], rows=size[1])


def spice_of(path: Path, section: SpiceSection | None) -> SpiceSetup | None:
    """Kernels, spacecraft and camera frame of a ``[spice]`` section."""
    if section is None:
        return None
    with prefix_errors("spice.kernels: "):
        kernels = find_kernels(section.kernels, path.parent)
    turn = rotation_from_xyzw(section.camera_from_frame_xyzw, "spice.camera_from_frame_xyzw")
    from_frame = None if section.frame is None else FrameRotation(rotation=turn, target="", source=section.frame)
    with prefix_errors("spice.clock: "):
        clock = None if section.clock is None else LabelClock(spacecraft=section.spacecraft, **dict(section.clock))
    return SpiceSetup(
        kernels=kernels,
        spacecraft=section.spacecraft,
        camera_from_frame=from_frame,
        ck_tolerance_s=section.ck_tolerance_s,
        clock=clock,
    )


def targets_of(
    path: Path, sections: Sequence[BodySection], spice: SpiceSetup | None
) -> tuple[tuple[TargetSetup, ...], list[str]]:
    """Bodies of the ``[[targets]]`` of a campaign or scene file."""
    decided, remarks = list[TargetSetup](), list[str]()
    for number, section in enumerate(sections):
        target = _target(path, f"targets[{number}]", section, spice)
        if isinstance(target.shape, Path) and target.units == "auto":
            surface = read_file(target.shape)
            units = "km"
            if not surface.in_km:
                units, remark = guessed_units(target.shape, surface)
                remarks.append(remark)
            target = replace(target, units=units)
        decided.append(target)
    require_unique([target.name for target in decided], "targets: two targets have the name")
    return tuple(decided), remarks


def _target(path: Path, where: str, section: BodySection, spice: SpiceSetup | None) -> TargetSetup:
    shape, spice_body = section.shape, section.spice_body or section.name
    if shape is None:
        require(spice is not None, f"{where}.shape: the radii of a PCK need [spice] with kernels")
        assert spice is not None
        with prefix_errors(f"{where}.shape: "):
            x_km, y_km, z_km = ellipsoid_from_pck(spice_body, spice.kernels).radii_km.tolist()
        shape = (x_km, y_km, z_km)
    with prefix_errors(f"{where}."):
        reflectance = McEwen() if section.reflectance is None else reflectance_from_mapping(section.reflectance)
    limb, uncertainty, orbit = LimbSetup(), TargetUncertainty(), None
    if isinstance(section, TargetSection):
        table, key = section.uncertainty.ephemeris_table, f"{where}.uncertainty.ephemeris_table"
        if table is not None:
            require(section.uncertainty.ephemeris_km == 0.0, f"{key}: give either ephemeris_km or a table")
            file = existing_file(path, key, table)
            with prefix_errors(f"{key}: "):
                orbit = read_orbit_covariance(file)
        with prefix_errors(f"{where}.uncertainty.pole_deg: "):
            uncertainty = _uncertainty(section, orbit)
            uncertainty.require_known_pole(section.name, None if isinstance(shape, str) else shape)
        terrain = None if section.terrain is None else existing_file(path, f"{where}.terrain", section.terrain)
        limb = LimbSetup.from_section(section, where, shape, terrain)
    return TargetSetup(
        name=section.name,
        shape=existing_file(path, f"{where}.shape", shape) if isinstance(shape, str) else shape,
        units=section.units,
        reflectance=reflectance,
        estimators=_estimators(path, where, section) if isinstance(section, TargetSection) else (),
        spice_body=spice_body,
        frame=section.frame or spice_body,
        uncertainty=uncertainty,
        limb=limb,
        orbit=orbit,
    )


def _uncertainty(section: TargetSection, orbit: OrbitCovariance | None) -> TargetUncertainty:
    known = section.uncertainty
    unknown = known.pole_deg == "unknown"
    return TargetUncertainty(
        scale=known.scale,
        pole_rad=0.0 if isinstance(known.pole_deg, str) else known.pole_deg * RAD_PER_DEG,
        spin_rad=known.spin_deg * RAD_PER_DEG,
        ephemeris_km=known.ephemeris_km if orbit is None else orbit.largest_sigma_km,
        sun_rad=known.sun_deg * RAD_PER_DEG,
        albedo=known.albedo,
        pole_unknown=unknown,
    )


def _estimators(path: Path, where: str, section: TargetSection) -> tuple[Estimator, ...]:
    """Estimators of a target; options of those that do not run are checked as well."""
    for key, names in (("estimators", section.estimators), ("options", section.options)):
        for name in names:
            known, hint = ", ".join(sorted(ESTIMATORS)), nearest(name, ESTIMATORS)
            require(name in ESTIMATORS, f"{where}.{key}: unknown estimator {name!r}{hint}; there are {known}")
    distinct = len(set(section.estimators)) == len(section.estimators)
    require(distinct, f"{where}.estimators: an estimator is named twice")
    built: dict[str, Estimator] = {}
    for name in (*section.estimators, *section.options):
        kind: Any = ESTIMATORS[name]  # each class has its own type of options
        key = f"{where}.options.{name}"
        options = options_from_mapping(type(kind().options), section.options.get(name, {}), key)
        built[name] = kind(with_files_found(options, path.parent, key))
    return tuple(built[name] for name in section.estimators)
