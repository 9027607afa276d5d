"""Real images of bodies: campaigns of published poses, and a table of what each estimator makes of each image.

Vesta, Dawn framing camera, 31 July 2011: the body is larger than the frame; the truth is in ``poses.json``.
Eros, NEAR multi-spectral imager, January 2001: the surface fills the frame, so there is no limb to match.

    python examples/real_bodies.py vesta DATA OUTPUT
    python examples/real_bodies.py eros DATA OUTPUT
    python examples/real_bodies.py table DATA OUTPUT [NAME]

DATA is a folder with ``bodies``, ``shapes`` and ``kernels``. ``vesta`` and ``eros`` write ``campaign.toml``,
``camera.toml`` and ``geometry.csv``, ready for ``giantlike run``; images and shapes stay where they are. ``table`` runs
the estimators on all images of ``real_body_cases.py`` (or those whose name holds NAME), prints a line for each and
writes ``table.md``, ``table.json`` and an overlay of each image.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.io.geometry_table import GeometryRow, write_geometry
from giantlike.io.image_files import read_image_file
from giantlike.io.spice import load_kernels, orientation
from giantlike.ray_tracing import trace_silhouette
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target
from giantlike.shapes import load_shape

if TYPE_CHECKING:
    from real_body_cases import Case

IN_CAMPAIGN = ["cross_correlation", "limb_matching", "ellipsoid_cra"]

# NEAR: boresight along spacecraft +X, samples along +Z, lines along -Y
MSI_FROM_NEAR = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
MSI_IFOV_RAD = 95.9e-6
NEAR_CLOCK_ZERO_UTC = "1996-02-17T20:43:29"  # mission elapsed time counts from launch, good to seconds


def dawn_camera(numbers: dict[str, Any]) -> Camera:
    """The framing camera as the data set of poses describes it."""
    return Camera(
        name="Dawn FC2",
        columns=numbers["columns"],
        rows=numbers["rows"],
        model=PinholeModel(**{key: numbers[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")}),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=1.0, saturation_dn=255.0),
    )


def vesta_campaign(data: Path, output: Path) -> Path:
    """Write the Vesta campaign; camera axes serve as inertial axes, for no epoch or attitude is published."""
    folder = data / "bodies" / "dawn_vesta"
    poses = json.loads((folder / "poses.json").read_text())
    camera = dawn_camera(poses["camera"])
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
                sun_direction_inertial=rotate(camera_from_body, unit(np.array(pose["sun_body"]))),
            )
        )
    return _write(output, camera, rows, folder / "*.png", "VESTA", data / "shapes" / "vesta_5002.ply")


def eros_campaign(data: Path, output: Path) -> Path:
    """Write the Eros campaign from the FITS headers; the orientation of Eros comes from the PCK."""
    camera, rows = eros_geometry(data)
    images = data / "bodies" / "near_msi" / "*.fit"
    return _write(output, camera, rows, images, "EROS", data / "shapes" / "eros007790.tab")


def eros_geometry(data: Path) -> tuple[Camera, list[GeometryRow]]:
    """Camera and geometry of the images of Eros."""
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
    return camera, rows


def _write(output: Path, camera: Camera, rows: list[GeometryRow], images: Path, target: str, shape: Path) -> Path:
    output.mkdir(parents=True, exist_ok=True)
    camera.save(output / "camera.toml")
    write_geometry(output / "geometry.csv", rows)
    campaign: dict[str, Any] = {
        "campaign": {"name": target.lower(), "output": "run"},
        "images": {"files": [str(images.resolve())], "geometry": "geometry.csv"},
        "camera": {"file": "camera.toml"},
        "targets": [{"name": target, "shape": str(shape.resolve()), "units": "km", "estimators": IN_CAMPAIGN}],
    }
    path = output / "campaign.toml"
    path.write_text(tomli_w.dumps(campaign))
    return path


def eros(data: Path) -> Iterator[Case]:
    """NEAR at Eros: the surface fills the frame, and estimators on limbs must refuse."""
    from real_body_cases import Case

    camera, rows = eros_geometry(data)
    shape = load_shape(data / "shapes" / "eros007790.tab")
    for row in rows:
        assert row.target_position_inertial_km is not None
        assert row.body_from_inertial is not None
        assert row.camera_from_inertial is not None
        apparent = ApparentGeometry(
            position_inertial_km=row.target_position_inertial_km,
            inertial_from_body=row.body_from_inertial.inv(),
            sun_direction_inertial=row.sun_direction_inertial,
        )
        image = Image.open(data / "bodies" / "near_msi" / row.file).with_attitude(row.camera_from_inertial)
        yield Case(
            name=f"Eros {row.file[:14]}",
            source="header, pointing to some pixels",
            image=image,
            camera=camera,
            scene=Scene(targets=(Target(name="EROS", shape=shape, ephemeris=apparent),)),
            center_px=camera.model.project(rotate(row.camera_from_inertial, row.target_position_inertial_km)),
            sigma_px=10.0,
            range_km=float(np.linalg.norm(row.target_position_inertial_km)),
            sigma_range=0.01,
        )


def table(data: Path, output: Path, only: str = "") -> Path:
    """Run the estimators on every image and write what came of it."""
    from real_body_cases import cassini_without_geometry, earth, europa, jupiter, vesta, voyager  # beside this file

    output.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for source in (vesta, europa, jupiter, voyager, cassini_without_geometry, earth, eros):
        for case in source(data):
            if only.lower() in case.name.lower():
                found = {name: _estimate(case, name) for name in case.estimators}
                rows += [_row(case, name, fix, spent_s) for name, (fix, spent_s) in found.items()]
                _overlay(case, {name: fix for name, (fix, _) in found.items()}, output)
                print("\n".join(_line(row) for row in rows[-len(found) :]), flush=True)
    (output / "table.json").write_text(json.dumps(rows, indent=1))
    head = ["image", "estimator", "status", "center, px", "sigma", "off, sigmas", "range, km", "sigma", "off, sigmas"]
    lines = [_line(dict.fromkeys(head, "") | dict(zip(head, head, strict=True)), head), "|" + " --- |" * len(head)]
    path = output / "table.md"
    path.write_text("\n".join([*lines, *(_line(row) for row in rows)]) + "\n")
    return path


def _estimate(case: Case, name: str) -> tuple[CenterFix | Failure, float]:
    """Run one estimator with the case's own options, where it has them."""
    estimator = ESTIMATORS[name]()
    known = {field.name for field in dataclasses.fields(estimator.options)}
    options = {key: value for key, value in case.options.items() if key in known}
    estimator = ESTIMATORS[name](dataclasses.replace(estimator.options, **options))
    started = time.process_time()
    fix = estimator.estimate(case.image, case.camera, case.scene)
    return fix, time.process_time() - started


def _row(case: Case, name: str, fix: CenterFix | Failure, spent_s: float) -> dict[str, Any]:
    """One line of the table."""
    row: dict[str, Any] = {"image": case.name, "estimator": name, "truth": case.source, "cpu_s": round(spent_s, 2)}
    if isinstance(fix, Failure):
        return row | {"status": f"{fix.reason}: {fix.detail.split(': ', 3)[-1]}"}
    names = [flag for flag in fix.flags.names() if flag not in ("apriori_attitude", "saturated")]
    row["status"] = ("suspect" if fix.flags.suspect else "ok") + (f" ({', '.join(names)})" if names else "")
    sigma = np.sqrt(np.diag(fix.covariance_px2))
    row |= {"center, px": _text(fix.center_px, 2), "sigma": _text(sigma, 2), "score": fix.score}
    if case.center_px is not None:
        total = fix.covariance_px2 + case.sigma_px**2 * np.eye(2)
        error = fix.center_px - case.center_px
        row |= {"error_px": error.tolist(), "off": math.sqrt(float(error @ np.linalg.solve(total, error)))}
    if isinstance(fix, PositionFix):
        row |= {"range_km": fix.range_km, "sigma_range_km": fix.sigma_range_km}
        if case.range_km is not None:
            total_km = math.hypot(fix.sigma_range_km, case.sigma_range * case.range_km)
            row |= {"range_error": fix.range_km / case.range_km - 1.0}
            row["range_off"] = (fix.range_km - case.range_km) / total_km
    return row


def _text(values: Any, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _line(row: dict[str, Any], head: list[str] | None = None) -> str:
    """A row as Markdown."""
    if head is not None:
        return "| " + " | ".join(head) + " |"
    cells = [row["image"], row["estimator"], row["status"], row.get("center, px", ""), row.get("sigma", "")]
    for key, form in (("off", ".1f"), ("range_km", ".1f"), ("sigma_range_km", ".2g"), ("range_off", "+.1f")):
        cells.append(format(row[key], form) if key in row else "")
    return "| " + " | ".join(cells) + " |"


def _overlay(case: Case, fixes: dict[str, CenterFix | Failure], output: Path) -> None:
    """The image with limb points, the outline at each position and the centers; a color for each estimator."""
    pixels = case.image.pixels.astype(np.float64)
    low, high = np.percentile(pixels, [1.0, 99.7])
    gray = (255.0 * np.clip((pixels - low) / max(high - low, 1e-9), 0.0, 1.0) ** 0.5).astype(np.uint8)
    picture = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    colors = ((0, 255, 255), (255, 0, 255), (0, 255, 0), (255, 160, 0), (0, 120, 255), (255, 255, 0))
    for number, (name, fix) in enumerate(fixes.items()):
        color = colors[number % len(colors)]
        if isinstance(fix, Failure):
            continue
        cv2.putText(picture, name, (8, 40 + 16 * number), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1)
        cv2.drawMarker(picture, _pixel(fix.center_px), color, cv2.MARKER_CROSS, 16, 1)
        if isinstance(fix, PositionFix):
            geometry = case.scene.geometry(case.image)
            assert not isinstance(geometry, Failure)
            body = geometry.body(fix.position_camera_km)
            angles = np.linspace(0.0, 2.0 * np.pi, 721)
            sun = geometry.sun_direction_camera
            limb = trace_silhouette(body, case.camera.model, angles, sun_direction_camera=sun)
            for point in limb.points_px[limb.valid & limb.lit]:
                cv2.circle(picture, _pixel(point), 0, color, -1)
            for point in fix.limb_px[::4]:
                cv2.circle(picture, _pixel(point), 2, color, 1)
    cv2.imwrite(str(output / f"{case.name.split(' (')[0].replace(' ', '_')}.png"), picture)


def _pixel(point: Any) -> tuple[int, int]:
    x, y = np.clip(np.rint(point), -30000, 30000).astype(int)
    return int(x), int(y)


if __name__ == "__main__":
    actions = {"vesta": vesta_campaign, "eros": eros_campaign, "table": table}
    print(actions[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]), *sys.argv[4:]))
