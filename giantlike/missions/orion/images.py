"""Made-up images of the Moon and the Earth, as Figs. 9 and 10 show them, and the package's own estimators on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.cislunar.body_measurements import disk_diameter
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.independent import (
    EllipsoidBody,
    PinholeView,
    Pose,
    Psf,
    Recorder,
    ReliefBody,
    SphereField,
    bumps,
    record,
    render_body,
)
from giantlike.missions.orion.constants import EARTH_KM, MOON_KM, focal_px
from giantlike.ray_tracing import McEwen
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid

PSF_PX = 0.7  # one sigma: the lens is staked slightly out of focus so that light of a point falls on several pixels
PEAK_DN = 3000.0  # of 4095 of a 12 bit detector: exposures that do not saturate
READ_NOISE_DN = 5.0
PREDICTION_PX, PREDICTION_RANGE = 4.0, 0.005  # errors of the prediction that an estimator starts from
FIELDS = 6  # different made-up reliefs: tables of the sphere cost more than images


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedScene:
    """Scene of a simulated image.

    ``relief_km`` is the root mean square of heights; the estimator assumes a sphere in any case.
    """

    body: str
    range_km: float
    phase_deg: float
    relief_km: float = 0.0
    seed: int = 0

    @property
    def radius_km(self) -> float:
        """Of the sphere."""
        return EARTH_KM if self.body == "Earth" else MOON_KM

    @property
    def radius_px(self) -> float:
        """Of the disk in the image."""
        return float(focal_px() * disk_diameter(self.range_km, self.radius_km) / 2.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photograph(Value):
    """An image with its truth."""

    view: ImagedScene
    image: Image
    camera: Camera
    scene: Scene
    position_camera_km: Float
    sun_direction_image: Float


def photograph(view: ImagedScene) -> Photograph:
    """Take an image by the independent renderer: attitude, Sun, place, noise and prediction by the seed."""
    rng = np.random.default_rng([view.seed, round(view.range_km), round(view.phase_deg)])
    camera = _camera(view.radius_px)
    middle = (camera.columns - 1) / 2.0
    center = middle + rng.uniform(-2.0, 2.0, 2)
    position = view.range_km * unit(np.array([*(center - middle) / focal_px(), 1.0]))
    azimuth, phase = rng.uniform(0.0, 2.0 * math.pi), math.radians(view.phase_deg)
    side = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    sight = unit(position)
    sun = -math.cos(phase) * sight + math.sin(phase) * unit(side - (side @ sight) * sight)
    turned = Rotation.from_quat(rng.normal(size=4))
    radii = np.full(3, view.radius_km)
    if view.relief_km > 0.0:
        body: EllipsoidBody | ReliefBody = ReliefBody(
            radii, _relief(view.seed % FIELDS, view.relief_km / view.radius_km)
        )
    else:
        body = EllipsoidBody(radii)
    light = render_body(
        body,
        PinholeView(focal_px(), (middle, middle), camera.columns, camera.rows),
        Pose(position, turned, sun),
        peak_dn=PEAK_DN,
        psf=Psf(PSF_PX),
    )
    seen = record(light, rng, Recorder(read_noise_e=READ_NOISE_DN, saturation_dn=4095.0))
    angle = rng.uniform(0.0, 2.0 * math.pi)
    off = PREDICTION_PX / focal_px() * view.range_km * np.array([math.cos(angle), math.sin(angle), 0.0])
    predicted = (position + off) * (1.0 + PREDICTION_RANGE * rng.choice([-1.0, 1.0]))
    geometry = ApparentGeometry(
        position_inertial_km=predicted, inertial_from_body=turned.inv(), sun_direction_inertial=sun
    )
    target = Target(name=view.body.upper(), shape=Ellipsoid(radii_km=radii), ephemeris=geometry, reflectance=McEwen())
    return Photograph(
        view=view,
        image=Image(pixels=seen.pixels.astype(np.int16), camera_from_inertial=Rotation.identity(), name=view.body),
        camera=camera,
        scene=Scene(targets=(target,)),
        position_camera_km=position,
        sun_direction_image=unit(sun[:2]),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimatorErrors(Value):
    """Result of an estimator on an image: errors along and across the Sun and of the radius, px; NaN where it refuses.

    ``suspect`` is True where a fix is flagged, or refused.
    """

    view: ImagedScene
    estimator: str
    errors_px: Float
    sigmas_px: Float
    suspect: bool


def measure_errors(taken: Photograph, estimator: str) -> EstimatorErrors:
    """Estimate the center and the range of the body, and compare with the truth."""
    fix = ESTIMATORS[estimator]().estimate(taken.image, taken.camera, taken.scene)
    nothing = np.full(3, np.nan)
    if isinstance(fix, Failure) or not isinstance(fix, PositionFix):
        return EstimatorErrors(view=taken.view, estimator=estimator, errors_px=nothing, sigmas_px=nothing, suspect=True)
    along = taken.sun_direction_image
    axes = np.array([along, [-along[1], along[0]]])
    center = axes @ (fix.center_px - taken.camera.model.project(taken.position_camera_km))
    found = focal_px() * disk_diameter(float(np.linalg.norm(fix.position_camera_km)), taken.view.radius_km) / 2.0
    sight = unit(fix.position_camera_km)
    radius_sigma = taken.view.radius_px * math.sqrt(sight @ fix.covariance_camera_km2 @ sight) / fix.range_km
    spread = np.sqrt(np.diag(axes @ fix.covariance_px2 @ axes.T))
    return EstimatorErrors(
        view=taken.view,
        estimator=estimator,
        errors_px=np.array([*center, found - taken.view.radius_px]),
        sigmas_px=np.array([*spread, radius_sigma]),
        suspect=fix.flags.suspect,
    )


def _camera(radius_px: float) -> Camera:
    """A window of Orion's camera around the body."""
    size = 2 * math.ceil(radius_px + 30.0)
    middle = (size - 1) / 2.0
    return Camera(
        name="Orion",
        columns=size,
        rows=size,
        model=PinholeModel(fx_px=focal_px(), fy_px=focal_px(), cx_px=middle, cy_px=middle),
        psf=GaussianPsf(sigma_px=PSF_PX),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=READ_NOISE_DN, saturation_dn=4095.0),
    )


@cache
def _relief(number: int, rms: float) -> SphereField:
    """Heights of a made-up Moon, in radii: bumps and hollows of 2 to 20 degrees."""
    return bumps(number, rms=rms, count=150, widths_deg=(2.0, 20.0))
