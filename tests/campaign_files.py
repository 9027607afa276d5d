"""Small campaigns with truth, written as files: what the tests of campaigns and of the command line run on."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.catalogs import MemoryCatalog, load_catalog
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import camera_from_inertial_of_pointing, rotate
from giantlike.core.time import et_from_time, time_from_et, time_from_utc
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import ObserverState
from giantlike.io import navigation_header, write_fits, write_geometry
from giantlike.io.geometry_table import GeometryRow
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid
from giantlike.simulation import Shot, Sources, simulate_image
from giantlike.simulation.incident import SimulationOptions

CAMERA = Camera(
    name="test camera",
    columns=320,
    rows=280,
    model=PinholeModel(fx_px=900.0, fy_px=900.0, cx_px=160.3, cy_px=139.6),
    psf=GaussianPsf(sigma_px=0.9),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=60000.0, bias_dn=100.0),
)
RADII_KM = (1.1, 1.0, 0.9)
LONG_S, SHORT_S = 2.0, 1.5e-4
PAIR_GAP_S = 20.0
START_UTC = "2024-05-01T00:00:00"
TURN_RAD_S = np.array([3e-7, -2e-7, 5e-7])
OBSERVER = ObserverState(position_km=np.array([1.5e8, 0.0, 0.0]), velocity_km_s=np.array([0.0, 29.0, 5.0]))
APRIORI_ERROR_RAD = np.array([1e-3, -7e-4, 2e-3])
APRIORI_OFFSET_KM = np.array([0.1, -0.08, 0.3])
BODY_TURN = Rotation.from_euler("xyz", [20.0, 30.0, 40.0], degrees=True)
"""``camera_from_body``."""
SUN_CAMERA = unit(np.array([0.8, -0.3, -0.5]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """What was true of an image: attitude and vector from camera to body, km, camera axes."""

    camera_from_inertial: Rotation
    position_camera_km: Float


@functools.cache
def sky() -> MemoryCatalog:
    return load_catalog("default")


def write_campaign(folder: Path, *, visits: int = 2, **changes: Any) -> tuple[Path, dict[str, Truth]]:
    """Images of a long - short - long triple per visit, geometry table and campaign file; returns it and the truth."""
    (folder / "images").mkdir(parents=True)
    start = et_from_time(time_from_utc(START_UTC))
    truth: dict[str, Truth] = {}
    rows = []
    for visit in range(visits):
        middle = start + 4000.0 * visit
        for kind, offset, exposure_s in (("a_long", -PAIR_GAP_S, LONG_S), ("b_short", 0.0, SHORT_S),
                                         ("c_long", PAIR_GAP_S, LONG_S)):  # fmt: skip
            name = f"visit{visit}_{kind}.fits"
            et = middle + offset
            truth[name] = _write_image(folder / "images" / name, visit, et, et - start, exposure_s)
            rows.append(_row(name, truth[name]))
    write_geometry(folder / "geometry.csv", rows)
    CAMERA.save(folder / "camera.toml")
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(campaign_table() | changes))
    return path, truth


def campaign_table() -> dict[str, Any]:
    """Content of the campaign file."""
    return {
        "campaign": {"name": "test", "output": "run"},
        "images": {"files": ["images/*.fits"], "geometry": "geometry.csv"},
        "camera": {"file": "camera.toml"},
        "stars": {"max_magnitude": 7.0, "long_exposure_s": 1.0},
        "report": {"max_overlays": 1},
        "targets": [
            {
                "name": "PEBBLE",
                "shape": {"radii_km": list(RADII_KM)},
                "estimators": ["cross_correlation", "limb_matching"],
            }
        ],
    }


def true_attitude(visit: int, seconds: float) -> Rotation:
    return Rotation.from_rotvec(TURN_RAD_S * seconds) * camera_from_inertial_of_pointing(60.0 + 90 * visit, 20.0, 30.0)


def _write_image(path: Path, visit: int, et: float, seconds: float, exposure_s: float) -> Truth:
    attitude = true_attitude(visit, seconds)
    position = np.array([1.5 - 1.0 * visit, 0.8, 32.0 - 4.0 * visit])
    shot = Shot(
        name=path.name,
        epoch=time_from_et(et),
        exposure_s=exposure_s,
        camera_from_inertial=attitude,
        observer=OBSERVER,
    )
    scene = Scene(
        targets=(
            Target(
                name="PEBBLE",
                shape=Ellipsoid(radii_km=np.array(RADII_KM)),
                ephemeris=_apparent(attitude, position),
            ),
        )
    )
    taken = simulate_image(
        shot,
        CAMERA,
        Sources(scene=scene, catalog=sky()),
        seed=(visit, int(1e3 * exposure_s), int(seconds + 100)),
        options=SimulationOptions(rays_per_pixel_side=3, max_magnitude=7.5),
    )
    header = navigation_header(
        epoch=shot.epoch,
        exposure_s=exposure_s,
        observer_position_km=OBSERVER.position_km,
        observer_velocity_km_s=OBSERVER.velocity_km_s,
    )
    write_fits(path, taken.image.pixels, header=header)
    return Truth(camera_from_inertial=attitude, position_camera_km=position)


def _apparent(attitude: Rotation, position_camera_km: Float) -> ApparentGeometry:
    return ApparentGeometry(
        position_inertial_km=rotate(attitude.inv(), position_camera_km),
        inertial_from_body=attitude.inv() * BODY_TURN,
        sun_direction_inertial=rotate(attitude.inv(), SUN_CAMERA),
    )


def _row(name: str, truth: Truth) -> GeometryRow:
    apparent = _apparent(truth.camera_from_inertial, truth.position_camera_km + APRIORI_OFFSET_KM)
    return GeometryRow(
        file=name,
        camera_from_inertial=Rotation.from_rotvec(APRIORI_ERROR_RAD) * truth.camera_from_inertial,
        target="PEBBLE",
        target_position_inertial_km=apparent.position_inertial_km,
        body_from_inertial=apparent.inertial_from_body.inv(),
        sun_direction_inertial=apparent.sun_direction_inertial,
    )
