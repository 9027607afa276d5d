"""Sequences of images of a rotating rock, for ``network.py`` and the tests of networks: truth, and what is told.

Not a benchmark itself. Images are of ``giantlike.independent``, which shares no code with what looks at them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.time import time_from_et
from giantlike.ephemeris import DistantLight
from giantlike.image import Image
from giantlike.independent import (
    PinholeView,
    Pose,
    Psf,
    Recorder,
    ReliefBody,
    SphereField,
    bumps,
    craters,
    record,
    render_body,
)
from giantlike.independent.render import Sampling
from giantlike.network import Rotating
from giantlike.ray_tracing import McEwen
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import TriangleMesh

RADII_KM = (10.0, 9.2, 8.6)
MEAN_KM = float(np.cbrt(np.prod(RADII_KM)))
READ_NOISE_DN = 5.0
PERIOD_S = 14_400.0
ET = 6e8
CELLS = 256
POLE_DEG = (80.0, 60.0)
SAMPLING = Sampling(cells=2, edge_rays=3)
"""Errors of the light are 5e-4 of the peak, rms: a third of the read noise."""


@dataclass(frozen=True, kw_only=True)
class Told:
    """How what is told differs from what is: one sigma each."""

    relief: float = 0.0
    """Heights that the shape lacks, of the radius."""
    albedo: float = 0.0
    law: str = "mcewen"
    timetag_s: float = 0.0
    focal: float = 0.0
    """Relative error of the focal length."""
    attitude_rad: float = 1e-5
    position_km: float = 0.2
    pole_deg: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Spinning:
    """Ephemeris of a rotating body at rest."""

    rotation: Rotating
    origin: str = "SOLAR SYSTEM BARYCENTER"

    def state(self, et: float) -> tuple[Float, Float]:
        """Position and velocity: none."""
        return np.zeros(3), np.zeros(3)

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation."""
        return self.rotation.inertial_from_body(et)


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Ephemeris of a camera of which places are known at some epochs."""

    places: dict[float, Float]
    origin: str = "SOLAR SYSTEM BARYCENTER"

    def state(self, et: float) -> tuple[Float, Float]:
        """Place at the nearest epoch."""
        return self.places[min(self.places, key=lambda known: abs(known - et))], np.zeros(3)

    def inertial_from_body(self, et: float) -> Rotation:
        """No orientation."""
        return Rotation.identity()


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequence:
    """Images, what is told, and the truth.

    heights, listed: of the body, and those that the shape has.
    attitudes, positions_km: true, inertial.
    """

    images: list[Image]
    camera: Camera
    scene: Scene
    body: ReliefBody
    heights: SphereField
    listed: SphereField
    attitudes: Rotation
    positions_km: Float
    rotation: Rotating
    view: PinholeView = field(repr=False)

    def true_point(self, point_km: Float) -> Float:
        """Points (n, 3) of the shape, moved along the radius to the true ground."""
        scaled = point_km / RADII_KM
        along = scaled / np.linalg.norm(scaled, axis=1)[:, None]
        factor = (1.0 + self.heights(along)) / (1.0 + self.listed(along))
        return np.asarray(point_km * factor[:, None])


@lru_cache(maxsize=4)
def rock(seed: int) -> tuple[SphereField, TriangleMesh]:
    """Heights of a body with craters, and the mesh of it."""
    heights = bumps(9000 + seed, rms=0.03, widths_deg=(10.0, 40.0), cells=CELLS)
    heights += craters(9100 + seed, depth=0.12, count=400, radii_deg=(2.0, 20.0), cells=CELLS)
    return heights, TriangleMesh(*ReliefBody(RADII_KM, heights).mesh(120), f"rock {seed}")


def sequence(
    seed: int,
    *,
    told: Told | None = None,
    images: int = 12,
    diameter_px: float = 200.0,
    phase_deg: float = 50.0,
    revolutions: float = 1.0,
    focal_px: float = 5000.0,
) -> Sequence:
    """Images of a rotating rock from nearly one place, poses drawn from their a priori."""
    told = told or Told()
    rng = np.random.default_rng([seed, 37])
    listed, mesh = rock(seed % 3)
    heights = listed + bumps(8000 + seed, rms=told.relief, widths_deg=(3.0, 15.0), count=150, cells=CELLS) \
        if told.relief else listed  # fmt: skip
    markings = bumps(7000 + seed, rms=told.albedo, widths_deg=(4.0, 25.0), cells=CELLS) if told.albedo else None
    body, size = ReliefBody(RADII_KM, heights, markings), int(1.5 * diameter_px)
    middle = (0.5 * (size - 1), 0.5 * (size - 1))
    view = PinholeView(focal_px, middle, size, size)
    rate = 360.0 * 86400.0 / PERIOD_S
    rotation = Rotating(
        pole_ra_deg=np.array(POLE_DEG[:1]), pole_dec_deg=np.array(POLE_DEG[1:]),
        pm_deg=np.array([-rate * ET / 86400.0 % 360.0, rate]),
    )  # fmt: skip
    range_km = 2.0 * MEAN_KM * focal_px / diameter_px
    pole = rotation.inertial_from_body(ET).as_matrix()[:, 2]
    aside = np.cross(pole, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    ets = ET + revolutions * PERIOD_S * (np.arange(images) + 0.5) / images
    positions, attitudes, pictures, places, shots = [], [], list[Image](), dict[float, Float](), []
    for k, et in enumerate(ets):
        latitude = math.radians(25.0) * math.sin(2.0 * math.pi * (k * 0.38 + rng.uniform(-0.05, 0.05)))
        away = math.cos(latitude) * aside + math.sin(latitude) * pole
        position = range_km * (away + 0.02 * rng.normal(size=3))
        z = -position / np.linalg.norm(position) + 0.002 * rng.normal(size=3)
        z /= np.linalg.norm(z)
        x = np.cross(pole, z)
        x /= np.linalg.norm(x)
        attitude = Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
        side = np.cross(away, pole)
        sun = math.cos(math.radians(phase_deg)) * aside + math.sin(math.radians(phase_deg)) * side / np.linalg.norm(
            side
        )
        exposed = et + told.timetag_s * rng.normal()
        camera_from_body = attitude * rotation.inertial_from_body(exposed)
        signal = render_body(
            body, view, Pose(attitude.apply(-position), camera_from_body, attitude.apply(sun)), law=told.law,
            psf=Psf(sigma_px=0.7), sampling=SAMPLING,
        )  # fmt: skip
        shots.append(record(signal, rng, Recorder(read_noise_e=READ_NOISE_DN)).pixels)
        positions.append(position)
        attitudes.append(attitude)
        places[float(et)] = position - told.position_km * rng.normal(size=3)
    camera = Camera(
        name="sequence",
        columns=size,
        rows=size,
        model=PinholeModel(
            fx_px=focal_px * (1.0 + told.focal * rng.normal()), fy_px=focal_px, cx_px=middle[0], cy_px=middle[1]
        ),
        psf=GaussianPsf(sigma_px=0.7),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=READ_NOISE_DN),
    )
    for k, et in enumerate(ets):
        error = told.attitude_rad * rng.normal(size=3)
        pictures.append(
            Image(
                name=f"image {k:02d}",
                pixels=shots[k].astype(np.float32),
                epoch=time_from_et(float(et)),
                camera_from_inertial=Rotation.from_rotvec(-error) * attitudes[k],
                attitude_covariance_rad2=told.attitude_rad**2 * np.eye(3),
            )
        )
    turned = rng.normal(size=2) * told.pole_deg
    declared = Rotating(
        pole_ra_deg=rotation.pole_ra_deg + turned[0] / math.cos(math.radians(POLE_DEG[1])),
        pole_dec_deg=rotation.pole_dec_deg + turned[1],
        pm_deg=rotation.pm_deg,
    )
    target = Target(
        name="ROCK", shape=mesh, ephemeris=Spinning(declared), reflectance=McEwen(),
        uncertainty=TargetUncertainty(ephemeris_km=told.position_km),
    )  # fmt: skip
    return Sequence(
        images=pictures,
        camera=camera,
        scene=Scene(targets=(target,), observer=Places(places), light=DistantLight(sun)),
        body=body,
        heights=heights,
        listed=listed,
        attitudes=Rotation.concatenate(attitudes),
        positions_km=np.array(positions),
        rotation=rotation,
        view=view,
    )
