"""Plan of an image of the gauntlet: the true world, and the a priori data for the estimators."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.gauntlet.bodies import ROCKS, ellipsoid, rock
from giantlike.independent import Body, Defects, PinholeView, Psf, Recorder, Sampling, StarField, random_stars
from giantlike.shapes import Shape

FOCAL_PX, STAR_FOCAL_PX = 5000.0, 2500.0
"""Focal lengths of the cameras for bodies and for stars, px: fields of 3 to 6 and of 12 degrees."""
READ_NOISE_DN = 5.0  # read noise, DN (1 electron each), as in the other truths of the project
BIAS_DN, FULL_DN = 100.0, 16383.0  # value without light and largest value, DN, of a converter of 14 bits
PSF_PX = 0.7  # width of the point spread function, px: typical of cameras in use
ATTITUDE_SIGMA_DEG = 0.02
"""Sigma of the a priori attitude, deg about each axis: 1.7 px for bodies, as of a star tracker and its alignment."""
FOCAL_SIGMA, CENTER_SIGMA_PX = 5e-5, 0.02
"""Calibration of the camera: relative error of the focal length and error of its center, px, of a good calibration."""
EPHEMERIS_SIGMA = (5e-4, 2e-3)
"""Sigma of the ephemeris along each axis, as a fraction of the range, minimum and maximum: 2.5 to 10 px."""
LARGEST_SIGMAS = 3.0
"""Priors are normal and cut off here: the prediction stays within 30 px and 0.6 % of range, inside every search."""
DECLARED_SHARE = 0.75  # fraction of the images with a declared uncertainty of the ephemeris
SPEED_KM_S = 30.0  # speed of the observer, km/s, as of the Earth
FAINTEST_MAG, BRIGHTEST_MAG, STARS = 8.5, 2.0, 110
"""Star fields: about 70 stars in the frame, of signal-to-noise ratios from 40 up."""

RECORDER = Recorder(read_noise_e=READ_NOISE_DN, bias_dn=BIAS_DN, saturation_dn=FULL_DN)
"""The detector: one electron per DN."""

Light = Callable[[Float, "World", np.random.Generator], Float]
"""Light added or taken away before the detector: (signal DN, world, random numbers) to signal."""
Readout = Callable[[Float, np.random.Generator], Float]
"""Damage to the values of a detector: (pixels DN, random numbers) to pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class World(Value):
    """Truth of an image: camera, target, illumination, detector."""

    view: PinholeView  # the camera
    attitude: Rotation  # ``camera_from_inertial``
    body: Body | None = None  # the target; None where it is not in the image at all
    # of the target, whether it is in the image or not
    position_camera_km: Float = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    camera_from_body: Rotation = field(default_factory=Rotation.identity)
    # in camera axes; unit vector from the body to the Sun
    sun: Float = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    law: str = "mcewen"
    psf: Psf = field(default_factory=lambda: Psf(PSF_PX))
    sampling: Sampling | None = None
    peak_dn: float = 3000.0  # brightest pixel of the body
    sky: StarField | None = None
    velocity_km_s: Float = field(default_factory=lambda: np.zeros(3))  # in inertial axes; of the observer
    lights: tuple[Light, ...] = ()  # in their order, before the detector
    recorder: Recorder = RECORDER
    defects: Defects = field(default_factory=Defects)
    readouts: tuple[Readout, ...] = ()  # in their order, after the detector

    @property
    def range_km(self) -> float:
        """Distance of the target, km."""
        return float(np.linalg.norm(self.position_camera_km))

    @property
    def center_px(self) -> Float:
        """Center of the target, (2,), px."""
        return self.view.project(self.position_camera_km)

    @property
    def phase_rad(self) -> float:
        """Phase angle of the target, rad."""
        return math.acos(float(np.clip(-(self.sun @ self.position_camera_km) / self.range_km, -1.0, 1.0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Told(Value):
    """A priori data for the estimators, with declared uncertainties."""

    shape: Shape | None = None  # None without a target
    law: str = "mcewen"
    psf_px: float = PSF_PX
    # in true camera axes; prediction, before the error of the attitude
    position_camera_km: Float = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    camera_from_body: Rotation = field(default_factory=Rotation.identity)  # before the error of the attitude
    sun: Float = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))  # in true camera axes
    ephemeris_sigma_km: float = 0.0  # 0 where it is not declared
    scale_sigma: float = 0.0  # relative
    # assumed ``camera_from_inertial``, as a rotation from the true one: ``assumed = attitude_error * true``
    attitude_error: Rotation = field(default_factory=Rotation.identity)
    attitude_sigma_deg: float = ATTITUDE_SIGMA_DEG  # declared
    focal_factor: float = 1.0  # ratio of the assumed to the true focal length
    center_shift_px: Float = field(default_factory=lambda: np.zeros(2))  # assumed minus true center
    focal_sigma: float = FOCAL_SIGMA  # declared, relative
    saturation_dn: float = FULL_DN  # declared
    dn_scale: float = 1.0  # DN of the image for each DN of the detector: below 1 after requantization
    mask: Callable[[Float], Any] | None = None  # from pixels as read (rows, columns) to the mask of declared bad ones
    observer_known: bool = True  # False where the velocity of the observer is not declared
    observer_factor: float = 1.0  # ratio of the assumed to the true velocity
    catalog: StarField | None = None  # assumed stars


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan(Value):
    """An image to be made."""

    world: World
    told: Told
    hard: bool = False  # True where the drawn disturbance justifies a refusal

    def but(self, *, world: dict[str, Any] | None = None, told: dict[str, Any] | None = None, hard: bool) -> Plan:
        """Return a plan with some fields of the world and of the a priori data changed."""
        return Plan(
            world=replace(self.world, **world) if world else self.world,
            told=replace(self.told, **told) if told else self.told,
            hard=self.hard or hard,
        )


@dataclass(frozen=True, kw_only=True)
class Base:
    """Limits from which the undisturbed image is drawn."""

    diameter_px: tuple[float, float] = (20.0, 250.0)  # smallest and largest, log-uniform; rocks to ``LARGEST_ROCK_PX``
    phase_deg: tuple[float, float] = (5.0, 125.0)  # smallest and largest
    rocks: float = 0.3  # fraction of bodies of irregular shape
    points: float = 0.0  # fraction of bodies of 1 to 3 px
    declared: float = DECLARED_SHARE  # fraction of images with a declared uncertainty of the ephemeris
    largest_frame_px: int = 512  # side of the largest frame; smaller bodies have smaller ones


LARGEST_ROCK_PX = 130.0  # diameter of the largest rocks, px: their rays march, at 1 s for 150 px
POINT_PX = (1.0, 3.0)  # diameters of bodies that are points of light, px
_MARGIN, _LEAST_FRAME_PX, _STAR_FRAME_PX = 1.6, 256, 512  # ratio to the body; smallest; of the star camera, px


def normal(rng: np.random.Generator, size: int) -> Float:
    """Standard normal numbers (size,), cut off at :data:`LARGEST_SIGMAS`."""
    return np.clip(rng.normal(size=size), -LARGEST_SIGMAS, LARGEST_SIGMAS)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number evenly in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def body_plan(rng: np.random.Generator, base: Base) -> Plan:
    """Draw an undisturbed image of a body, and a priori errors within the declared uncertainty."""
    rocky = rng.uniform() < base.rocks
    diameter = log_uniform(rng, *base.diameter_px)
    if rocky:
        diameter = min(diameter, max(LARGEST_ROCK_PX, base.diameter_px[0]))
    point = rng.uniform() < base.points
    if point:
        rocky, diameter = False, log_uniform(rng, *POINT_PX)
    size = int(np.clip(_MARGIN * diameter + 76.0, _LEAST_FRAME_PX, base.largest_frame_px))
    view = PinholeView(FOCAL_PX, tuple(0.5 * (size - 1) + rng.uniform(-3.0, 3.0, 2)), size, size)
    figure: tuple[Body, Shape] = (
        rock(int(rng.integers(ROCKS)))
        if rocky
        else ellipsoid(10.0 * np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.8, 1.0)]))
    )
    body, shape = figure
    # Any position with the whole body in the frame, with a few pixels of sky around it.
    free = max(0.5 * size - 0.65 * diameter - 12.0, 2.0)
    sight = view.directions(0.5 * (size - 1) + rng.uniform(-free, free, 2))
    sight /= np.linalg.norm(sight)
    position = 2.0 * shape.mean_radius_km * FOCAL_PX / diameter * sight
    world = World(
        view=view,
        attitude=Rotation.random(rng=rng),
        body=body,
        position_camera_km=position,
        camera_from_body=Rotation.random(rng=rng),
        sun=sun_at(rng, sight, math.radians(rng.uniform(*base.phase_deg))),
        law=str(rng.choice(["mcewen", "mcewen", "lambert", "lommel_seeliger"])),
        sampling=Sampling(cells=2, edge_rays=3) if rocky else None,
        peak_dn=log_uniform(rng, 400.0, 8000.0),
        lights=(_level(rng.uniform(0.0, 60.0)),),
    )
    declared = rng.uniform() < base.declared
    sigma_km = log_uniform(rng, *EPHEMERIS_SIGMA) * world.range_km
    told = Told(
        shape=shape,
        law=world.law,
        psf_px=world.psf.sigma_px * float(1.0 + 0.03 * normal(rng, 1)[0]),
        position_camera_km=world.position_camera_km + sigma_km * normal(rng, 3),
        camera_from_body=world.camera_from_body,
        sun=world.sun,
        ephemeris_sigma_km=sigma_km if declared else 0.0,
        **_camera_and_attitude(rng),
    )
    return Plan(world=world, told=told)


def sun_at(rng: np.random.Generator, sight: Float, phase_rad: float) -> Float:
    """Unit vector (3,) to the Sun at a phase angle, on any side; ``sight``: unit vector to the body, camera axes."""
    side = np.cross(sight, [*rng.normal(size=2), 0.0])
    return -math.cos(phase_rad) * sight + math.sin(phase_rad) * side / np.linalg.norm(side)


def _level(level_dn: float) -> Light:
    return lambda signal, world, rng: signal + level_dn


def _camera_and_attitude(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "attitude_error": Rotation.from_rotvec(np.radians(ATTITUDE_SIGMA_DEG) * normal(rng, 3)),
        "focal_factor": float(1.0 + FOCAL_SIGMA * normal(rng, 1)[0]),
        "center_shift_px": CENTER_SIGMA_PX * normal(rng, 2),
    }


def star_plan(rng: np.random.Generator) -> Plan:
    """Draw an undisturbed image of stars, and a priori errors within the declared uncertainty."""
    size = _STAR_FRAME_PX
    view = PinholeView(STAR_FOCAL_PX, tuple(0.5 * (size - 1) + rng.uniform(-3.0, 3.0, 2)), size, size)
    attitude = Rotation.random(rng=rng)
    velocity = rng.normal(size=3)
    sky = random_stars(
        rng,
        STARS,
        axis=attitude.inv().as_matrix()[:, 2],
        radius_rad=1.15 * math.atan(size / STAR_FOCAL_PX / math.sqrt(2.0)),
        magnitudes=(BRIGHTEST_MAG, FAINTEST_MAG),
    )
    world = World(
        view=view,
        attitude=attitude,
        sky=sky,
        velocity_km_s=SPEED_KM_S * velocity / np.linalg.norm(velocity),
        lights=(_level(rng.uniform(10.0, 60.0)),),
    )
    return Plan(world=world, told=Told(catalog=sky, **_camera_and_attitude(rng)))
