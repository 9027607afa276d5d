"""A plan file for ``giantlike plan``: its keys, and the plan that follows."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from giantlike._system.reading import resolving
from giantlike.camera import Camera
from giantlike.campaign.file.inputs import SpiceSetup, TargetSetup, camera_of, catalog_of, geometry_of, spice_of
from giantlike.campaign.file.inputs import targets_of as resolve_targets
from giantlike.campaign.file.options import options_validator
from giantlike.campaign.file.schema import PhotometrySection, SpiceSection, StarsSection, TargetSection
from giantlike.campaign.file.toml_file import TomlSection, prefix_errors, read_toml
from giantlike.campaign.render.schema import LightSection
from giantlike.catalogs import load_catalog
from giantlike.core.arrays import as_finite, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.ephemeris import ApparentGeometry, DistantLight, SpiceEphemeris
from giantlike.io.spice import load_kernels
from giantlike.planning import (
    Candidate,
    OrbitPrior,
    Plan,
    PlanOptions,
    SelectOptions,
    TruthOptions,
    candidates_from_table,
    candidates_in_window,
    plan_images,
)
from giantlike.scene import Scene, Target

_MOST_EPOCHS = 100_000
"""Epochs of a window that a mistyped step can request."""


class WindowSection(TomlSection):
    """``[[plan.window]]``: epochs at which the camera points at a body, by SPICE."""

    start: str
    """First epoch, UTC."""
    stop: str
    """Last epoch, UTC."""
    step_s: float = Field(gt=0)
    """Time between two images, s."""
    point: str | None = None
    """Target that the camera points at; default: that of the plan."""
    at_px: tuple[float, float] | None = None
    """Pixel of its center; default: the middle of the image."""
    roll_deg: float = 0.0
    """Position angle of the upward direction of the image, deg."""
    exposure_s: float | None = Field(default=None, gt=0)
    """Exposure time, s; default: the best of `exposures_s`."""


class SelectSection(TomlSection):
    """``[plan.select]``: the choice of images."""

    count: int = Field(ge=1)
    """Number of images."""
    min_gap_s: float = Field(default=0.0, ge=0)
    """Smallest time between two of them, s."""


class OrbitSection(TomlSection):
    """``[plan.orbit]``: the orbit that they shall determine."""

    epoch_utc: str
    """Epoch of the state, UTC."""
    state: list[float]
    """Spacecraft minus target: position, km, and velocity, km/s, ICRF axes."""
    covariance: list[list[float]]
    """Of the state, 6 x 6."""
    gm_km3_s2: float = Field(default=0.0, ge=0)
    """Of the target; 0: a straight line."""


class PlanSection(TomlSection):
    """``[plan]``: what to plan."""

    output: str = "planned"
    """Folder of the plan."""
    target: str | None = None
    """Target that is navigated by; may be left out where there is one."""
    geometry: str | None = None
    """Geometry table of candidates; `[[plan.window]]` in its place or in addition."""
    seed: int = Field(default=0, ge=0)
    """Seed of everything random."""
    draws: int = Field(default=3, ge=1)
    """Drawn images of each size, phase and brightness."""
    estimators: list[str] = Field(default=["auto"])
    """Estimators whose fixes are predicted; none: no images are drawn."""
    exposures_s: list[float] = Field(default=[])
    """Exposure times to choose from, s."""
    well_fraction: tuple[float, float] = (0.4, 0.8)
    """Brightest pixel over full scale."""
    min_snr: float = Field(default=5.0, ge=0)
    """Smallest signal to noise ratio of the body."""
    max_blur_px: float = Field(default=0.5, gt=0)
    """Largest motion during an exposure, px."""
    keep_out_deg: float = Field(default=0.0, ge=0, le=180)
    """Smallest angle of the boresight from the Sun, deg."""
    window: list[WindowSection] = Field(default_factory=list)
    truth: Annotated[TruthOptions, options_validator(TruthOptions)] = TruthOptions()
    """Standard deviations of what images are drawn from."""
    select: SelectSection | None = None
    orbit: OrbitSection | None = None


class PlanTargetSection(TargetSection):
    """``[[targets]]``: a body, with its uncertainties."""

    estimators: list[str] = Field(default=[])
    """Not used: those of `[plan]` count."""
    options: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Refused: fixes are predicted with the default options."""
    albedo: float = Field(default=0.045, gt=0)
    """Normal albedo."""


class PlanFile(TomlSection):
    """Whole plan file."""

    plan: PlanSection
    camera: dict[str, Any]
    """As in a campaign file."""
    photometry: PhotometrySection = PhotometrySection()
    light: LightSection = LightSection()
    stars: StarsSection | None = None
    spice: SpiceSection | None = None
    targets: list[PlanTargetSection] = Field(min_length=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanSetup:
    """A plan file whose keys and files have been checked."""

    path: Path
    content: PlanFile
    camera: Camera
    targets: tuple[TargetSetup, ...]
    spice: SpiceSetup | None
    warnings: tuple[str, ...]

    @classmethod
    def load(cls, path: str | Path) -> PlanSetup:
        """Read and check a plan file and the files it names."""
        path = Path(path)
        content, _ = read_toml(path, PlanFile, "plan file")
        with resolving(path, "a plan file"):
            table = dict(content.camera)
            with prefix_errors("photometry: "):
                zero_point = content.photometry.value
            camera, _ = camera_of(path, table)
            camera = camera if zero_point is None else replace(camera, photometry=zero_point)
            spice = spice_of(path, content.spice)
            for number, section in enumerate(content.targets):
                where, one_sigma = f"targets[{number}]", section.uncertainty.ephemeris_table is None
                require(one_sigma, f"{where}.uncertainty.ephemeris_table: a plan takes one sigma: give ephemeris_km")
                require(not section.options, f"{where}.options: a plan has the default options of estimators")
            targets, warnings = resolve_targets(path, content.targets, spice)
            given = bool(content.plan.window) or content.plan.geometry is not None
            require(given, "plan: there is no candidate: give geometry, or [[plan.window]] with [spice]")
            require(spice is not None or not content.plan.window, "plan.window: epochs of a window need [spice]")
            if camera.photometry is None:
                warnings = [*warnings, "no zero point ([photometry], or that of the camera): no signals and no fixes"]
            for section in content.targets:
                hidden = [name for name in ("atmosphere", "rings", "terrain") if getattr(section, name) is not None]
                if hidden:
                    warnings = [*warnings, f"{section.name}: scene.toml renders it without its {', '.join(hidden)}"]
        return cls(path=path, content=content, camera=camera, targets=targets, spice=spice, warnings=tuple(warnings))

    def plan(self) -> tuple[Plan, Plan] | Failure:
        """Plan all candidates; beside that plan, the one of the images that ``[plan.select]`` chooses, if it does."""
        kernels = contextlib.nullcontext() if self.spice is None else load_kernels(self.spice.kernels, self.path.parent)
        try:
            with kernels:
                return self._plan()
        except InputError as error:
            raise DataError(self.path, str(error)) from error

    def _plan(self) -> tuple[Plan, Plan] | Failure:
        section, stars = self.content.plan, self.content.stars
        scene = self._scene()
        options = PlanOptions(
            target=section.target,
            seed=section.seed,
            exposures_s=tuple(section.exposures_s),
            keep_out_deg=section.keep_out_deg,
            well_fraction=section.well_fraction,
            min_snr=section.min_snr,
            max_blur_px=section.max_blur_px,
            estimators=tuple(section.estimators),
            draws=section.draws,
            truth=section.truth,
            sun_distance_au=self.content.light.distance_au,
        )
        if stars is not None:
            faintest = replace(stars.options, max_magnitude=stars.max_magnitude)
            options = replace(options, stars=faintest, detection=stars.detection)
        catalog = None if stars is None else load_catalog(catalog_of(self.path, stars.catalog))
        plan = plan_images(self._candidates(scene), self.camera, scene, catalog, options)
        if isinstance(plan, Failure):
            return plan
        if section.select is None:
            return plan, plan
        orbit = None
        if section.orbit is not None:
            with prefix_errors("plan.orbit: "):
                orbit = OrbitPrior(
                    et=et_from_time(time_from_utc(section.orbit.epoch_utc)),
                    state=np.array(section.orbit.state),
                    covariance=as_finite(section.orbit.covariance, (6, 6), "orbit covariance"),
                    gm_km3_s2=section.orbit.gm_km3_s2,
                )
        return plan, plan.select(section.select.count, SelectOptions(min_gap_s=section.select.min_gap_s, orbit=orbit))

    def _scene(self) -> Scene:
        """Bodies with their uncertainties; without SPICE their geometry is that of the candidates."""
        nowhere = ApparentGeometry(position_inertial_km=np.array([0.0, 0.0, 1.0]))
        targets, spice, sun = [], self.spice, self.content.light.direction
        for setup, section in zip(self.targets, self.content.targets, strict=True):
            targets.append(
                Target(
                    name=setup.name,
                    shape=setup.load_shape(),
                    ephemeris=nowhere if spice is None else SpiceEphemeris(setup.spice_body, setup.frame),
                    reflectance=setup.reflectance,
                    uncertainty=setup.uncertainty,
                    terrain=setup.limb.height_map(),
                    atmosphere=setup.limb.atmosphere,
                    rings=setup.limb.rings,
                    air=setup.limb.air,
                    normal_albedo=section.albedo,
                )
            )
        if spice is not None:
            return Scene(targets=tuple(targets), observer=SpiceEphemeris(spice.spacecraft), light=SpiceEphemeris("SUN"))
        return Scene(targets=tuple(targets), light=None if sun is None else DistantLight(np.array(sun)))

    def _candidates(self, scene: Scene) -> list[Candidate]:
        section, found = self.content.plan, list[Candidate]()
        if section.geometry is not None:
            table = geometry_of(self.path, "plan.geometry", section.geometry, self.content.targets)
            found += candidates_from_table(table)
            name = scene.target(section.target).name
            if self.spice is None:
                found = [
                    one
                    if name in one.places or one.failure is not None
                    else replace(
                        one,
                        failure=Failure(
                            Reason.NO_GEOMETRY, f"{one.name}: {section.geometry} has no position of {name}"
                        ),
                    )
                    for one in found
                ]
        for number, window in enumerate(section.window):
            key = f"plan.window[{number}]"
            with prefix_errors(f"{key}: "):
                start, stop = (et_from_time(time_from_utc(text)) for text in (window.start, window.stop))
                require(start <= stop, f"stop {window.stop} is before start {window.start}")
                count = int((stop - start) / window.step_s + 1e-9) + 1
                require(count <= _MOST_EPOCHS, f"{count} epochs, at most {_MOST_EPOCHS}: enlarge step_s")
                found += candidates_in_window(
                    (start + window.step_s * np.arange(count)).tolist(),
                    self.camera,
                    scene,
                    target=window.point or section.target,
                    at_px=window.at_px,
                    roll_deg=window.roll_deg,
                    exposure_s=window.exposure_s,
                    prefix="image" if len(section.window) == 1 else f"window{number + 1}",
                )
        return found
