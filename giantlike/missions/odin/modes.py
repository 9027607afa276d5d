"""The four modes run from nothing to a pose, with simulated cameras in space and a folder as a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.autonomy import ModeMachine, pose_of_pair
from giantlike.autonomy.body_search import pointing_slew
from giantlike.autonomy.camera_sources import CameraSource, ExposureRequest, SimulatedCamera, take_pair
from giantlike.autonomy.mode_machine import InstrumentState, Mode, Slew, Telemetry
from giantlike.autonomy.two_camera_pose import Interlock, carried_attitude
from giantlike.calibration import calibrate_stars, identify_first
from giantlike.camera import Camera
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, PositionFix, Reason
from giantlike.image import Image
from giantlike.missions.odin.ground import GroundStates, catalog, moon_frame, sky_at, star_frame
from giantlike.missions.odin.narrow import (
    ESTIMATED,
    MOON_APRIORI_KM,
    NIGHT_ET,
    SCALE_ERROR,
    moon_scene,
    solve_attitude,
    true_interlock,
)
from giantlike.missions.odin.paper import paper, rough_narrow_camera
from giantlike.missions.odin.wide import EXPOSURES_S, CislunarScene, FoundBody, search, wide_image
from giantlike.relative import EllipsoidCRA
from giantlike.stars import StarNavigation, StarOptions

NARROW_FROM_INSTRUMENT = Rotation.from_euler("y", -90.0, degrees=True)  # boresight of the first camera along +x
SPACECRAFT_FROM_MOON_KM = np.array([150_000.0, -130_000.0, 60_000.0])
STAR_EXPOSURE_S, BODY_EXPOSURE_S = 0.5, 2e-4


@dataclass
class Vehicle:
    """A simulated vehicle: it slews on command, and its cameras see the scene there."""

    sky: GroundStates
    scene: CislunarScene
    instrument_from_inertial: Rotation
    rng: np.random.Generator

    def narrow(self, index: int) -> Rotation:
        """Attitude of a narrow camera."""
        first = NARROW_FROM_INSTRUMENT * self.instrument_from_inertial
        return first if index == 0 else true_interlock() * first

    def narrow_image(self, index: int, request: ExposureRequest) -> Image:
        """Image of a narrow camera: the Moon where it is in the field, else stars."""
        attitude = self.narrow(index)
        off = float(np.arccos(np.clip(unit(rotate(attitude, self.sky.moon_km))[2], -1.0, 1.0)))
        sky = replace(self.sky, et=request.et)
        if off < math.radians(7.0):
            return moon_frame(sky, attitude, self.rng, air=False)
        return star_frame(sky, attitude, self.rng, air=False)

    def wide_image(self, index: int, request: ExposureRequest) -> Image:
        """Image of a wide camera."""
        bodies = {name: rotate(self.instrument_from_inertial, place) for name, place in self.scene.bodies_km.items()}
        return wide_image(replace(self.scene, bodies_km=bodies), index, self.rng, request.exposure_s)


def vehicle_in_space(rng: np.random.Generator) -> Vehicle:
    """Spacecraft 200,000 km from the Moon, its attitude such that a narrow camera misses the Moon."""
    ground = sky_at(NIGHT_ET)
    moon = -SPACECRAFT_FROM_MOON_KM
    earth = moon - ground.moon_km  # near enough: the Moon as seen from the site
    observer = replace(ground.observer, position_km=ground.observer.position_km - earth)
    sky = replace(ground, observer=observer, moon_km=moon)
    places = {"MOON": moon, "EARTH": earth, "SUN": moon + 1.496e8 * ground.sun_from_moon}
    scene = CislunarScene(bodies_km=places, albedo={"EARTH": 1.1, "MOON": 0.97})
    toward = unit(moon)
    attitude = pointing_slew(toward, unit(np.array([0.15, 0.45, 0.9])))
    return Vehicle(sky=sky, scene=scene, instrument_from_inertial=attitude, rng=rng)


def sources_of(vehicle: Vehicle) -> tuple[tuple[CameraSource, CameraSource], tuple[CameraSource, CameraSource]]:
    """Narrow and wide cameras of a vehicle."""
    narrow = [SimulatedCamera(rough_narrow_camera(), partial(vehicle.narrow_image, k)) for k in (0, 1)]
    wide = [SimulatedCamera(rough_narrow_camera(), partial(vehicle.wide_image, k)) for k in (0, 1)]
    return (narrow[0], narrow[1]), (wide[0], wide[1])


def calibration_task(
    state: InstrumentState, *, narrow: tuple[CameraSource, CameraSource], vehicle: Vehicle, images: int
) -> InstrumentState | Failure:
    """Calibrate both narrow cameras on stars, the vehicle turned a little between images, and their interlock."""
    pairs = []
    start = vehicle.instrument_from_inertial
    for k in range(images):
        vehicle.instrument_from_inertial = Rotation.from_rotvec([0.0, 0.0, 0.08 * k]) * start
        pair = take_pair(narrow, NIGHT_ET + 10.0 * k, (STAR_EXPOSURE_S, STAR_EXPOSURE_S))
        if isinstance(pair, Failure):
            return pair
        pairs.append(pair)
    vehicle.instrument_from_inertial = start
    cameras = []
    for images_of_camera, rough in zip(zip(*pairs, strict=True), state.cameras, strict=True):
        camera = calibrate_camera(list(images_of_camera), rough)
        if isinstance(camera, Failure):
            return camera
        cameras.append(camera)
    turns = []
    for pair in pairs:
        first, second = (solve_attitude(image, camera) for image, camera in zip(pair, cameras, strict=True))
        if not isinstance(first, Failure) and not isinstance(second, Failure):
            turns.append(second.camera_from_inertial * first.camera_from_inertial.inv())
    if len(turns) < 2:
        return Failure(Reason.TOO_FEW_MATCHES, f"{len(turns)} of {images} pairs have both attitudes, 2 are needed")
    between = Rotation.concatenate(turns)
    mean = between.mean()
    errors = (between * mean.inv()).as_rotvec()
    covariance = errors.T @ errors / len(turns) + np.eye(3) * math.radians(0.2 / 3600.0) ** 2
    interlock = Interlock(second_from_first=mean, covariance_rad2=covariance)
    return replace(state, cameras=(cameras[0], cameras[1]), interlock=interlock)


def calibrate_camera(images: list[Image], rough: Camera) -> Camera | Failure:
    """Camera from star images and a rough field of view."""
    navigation = StarNavigation(rough, catalog(), StarOptions(lost_in_space=True))
    found = [identify_first(image, rough, navigation, scale_error=SCALE_ERROR) for image in images]
    good = [each for each in found if not isinstance(each, Failure)]
    answer = calibrate_stars(good, rough, estimate=ESTIMATED, model_type="brown")
    return answer if isinstance(answer, Failure) else replace(rough, model=answer.result.model)


def determination_task(
    state: InstrumentState,
    *,
    wide: tuple[CameraSource, CameraSource],
    exposures_s: tuple[float, ...],
    predicted_sun: Float | None,
) -> InstrumentState | Failure:
    """Search the wide images and request the slew that puts the Moon, else the Earth, into the second narrow camera."""
    images = []
    for exposure_s in exposures_s:
        for source in wide:
            image = source.take(ExposureRequest(et=NIGHT_ET, exposure_s=exposure_s))
            if isinstance(image, Failure):
                return image
            images.append(image)
    found = search(images, predicted_sun)
    named: dict[str, FoundBody] = {each.name: each for each in found if each.name is not None}
    for target in ("MOON", "EARTH"):
        if target in named:
            boresight = rotate((true_interlock() * NARROW_FROM_INSTRUMENT).inv(), [0.0, 0.0, 1.0])
            slew = Slew(target=target, camera=1, new_from_old=pointing_slew(named[target].direction, boresight))
            return replace(state, target=target, target_camera=1, slew=slew)
    reasons = "; ".join(each.why for each in found) or "no patch of light"
    return Failure(Reason.AMBIGUOUS, f"neither Moon nor Earth was distinguished from other light: {reasons}")


def processing_task(
    state: InstrumentState, *, narrow: tuple[CameraSource, CameraSource], vehicle: Vehicle
) -> InstrumentState | Failure:
    """Attitude from stars in one narrow camera, position of the Moon in the other."""
    exposures = (STAR_EXPOSURE_S, BODY_EXPOSURE_S) if state.target_camera == 1 else (BODY_EXPOSURE_S, STAR_EXPOSURE_S)
    pair = take_pair(narrow, NIGHT_ET + 600.0, exposures)
    if isinstance(pair, Failure):
        return pair
    body, stars = state.target_camera, 1 - state.target_camera
    attitude = solve_attitude(pair[stars], state.cameras[stars])
    if isinstance(attitude, Failure):
        return attitude
    assert state.interlock is not None  # the machine requires one before processing
    interlock = state.interlock if body == 1 else state.interlock.reversed()
    turn, covariance = carried_attitude(attitude, interlock)
    image = pair[body].with_attitude(turn, covariance_rad2=covariance)
    sky = replace(vehicle.sky, et=NIGHT_ET + 600.0)
    fix = EllipsoidCRA().estimate(
        image, state.cameras[body], moon_scene(sky, vehicle.rng.normal(0.0, MOON_APRIORI_KM, 3))
    )
    if not isinstance(fix, PositionFix):
        return fix
    return replace(state, pose=pose_of_pair(fix, turn, covariance))


@dataclass(frozen=True, eq=False)
class ModeRun:
    """A run of the modes: telemetry in order, last state, and the vehicle as it ended."""

    telemetry: tuple[Telemetry, ...]
    state: InstrumentState
    vehicle: Vehicle

    @property
    def position_error_sigmas(self) -> float:
        """Error of the position of the Moon over its covariance: the square root of a chi-square of 3."""
        pose = self.state.pose
        if pose is None:
            return math.inf
        error = pose.position_inertial_km - self.vehicle.sky.moon_km
        return float(np.sqrt(error @ np.linalg.solve(pose.covariance_inertial_km2, error)))


def fly(rng: np.random.Generator, *, images: int) -> ModeRun:
    """Command the modes one after the other, after commands that a state must refuse."""
    vehicle = vehicle_in_space(rng)
    narrow, wide = sources_of(vehicle)
    sun = rotate(vehicle.instrument_from_inertial, unit(vehicle.scene.bodies_km["SUN"]))
    machine = ModeMachine(
        {
            Mode.CALIBRATION: partial(calibration_task, narrow=narrow, vehicle=vehicle, images=images),
            Mode.TARGET_DETERMINATION: partial(
                determination_task, wide=wide, exposures_s=EXPOSURES_S, predicted_sun=sun
            ),
            Mode.PROCESSING: partial(processing_task, narrow=narrow, vehicle=vehicle),
        }
    )
    state = InstrumentState(cameras=(rough_narrow_camera("narrow 0"), rough_narrow_camera("narrow 1")))
    log: list[Telemetry] = []
    for mode in (Mode.PROCESSING, Mode.CALIBRATION, Mode.TARGET_DETERMINATION, Mode.PROCESSING, Mode.IDLE):
        state, answer = machine.command(state, mode)
        log.append(answer)
        if not answer.done:
            continue
        state, answer = machine.step(state)
        log.append(answer)
        if mode is Mode.TARGET_DETERMINATION and state.slew is not None:
            vehicle.instrument_from_inertial = state.slew.new_from_old * vehicle.instrument_from_inertial
    return ModeRun(telemetry=tuple(log), state=state, vehicle=vehicle)


def cycle_s() -> float:
    """Seconds that a cycle may take."""
    return float(paper()["cycle"]["seconds"])
