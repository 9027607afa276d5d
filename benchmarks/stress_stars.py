"""Star fields and calibrated cameras under wrong models, for ``stress.py``: not a benchmark itself.

Stars, their images and the directions of a calibration come from ``giantlike.independent``, which shares no code with
detection, identification, attitude and camera models.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from stress_truth import RADII_KM, READ_NOISE_DN, Case, Draw, Seen, draw_of

from giantlike.calibration import ImageObservations, calibrate
from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.catalogs import MemoryCatalog
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.time import time_from_et
from giantlike.gauntlet.stage import catalog_of
from giantlike.image import Image, ObserverState
from giantlike.independent import (
    EllipsoidBody,
    PinholeView,
    Pose,
    Psf,
    Recorder,
    StarField,
    background,
    random_stars,
    record,
    render_body,
    star_image,
)
from giantlike.shapes import Ellipsoid
from giantlike.stars import StarNavigation

SIZE, FOCAL_PX = 1024, 5000.0
VIEW = PinholeView(FOCAL_PX, (513.0, 509.0), SIZE, SIZE)
AU_KM, SPEED_KM_S = 1.495978707e8, 30.0
EPOCH = time_from_et(5.05e8)  # 2016.0, the epoch of the catalog
CATALOG_MAGNITUDE = 9.0
FEW = 24  # of which about half lie in the frame
WAVES = 200
CALIBRATION_IMAGES, STARS_AN_IMAGE, CENTROID_PX = 5, 30, 0.1


@dataclass(frozen=True, kw_only=True)
class StarCase:
    """A kind of star image."""

    name: str
    stars: int = 80
    faintest: float = CATALOG_MAGNITUDE
    slope_dn: tuple[float, float] = (0.0, 0.0)
    level_dn: float = 50.0
    observer: bool = True
    brightest: float = 2.0
    guide: float = 0.0
    """Magnitude of one star near the middle that is far brighter than the others; 0 for none."""
    shared_px: float = 0.0
    shared_length_px: float = 300.0
    """Distortion that nobody told: standard deviation per axis, and length over which neighbors share it."""
    psf: Psf = field(default_factory=Psf)
    estimators: tuple[str, ...] = ("stars",)


STAR_CASES = (
    StarCase(name="stars exact"),
    StarCase(name="stars ramp 2 DN/px", slope_dn=(2.0 * SIZE, 0.0), level_dn=1100.0),
    StarCase(name="stars crowded", stars=6000, faintest=12.0),
    StarCase(name="stars observer unknown", observer=False),
    StarCase(name="12 stars", stars=FEW),
    StarCase(name="12 stars distorted over 300 px", stars=FEW, shared_px=0.3),
    StarCase(name="12 stars distorted over 600 px", stars=FEW, shared_px=0.3, shared_length_px=600.0),
    StarCase(name="stars distorted over 300 px", shared_px=0.3),
    StarCase(name="stars distorted over 600 px", shared_px=0.3, shared_length_px=600.0),
    StarCase(name="120 stars", stars=240),
    StarCase(name="120 stars distorted over 600 px", stars=240, shared_px=0.3, shared_length_px=600.0),
    StarCase(name="12 stars one bright", stars=FEW, brightest=8.0, guide=4.0),
    StarCase(name="12 stars one bright distorted", stars=FEW, brightest=8.0, guide=4.0, shared_px=0.05),
    StarCase(name="12 stars wings", stars=FEW, psf=Psf(0.7, wing_share=0.1, wing_sigma_px=4.0)),
    StarCase(name="12 stars 1.2 px told 0.7", stars=FEW, psf=Psf(1.2)),
    StarCase(name="12 stars smeared by 2 px", stars=FEW, psf=Psf(motion_px=(1.6, 1.2))),
    StarCase(name="12 stars smeared by 5 px", stars=FEW, psf=Psf(motion_px=(4.0, 3.0))),
    StarCase(name="stars smeared by 5 px", psf=Psf(motion_px=(4.0, 3.0))),
)
CORNER_CASE = Case(
    name="camera of 150 stars, body in a corner",
    observed=True,
    estimators=("cross_correlation", "limb_matching", "ellipsoid_cra", "sigmoid_limb"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class StarSeen:
    """A star field before the camera, without noise."""

    number: int
    signal_dn: Float
    camera: Camera
    catalog: MemoryCatalog
    attitude: Rotation
    velocity_km_s: Float


class WarpedView(PinholeView):
    """The camera with a smooth distortion of its own: a field of random waves, whose correlation is a Gaussian."""

    def __init__(self, rng: np.random.Generator, size_px: float, length_px: float) -> None:
        super().__init__(VIEW.focal_px, VIEW.center_px, SIZE, SIZE)
        waves = (rng.normal(scale=1.0 / length_px, size=(2, WAVES, 2)), rng.uniform(0.0, 2.0 * math.pi, (2, WAVES)))
        object.__setattr__(self, "_waves", waves)
        object.__setattr__(self, "_size_px", size_px * math.sqrt(2.0 / WAVES))

    def project(self, vectors_camera: ArrayLike) -> Float:
        """Return the pixels (..., 2) of vectors (..., 3) in camera axes."""
        places = super().project(vectors_camera)
        vectors, phases = self._waves  # type: ignore[attr-defined]
        shifts = [np.cos(places @ wave.T + phase).sum(axis=-1) for wave, phase in zip(vectors, phases, strict=True)]
        return places + self._size_px * np.stack(shifts, axis=-1)  # type: ignore[attr-defined]


def _catalog(field: StarField) -> MemoryCatalog:
    known = field.magnitudes <= CATALOG_MAGNITUDE
    return catalog_of(StarField(directions=field.directions[known], magnitudes=field.magnitudes[known]))


def star_view(case: StarCase, number: int) -> StarSeen:
    """Render a star field: another sky, attitude and velocity for each number."""
    rng = np.random.default_rng([number, 31])
    attitude = Rotation.random(rng=rng)
    axis = attitude.inv().as_matrix()[:, 2]
    reach = 1.1 * math.atan(SIZE / FOCAL_PX / math.sqrt(2.0))
    field = random_stars(rng, case.stars, axis=axis, radius_rad=reach, magnitudes=(case.brightest, case.faintest))
    if case.guide:
        middle = random_stars(rng, 1, axis=axis, radius_rad=0.5 * reach, magnitudes=(case.guide, case.guide + 0.1))
        field = StarField(
            directions=np.vstack([middle.directions, field.directions]),
            magnitudes=np.append(middle.magnitudes, field.magnitudes),
        )
    velocity = rng.normal(size=3)
    velocity *= SPEED_KM_S / np.linalg.norm(velocity)
    view = WarpedView(rng, case.shared_px, case.shared_length_px) if case.shared_px else VIEW
    signal, _ = star_image(field, view, attitude, observer_velocity_km_s=velocity, psf=case.psf)
    signal += background(signal.shape, constant_dn=case.level_dn, slope_dn=case.slope_dn)
    return StarSeen(
        number=number,
        signal_dn=signal,
        camera=star_camera(),
        catalog=_catalog(field),
        attitude=attitude,
        velocity_km_s=velocity,
    )


def star_camera() -> Camera:
    """The camera as it is."""
    return Camera(
        name="stress",
        columns=SIZE,
        rows=SIZE,
        model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=VIEW.center_px[0], cy_px=VIEW.center_px[1]),
        psf=GaussianPsf(sigma_px=0.7),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=READ_NOISE_DN),
    )


def star_draw(case: StarCase, seen: StarSeen, seed: int) -> Image:
    """Expose a star field; the a priori attitude is 0.05 degrees off per axis."""
    rng = np.random.default_rng([seen.number, seed, 77])
    shot = record(seen.signal_dn, rng, Recorder(read_noise_e=READ_NOISE_DN))
    wrong = Rotation.from_rotvec(np.radians(0.05) * rng.normal(size=3))
    # The Sun at right angles to the boresight, where its gravity bends light by 4 mas.
    side = seen.attitude.inv().as_matrix()[:, 0]
    state = ObserverState(position_km=AU_KM * side, velocity_km_s=seen.velocity_km_s)
    return Image(
        pixels=shot.pixels.astype(np.float32),
        epoch=EPOCH,
        camera_from_inertial=wrong * seen.attitude,
        observer=state if case.observer else None,
        name=f"{case.name} {seen.number} {seed}",
    )


def calibrated_camera(rng: np.random.Generator) -> Camera | Failure:
    """The camera as 5 images of 30 stars each with centroids right to 0.1 px calibrate it."""
    observations = []
    for number in range(CALIBRATION_IMAGES):
        pixels = rng.uniform(0.0, SIZE - 1.0, (STARS_AN_IMAGE, 2))
        seen = VIEW.directions(pixels)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        attitude = Rotation.random(rng=rng)
        observations.append(
            ImageObservations(
                name=f"stars {number}",
                targets=attitude.inv().apply(seen),
                points_px=pixels + rng.normal(scale=CENTROID_PX, size=pixels.shape),
                sigma_px=np.full(len(pixels), CENTROID_PX),
            )
        )
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "p1", "p2")
    start = BrownModel(fx_px=FOCAL_PX * 1.001, fy_px=FOCAL_PX * 1.001, cx_px=511.5, cy_px=511.5)
    result = calibrate(observations, start, estimate=names, columns=SIZE, rows=SIZE)
    if isinstance(result, Failure):
        return result
    uncertainty = ModelUncertainty(
        estimated=result.estimated,
        covariance=result.covariance,
        residual_sigma_px=result.residual_sigma_px,
        n_observations=int(result.used.sum()),
        n_images=CALIBRATION_IMAGES,
    )
    return replace(star_camera(), model=result.model, uncertainty=uncertainty)


def _corner(sky: StarSeen) -> Seen:
    """A body in a corner of the frame, under the attitude of a star image."""
    rng = np.random.default_rng([sky.number, 91])
    corner = np.array([0.1, 0.1]) + 0.8 * rng.integers(2, size=2)
    sight = VIEW.directions(corner * (SIZE - 1) + rng.uniform(-1.0, 1.0, 2))
    sight /= np.linalg.norm(sight)
    phase_deg = CORNER_CASE.phases_deg[sky.number % len(CORNER_CASE.phases_deg)]
    phase = math.radians(phase_deg)
    position = 2.0 * float(np.cbrt(np.prod(RADII_KM))) * FOCAL_PX / CORNER_CASE.diameter_px * sight
    side = np.cross(sight, [*rng.normal(size=2), 0.0])
    sun = -math.cos(phase) * sight + math.sin(phase) * side / np.linalg.norm(side)
    turn = Rotation.random(rng=rng)
    return Seen(
        case=CORNER_CASE,
        number=sky.number,
        phase_deg=phase_deg,
        signal_dn=render_body(EllipsoidBody(RADII_KM), VIEW, Pose(position, turn, sun)),
        camera=sky.camera,
        shape=Ellipsoid(radii_km=np.array(RADII_KM)),
        position_camera_km=position,
        center_px=VIEW.project(position),
        camera_from_body=turn,
        sun=sun,
        attitude=sky.attitude,
    )


def corner_draws(number: int, draws: int) -> Iterator[Draw]:
    """Images of a body in a corner: calibrated camera and attitude from stars with it are new in each draw."""
    sky = star_view(STAR_CASES[0], number)
    seen = _corner(sky)
    for seed in range(draws):
        camera = calibrated_camera(np.random.default_rng([number, seed, 5]))
        if isinstance(camera, Failure):
            continue
        attitude = StarNavigation(camera, sky.catalog).solve(star_draw(STAR_CASES[0], sky, seed))
        if isinstance(attitude, Failure):
            continue
        draw = draw_of(replace(seen, camera=camera), seed)
        yield replace(draw, image=draw.image.with_attitude(attitude))
