"""Narrow cameras: calibration from star images, the rotation between them, and the Moon from the ground."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.autonomy import pose_of_pair
from giantlike.autonomy.refraction import SiteAtmosphere, remove_refraction
from giantlike.autonomy.two_camera_pose import Interlock, PairPose, carried_attitude
from giantlike.calibration import calibrate_stars, identify_first
from giantlike.calibration.result import CalibrationResult
from giantlike.camera import Camera
from giantlike.catalogs import apparent_directions
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import camera_from_inertial_of_pointing, radec_from_direction, rotate
from giantlike.core.outcomes import AttitudeFix, Failure, PositionFix
from giantlike.core.units import RAD_PER_ARCSEC
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.missions.odin.ground import MOON_RADIUS_KM, GroundStates, catalog, moon_frame, sky_at, star_frame
from giantlike.missions.odin.paper import narrow_camera, rough_narrow_camera
from giantlike.relative import EllipsoidCRA
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid
from giantlike.stars import StarNavigation, StarOptions

NIGHT_ET = 793_039_000.0  # 2025-02-17, Moon rising at the site, 12 days after new
AIR = SiteAtmosphere(pressure_hpa=1010.0, temperature_c=15.0)
LEAST_ELEVATION_RAD = np.radians(25.0)
"""Lowest boresight of a star camera: below, trees, and refraction that changes by 10 arcsec over the field."""
ESTIMATED = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "p1", "p2")
SCALE_ERROR = 0.05  # of the field of view of Table 1, which is given to the degree
MOON_APRIORI_KM = 2000.0  # of the predicted position, per axis: 18 arcmin


@dataclass(frozen=True, eq=False)
class LensStudy:
    """Calibration from star images: result, the first image, and the number of images solved."""

    result: CalibrationResult
    first: Image
    identified: int
    images: int


def calibrate_lens(count: int, rng: np.random.Generator) -> LensStudy | Failure:
    """Calibrate a narrow camera from images of stars with nothing known but its size and field of view."""
    rough = rough_narrow_camera()
    navigation = StarNavigation(rough, catalog(), StarOptions(lost_in_space=True))
    found, solved = [], []
    for k in range(count):
        sky = sky_at(NIGHT_ET + 120.0 * k)
        turn = pointing_above(sky, rng, np.radians(45.0))
        image = star_frame(sky, turn, rng, name=f"stars {k}")
        star_image = identify_first(image, rough, navigation, scale_error=SCALE_ERROR)
        if not isinstance(star_image, Failure):
            found.append(star_image)
            solved.append(image)
    calibration = calibrate_stars(found, rough, estimate=ESTIMATED, model_type="brown")
    if isinstance(calibration, Failure):
        return calibration
    return LensStudy(result=calibration.result, first=solved[0], identified=len(found), images=count)


def site_air(*, air: bool) -> SiteAtmosphere:
    """Atmosphere over the site, or none."""
    return AIR if air else replace(AIR, pressure_hpa=0.0)


def pointing_above(sky: GroundStates, rng: np.random.Generator, least_rad: float) -> Rotation:
    """Attitude of a camera that looks higher than an elevation."""
    while True:
        direction = unit(rng.normal(size=3))
        if sky.elevation(direction) > least_rad:
            ra, dec = radec_from_direction(direction)
            return camera_from_inertial_of_pointing(float(ra), float(dec), float(rng.uniform(0.0, 360.0)))


def true_interlock() -> Rotation:
    """Second camera from the first: 90 degrees and the error of a bracket."""
    return Rotation.from_rotvec(np.radians([0.31, -0.22, 0.17])) * Rotation.from_euler("y", -90.0, degrees=True)


def rig_above(sky: GroundStates, rng: np.random.Generator) -> Rotation:
    """Attitude of the first camera with both cameras above the least elevation."""
    while True:
        turn = pointing_above(sky, rng, LEAST_ELEVATION_RAD)
        other = (true_interlock() * turn).inv()
        if sky.elevation(rotate(other, [0.0, 0.0, 1.0])) > LEAST_ELEVATION_RAD:
            return turn


def without_refraction(fix: AttitudeFix, camera: Camera, sky: GroundStates, air: SiteAtmosphere = AIR) -> Rotation:
    """Attitude from the stars of a fix with refraction taken out of their measured directions."""
    stars = catalog().cone(rotate(fix.camera_from_inertial.inv(), [0.0, 0.0, 1.0]), np.radians(14.0))
    order = {int(key): k for k, key in enumerate(stars.ids)}
    kept = [k for k, key in enumerate(fix.star_ids) if int(key) in order]
    chosen = stars.select(np.array([order[int(fix.star_ids[k])] for k in kept]))
    directions = apparent_directions(
        chosen, sky.et, observer_position_km=sky.observer.position_km, observer_velocity_km_s=sky.observer.velocity_km_s
    )
    seen = unit(camera.model.unproject(fix.observed_px[kept]))
    turn = fix.camera_from_inertial
    for _ in range(3):  # the vertical in camera axes follows the attitude, which changes by an arcminute at first
        up = rotate(turn, sky.zenith)
        turn, _ = Rotation.align_vectors(
            remove_refraction(seen, up, air), directions, weights=1.0 / fix.sigma_px[kept] ** 2
        )
    return turn


def solve_attitude(image: Image, camera: Camera) -> AttitudeFix | Failure:
    """Attitude of a star image, lost in space."""
    return StarNavigation(camera, catalog(), StarOptions(lost_in_space=True)).solve(image)


@dataclass(frozen=True, eq=False)
class InterlockStudy(Value):
    """Rotations between the cameras from pairs of star images.

    Rotations of n pairs as the stars show them and with refraction taken out, the orientation (n,) of each, and the
    pairs that failed.
    """

    seen: Rotation
    corrected: Rotation
    orientation: Float
    failed: int

    def angles_arcsec(self, *, corrected: bool) -> Float:
        """Angle of each rotation minus the mean, arcsec."""
        angles = (self.corrected if corrected else self.seen).magnitude()
        return np.asarray(np.degrees(angles - angles.mean()) * 3600.0)


def interlock_study(
    pairs: int, orientations: int, rng: np.random.Generator, progress: Callable[[int], None], *, air: bool = True
) -> InterlockStudy:
    """Photograph stars with both cameras, the rig turned a couple of times."""
    camera = narrow_camera()
    seen, corrected, failed, site = [], [], 0, site_air(air=air)
    which: list[int] = []
    turn = Rotation.identity()
    for k in range(pairs):
        sky = sky_at(NIGHT_ET + 60.0 * k)
        group = k * orientations // pairs
        if not which or which[-1] != group:
            turn = rig_above(sky, rng)
        first, second = (
            solve_attitude(star_frame(sky, attitude, rng, air=air), camera)
            for attitude in (turn, true_interlock() * turn)
        )
        progress(k + 1)
        if isinstance(first, Failure) or isinstance(second, Failure):
            failed += 1
            continue
        seen.append(second.camera_from_inertial * first.camera_from_inertial.inv())
        first_turn, second_turn = (without_refraction(each, camera, sky, site) for each in (first, second))
        corrected.append(second_turn * first_turn.inv())
        which.append(group)
    return InterlockStudy(
        seen=Rotation.concatenate(seen),
        corrected=Rotation.concatenate(corrected),
        orientation=np.array(which, dtype=np.float64),
        failed=failed,
    )


def turn_by_air(zenith_camera: Float, air: SiteAtmosphere) -> Rotation:
    """Rotation by which an attitude from stars over the whole field is wrong when refraction is left in."""
    camera = narrow_camera()
    x, y = np.meshgrid(np.linspace(0.0, camera.columns - 1.0, 5), np.linspace(0.0, camera.rows - 1.0, 5))
    seen = unit(camera.model.unproject(np.stack([x.ravel(), y.ravel()], axis=-1)))
    return Rotation.align_vectors(seen, remove_refraction(seen, zenith_camera, air))[0]


def scatter_by_air(sets: int, orientations: int, rng: np.random.Generator, *, air: bool = True) -> Float:
    """Standard deviations (sets,), arcsec, of the angle between the cameras by refraction, random orientations."""
    sky, between, site = sky_at(NIGHT_ET), true_interlock(), site_air(air=air)
    result = np.empty(sets)
    for k in range(sets):
        angles = []
        for _ in range(orientations):
            turn = rig_above(sky, rng)
            first, second = (turn_by_air(rotate(each, sky.zenith), site) for each in (turn, between * turn))
            angles.append(float((second * between * first.inv()).magnitude()))
        result[k] = np.degrees(np.std(angles)) * 3600.0
    return result


@dataclass(frozen=True, eq=False)
class MoonPair(Value):
    """A pair of images of the stars and the Moon: truth, poses as the stars show them and with refraction taken out."""

    sky: GroundStates
    elevation_rad: float
    fix: PositionFix
    image: Image
    true_camera_km: Float
    seen: PairPose
    corrected: PairPose
    cpu_s: float

    def expected_px(self, pose: PairPose) -> Float:
        """Pixel (2,) at which the attitude of a pose puts the Moon of the ephemeris."""
        return narrow_camera().model.project(rotate(pose.camera_from_inertial, self.sky.moon_km))

    @property
    def offset_px(self) -> float:
        """Distance of the expected Moon from the measured one, refraction left in."""
        return float(np.linalg.norm(self.expected_px(self.seen) - self.fix.center_px))

    @property
    def corrected_offset_px(self) -> float:
        """The same with refraction taken out of stars and Moon."""
        measured = narrow_camera().model.project(self.corrected.position_camera_km)
        return float(np.linalg.norm(self.expected_px(self.corrected) - measured))


def moon_scene(sky: GroundStates, error_km: Float) -> Scene:
    """Scene with the Moon where it is expected."""
    target = Target(
        name="MOON",
        shape=Ellipsoid(radii_km=np.full(3, MOON_RADIUS_KM)),
        ephemeris=ApparentGeometry(
            position_inertial_km=sky.moon_km + error_km, sun_direction_inertial=sky.sun_from_moon
        ),
    )
    return Scene(targets=(target,))


def moon_pair(
    sky: GroundStates, interlocks: tuple[Interlock, Interlock], rng: np.random.Generator, *, air: bool = True
) -> MoonPair | Failure:
    """Photograph stars with the first camera and the Moon with the second, and find attitude and position."""
    camera = narrow_camera()
    second = _moon_attitude(sky, rng)
    first = true_interlock().inv() * second
    stars, moon = star_frame(sky, first, rng, air=air), moon_frame(sky, second, rng, air=air)
    start = time.process_time()
    attitude = solve_attitude(stars, camera)
    if isinstance(attitude, Failure):
        return attitude
    turn, spread = carried_attitude(attitude, interlocks[0])
    image = moon.with_attitude(turn, covariance_rad2=spread)
    fix = EllipsoidCRA().estimate(image, camera, moon_scene(sky, rng.normal(0.0, MOON_APRIORI_KM, 3)))
    if isinstance(fix, Failure):
        return fix
    seen = pose_of_pair(fix, turn, spread)
    spent = time.process_time() - start
    clear = without_refraction(attitude, camera, sky, site_air(air=air))
    better = interlocks[1].second_from_first * clear
    lowered = remove_refraction(fix.position_camera_km, rotate(better, sky.zenith), site_air(air=air))
    moved = Rotation.align_vectors(lowered[None], fix.position_camera_km[None])[0].as_matrix()
    # the scatter of pairs then has three parts: noise, image motion of two cameras, and the mean's own error
    corrected = pose_of_pair(_move_fix(fix, lowered, moved), better, interlocks[1].covariance_rad2)
    return MoonPair(
        sky=sky,
        elevation_rad=sky.elevation(sky.moon_km),
        fix=fix,
        image=moon,
        true_camera_km=rotate(second, sky.moon_km),
        seen=seen,
        corrected=corrected,
        cpu_s=spent,
    )


def _move_fix(fix: PositionFix, position: Float, turn: Float) -> PositionFix:
    """A fix at another position, its covariance turned along."""
    covariance = turn @ fix.covariance_camera_km2 @ turn.T
    return replace(
        fix, position_camera_km=position, covariance_camera_km2=(covariance + covariance.T) / 2.0, parts={}, partials={}
    )


def _moon_attitude(sky: GroundStates, rng: np.random.Generator) -> Rotation:
    """Attitude of the second camera: the Moon within 2 degrees of its center, the first camera on clear sky."""
    ra, dec = radec_from_direction(sky.moon_km)
    for _ in range(10_000):
        turn = camera_from_inertial_of_pointing(float(ra), float(dec), float(rng.uniform(0.0, 360.0)))
        turn = Rotation.from_rotvec(rng.uniform(-0.035, 0.035, 3) * [1.0, 1.0, 0.0]) * turn
        star_axis = rotate((true_interlock().inv() * turn).inv(), [0.0, 0.0, 1.0])
        if sky.elevation(star_axis) > LEAST_ELEVATION_RAD:
            return turn
    raise ArithmeticError("no roll of the rig lets the star camera see clear sky")  # pragma: no cover


def lines_of(study: InterlockStudy, *, corrected: bool) -> Interlock:
    """Interlock of a study: the mean rotation, with the scatter of a pair as its error."""
    rotations = study.corrected if corrected else study.seen
    mean = rotations.mean()
    errors = (rotations * mean.inv()).as_rotvec()
    scatter = errors.T @ errors / (len(errors) - 1.0) * (1.0 + 1.0 / len(errors))
    floor = np.eye(3) * (0.1 * RAD_PER_ARCSEC) ** 2  # two pairs alone leave the scatter without rank
    return Interlock(second_from_first=mean, covariance_rad2=scatter + floor)
