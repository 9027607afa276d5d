"""One image of the gauntlet, made from (seed, index) alone: pixels, a priori data, and the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import PinholeModel
from giantlike.catalogs import MemoryCatalog, StarTable
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.time import time_from_et
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.bodies import TOLD_LAWS
from giantlike.gauntlet.kinds import KINDS, Kind
from giantlike.gauntlet.plan import BIAS_DN, CENTER_SIGMA_PX, READ_NOISE_DN, Plan, World, body_plan, star_plan
from giantlike.image import Image, ObserverState
from giantlike.independent import Pose, StarField, record, render_body, star_image
from giantlike.scene import Scene, Target, TargetUncertainty

TARGET = "TARGET"  # name of the body
ZERO_POINT_DN = 1e6  # signal of a star of magnitude 0, DN over all pixels: 400 DN at the limit of the catalog
_AU_KM = 1.495978707e8
_EPOCH_ET = 5.05e8  # s past J2000: 2016.0, the epoch of the catalog
_DECK, _BASE, _DISTURB, _EXPOSE = range(4)  # streams of random numbers of a seed, and of an image of it


@lru_cache(maxsize=8)
def deck(seed: int) -> tuple[str, ...]:
    """Return the kinds in the order in which they come, again and again, for one seed."""
    names = [kind.name for kind in KINDS.values() for _ in range(kind.weight)]
    return tuple(str(name) for name in np.random.default_rng([seed, _DECK]).permutation(names))


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage(Value):
    """An image, its a priori data, and the truth."""

    seed: int
    index: int
    kind: Kind
    plan: Plan  # plan, base: True world and a priori data; the same without the disturbance
    base: Plan
    signal_dn: Float  # (rows, columns); without noise
    pixels_dn: Float  # (rows, columns); as they arrive
    image: Image
    camera: Camera  # as assumed
    scene: Scene | None  # as assumed; None for images of stars
    catalog: MemoryCatalog | None  # as assumed; None for images of bodies

    @property
    def world(self) -> World:
        """The truth."""
        return self.plan.world

    @cached_property
    def undisturbed(self) -> Stage:
        """The same scene without the disturbance, with the same a priori errors."""
        if self.kind.undisturbed:
            return self
        known = (self.signal_dn, self.pixels_dn) if self.plan.world is self.base.world else None
        return _stage(self.seed, self.index, self.base, self.base, known)


def kind_of(seed: int, index: int) -> Kind:
    """Return the kind of an image."""
    names = deck(seed)
    return KINDS[names[index % len(names)]]


def plans_of(seed: int, index: int) -> tuple[Plan, Plan]:
    """Draw the plan of an image."""
    kind = kind_of(seed, index)
    rng = np.random.default_rng([seed, index, _BASE])
    base = body_plan(rng, kind.base) if kind.body else star_plan(rng)
    return kind.disturb(base, np.random.default_rng([seed, index, _DISTURB])), base


def stage_of(seed: int, index: int) -> Stage:
    """Make an image of the gauntlet."""
    return _stage(seed, index, *plans_of(seed, index))


def _stage(seed: int, index: int, plan: Plan, base: Plan, known: tuple[Float, Float] | None = None) -> Stage:
    """Make the image of a plan; signal and pixels may be known."""
    signal, pixels = known or expose(plan.world, np.random.default_rng([seed, index, _EXPOSE]))
    return Stage(
        seed=seed,
        index=index,
        kind=kind_of(seed, index),
        plan=plan,
        base=base,
        signal_dn=signal,
        pixels_dn=pixels,
        image=_image(plan, pixels, f"gauntlet {seed} {index}"),
        camera=_camera(plan),
        scene=None if plan.told.shape is None else _scene(plan),
        catalog=None if plan.told.catalog is None else catalog_of(plan.told.catalog),
    )


def expose(world: World, rng: np.random.Generator) -> tuple[Float, Float]:
    """Take an image. Returns (rows, columns), (rows, columns) DN."""
    signal = signal_of(world, rng)
    pixels = record(signal, rng, world.recorder, world.defects).pixels
    for readout in world.readouts:
        pixels = readout(pixels, rng)
    return signal, pixels


def signal_of(world: World, rng: np.random.Generator) -> Float:
    """Render a world without noise."""
    view = world.view
    signal = np.zeros((view.rows, view.columns))
    if world.body is not None:
        pose = Pose(world.position_camera_km, world.camera_from_body, world.sun)
        signal = render_body(
            world.body, view, pose, law=world.law, peak_dn=world.peak_dn, psf=world.psf, sampling=world.sampling
        )
    if world.sky is not None:
        stars, _ = star_image(
            world.sky,
            view,
            world.attitude,
            observer_velocity_km_s=world.velocity_km_s,
            psf=world.psf,
            zero_point_dn=ZERO_POINT_DN,
        )
        signal = signal + stars
    for light in world.lights:
        signal = light(signal, world, rng)
    return np.asarray(signal, dtype=float)


def catalog_of(field: StarField) -> MemoryCatalog:
    """Return stars of the independent sky as a catalog."""
    x, y, z = field.directions.T
    zero = np.zeros(field.magnitudes.size)
    stars = StarTable(
        ids=np.arange(zero.size) + 1,
        ra_deg=np.degrees(np.arctan2(y, x)) % 360.0,
        dec_deg=np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))),
        pm_ra_mas_yr=zero,
        pm_dec_mas_yr=zero,
        parallax_mas=zero,
        radial_velocity_km_s=zero,
        epoch_jyear=zero + 2016.0,
        magnitude=field.magnitudes,
        color_bv=zero + 0.6,
        sigma_mas=zero,
        sigma_pm_mas_yr=zero,
    )
    return MemoryCatalog(stars, name="made up", band="G", version="1")


def _camera(plan: Plan) -> Camera:
    """The assumed camera."""
    view, told = plan.world.view, plan.told
    focal = view.focal_px * told.focal_factor
    center = np.asarray(view.center_px) + told.center_shift_px
    # One relative error of both focal lengths, and separate errors of the center.
    spread = np.zeros((4, 4))
    spread[:2, :2] = (told.focal_sigma * focal) ** 2
    spread[2, 2] = spread[3, 3] = CENTER_SIGMA_PX**2
    return Camera(
        name="gauntlet",
        columns=view.columns,
        rows=view.rows,
        model=PinholeModel(fx_px=focal, fy_px=focal, cx_px=float(center[0]), cy_px=float(center[1])),
        psf=GaussianPsf(sigma_px=told.psf_px),
        detector=Detector(
            gain_e_per_dn=1.0 / told.dn_scale,
            read_noise_e=READ_NOISE_DN,
            bias_dn=BIAS_DN * told.dn_scale,
            saturation_dn=told.saturation_dn * told.dn_scale,
        ),
        uncertainty=ModelUncertainty(
            estimated=("fx_px", "fy_px", "cx_px", "cy_px"),
            covariance=spread,
            residual_sigma_px=CENTER_SIGMA_PX,
            n_observations=100,
            n_images=10,
        ),
    )


def _image(plan: Plan, pixels: Float, name: str) -> Image:
    world, told = plan.world, plan.told
    sigma = math.radians(told.attitude_sigma_deg)
    state = ObserverState(
        position_km=_AU_KM * world.attitude.inv().as_matrix()[:, 0],
        velocity_km_s=told.observer_factor * world.velocity_km_s,
    )
    stars = world.sky is not None or told.catalog is not None
    bad = None if told.mask is None else told.mask(pixels)
    image = Image(
        pixels=pixels.astype(np.float32),
        epoch=time_from_et(_EPOCH_ET),
        camera_from_inertial=told.attitude_error * world.attitude,
        attitude_covariance_rad2=sigma**2 * np.eye(3),
        observer=state if stars and told.observer_known else None,
        name=name,
    )
    return image if bad is None else replace(image, mask=bad)


def _scene(plan: Plan) -> Scene:
    told, back = plan.told, plan.world.attitude.inv()
    assert told.shape is not None
    geometry = ApparentGeometry(
        position_inertial_km=rotate(back, told.position_camera_km),
        inertial_from_body=back * told.camera_from_body,
        sun_direction_inertial=rotate(back, told.sun),
    )
    target = Target(
        name=TARGET,
        shape=told.shape,
        ephemeris=geometry,
        reflectance=TOLD_LAWS[told.law],
        uncertainty=TargetUncertainty(scale=told.scale_sigma, ephemeris_km=told.ephemeris_sigma_km),
    )
    return Scene(targets=(target,))
