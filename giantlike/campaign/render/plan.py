"""A scene file, checked and resolved: camera, bodies and exposures, ready to be rendered."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.reading import resolving
from giantlike.camera import Camera
from giantlike.campaign.file.inputs import (
    SpiceSetup,
    TargetSetup,
    camera_of,
    catalog_of,
    existing_file,
    geometry_of,
    require_unique,
    spice_of,
    targets_of,
)
from giantlike.campaign.file.toml_file import prefix_errors, read_toml
from giantlike.campaign.render.schema import DetectorSection, ImageSection, PlaceSection, RenderFile
from giantlike.core.arrays import Float, require, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, rotation_from_xyzw
from giantlike.core.photometry import Photometry
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.units import AU_KM, RAD_PER_DEG
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry, SpiceEphemeris
from giantlike.image import ObserverState
from giantlike.io.geometry_table import GeometryRow, ImageGeometry
from giantlike.io.image_files import read_image_file
from giantlike.io.spice import load_kernels
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape
from giantlike.simulation import Shot
from giantlike.simulation.detector import DetectorModel, HotPixels, Stream, scattered_pixels
from giantlike.simulation.effects import FlatField, pixel_response
from giantlike.simulation.incident import SimulationOptions, true_geometry
from giantlike.simulation.shot import make_black_image

if TYPE_CHECKING:
    from astropy.time import Time

SUN_RADIUS_KM = 695_700.0  # nominal solar radius, IAU 2015 resolution B3
FITS_SUFFIXES = frozenset({".fits", ".fit", ".fts"})  # suffixes of the files that images are written to


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exposure(Value):
    """An image to be rendered, as given by the files; SPICE completes attitude, observer and positions."""

    key: str  # its location in the scene file or table, for messages
    file: str  # file of the image, relative to the output folder
    epoch: Time
    exposure_s: float
    camera_from_inertial: Rotation | None = None
    angular_rate_camera_rad_s: Float = field(default_factory=lambda: np.zeros(3))  # in rad/s
    observer: ObserverState | None = None
    places: Mapping[str, GeometryRow] = field(default_factory=dict)  # positions of targets, by name


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderPlan(Value):
    """A scene file whose keys, files and names have been checked."""

    path: Path
    content: RenderFile
    camera: Camera
    targets: tuple[TargetSetup, ...]  # without estimators; the shapes are loaded by :meth:`shots`
    places: Mapping[str, GeometryRow]  # defaults, by target
    exposures: tuple[Exposure, ...]
    detector: DetectorModel
    catalog: str | None  # name or path of the catalog; None: no stars
    spice: SpiceSetup | None
    warnings: tuple[str, ...]  # oddities that are not errors

    @classmethod
    def load(cls, path: str | Path) -> RenderPlan:
        """Read and check a scene file and the files it names."""
        path = Path(path)
        content, _ = read_toml(path, RenderFile, "scene file")
        with resolving(path, "a scene file"):
            return _resolve(path, content)

    @property
    def photometry(self) -> Photometry:
        """Zero point of the scene file, else of the camera file, else the default."""
        return self.content.photometry.value or self.camera.photometry or Photometry()

    @property
    def options(self) -> SimulationOptions:
        """Sampling, faintest star, size of the Sun."""
        light, stars = self.content.light, self.content.stars
        return SimulationOptions(
            rays_per_pixel_side=self.content.render.rays_per_pixel_side,
            max_magnitude=None if stars is None else stars.max_magnitude,
            sun_radius_rad=math.asin(SUN_RADIUS_KM / (light.distance_au * AU_KM)) if light.extended else 0.0,
        )

    def kernels(self) -> AbstractContextManager[object]:
        """Load the SPICE kernels, if there are any, until the end of a ``with`` block."""
        return contextlib.nullcontext() if self.spice is None else load_kernels(self.spice.kernels, self.path.parent)

    def shots(self) -> list[tuple[Shot, Scene | None]]:
        """Every exposure with its scene, None without a target; call it inside ``with plan.kernels()``."""
        try:
            shapes = {target.name: target.load_shape() for target in self.targets}
            shots = [(self._shot(exposure), self._scene(exposure, shapes)) for exposure in self.exposures]
            shown: set[str] = set()
            for shot, scene in shots:
                if scene is not None:
                    frame = make_black_image(shot, self.camera)
                    shown |= {true_geometry(scene, frame, body.name).target.name for body in scene.targets}
            for number, setup in enumerate(self.targets):
                require(
                    setup.name in shown,
                    f"targets[{number}].position_km: nothing says where {setup.name!r} is: give it here, in an "
                    "image or in the geometry table, or add [spice]",
                )
        except InputError as error:
            raise DataError(self.path, str(error)) from error
        return shots

    def _shot(self, exposure: Exposure) -> Shot:
        turn, observer = exposure.camera_from_inertial, exposure.observer
        if self.spice is not None:
            et = et_from_time(exposure.epoch)
            if turn is None:
                pointing = self.spice.camera_from_inertial(et)
                turn = None if pointing is None else pointing.rotation
            observer = observer or self.spice.observer(et)
        if turn is None:
            raise InputError(
                f"{exposure.key}: an attitude is needed: camera_from_inertial_xyzw, pointing_deg, or spice.frame"
            )
        return Shot(
            name=exposure.file,
            epoch=exposure.epoch,
            exposure_s=exposure.exposure_s,
            camera_from_inertial=turn,
            observer=observer,
            angular_rate_camera_rad_s=exposure.angular_rate_camera_rad_s,
        )

    def _scene(self, exposure: Exposure, shapes: Mapping[str, Shape]) -> Scene | None:
        """Targets of an image; None if there are none."""
        targets = []
        for setup in self.targets:
            place = _complete_place(exposure.places.get(setup.name), self.places[setup.name])
            ephemeris = self._ephemeris(exposure, setup, place)
            if ephemeris is not None:
                shape = shapes[setup.name]
                targets.append(
                    Target(
                        name=setup.name,
                        shape=shape,
                        ephemeris=ephemeris,
                        reflectance=setup.reflectance,
                        normal_albedo=self._albedos[setup.name],
                    )
                )
        if not targets:
            return None
        if self.spice is None:
            return Scene(targets=tuple(targets))
        return Scene(
            targets=tuple(targets), observer=SpiceEphemeris(self.spice.spacecraft), light=SpiceEphemeris("SUN")
        )

    @property
    def _albedos(self) -> Mapping[str, float]:
        return {target.name: target.albedo for target in self.content.targets}

    def _ephemeris(
        self, exposure: Exposure, setup: TargetSetup, place: GeometryRow
    ) -> ApparentGeometry | SpiceEphemeris | None:
        position = place.target_position_inertial_km
        if position is None:
            return None if self.spice is None else SpiceEphemeris(setup.spice_body, setup.frame)
        et = et_from_time(exposure.epoch)
        sun, turn = place.sun_direction_inertial, place.body_from_inertial
        if sun is None and self.content.light.direction is not None:
            sun = np.array(self.content.light.direction)
        if sun is None and self.spice is not None:
            sun = self.spice.sun_from(position, et)
        if sun is None:
            raise InputError(f"{exposure.key}: no direction to the Sun for {setup.name!r}: give light.direction")
        inertial_from_body = Rotation.identity()
        if turn is not None:
            inertial_from_body = turn.inv()
        elif self.spice is not None:
            inertial_from_body = setup.inertial_from_body(position, et)
        return ApparentGeometry(
            position_inertial_km=position, inertial_from_body=inertial_from_body, sun_direction_inertial=sun
        )


def _resolve(path: Path, content: RenderFile) -> RenderPlan:
    camera, _ = camera_of(path, content.camera)
    require(camera.psf is not None, "camera: rendering needs the PSF of the camera, [psf] with sigma_px")
    targets, guessed = targets_of(path, content.targets, spice_of(path, content.spice))
    light = content.light
    require(light.direction is None or any(light.direction), "light.direction: must not be the zero vector")
    outside = not light.extended or light.distance_au * AU_KM > SUN_RADIUS_KM
    require(outside, f"light.distance_au: {light.distance_au:g} au lies inside the Sun")
    with prefix_errors("photometry: "):
        _ = content.photometry.value
    exposures = _exposures(path, content)
    names = {target.name for target in targets}
    for exposure in exposures:
        for name in sorted(exposure.places):
            require(name in names, f"{exposure.key}: there is no target {name!r} in [[targets]]")
    return RenderPlan(
        path=path,
        content=content,
        camera=camera,
        targets=targets,
        places={section.name: _place(f"targets[{k}]", section) for k, section in enumerate(content.targets)},
        exposures=exposures,
        detector=_detector(path, content.detector, camera),
        catalog=None if content.stars is None else catalog_of(path, content.stars.catalog),
        spice=spice_of(path, content.spice),
        warnings=tuple(guessed),
    )


def _place(where: str, section: PlaceSection) -> GeometryRow:
    for key in ("position_km", "sun_direction"):
        vector = getattr(section, key)
        require(vector is None or any(vector), f"{where}.{key}: must not be the zero vector")
    quaternion = section.body_from_inertial_xyzw
    turn = None if quaternion is None else rotation_from_xyzw(quaternion, f"{where}.body_from_inertial_xyzw")
    return GeometryRow(
        file="",
        target_position_inertial_km=None if section.position_km is None else np.array(section.position_km),
        body_from_inertial=turn,
        sun_direction_inertial=None if section.sun_direction is None else unit(np.array(section.sun_direction)),
    )


def _complete_place(place: GeometryRow | None, default: GeometryRow) -> GeometryRow:
    """Place of a target in an image, completed by its default."""
    if place is None:
        return default
    names = ("target_position_inertial_km", "body_from_inertial", "sun_direction_inertial")
    return replace(place, **{name: getattr(default, name) for name in names if getattr(place, name) is None})


def _exposures(path: Path, content: RenderFile) -> tuple[Exposure, ...]:
    table = content.render.geometry
    require((table is None) == bool(content.images), "either [[images]] or render.geometry is needed, and not both")
    if table is None:
        exposures = [_from_section(f"images[{k}]", section) for k, section in enumerate(content.images)]
    else:
        rows = geometry_of(path, "render.geometry", table, content.targets)
        exposures = []
        for name in dict.fromkeys(row.file for row in rows.rows):
            known = rows.image(name)
            assert known is not None
            exposures.append(_from_table(f"{rows.path.name}: {name}", name, known))
    for exposure in exposures:
        fits = Path(exposure.file).suffix.lower() in FITS_SUFFIXES
        require(fits, f"{exposure.key}: images are written as FITS, so the file must end in .fits")
    require_unique([exposure.file for exposure in exposures], "images: two images have the file")
    return tuple(exposures)


def _from_section(where: str, section: ImageSection) -> Exposure:
    turn, quaternion, pointing = None, section.camera_from_inertial_xyzw, section.pointing_deg
    require(None in (quaternion, pointing), f"{where}: give camera_from_inertial_xyzw or pointing_deg, not both")
    if quaternion is not None:
        turn = rotation_from_xyzw(quaternion, f"{where}.camera_from_inertial_xyzw")
    if pointing is not None:
        turn = camera_from_inertial_of_pointing(*pointing)
    with prefix_errors(f"{where}.epoch_utc: "):
        epoch = time_from_utc(section.epoch_utc)
    observer = None
    if section.observer is not None:
        observer = ObserverState(
            position_km=np.array(section.observer.position_km), velocity_km_s=np.array(section.observer.velocity_km_s)
        )
    return Exposure(
        key=where,
        file=section.file,
        epoch=epoch,
        exposure_s=section.exposure_s,
        camera_from_inertial=turn,
        angular_rate_camera_rad_s=np.array(section.angular_rate_deg_s) * RAD_PER_DEG,
        observer=observer,
        places={name: _place(f"{where}.targets.{name}", place) for name, place in section.targets.items()},
    )


def _from_table(where: str, file: str, known: ImageGeometry) -> Exposure:
    if known.epoch is None or known.exposure_s is None:
        raise InputError(f"{where}: the geometry table must give epoch_utc and exposure_s")
    return Exposure(
        key=where,
        file=file,
        epoch=known.epoch,
        exposure_s=known.exposure_s,
        camera_from_inertial=known.camera_from_inertial,
        observer=known.observer,
        places=known.targets,
    )


def _detector(path: Path, section: DetectorSection, camera: Camera) -> DetectorModel:
    """Build the detector: maps are drawn from the seed of the pattern, so that they are common to all images."""
    seed, size = section.pattern_seed, (camera.columns, camera.rows)
    response = None
    if section.response_file is not None:
        response = read_image_file(existing_file(path, "detector.response_file", section.response_file)).pixels
        fits = response.shape == size[::-1]
        require(fits, f"detector.response_file: {response.shape} pixels, the camera has {size[::-1]}")
        response = response.astype(np.float64)
    elif section.response_rms > 0:
        response = pixel_response(*size, rms=section.response_rms, random=Stream.PIXEL_RESPONSE.random(seed))
    hot = section.hot_pixels
    with prefix_errors("detector."):
        return DetectorModel(
            stray=section.stray,
            flat=FlatField(response=response, vignetting=section.vignetting),
            transfer=section.transfer,
            dark=section.dark,
            hot_pixels=HotPixels.draw(hot.count, *size, Stream.HOT_PIXELS.random(seed), median_e_s=hot.median_e_s),
            dead_px=scattered_pixels(section.dead_pixels, *size, Stream.DEAD_PIXELS.random(seed)),
            shot_noise=section.shot_noise,
            cosmic_rays=section.cosmic_rays,
            well=section.well,
            bits=section.bits,
        )
