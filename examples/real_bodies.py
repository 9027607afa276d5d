"""Turn published poses of two asteroids into campaigns, ready for ``giantlike run``.

Vesta, Dawn framing camera, 31 July 2011: the body is larger than the frame; the truth is in ``poses.json``.
Eros, NEAR multi-spectral imager, January 2001: the surface fills the frame, so there is no limb to match.

    python examples/real_bodies.py vesta DATA OUTPUT
    python examples/real_bodies.py eros DATA OUTPUT

DATA is a folder with ``bodies/dawn_vesta``, ``bodies/near_msi``, ``shapes`` and ``kernels``. OUTPUT gets
``campaign.toml``, ``camera.toml`` and ``geometry.csv``; images and shapes stay where they are.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.io.geometry_table import GeometryRow, write_geometry
from giantlike.io.image_files import read_image_file
from giantlike.io.spice import load_kernels, orientation

ESTIMATORS = ["cross_correlation", "limb_matching", "ellipsoid_cra"]

# NEAR: boresight along spacecraft +X, samples along +Z, lines along -Y
MSI_FROM_NEAR = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
MSI_IFOV_RAD = 95.9e-6
NEAR_CLOCK_ZERO_UTC = "1996-02-17T20:43:29"  # mission elapsed time counts from launch, good to seconds


def vesta_campaign(data: Path, output: Path) -> Path:
    """Write the Vesta campaign; camera axes serve as inertial axes, for no epoch or attitude is published."""
    folder = data / "bodies" / "dawn_vesta"
    poses = json.loads((folder / "poses.json").read_text())
    numbers = poses["camera"]
    camera = Camera(
        name="Dawn FC2",
        columns=numbers["columns"],
        rows=numbers["rows"],
        model=PinholeModel(**{key: numbers[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")}),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=1.0, saturation_dn=255.0),
    )
    rows = []
    for name, pose in poses["images"].items():
        camera_from_body = Rotation.from_quat(pose["q_wxyz_camera_from_body"], scalar_first=True)
        rows.append(
            GeometryRow(
                file=name,
                camera_from_inertial=Rotation.identity(),
                target="VESTA",
                target_position_inertial_km=np.array(pose["t_body_in_camera_km"]),
                body_from_inertial=camera_from_body.inv(),
                sun_direction_inertial=camera_from_body.apply(unit(np.array(pose["sun_body"]))),
            )
        )
    return _write(output, camera, rows, folder / "*.png", "VESTA", data / "shapes" / "vesta_5002.ply")


def eros_campaign(data: Path, output: Path) -> Path:
    """Write the Eros campaign from the FITS headers; the orientation of Eros comes from the PCK."""
    folder = data / "bodies" / "near_msi"
    focal = 1.0 / MSI_IFOV_RAD
    model = PinholeModel(fx_px=focal, fy_px=focal, cx_px=268.0, cy_px=205.5)
    camera = Camera(name="NEAR MSI", columns=537, rows=412, model=model, psf=GaussianPsf(sigma_px=0.8))
    rows = []
    with load_kernels([str(data / "kernels" / "pck00011.tpc")], base=Path()):
        for path in sorted(folder.glob("*.fit")):
            header = read_image_file(path).header
            number = {key: float(header[f"NEAR-{key:03d}"]) for key in (18, 19, 20, 21, 22, 23, 24, 25, 27, 28, 29)}
            near_from_inertial = Rotation.from_quat([number[key] for key in (19, 20, 21, 22)], scalar_first=True)
            spacecraft_km = np.array([number[key] for key in (23, 24, 25)])
            eros_km = np.array([number[key] for key in (27, 28, 29)])
            et = et_from_time(time_from_utc(NEAR_CLOCK_ZERO_UTC)) + number[18]
            rows.append(
                GeometryRow(
                    file=path.name,
                    camera_from_inertial=MSI_FROM_NEAR * near_from_inertial,
                    target="EROS",
                    target_position_inertial_km=eros_km - spacecraft_km,
                    body_from_inertial=orientation("IAU_EROS", et).inv(),
                    sun_direction_inertial=unit(-eros_km),
                )
            )
    return _write(output, camera, rows, folder / "*.fit", "EROS", data / "shapes" / "eros007790.tab")


def _write(output: Path, camera: Camera, rows: list[GeometryRow], images: Path, target: str, shape: Path) -> Path:
    output.mkdir(parents=True, exist_ok=True)
    camera.save(output / "camera.toml")
    write_geometry(output / "geometry.csv", rows)
    campaign: dict[str, Any] = {
        "campaign": {"name": target.lower(), "output": "run"},
        "images": {"files": [str(images.resolve())], "geometry": "geometry.csv"},
        "camera": {"file": "camera.toml"},
        "targets": [{"name": target, "shape": str(shape.resolve()), "units": "km", "estimators": ESTIMATORS}],
    }
    path = output / "campaign.toml"
    path.write_text(tomli_w.dumps(campaign))
    return path


if __name__ == "__main__":
    writer = {"vesta": vesta_campaign, "eros": eros_campaign}[sys.argv[1]]
    print(writer(Path(sys.argv[2]), Path(sys.argv[3])))
