"""A made-up approach as files: images, a campaign that can be run, and the truth beside it."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tomli_w

from giantlike.catalogs import StarCatalog
from giantlike.core.frames import quaternion_xyzw
from giantlike.io import navigation_header, write_fits, write_geometry, write_text_atomic
from giantlike.io.decoded import HeaderValue
from giantlike.io.geometry_table import GeometryRow
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh
from giantlike.simulation.approach import Approach, Frame
from giantlike.simulation.images import SimulatedImage

CAMPAIGN_FILE, TRUTH_FILE = "campaign.toml", "truth.csv"
MAX_MAGNITUDE = 8.5
"""Faintest star that the campaign asks the catalog for; fainter ones are in the images all the same."""
ESTIMATORS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "ROCK": ("unresolved", "cross_correlation", "limb_matching"),
        "MOON": ("cross_correlation", "limb_matching", "ellipsoid_cra"),
    }
)
"""What the campaign runs on each target."""
TRUTH_COLUMNS = (
    "file", "kind", "qx", "qy", "qz", "qw", "target", "x_px", "y_px", "x_camera_km", "y_camera_km", "z_camera_km",
    "range_km", "diameter_px", "phase_deg",
)  # fmt: skip
"""Columns of ``truth.csv``: true attitude (camera_from_inertial), and the true apparent place of the body in view."""


def write_approach(
    approach: Approach,
    folder: Path,
    catalog: StarCatalog,
    *,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Take all images of an approach and write them with everything that a campaign needs.

    Parameters
    ----------
    approach : Approach
    folder : Path
        Gets ``images/*.fits``, ``shapes/``, ``camera.toml``, ``geometry.csv``, ``campaign.toml`` and, for the
        comparison afterwards, ``truth.csv``, which no campaign reads.
    catalog : StarCatalog
        The sky.
    workers : int
        Images made at the same time.
    progress : callable, optional
        Called with the number of images done and the number of all.

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
    truth: list[list[str]] = []

    def make(frame: Frame) -> list[str]:
        taken = approach.take(frame, catalog)
        write_fits(folder / "images" / frame.shot.name, taken.image.pixels, header=_header(frame))
        return _truth_row(approach, frame, taken)

    with ThreadPoolExecutor(workers) as pool:
        for row in pool.map(make, approach.frames):
            truth.append(row)
            if progress is not None:
                progress(len(truth), len(approach.frames))
    approach.camera.save(folder / "camera.toml")
    write_geometry(folder / "geometry.csv", [_geometry_row(frame) for frame in approach.frames])
    tables = [_target_table(folder, target.name, target.shape) for target in approach.targets]
    write_text_atomic(folder / TRUTH_FILE, _csv_text([list(TRUTH_COLUMNS), *truth]))
    campaign = folder / CAMPAIGN_FILE
    write_text_atomic(campaign, tomli_w.dumps(_campaign_table(approach, tables)))
    return campaign


def _header(frame: Frame) -> dict[str, HeaderValue]:
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
    write_text_atomic(folder / file, _obj_text(shape))
    return table | {"shape": file, "units": "km"}


def _obj_text(mesh: TriangleMesh) -> str:
    vertices = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices_km.tolist()]
    faces = [f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist()]
    return "".join([f"# {mesh.name}, km\n", *vertices, *faces])


def _geometry_row(frame: Frame) -> GeometryRow:
    geometry = frame.apriori_geometry
    return GeometryRow(
        file=frame.shot.name,
        camera_from_inertial=frame.apriori_camera_from_inertial,
        target=frame.target,
        target_position_inertial_km=geometry.position_inertial_km,
        body_from_inertial=geometry.inertial_from_body.inv(),
        sun_direction_inertial=geometry.sun_direction_inertial,
    )


def _truth_row(approach: Approach, frame: Frame, taken: SimulatedImage) -> list[str]:
    body = taken.bodies[frame.target]
    center_px = approach.camera.model.project(body.position_camera_km)
    shape = body.target.shape
    numbers = [
        *center_px,
        *body.position_camera_km,
        body.range_km,
        2.0 * shape.mean_radius_km / body.range_km * approach.camera.model.focal_length_px,
        np.degrees(body.phase_angle_rad),
    ]
    kind = "stars" if frame.star_image else "body"
    attitude = [repr(value) for value in quaternion_xyzw(frame.shot.camera_from_inertial).tolist()]
    return [frame.shot.name, kind, *attitude, frame.target, *(repr(float(value)) for value in numbers)]


def _csv_text(rows: list[list[str]]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()
