"""``giantlike shape render``: a picture of a shape."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_bytes_atomic
from giantlike.camera_models import PinholeModel
from giantlike.cli.arguments import Json, Overwrite, Units, UnitsOption
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.cli.shape_commands import units_said
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec, east_north
from giantlike.core.outcomes import Failure
from giantlike.ray_tracing import Body, RenderOptions, reflectance_from_mapping, render
from giantlike.shapes import TriangleMesh, load_shape

_DISTANCE_RADII = 100.0  # far enough that perspective is below a percent of the radius
_FILL = 0.95  # diameter of the sphere around the body / width of the picture
_WHITE_QUANTILE = 0.999  # a thousandth of the illuminated pixels may be clipped: glints do not darken the rest
_LARGEST_PX = 8192  # 64 megapixels; bounds the memory of a picture


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureView:
    """Viewing and illumination geometry of a picture of a shape."""

    phase_deg: float  # angle at the body between Sun and camera; the Sun is to the right
    longitude_deg: float  # longitude_deg, latitude_deg: east, of the point that faces the camera; north is up
    latitude_deg: float
    size_px: int
    law: str  # name of the reflectance law

    def __post_init__(self) -> None:
        require(0.0 <= self.phase_deg < 180.0, f"--phase must be in [0, 180) degrees, got {self.phase_deg:g}")
        require(
            abs(self.latitude_deg) <= 90.0, f"--sub-observer latitude must be in [-90, 90], got {self.latitude_deg:g}"
        )
        require(math.isfinite(self.longitude_deg), f"--sub-observer longitude must be finite, got {self.longitude_deg}")
        require(1 <= self.size_px <= _LARGEST_PX, f"--size must be in [1, {_LARGEST_PX}], got {self.size_px}")


def render_shape(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Shape file.")],
    target: Annotated[Path, typer.Argument(metavar="OUT.png", help="Picture, 8 bit gray.")],
    units: UnitsOption = Units.KM,
    phase: Annotated[float, typer.Option(metavar="DEG", help="Phase angle, 0 to 180; the Sun is to the right.")] = 45.0,
    sub_observer: Annotated[
        tuple[float, float], typer.Option(metavar="LON LAT", help="Point seen in the middle, degrees east and north.")
    ] = (0.0, 0.0),
    size: Annotated[int, typer.Option(metavar="PX", help="Width and height of the picture.")] = 512,
    reflectance: Annotated[str, typer.Option(metavar="LAW", help="Reflectance law with its standard parameters.")] = (
        "mcewen"
    ),
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Make a picture of a shape, body north up, seen from a hundred radii away."""
    longitude, latitude = sub_observer
    view = PictureView(phase_deg=phase, longitude_deg=longitude, latitude_deg=latitude, size_px=size, law=reflectance)
    require(target.suffix.lower() == ".png", f"{target}: pictures end in .png")
    require(overwrite or not target.exists(), f"{target} exists: name another file, or give --overwrite")
    with units_said():
        mesh = load_shape(source, units=units)
    write_bytes_atomic(target, _png(picture(mesh, view)))
    summary = {"file": str(target), "facets": len(mesh.faces), "columns": view.size_px, "rows": view.size_px}
    return show_result(summary, f"wrote {target}: {view.size_px} x {view.size_px} px", json=json)


def picture(mesh: TriangleMesh, view: PictureView) -> NDArray[np.uint8]:
    """Gray levels (size, size) of a view; the brightest parts are white."""
    distance_km = _DISTANCE_RADII * mesh.circumscribing_radius_km
    focal_px = 0.5 * _FILL * view.size_px * math.sqrt(_DISTANCE_RADII**2 - 1.0)
    middle_px = 0.5 * (view.size_px - 1)
    body = Body(
        shape=mesh,
        camera_from_body=_camera_from_body(view),
        position_camera_km=np.array([0.0, 0.0, distance_km]),
        reflectance=reflectance_from_mapping({"model": view.law}),
    )
    phase = math.radians(view.phase_deg)
    template = render(
        body,
        PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=middle_px, cy_px=middle_px),
        sun_direction_camera=np.array([math.sin(phase), 0.0, -math.cos(phase)]),
        columns=view.size_px,
        rows=view.size_px,
        options=RenderOptions(rays_per_pixel_side=3),
    )
    if isinstance(template, Failure):
        raise InputError(f"{mesh.name}: {template.detail}")
    brightness = template.placed(view.size_px, view.size_px)
    white = float(np.quantile(brightness[brightness > 0.0], _WHITE_QUANTILE))
    return np.rint(255.0 * np.clip(brightness / white, 0.0, 1.0)).astype(np.uint8)


def _camera_from_body(view: PictureView) -> Rotation:
    """Attitude of a camera over a point of the body that looks at its center, north up (image -y)."""
    east, north = east_north(view.longitude_deg, view.latitude_deg)
    outward = direction_from_radec(view.longitude_deg, view.latitude_deg)
    return Rotation.from_matrix(np.stack([east, -north, -outward]))


def _png(pixels: NDArray[np.uint8]) -> bytes:
    import cv2

    _, data = cv2.imencode(".png", pixels)
    return data.tobytes()
