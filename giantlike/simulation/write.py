"""Files of a simulated approach: images, a campaign that can be run, and the truth in a separate table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tomli_w

from giantlike._system.atomic import write_text_atomic
from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.frames import quaternion_xyzw
from giantlike.io import navigation_header, write_fits, write_geometry
from giantlike.io.csv_rows import write_csv_rows
from giantlike.io.decoded import HeaderValue
from giantlike.io.geometry_table import GeometryRow
from giantlike.io.tables import column, columns_of
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh
from giantlike.shapes.files.exchange import write_obj
from giantlike.simulation.approach import Approach, ApproachFrame
from giantlike.simulation.images import SimulatedImage

CAMPAIGN_FILE, TRUTH_FILE = "campaign.toml", "truth.csv"
MAX_MAGNITUDE = 8.5
"""Faintest star that the campaign uses, 400 electrons in a 5 s exposure; the images hold fainter ones too."""
ESTIMATORS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "ROCK": ("unresolved", "cross_correlation", "limb_matching"),
        "MOON": ("cross_correlation", "limb_matching", "ellipsoid_cra"),
    }
)
"""Estimators that the campaign runs on each target."""


STAR_IMAGE, BODY_IMAGE = "stars", "body"  # purpose of an image, in ``truth.csv``


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthRow:
    """Row of ``truth.csv``: the true attitude of an image and the true apparent position of the body in view."""

    file: str = column("Image file")
    kind: str | None = column("``stars`` or ``body``: what the image was taken for")
    qx: float = column("Quaternion of camera_from_inertial, x")
    qy: float = column("Quaternion of camera_from_inertial, y")
    qz: float = column("Quaternion of camera_from_inertial, z")
    qw: float = column("Quaternion of camera_from_inertial, scalar")
    target: str = column("Body in view")
    x_px: float = column("Center of the body, column", unit="px")
    y_px: float = column("Center of the body, row", unit="px")
    x_camera_km: float | None = column("Center of the body, x", unit="km", frame="camera")
    y_camera_km: float | None = column("Center of the body, y", unit="km", frame="camera")
    z_camera_km: float | None = column("Center of the body, z", unit="km", frame="camera")
    range_km: float = column("Distance of the center of the body", unit="km")
    diameter_px: float = column("Apparent diameter of the sphere of the body's volume", unit="px")
    phase_deg: float = column("Angle Sun - body - camera", unit="deg")


TRUTH_COLUMNS = tuple(each.name for each in columns_of(TruthRow))  # columns of ``truth.csv``


def write_approach(
    approach: Approach,
    folder: Path,
    catalog: StarCatalog,
    *,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Simulate all images of an approach and write them with everything that a campaign needs.

    Parameters
    ----------
    approach : Approach; the plan
    folder : Path
        Gets ``images/*.fits``, ``shapes/``, ``camera.toml``, ``geometry.csv``, ``campaign.toml`` and, for the
        comparison afterwards, ``truth.csv``, which no campaign reads.
    catalog : StarCatalog; stars
    workers : int; number of images made at the same time
    progress : callable, optional; called with the number of finished images and the number of all

    Returns
    -------
    Path
        The campaign file.

    Raises
    ------
    DataError
        A file cannot be written.
    """
    for name in ("images", "shapes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    truth: list[TruthRow] = []

    def make(frame: ApproachFrame) -> TruthRow:
        taken = approach.take(frame, catalog)
        write_fits(folder / "images" / frame.shot.name, taken.image.pixels, header=frame_header(frame))
        return truth_row(frame, taken, approach.camera)

    with ThreadPoolExecutor(workers) as pool:
        for row in pool.map(make, approach.frames):
            truth.append(row)
            if progress is not None:
                progress(len(truth), len(approach.frames))
    approach.camera.save(folder / "camera.toml")
    write_geometry(folder / "geometry.csv", [geometry_row(frame) for frame in approach.frames])
    tables = [_target_table(folder, target.name, target.shape) for target in approach.targets]
    write_csv_rows(folder / TRUTH_FILE, TRUTH_COLUMNS, map(astuple, truth))
    campaign = folder / CAMPAIGN_FILE
    write_text_atomic(campaign, tomli_w.dumps(_campaign_table(approach, tables)))
    return campaign


def frame_header(frame: ApproachFrame) -> dict[str, HeaderValue]:
    """Header of the image of a frame: a priori values for navigation, without the truth."""
    return navigation_header(
        epoch=frame.shot.epoch,
        exposure_s=frame.shot.exposure_s,
        observer_position_km=frame.apriori_observer.position_km,
        observer_velocity_km_s=frame.apriori_observer.velocity_km_s,
    )


def _campaign_table(approach: Approach, targets: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "campaign": {"name": "demo", "output": "run"},
        "images": {"files": ["images/*.fits"], "geometry": "geometry.csv"},
        "camera": {"file": "camera.toml"},
        "stars": {
            "catalog": "default",
            "max_magnitude": MAX_MAGNITUDE,
            "lost_in_space": True,
            "long_exposure_s": 1.0,
            "transfer": "interpolate",
            "drift_arcsec_per_sqrt_s": approach.options.jitter_arcsec_per_sqrt_s,
        },
        "targets": targets,
    }


def _target_table(folder: Path, name: str, shape: Shape) -> dict[str, Any]:
    table: dict[str, Any] = {"name": name, "estimators": list(ESTIMATORS[name])}
    if isinstance(shape, Ellipsoid):
        return table | {"shape": {"radii_km": shape.radii_km.tolist()}}
    assert isinstance(shape, TriangleMesh)
    file = f"shapes/{name.lower()}.obj"
    write_obj(folder / file, shape)
    return table | {"shape": file, "units": "km"}


def geometry_row(frame: ApproachFrame) -> GeometryRow:
    """Row of the geometry table of a frame: its a priori knowledge."""
    geometry = frame.apriori_geometry
    return GeometryRow(
        file=frame.shot.name,
        camera_from_inertial=frame.apriori_camera_from_inertial,
        target=frame.target,
        target_position_inertial_km=geometry.position_inertial_km,
        body_from_inertial=geometry.inertial_from_body.inv(),
        sun_direction_inertial=geometry.sun_direction_inertial,
        target_velocity_inertial_km_s=geometry.velocity_inertial_km_s,
    )


def truth_row(frame: ApproachFrame, taken: SimulatedImage, camera: Camera) -> TruthRow:
    """Row of the truth of a frame."""
    body, model = taken.bodies[frame.target], camera.model
    vectors = {
        "q{}": ("xyzw", quaternion_xyzw(frame.shot.camera_from_inertial)),
        "{}_px": ("xy", model.project(body.position_camera_km)),
        "{}_camera_km": ("xyz", body.position_camera_km),
    }
    numbers = {
        name.format(axis): number
        for name, (axes, vector) in vectors.items()
        for axis, number in zip(axes, vector.tolist(), strict=True)
    }
    return TruthRow(
        file=frame.shot.name,
        kind=STAR_IMAGE if frame.star_image else BODY_IMAGE,
        target=frame.target,
        range_km=body.range_km,
        diameter_px=2.0 * body.target.shape.mean_radius_km / body.range_km * model.focal_length_px,
        phase_deg=float(np.degrees(body.phase_angle_rad)),
        **numbers,
    )
