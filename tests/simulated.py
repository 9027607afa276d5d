"""A small camera, a made-up sky and a ball before it, for tests of simulated images."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.catalogs import MemoryCatalog, StarTable
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import radec_from_direction
from giantlike.core.time import time_from_et
from giantlike.core.units import AU_KM, RAD_PER_DEG
from giantlike.ephemeris import ApparentGeometry, DistantLight
from giantlike.image import ObserverState
from giantlike.ray_tracing import Lambert
from giantlike.scene import Scene, Target
from giantlike.shapes import sphere
from giantlike.simulation import Shot

ET = 7.6e8  # January 2024
OBSERVER = ObserverState(position_km=np.array([AU_KM, 0.0, 0.0]), velocity_km_s=np.array([0.0, 30.0, 0.0]))


def small_camera(size: int = 200, *, focal_px: float = 1000.0) -> Camera:
    return Camera(
        name="test",
        columns=size,
        rows=size,
        model=PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=(size - 1) / 2, cy_px=(size - 1) / 2),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=2.0, read_noise_e=6.0, saturation_dn=30_000.0, bias_dn=100.0),
    )


def _catalog(
    ra_deg: Float,
    dec_deg: Float,
    magnitude: Float,
    motion_mas_yr: Float | None = None,
    parallax_mas: Float | None = None,
) -> MemoryCatalog:
    zero = np.zeros(len(ra_deg))
    motion = np.zeros((2, len(ra_deg))) if motion_mas_yr is None else motion_mas_yr
    stars = StarTable(
        ids=np.arange(len(ra_deg)) + 1,
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        pm_ra_mas_yr=motion[0],
        pm_dec_mas_yr=motion[1],
        parallax_mas=zero if parallax_mas is None else parallax_mas,
        radial_velocity_km_s=zero,
        epoch_jyear=zero + 2016.0,
        magnitude=magnitude,
        color_bv=zero + 0.6,
        sigma_mas=zero,
        sigma_pm_mas_yr=zero,
    )
    return MemoryCatalog(stars, name="made up", band="G", version="1")


def small_catalog(count: int, axis_ra_deg: float, axis_dec_deg: float, spread_deg: float) -> MemoryCatalog:
    """Stars of magnitude 2 to 8 near a direction, with large proper motions and parallaxes."""
    rng = np.random.default_rng(3)
    return _catalog(
        axis_ra_deg + rng.uniform(-spread_deg, spread_deg, count),
        axis_dec_deg + rng.uniform(-spread_deg, spread_deg, count),
        motion_mas_yr=rng.normal(0.0, 500.0, (2, count)),
        parallax_mas=rng.uniform(0.0, 300.0, count),
        magnitude=rng.uniform(2.0, 8.0, count),
    )


def shot_of(exposure_s: float = 1.0, attitude: Rotation | None = None) -> Shot:
    return Shot(
        name="test",
        epoch=time_from_et(ET),
        exposure_s=exposure_s,
        camera_from_inertial=attitude or Rotation.identity(),
        observer=OBSERVER,
    )


def sphere_scene(range_km: float, phase_deg: float, radius_km: float = 30.0) -> Scene:
    """A Lambert sphere on the boresight, the Sun to the right of the camera (+x)."""
    phase = phase_deg * RAD_PER_DEG
    place = ApparentGeometry(position_inertial_km=np.array([0.0, 0.0, range_km]))
    target = Target(name="BALL", shape=sphere(radius_km), ephemeris=place, reflectance=Lambert())
    return Scene(targets=(target,), light=DistantLight(np.array([np.sin(phase), 0.0, -np.cos(phase)])))


def catalog_at(camera: Camera, points_px: Float) -> MemoryCatalog:
    """Stars of magnitude 4 to 8 that an unturned camera at rest sees at these pixels."""
    magnitudes = np.random.default_rng(4).uniform(4.0, 8.0, len(points_px))
    return catalog_of_directions(camera.model.unproject(points_px), magnitudes)


def catalog_of_directions(directions: Float, magnitudes: Float) -> MemoryCatalog:
    """Stars at rest in given directions (n, 3)."""
    return _catalog(*radec_from_direction(directions), magnitudes)
