"""A simulated approach to a small irregular body after a flyby of a round moon, with its truth.

The truth and the a priori knowledge of navigation are kept apart: an :class:`ApproachFrame` holds both, and only the
latter is written where a campaign reads it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import camera_from_inertial_of_pointing, radec_from_direction
from giantlike.core.light import boosted
from giantlike.core.photometry import Photometry
from giantlike.core.time import et_from_time, time_from_et, time_from_utc
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_DEG, SECONDS_PER_DAY
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry, FixedEphemeris, light_path
from giantlike.image import ObserverState
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid, Shape, irregular_body
from giantlike.simulation.detector import DetectorModel, HotPixels
from giantlike.simulation.images import SimulatedImage, simulate_image
from giantlike.simulation.incident import SimulationOptions, Sources, visible_peak
from giantlike.simulation.orbits import CircularOrbit, Rendezvous
from giantlike.simulation.shot import Shot, make_black_image

_FIRST_DAY_UTC = "2024-03-02T06:00:00"  # epoch of the first visit; chosen, any other moves the body along its orbit
_RAYS = 5  # along a pixel's side, in images of the body
_STAR_IMAGE_RAYS = 2  # along a pixel's side in star images, where the body is saturated
_DIRECTION_STEP_DEG = 25.0  # turn of the camera's direction about the Sun from visit to visit
_USED_PART = 0.7  # of the free half frame, over which the body is placed


@dataclass(frozen=True, slots=True, kw_only=True)
class Visit:
    """Time, distance and phase angle at which the body is imaged.

    Parameters
    ----------
    day : float; days since the first visit
    diameter_px : float, px; apparent diameter of the sphere of the body's volume
    phase_deg : float, deg; angle Sun - body - camera
    lost : bool; True if there is no a priori attitude
    """

    day: float
    diameter_px: float
    phase_deg: float
    lost: bool = False


APPROACH = (
    Visit(day=0.0, diameter_px=1.0, phase_deg=20.0),
    Visit(day=1.0, diameter_px=1.4, phase_deg=50.0),
    Visit(day=2.0, diameter_px=2.0, phase_deg=80.0),
    Visit(day=4.0, diameter_px=12.0, phase_deg=110.0),
    Visit(day=5.0, diameter_px=30.0, phase_deg=120.0),
    Visit(day=6.0, diameter_px=60.0, phase_deg=100.0),
    Visit(day=7.0, diameter_px=100.0, phase_deg=75.0, lost=True),
    Visit(day=8.0, diameter_px=150.0, phase_deg=45.0),
    Visit(day=9.0, diameter_px=200.0, phase_deg=25.0),
    Visit(day=10.0, diameter_px=250.0, phase_deg=60.0),
    Visit(day=11.0, diameter_px=300.0, phase_deg=95.0),
)
MOON_FLYBY = (Visit(day=0.0, diameter_px=220.0, phase_deg=35.0), Visit(day=0.2, diameter_px=280.0, phase_deg=85.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class ApproachOptions:
    """Options of the simulated approach.

    Parameters
    ----------
    seed : int; seed of everything random: equal options give equal images
    approach, moon : tuple of Visit; of ``ROCK`` (two or more) and of the ellipsoid ``MOON`` (none, two or more)
    facets : int; facets of the irregular body
    long_exposure_s : float, s; exposure time of the star images
    longest_short_s : float, s; longest exposure of the images of the body
    peak_of_full_scale : float; brightest pixel of the body in its images, as a fraction of full scale above bias
    frame_margin_px : float, px; least distance of the body from the edge of the frame, where it fits
    pair_gap_s : float, s; time between mid-exposures of a star image and of the image of the body next to it
    attitude_error_deg : (float, float), deg; smallest and largest error of the a priori attitude
    drift_arcsec_s : float, arcsec/s; constant rate of the camera during a visit
    jitter_arcsec_per_sqrt_s : float, arcsec/s^0.5; random walk added to the drift, per axis
    position_error_px : float, px; error of the a priori position across the line of sight
    range_error : float; largest relative error of the a priori range

    Raises
    ------
    InputError
        A value is out of range, or visits are not in order of time.

    Notes
    -----
    The defaults are the scenario of the demonstration; they set how hard its images are, not how they are processed.
    """

    seed: int = 7
    approach: tuple[Visit, ...] = APPROACH
    moon: tuple[Visit, ...] = MOON_FLYBY
    facets: int = 50_000
    long_exposure_s: float = 5.0
    longest_short_s: float = 0.5
    peak_of_full_scale: float = 0.7
    frame_margin_px: float = 40.0
    pair_gap_s: float = 30.0
    attitude_error_deg: tuple[float, float] = (0.1, 0.3)
    drift_arcsec_s: float = 0.5
    jitter_arcsec_per_sqrt_s: float = 0.03
    position_error_px: float = 10.0
    range_error: float = 0.015

    def __post_init__(self) -> None:
        require(len(self.approach) >= 2, f"an approach needs at least 2 visits, got {len(self.approach)}")
        require(len(self.moon) != 1, "a flyby of the moon needs no visit or at least 2, got 1")
        for visits in (self.approach, self.moon):
            days = [visit.day for visit in visits]
            require(days == sorted(set(days)), f"visits must follow one another in time, got days {days}")
        require_number(self.long_exposure_s, "long_exposure_s", least=1.0)
        require_number(self.longest_short_s, "longest_short_s", above=0.0)
        require_number(self.peak_of_full_scale, "peak_of_full_scale", above=0.0)
        require_number(self.frame_margin_px, "frame_margin_px", least=0.0)
        low, high = self.attitude_error_deg
        require(0.0 <= low <= high, f"attitude_error_deg must be (smallest, largest), got {self.attitude_error_deg}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ApproachFrame(Value):
    """An image to be taken: its truth and its a priori knowledge."""

    shot: Shot  # true exposure
    scene: Scene  # true scene
    target: str  # name of the body in view
    star_image: bool  # True for a long exposure, in which the body is saturated
    seed: tuple[int, int]  # (int, int); seed of the noise of this image
    apriori_camera_from_inertial: Rotation | None  # attitude with its error; None where the attitude is lost
    apriori_observer: ObserverState  # observer with its error
    apriori_geometry: ApparentGeometry  # with the error of the position; orientation and Sun are exact


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Approach(Value):
    """A simulated campaign whose images are not yet made."""

    camera: Camera  # the camera
    photometry: Photometry  # zero point of the camera
    sun_distance_au: float  # of the bodies, au
    detector: DetectorModel  # effects of the detector
    targets: tuple[Target, ...]  # bodies with their true ephemerides
    frames: tuple[ApproachFrame, ...]  # images in order of time
    options: ApproachOptions  # options that the approach was planned with

    def take(self, frame: ApproachFrame, catalog: StarCatalog) -> SimulatedImage:
        """Simulate the image of a frame; equal frames give equal images."""
        return simulate_image(
            frame.shot,
            self.camera,
            Sources(
                scene=frame.scene, catalog=catalog, photometry=self.photometry, sun_distance_au=self.sun_distance_au
            ),
            seed=frame.seed,
            detector=self.detector,
            options=SimulationOptions(rays_per_pixel_side=_STAR_IMAGE_RAYS if frame.star_image else _RAYS),
        )


def demo_camera() -> Camera:
    """Return a navigation camera of 1024 x 1024 pixels with the optics of NavCam 1 of OSIRIS-REx.

    The principal point is moved to the middle of the smaller frame; the detector values belong to no real camera.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Table 1.
    """
    return Camera(
        name="NAVCAM",
        columns=1024,
        rows=1024,
        model=BrownModel(
            fx_px=3473.3, fy_px=3473.4, cx_px=508.7, cy_px=515.2,
            k1=-0.539, k2=0.388, k3=-0.214, p1=2.55e-4, p2=8.64e-4,
        ),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=8.0, read_noise_e=12.0, saturation_dn=4095.0, bias_dn=100.0),
    )  # fmt: skip


def plan_approach(options: ApproachOptions = ApproachOptions()) -> Approach:
    """Plan the whole campaign: bodies, trajectories, attitudes, exposures and a priori errors.

    Parameters
    ----------
    options : ApproachOptions; visits, errors and exposures

    Returns
    -------
    Approach
        Each visit has a long exposure, a short one and another long one: the camera turns meanwhile, so the attitude
        of the short one is interpolated between the two.
    """
    camera = demo_camera()
    orbit = CircularOrbit(epoch_et=et_from_time(time_from_utc(_FIRST_DAY_UTC)))
    rock = irregular_body(options.seed, facets=options.facets, name="ROCK")
    moon = Ellipsoid(radii_km=np.array([208.0, 197.0, 190.0]), name="MOON")
    moon_orbit = replace(
        orbit, longitude_rad=-0.8, spin_period_s=81_000.0, epoch_et=orbit.epoch_et - 30 * SECONDS_PER_DAY
    )
    rng = np.random.default_rng([options.seed, 0])
    hot = HotPixels.draw(40, camera.columns, camera.rows, rng, median_e_s=400.0)
    planner = _Planner(camera=camera, sources=Sources(sun_distance_au=orbit.radius_au), options=options, rng=rng)
    frames: list[ApproachFrame] = []
    targets: list[Target] = []
    for name, shape, path, visits in (
        ("MOON", moon, moon_orbit, options.moon),
        ("ROCK", rock, orbit, options.approach),
    ):
        if visits:
            encounter = _Encounter.plan(name, shape, path, visits, camera)
            targets.append(encounter.target)
            frames += planner.frames(encounter, visits)
    return Approach(
        camera=camera,
        photometry=planner.sources.photometry,
        sun_distance_au=orbit.radius_au,
        detector=DetectorModel(hot_pixels=hot),
        targets=tuple(targets),
        frames=tuple(frames),
        options=options,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Encounter(Value):
    """A body and the spacecraft that visits it."""

    target: Target
    orbit: CircularOrbit
    spacecraft: Rendezvous
    scene: Scene = field(repr=False)

    @classmethod
    def plan(cls, name: str, shape: Shape, orbit: CircularOrbit, visits: Sequence[Visit], camera: Camera) -> _Encounter:
        times = [orbit.epoch_et + visit.day * SECONDS_PER_DAY for visit in visits]
        offsets = []
        for number, (et, visit) in enumerate(zip(times, visits, strict=True)):
            range_km = 2.0 * shape.mean_radius_km * camera.model.focal_length_px / visit.diameter_px
            offsets.append(
                range_km * _toward_camera(-orbit.state(et)[0], visit.phase_deg, _DIRECTION_STEP_DEG * number)
            )
        spacecraft = Rendezvous(orbit, times, np.array(offsets))
        target = Target(name=name, shape=shape, ephemeris=orbit)
        scene = Scene(targets=(target,), observer=spacecraft, light=FixedEphemeris())
        return cls(target=target, orbit=orbit, spacecraft=spacecraft, scene=scene)

    def observer(self, et: float) -> ObserverState:
        position, velocity = self.spacecraft.state(et)
        return ObserverState(position_km=position, velocity_km_s=velocity)

    def apparent_km(self, et: float) -> Float:
        """Apparent vector (3,) from camera to body, km, inertial axes."""
        position, velocity = self.spacecraft.state(et)
        return boosted(light_path(self.orbit, et, position)[0], velocity)


def _toward_camera(to_sun_km: Float, phase_deg: float, turn_deg: float) -> Float:
    """Unit vector (3,) from a body to a camera at a phase angle, turned about the direction of the Sun."""
    sun = unit(to_sun_km)
    first = unit(np.cross(sun, [0.0, 0.0, 1.0]))
    second = np.cross(sun, first)
    phase, turn = phase_deg * RAD_PER_DEG, turn_deg * RAD_PER_DEG
    return math.cos(phase) * sun + math.sin(phase) * (math.cos(turn) * first + math.sin(turn) * second)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Planner(Value):
    """Plan of frames from visits; everything random is drawn from one generator, in order."""

    camera: Camera
    sources: Sources
    options: ApproachOptions
    rng: np.random.Generator

    def frames(self, encounter: _Encounter, visits: Sequence[Visit]) -> Iterator[ApproachFrame]:
        """Yield a long, a short and a long exposure of each visit."""
        gap = self.options.pair_gap_s
        for number, visit in enumerate(visits):
            middle = encounter.orbit.epoch_et + visit.day * SECONDS_PER_DAY
            apparent_km = encounter.apparent_km(middle)
            attitudes = self._attitudes(apparent_km, encounter.target.shape)
            misalignment = None if visit.lost else self._misalignment()
            error_km = self._position_error_km(apparent_km)
            for label, et, attitude in zip(
                ("long1", "short", "long2"), (middle - gap, middle, middle + gap), attitudes, strict=True
            ):
                name = f"{encounter.target.name.lower()}_{number + 1:02d}_{label}.fits"
                yield self._frame(encounter, name, et, attitude, misalignment, error_km)

    def _frame(
        self,
        encounter: _Encounter,
        name: str,
        et: float,
        attitude: Rotation,
        misalignment: Rotation | None,
        error_km: Float,
    ) -> ApproachFrame:
        star_image = "long" in name
        observer = encounter.observer(et)
        shot = Shot(
            name=name,
            epoch=time_from_et(et),
            exposure_s=self.options.long_exposure_s,
            camera_from_inertial=attitude,
            observer=observer,
        )
        if not star_image:
            shot = replace(shot, exposure_s=self._short_exposure_s(shot, encounter))
        apparent = encounter.scene.apparent(make_black_image(shot, self.camera), encounter.target)
        assert isinstance(apparent, ApparentGeometry)
        emission = light_path(encounter.orbit, et, observer.position_km)[1]
        return ApproachFrame(
            shot=shot,
            scene=encounter.scene,
            target=encounter.target.name,
            star_image=star_image,
            seed=(self.options.seed, int(self.rng.integers(2**31))),
            apriori_camera_from_inertial=None if misalignment is None else misalignment * attitude,
            apriori_observer=replace(observer, position_km=observer.position_km - error_km),
            apriori_geometry=replace(
                apparent,
                position_inertial_km=apparent.position_inertial_km + error_km,
                velocity_inertial_km_s=encounter.orbit.state(emission)[1],
            ),
        )

    def _attitudes(self, apparent_km: Float, shape: Shape) -> tuple[Rotation, ...]:
        """True attitudes of the three images of a visit, with the body at a random position in the frame."""
        camera, options = self.camera, self.options
        reach_px = camera.model.focal_length_px * shape.circumscribing_radius_km / float(np.linalg.norm(apparent_km))
        free_px = max(min(camera.columns, camera.rows) / 2 - reach_px - options.frame_margin_px, 0.0)
        place_px = camera.center_px + self.rng.uniform(-_USED_PART, _USED_PART, 2) * free_px
        ra_deg, dec_deg = radec_from_direction(apparent_km)
        at_boresight = camera_from_inertial_of_pointing(float(ra_deg), float(dec_deg), self.rng.uniform(0.0, 360.0))
        middle = _turn_onto(camera.model.unproject(place_px)) * at_boresight
        steps = options.pair_gap_s * options.drift_arcsec_s * _random_direction(self.rng) + (
            options.jitter_arcsec_per_sqrt_s * math.sqrt(options.pair_gap_s) * self.rng.normal(size=(2, 3))
        )
        before, after = (Rotation.from_rotvec(step * RAD_PER_ARCSEC) for step in steps)
        return before.inv() * middle, middle, after * middle

    def _misalignment(self) -> Rotation:
        angle_deg = self.rng.uniform(*self.options.attitude_error_deg)
        return Rotation.from_rotvec(_random_direction(self.rng) * angle_deg * RAD_PER_DEG)

    def _position_error_km(self, apparent_km: Float) -> Float:
        """Error (3,) of the predicted vector from camera to body, inertial axes."""
        across = unit(np.cross(apparent_km, _random_direction(self.rng)))
        across_rad = self.options.position_error_px / self.camera.model.focal_length_px
        range_km = float(np.linalg.norm(apparent_km))
        along = self.rng.uniform(-self.options.range_error, self.options.range_error)
        return range_km * across_rad * across + along * apparent_km

    def _short_exposure_s(self, shot: Shot, encounter: _Encounter) -> float:
        """Exposure time that brings the brightest pixel of the body to the wanted fraction of full scale, s."""
        peak = visible_peak(shot, self.camera, encounter.scene, encounter.target.name)
        require(peak > 0, f"{shot.name}: {encounter.target.name} is not visible, so its exposure cannot be chosen")
        detector = self.camera.detector
        wanted_e = (
            self.options.peak_of_full_scale * (detector.saturation_dn - detector.bias_dn) * detector.gain_e_per_dn
        )
        exposure_s = wanted_e / (peak * self.sources.surface_rate_e_s(self.camera))
        return float(f"{min(exposure_s, self.options.longest_short_s):.3g}")


def _turn_onto(direction: Float) -> Rotation:
    """Smallest rotation that takes +z to a unit vector (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(axis))
    return Rotation.from_rotvec(axis * (math.atan2(sine, direction[2]) / sine if sine > 0 else 0.0))


def _random_direction(rng: np.random.Generator) -> Float:
    return unit(rng.normal(size=3))
