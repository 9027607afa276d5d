"""Cameras of the paper: fields of view, projection of the fisheye, sizes of bodies, trade of sensor and lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.missions.odin.paper import narrow_camera, paper, wide_camera
from giantlike.relative.horizon.geometry import Figure, horizon_residuals

EARTH_RADIUS_KM, MOON_RADIUS_KM, MOON_DISTANCE_KM = 6371.0, 1737.4, 384_400.0
EDGE_SIGMA_PX = 0.1  # of a limb point: real-time practice rarely beats 0.07 to 0.1 px
SENSORS = {  # board-level global-shutter sensors that the maker of the paper's sells: columns, rows, pixel (um)
    "IMX287": (720, 540, 6.9),
    "IMX273": (1440, 1080, 3.45),
    "IMX265": (2048, 1536, 3.45),
    "IMX264": (2448, 2048, 3.45),
    "IMX267": (4096, 2160, 3.45),
    "IMX304": (4096, 3000, 3.45),
    "IMX183": (5472, 3648, 2.4),
}
LENSES_MM = (6.0, 8.5, 12.0, 16.0, 25.0, 35.0, 50.0)  # the series of the paper's lens


@dataclass(frozen=True)
class SensorChoice:
    """A sensor with a lens: its field of view and resolution."""

    sensor: str
    focal_mm: float
    fov_deg: float
    least_fov_deg: float
    ifov_arcsec: float
    megapixels: float
    range_sigma: float
    nearest_earth_km: float


def choices() -> tuple[SensorChoice, ...]:
    """Every sensor with every lens whose image circle (11 mm, of 2/3 inch sensors) covers it."""
    result = []
    for sensor, (columns, rows, pixel_um) in SENSORS.items():
        if np.hypot(columns, rows) * pixel_um * 1e-3 > 11.1:
            continue
        for focal_mm in LENSES_MM:
            focal_px = focal_mm * 1e3 / pixel_um
            wide, high = (float(2.0 * np.degrees(np.arctan(n / 2.0 / focal_px))) for n in (columns, rows))
            result.append(
                SensorChoice(
                    sensor=sensor,
                    focal_mm=focal_mm,
                    fov_deg=wide,
                    least_fov_deg=high,
                    ifov_arcsec=float(np.degrees(1.0 / focal_px) * 3600.0),
                    megapixels=columns * rows / 1e6,
                    range_sigma=range_sigma(focal_px, MOON_RADIUS_KM, MOON_DISTANCE_KM),
                    nearest_earth_km=float(EARTH_RADIUS_KM / np.sin(np.radians(high / 2.0))),
                )
            )
    return tuple(result)


def range_sigma(focal_px: float, radius_km: float, range_km: float) -> float:
    """Relative error of the range of a half-lit sphere from its limb, by eqs. 14 to 20 of the paper."""
    radius_px = focal_px * radius_km / float(np.sqrt(range_km**2 - radius_km**2))
    turns = np.linspace(-np.pi / 2.0, np.pi / 2.0, max(int(np.pi * radius_px), 4))
    points = radius_px * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    model = PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=0.0, cy_px=0.0)
    figure = Figure(radii_km=np.full(3, radius_km), camera_from_axes=Rotation.identity())
    design = horizon_residuals(points, model, figure, np.array([0.0, 0.0, range_km]))[1] / EDGE_SIGMA_PX
    return float(np.sqrt(np.linalg.inv(design.T @ design)[2, 2]) / range_km)


def is_dominated(choice: SensorChoice, others: tuple[SensorChoice, ...]) -> bool:
    """True if another choice sees as wide, ranges the Moon as well and has no more pixels, and one of them better."""
    mine = (choice.range_sigma, -choice.least_fov_deg, choice.megapixels)
    for other in others:
        its = (other.range_sigma, -other.least_fov_deg, other.megapixels)
        if all(a <= b * (1 + 1e-9 * np.sign(b)) for a, b in zip(its, mine, strict=True)) and its != mine:
            return True
    return False


def diameters_px(radius_km: float, ranges_km: Float, *, wide: bool) -> tuple[Float, Float]:
    """Diameter of a body in the middle and at the edge of the frame, px.

    ``ranges_km`` (n,); ``wide``: the wide camera by Table 2 (else the narrow one by Table 3); returns ``center``,
    ``edge`` (n,) px.
    """
    camera = wide_camera() if wide else narrow_camera()
    middle = np.array([camera.model.parameters[2], camera.model.parameters[3]])  # cx_px, cy_px
    edge = np.array([middle[0], 0.0]) if wide else np.array([0.0, middle[1]])
    half = np.arcsin(radius_km / ranges_km)
    center, outer = (np.array([_image_diameter(camera, at, angle) for angle in half]) for at in (middle, edge))
    return center, outer


def _image_diameter(camera: Camera, at_px: Float, half_angle: float) -> float:
    """Diameter of the circle with the area that a cone covers around a pixel; the cone may reach beyond the frame."""
    axis = unit(camera.model.unproject(at_px))
    first = unit(np.cross(axis, [1.0, 0.3, 0.0]))
    turns = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)[:, None]
    around = np.cos(half_angle) * axis + np.sin(half_angle) * (
        np.cos(turns) * first + np.sin(turns) * np.cross(axis, first)
    )
    outline = camera.model.project(around)
    x, y = outline.T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    return float(2.0 * np.sqrt(area / np.pi))


def fisheye_radius_px(angles_rad: Float) -> Float:
    """Radius (n,) in px at angles (n,) from the boresight, by Table 2."""
    camera = wide_camera()
    directions = np.stack([np.sin(angles_rad), np.zeros_like(angles_rad), np.cos(angles_rad)], axis=-1)
    return np.asarray(camera.model.project(directions)[:, 0] - camera.model.parameters[2])


def shrinkage_along_radius() -> float:
    """Scale along the radius at the edge of the field relative to the center, by Table 2."""
    edge = np.radians(paper()["wide"]["fov_deg"] / 2.0)
    step = 0.01
    near, far = fisheye_radius_px(np.array([edge - step, edge + step]))
    return float((far - near) / (2.0 * step) / paper()["fisheye"]["a0"])


def projections(angles_rad: Float) -> dict[str, Float]:
    """Radii of the usual fisheye projections with the focal length of Table 2, px."""
    focal = float(paper()["fisheye"]["a0"])
    return {
        "equidistance": focal * angles_rad,
        "equisolid": 2.0 * focal * np.sin(angles_rad / 2.0),
        "stereographic": 2.0 * focal * np.tan(angles_rad / 2.0),
        "orthographic": focal * np.sin(angles_rad),
    }


def field_of_wide_deg(half_px: float) -> float:
    """Full angle that Table 2 sees at a radius on both sides, deg."""
    camera = wide_camera()
    seen = unit(camera.model.unproject([camera.model.parameters[2] + half_px, camera.model.parameters[3]]))
    return float(2.0 * np.degrees(np.arccos(seen[2])))


def coverage(samples: int, rng: np.random.Generator) -> float:
    """Fraction of the sky in the frames of two wide cameras that look to opposite ends, by the lens of Table 2."""
    camera = wide_camera()
    directions = unit(rng.normal(size=(samples, 3)))
    seen = np.zeros(samples, dtype=bool)
    for flip in ([1.0, 1.0, 1.0], [1.0, -1.0, -1.0]):
        pixels = camera.model.project(directions * flip)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5).all(axis=1) & (pixels <= [camera.columns - 0.5, camera.rows - 0.5]).all(axis=1)
        angle = np.degrees(np.arccos(np.clip((directions * flip)[:, 2], -1.0, 1.0)))
        seen |= inside & (angle <= paper()["wide"]["fov_deg"] / 2.0)
    return float(seen.mean())
