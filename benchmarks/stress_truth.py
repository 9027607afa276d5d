"""Bodies seen under wrong models, for ``stress.py``: images from the independent truth, and what an estimator is told.

Not a benchmark itself. A view is rendered once by ``giantlike.independent``, which shares no code with the estimators;
draws of it have their own noise and their own error of the prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from giantlike.atmosphere import Atmosphere
from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.bodies import TOLD_LAWS
from giantlike.image import Image
from giantlike.independent import (
    Defects,
    EllipsoidBody,
    Haze,
    PinholeView,
    Pose,
    Psf,
    Recorder,
    ReliefBody,
    SphereField,
    background,
    bumps,
    craters,
    hazy_sphere,
    record,
    render_body,
)
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh

RADII_KM = (10.0, 9.2, 8.6)
MEAN_KM = float(np.cbrt(np.prod(RADII_KM)))
FOCAL_PX = 5000.0
READ_NOISE_DN = 5.0
PEAK_DN = 3000.0
ATTITUDE = Rotation.from_rotvec([0.3, -1.0, 0.4])
ERROR_PX, RANGE_ERROR = 4.0, 0.01
MESH_CELLS = 160
TRAIL_PX = 5.0
"""Decay length of charge-transfer trails."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A kind of image, and how what is told differs from what is."""

    name: str
    diameter_px: float = 120.0
    phases_deg: tuple[float, ...] = (15.0, 60.0, 90.0, 125.0)
    body: str = "ellipsoid"
    law: str = "mcewen"
    told_law: str = "mcewen"
    relief: float = 0.0
    albedo: float = 0.0
    psf: Psf = field(default_factory=Psf)
    told_psf_px: float = 0.7
    level_dn: float = 0.0
    slope_dn: tuple[float, float] = (0.0, 0.0)
    saturation_dn: float = math.inf
    told_saturation: bool = True
    dead_columns: int = 0
    oval: float = 1.0
    """Width of the point spread function along columns over that along rows."""
    trail_share: float = 0.0
    """Share of the charge that is left behind along the rows, with a decay length of ``TRAIL_PX``."""
    jpeg_quality: int = 0
    """Quality of the 8-bit JPEG that the image is, without a declared detector; 0 where it is none."""
    undeclared_spin_deg: float = 0.0
    pole_error_deg: float = 0.0
    attitude_error_deg: float = 0.0
    frame_px: int = 0
    mesh_cells: int = MESH_CELLS
    haze: Haze | None = None
    """Around a sphere of the mean radius."""
    told_haze_sigma_km: float = 0.0
    """Of the altitude of the limb, by which the haze is told; 0 where it is not."""
    estimators: tuple[str, ...] = ()
    options: str = ""
    observed: bool = False
    """Compare observed less computed with the sum of all parts: attitude and camera count."""

    @property
    def size_px(self) -> int:
        """Side of the frame."""
        return self.frame_px or int(max(160.0, 1.5 * self.diameter_px + 76.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """A view without noise, and the truth of it."""

    case: Case
    number: int
    phase_deg: float
    signal_dn: Float
    camera: Camera
    shape: Shape
    position_camera_km: Float
    center_px: Float
    camera_from_body: Rotation
    sun: Float
    attitude: Rotation = ATTITUDE


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """An image and the scene as it is believed to be."""

    seen: Seen
    image: Image
    scene: Scene


@lru_cache
def _rock(seed: int, cells: int) -> tuple[SphereField, TriangleMesh]:
    """Heights of a body with craters, and the mesh of it."""
    heights = bumps(9000 + seed, rms=0.03, widths_deg=(10.0, 40.0))
    heights += craters(9100 + seed, depth=0.1, count=250, radii_deg=(2.0, 20.0))
    return heights, TriangleMesh(*ReliefBody(RADII_KM, heights).mesh(cells), f"rock {seed}")


def _figure(case: Case, number: int) -> tuple[EllipsoidBody | ReliefBody, Shape]:
    """The body, and the shape that is told."""
    markings = bumps(7000 + number, rms=case.albedo, widths_deg=(4.0, 25.0)) if case.albedo else None
    unlisted = bumps(8000 + number, rms=case.relief, widths_deg=(3.0, 15.0), count=150) if case.relief else None
    if case.haze is not None:
        return EllipsoidBody(MEAN_KM), Ellipsoid(radii_km=np.full(3, MEAN_KM))
    if case.body == "ellipsoid":
        told = Ellipsoid(radii_km=np.array(RADII_KM))
        if unlisted is None:
            return EllipsoidBody(RADII_KM, markings), told
        return ReliefBody(RADII_KM, unlisted, markings), told
    listed, mesh = _rock(number % 3, case.mesh_cells)
    return ReliefBody(RADII_KM, listed if unlisted is None else listed + unlisted, markings), mesh


def view_of(case: Case, number: int, rendered_dn: Float | None = None) -> Seen:
    """Render a view of a case: another place, pose, Sun and body for each number; or take what was rendered before."""
    rng = np.random.default_rng([number, 4711])
    size, phase_deg = case.size_px, case.phases_deg[number % len(case.phases_deg)]
    middle = (0.5 * (size - 1) + 1.5, 0.5 * (size - 1) - 2.5)
    view = PinholeView(FOCAL_PX, middle, size, size)
    place = 0.5 * (size - 1) + rng.uniform(-1.5, 1.5, 2)
    if case.diameter_px > size:  # the limb towards the Sun crosses the frame
        place = place + np.array([0.5 * case.diameter_px, 0.0]) * rng.choice([-1.0, 1.0])
    sight = view.directions(place)
    sight /= np.linalg.norm(sight)
    position = 2.0 * MEAN_KM * FOCAL_PX / case.diameter_px * sight
    side = np.cross(sight, [*rng.normal(size=2), 0.0])
    if case.diameter_px > size:
        side = np.array([0.5 * (size - 1) - place[0], 0.3 * rng.normal() * case.diameter_px, 0.0])
        side -= (side @ sight) * sight
    side /= np.linalg.norm(side)
    phase = math.radians(phase_deg)
    sun = -math.cos(phase) * sight + math.sin(phase) * side
    turn = Rotation.random(rng=rng)
    body, told = _figure(case, number)
    signal = rendered_dn
    if signal is None:
        if case.haze is None:
            signal = render_body(body, view, Pose(position, turn, sun), law=case.law, psf=case.psf)
        else:
            signal = hazy_sphere(MEAN_KM, case.haze, view, Pose(position, turn, sun), law=case.law, psf=case.psf)
            signal *= PEAK_DN / signal.max()
        signal = trailed(widened(signal, case), case.trail_share)
        signal += background((size, size), constant_dn=case.level_dn, slope_dn=case.slope_dn)
    camera = Camera(
        name="stress",
        columns=size,
        rows=size,
        model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=middle[0], cy_px=middle[1]),
        psf=GaussianPsf(sigma_px=case.told_psf_px),
        detector=Detector()
        if case.jpeg_quality
        else Detector(
            gain_e_per_dn=1.0,
            read_noise_e=READ_NOISE_DN,
            saturation_dn=case.saturation_dn if case.told_saturation else math.inf,
        ),
    )
    return Seen(
        case=case,
        number=number,
        phase_deg=phase_deg,
        signal_dn=signal,
        camera=camera,
        shape=told,
        position_camera_km=position,
        center_px=view.project(position),
        camera_from_body=turn,
        sun=sun,
    )


def widened(signal_dn: Float, case: Case) -> Float:
    """Image (h, w) with a point spread function that is oval."""
    if case.oval == 1.0:
        return signal_dn
    return np.asarray(gaussian_filter1d(signal_dn, case.psf.sigma_px * math.sqrt(case.oval**2 - 1.0), axis=1))


def trailed(signal_dn: Float, share: float) -> Float:
    """Image (h, w) of which a share of the charge arrives late, in an exponential trail along the rows."""
    decay = math.exp(-1.0 / TRAIL_PX)
    late = lfilter([0.0, 1.0 - decay], [1.0, -decay], signal_dn, axis=1)
    return np.asarray((1.0 - share) * signal_dn + share * late)


def jpeg(pixels_dn: Float, quality: int) -> NDArray[np.uint8]:
    """Image (h, w) of 8 bits after compression, its peak near 230."""
    values = np.clip(np.rint(230.0 / PEAK_DN * pixels_dn + 8.0), 0.0, 255.0).astype(np.uint8)
    _, data = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def draw_of(seen: Seen, seed: int) -> Draw:
    """Expose a view, and make the scene with errors of the prediction; sigmas of what is wrong on purpose are told."""
    case = seen.case
    rng = np.random.default_rng([seen.number, seed, 815])
    center = seen.center_px
    columns = tuple(int(x) for x in np.round(center[0] + np.linspace(-0.3, 0.35, case.dead_columns) * case.diameter_px))
    recorder = Recorder(read_noise_e=READ_NOISE_DN, saturation_dn=case.saturation_dn)
    shot = record(seen.signal_dn, rng, recorder, Defects(dead_columns=columns))
    predicted = center + rng.uniform(-ERROR_PX, ERROR_PX, 2)
    sight = seen.camera.model.unproject(predicted)
    distance = float(np.linalg.norm(seen.position_camera_km)) * (1.0 + rng.uniform(-RANGE_ERROR, RANGE_ERROR))
    wrong = Rotation.from_rotvec(np.radians(case.pole_error_deg) * rng.normal(size=3))
    wrong = wrong * seen.camera_from_body * Rotation.from_rotvec([0.0, 0.0, math.radians(case.undeclared_spin_deg)])
    turned = Rotation.from_rotvec(np.radians(case.attitude_error_deg) * rng.normal(size=3))
    back = seen.attitude.inv()
    geometry = ApparentGeometry(
        position_inertial_km=back.apply(distance * sight),
        inertial_from_body=back * wrong,
        sun_direction_inertial=back.apply(seen.sun),
    )
    target = Target(
        name="BODY",
        shape=seen.shape,
        ephemeris=geometry,
        reflectance=TOLD_LAWS[case.told_law],
        atmosphere=None
        if case.haze is None or not case.told_haze_sigma_km
        else Atmosphere(
            scale_height_km=case.haze.scale_height_km,
            optical_depth=case.haze.vertical_depth,
            sigma_km=case.told_haze_sigma_km,
        ),
        uncertainty=TargetUncertainty(
            pole_rad=math.radians(case.pole_error_deg), spin_rad=math.radians(case.pole_error_deg)
        ),
    )
    image = Image(
        pixels=jpeg(shot.pixels, case.jpeg_quality) if case.jpeg_quality else shot.pixels.astype(np.float32),
        camera_from_inertial=turned * seen.attitude,
        attitude_covariance_rad2=np.radians(case.attitude_error_deg) ** 2 * np.eye(3)
        if case.attitude_error_deg
        else None,
        name=f"{case.name} {seen.number} {seed}",
    )
    return Draw(seen=seen, image=image, scene=Scene(targets=(target,)))


ELLIPSOID = ("cross_correlation", "limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit", "moment", "auto")
"""Estimators for ellipsoids."""
LIMBS = ("limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit")
ROCK = ("cross_correlation", "limb_matching", "moment", "auto")
"""Estimators for meshes."""
HAZE = Haze(scale_height_km=0.05, vertical_depth=0.05)
"""0.3 px of scale height; along the limb the optical depth is 1.7 at the ground."""
THICK_HAZE = Haze(scale_height_km=0.15, vertical_depth=0.2)
"""1 px of scale height, and an optical depth of 4 along the limb at the ground."""
_BASE = Case(name="exact", estimators=ELLIPSOID)


def _pairs() -> list[Case]:
    """Law pairs: rendered, and told."""
    rendered = [
        ("lommel_seeliger", "lambert"),
        ("lommel_seeliger", "mcewen"),
        ("lambert", "mcewen"),
        ("hapke", "mcewen"),
        ("minnaert", "mcewen"),
        ("mcewen", "lambert"),
        ("hapke", "lambert"),
    ]
    return [replace(_BASE, name=f"law {law} told {told}", law=law, told_law=told) for law, told in rendered]


CASES: tuple[Case, ...] = (
    _BASE,
    replace(_BASE, name="exact rock", body="rock", estimators=ROCK),
    replace(_BASE, name="exact 300 px", diameter_px=300.0),
    replace(
        _BASE,
        name="exact rock, 250 px",
        body="rock",
        diameter_px=250.0,
        phases_deg=(30.0, 60.0, 90.0),
        estimators=("surface_features",),
    ),
    replace(
        _BASE,
        name="law lommel_seeliger rock, 250 px",
        body="rock",
        diameter_px=250.0,
        phases_deg=(30.0, 60.0, 90.0),
        law="lommel_seeliger",
        estimators=("surface_features",),
    ),
    replace(
        _BASE,
        name="plane rock, 250 px",
        body="rock",
        diameter_px=250.0,
        phases_deg=(30.0, 60.0, 90.0),
        level_dn=200.0,
        slope_dn=(200.0, 100.0),
        estimators=("surface_features",),
    ),
    replace(_BASE, name="plane", level_dn=200.0, slope_dn=(200.0, 100.0)),
    replace(_BASE, name="plane rock", body="rock", estimators=ROCK, level_dn=200.0, slope_dn=(200.0, 100.0)),
    *_pairs(),
    replace(_BASE, name="law lommel_seeliger rock", body="rock", estimators=ROCK, law="lommel_seeliger"),
    replace(_BASE, name="law lambert 300 px", diameter_px=300.0, law="lambert"),
    replace(_BASE, name="psf wings", psf=Psf(0.7, wing_share=0.1, wing_sigma_px=4.0)),
    replace(_BASE, name="psf told 30 % wide", told_psf_px=0.91),
    replace(_BASE, name="psf told 30 % narrow", told_psf_px=0.49),
    replace(_BASE, name="saturated, declared", saturation_dn=2000.0),
    replace(_BASE, name="saturated, not declared", saturation_dn=2000.0, told_saturation=False),
    replace(_BASE, name="dead columns, not masked", dead_columns=3),
    replace(_BASE, name="dead columns, 30 px", diameter_px=30.0, dead_columns=2),
    replace(_BASE, name="pole 2 deg off", pole_error_deg=2.0),
    replace(_BASE, name="pole 2 deg off, rock", body="rock", estimators=ROCK, pole_error_deg=2.0),
    replace(_BASE, name="attitude 0.01 deg off", attitude_error_deg=0.01, observed=True),
    replace(_BASE, name="relief 1 % unlisted", relief=0.01),
    replace(_BASE, name="relief 1 % unlisted, rock", body="rock", estimators=ROCK, relief=0.01),
    replace(_BASE, name="albedo 15 %", albedo=0.15),
    replace(_BASE, name="albedo 15 %, rock", body="rock", estimators=ROCK, albedo=0.15),
    replace(_BASE, name="30 px", diameter_px=30.0),
    replace(_BASE, name="30 px, 125 deg", diameter_px=30.0, phases_deg=(125.0,)),
    replace(_BASE, name="30 px, law lambert", diameter_px=30.0, law="lambert"),
    replace(
        _BASE,
        name="larger than the frame",
        diameter_px=1000.0,
        frame_px=512,
        phases_deg=(30.0, 60.0, 90.0),
        estimators=(*LIMBS, "cross_correlation", "auto"),
    ),
    replace(
        _BASE,
        name="unresolved",
        diameter_px=2.0,
        phases_deg=(0.0, 60.0, 120.0, 150.0),
        estimators=("unresolved", "moment", "auto"),
    ),
    replace(
        _BASE,
        name="unresolved, law lambert",
        diameter_px=2.0,
        law="lambert",
        phases_deg=(0.0, 60.0, 120.0, 150.0),
        estimators=("unresolved", "auto"),
    ),
    replace(_BASE, name="facets of 3 px rock", body="rock", estimators=ROCK, mesh_cells=32),
    replace(_BASE, name="facets of 6 px rock", body="rock", estimators=ROCK, mesh_cells=16),
    replace(_BASE, name="haze told", haze=HAZE, told_haze_sigma_km=0.5 * HAZE.scale_height_km),
    replace(_BASE, name="haze not told", haze=HAZE),
    replace(
        _BASE,
        name="haze told with twilight",
        haze=replace(HAZE, twilight=True),
        told_haze_sigma_km=0.5 * HAZE.scale_height_km,
    ),
    replace(_BASE, name="haze not told, thick", haze=THICK_HAZE),
    replace(_BASE, name="trails 2 %", trail_share=0.02),
    replace(_BASE, name="trails 2 %, rock", body="rock", estimators=ROCK, trail_share=0.02),
    replace(_BASE, name="psf oval 1.3", oval=1.3),
    replace(_BASE, name="psf oval 1.3, rock", body="rock", estimators=ROCK, oval=1.3),
    replace(_BASE, name="spin 3 deg off, not told", undeclared_spin_deg=3.0),
    replace(_BASE, name="spin 3 deg off, not told, rock", body="rock", estimators=ROCK, undeclared_spin_deg=3.0),
    replace(_BASE, name="jpeg 85", jpeg_quality=85),
    replace(_BASE, name="saturated, 30 px", diameter_px=30.0, saturation_dn=2000.0),
    replace(_BASE, name="edges step", estimators=LIMBS[:1], options="step"),
    replace(_BASE, name="edges step, law lambert", estimators=LIMBS[:1], options="step", law="lambert"),
)
