"""Images of stars and Moon by the independent renderer, through the lens as it was, and of the Earth in its air."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.frames import direction_from_radec
from giantlike.core.values import Value
from giantlike.independent import (
    PinholeView,
    Pose,
    Psf,
    Recorder,
    ReliefBody,
    StarField,
    record,
    render_body,
    rough,
    star_image,
)
from giantlike.missions.artemis1.passes import Pass, Setting, sun_direction
from giantlike.relative.horizon.geometry import Figure

_MARGIN_PX = 14
_STRIKE_PX = np.array([1.5, 2.0])
"""Place of the pixels filled by radiation beside a star: near enough to be detected as one source [assumed]."""
_RAYS = ((100.0, 4), (250.0, 3), (math.inf, 2))
"""Largest radius, px, and rays along the side of a pixel: steps of the limb are averaged along it and blurred."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageWindow(Value):
    """One image: the window around the body, and its truth."""

    pixels_dn: Float  # (rows, columns)
    model: PinholeModel | BrownModel  # of the window
    corner_px: Float  # first pixel of the window in the frame
    position_camera_km: Float  # True position of the body
    radius_px: float  # apparent radius


def detected_altitude_km(setting: Setting, exposure_us: float, wavelength_nm: float | None = None) -> float:
    """Altitude at which an edge by moments finds the limb: the height of a step that holds the same light."""
    air = setting.air if wavelength_nm is None else setting.air.seen_at(wavelength_nm)
    altitudes = np.linspace(0.0, 200.0, 20001)
    level = exposure_us / setting.data["earth"]["saturating_exposure_us"]
    light = np.minimum(level * air.brightness(altitudes, float(setting.figure("earth").radii_km.mean())), 1.0)
    return float(np.trapezoid(light, altitudes)) / min(float(level), 1.0)


def earth_shot(
    setting: Setting, position_km: Float, sun: Float, exposure_us: float, rng: np.random.Generator | None
) -> ImageWindow:
    """Take an image of the Earth in its atmosphere: clouds below, molecules above the limb."""
    level_dn = setting.detector.saturation_dn * exposure_us / setting.data["earth"]["saturating_exposure_us"]
    model, figure = setting.model, setting.figure("earth")
    radius_px, low, size = _window(setting, model, figure, position_km)
    rays = next(count for largest, count in _RAYS if radius_px <= largest)
    steps, rows = ((np.arange(size[k] * rays) + 0.5) / rays - 0.5 + low[k] for k in range(2))
    fine = _light(setting, figure, position_km, sun, level_dn, np.stack(np.meshgrid(steps, rows), axis=-1))
    blurred = gaussian_filter(fine, setting.psf.sigma_px * rays)
    pixels = blurred.reshape(size[1], rays, size[0], rays).mean(axis=(1, 3))
    return ImageWindow(
        pixels_dn=pixels if rng is None else _record(setting, pixels, rng),
        model=replace(model, cx_px=model.cx_px - low[0], cy_px=model.cy_px - low[1]),
        corner_px=low,
        position_camera_km=position_km,
        radius_px=radius_px,
    )


def made_up_moon(setting: Setting, seed: int) -> ReliefBody:
    """Make a Moon with the relief that was expected before flight: hills down to 90 km half across."""
    radii_km, relief_km = setting.figure("moon").radii_km, setting.data["moon"]["relief_km"]
    ground = rough(seed, rms=relief_km / float(radii_km[0]), degrees=(2.5, 60.0), count=200, cells=128)
    return ReliefBody(radii_km, ground)


def _camera_from_moon(one: Pass) -> Rotation:
    """Orientation of the Moon in a pass: another side of it in each (longitudes by the golden angle)."""
    longitude = math.radians(137.5 * one.number)
    latitude = math.radians(40.0) * math.sin(longitude * 1.7)
    toward = direction_from_radec(math.degrees(longitude), math.degrees(latitude))
    right = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    return Rotation.from_matrix([right, np.cross(right, toward), -toward])


def moon_shot(
    setting: Setting,
    body: ReliefBody,
    one: Pass,
    position_km: Float,
    lens: BrownModel,
    camera: BrownModel,
    rng: np.random.Generator,
) -> ImageWindow:
    """Take an image of the Moon through a lens; the window is that of the camera as it was calibrated."""
    radius_px, low, size = _window(setting, lens, setting.figure("moon"), position_km)
    pose = Pose(position_km, _camera_from_moon(one), sun_direction(one.phase_deg))
    view, psf = _view(lens, low, size), Psf(sigma_px=setting.psf.sigma_px)
    light = render_body(body, view, pose, peak_dn=setting.data["moon"]["peak_dn"], psf=psf)
    return ImageWindow(
        pixels_dn=_record(setting, light, rng),
        model=replace(camera, cx_px=camera.cx_px - low[0], cy_px=camera.cy_px - low[1]),
        corner_px=low,
        position_camera_km=position_km,
        radius_px=radius_px,
    )


def star_shot(
    setting: Setting,
    field: StarField,
    attitude: Rotation,
    lens: BrownModel,
    rng: np.random.Generator,
    *,
    struck: bool = False,
) -> Float:
    """Take an image of stars, (rows, columns), DN; ``struck``: radiation fills pixels beside a faint star."""
    data, rules = setting.data["camera"], setting.data["calibration"]
    view = _view(lens, np.zeros(2), np.array([data["columns"], data["rows"]]))
    psf = Psf(sigma_px=setting.psf.sigma_px)
    light, places = star_image(field, view, attitude, psf=psf, zero_point_dn=rules["zero_point_dn"])
    if struck:
        inner = np.flatnonzero((np.abs(places - view.center_px) < 0.3 * view.rows).all(axis=1))
        near = inner[np.argmin(np.abs(field.magnitudes[inner] - rules["max_magnitude"] + 0.5))]
        x, y = np.rint(places[near] + _STRIKE_PX).astype(int)
        light[y - 1 : y + 2, x - 1 : x + 2] += 0.25 * setting.detector.saturation_dn
    return _record(setting, light, rng)


def _view(lens: BrownModel, low: Float, size: NDArray[np.intp]) -> PinholeView:
    """A window of the camera for the independent renderer."""
    return PinholeView(
        focal_px=lens.fx_px,
        aspect=lens.fy_px / lens.fx_px,
        center_px=(lens.cx_px - low[0], lens.cy_px - low[1]),
        columns=int(size[0]),
        rows=int(size[1]),
        **{name: getattr(lens, name) for name in ("skew_px", "k1", "k2", "k3", "p1", "p2")},
    )


def _window(
    setting: Setting, model: BrownModel | PinholeModel, figure: Figure, position_km: Float
) -> tuple[float, Float, NDArray[np.intp]]:
    """Apparent radius of a body, px, first column and row of the window around it, and its columns and rows."""
    radius, distance = float(figure.radii_km.max()), float(np.linalg.norm(position_km))
    radius_px = setting.model.fx_px * radius / math.sqrt(distance**2 - radius**2)
    center, reach = model.project(position_km), radius_px + _MARGIN_PX
    low = np.floor(center - reach)
    return radius_px, low, (np.ceil(center + reach) - low + 1.0).astype(np.intp)


def _record(setting: Setting, signal_dn: Float, rng: np.random.Generator) -> Float:
    own = setting.detector
    recorder = Recorder(gain_e_per_dn=own.gain_e_per_dn, read_noise_e=own.read_noise_e, saturation_dn=own.saturation_dn)
    return record(signal_dn, rng, recorder).pixels


def limb_px(model: PinholeModel, figure: Figure, position_km: Float, around_rad: Float) -> tuple[Float, Float]:
    """Limb points (n, 2), px, of an ellipsoid toward position angles in the image, and their outward normals (n, 2)."""
    eye = -figure.to_sphere @ position_km  # the camera, where the body is the unit sphere
    distance = float(np.linalg.norm(eye))
    axis = eye / distance
    way = np.stack([np.cos(around_rad), np.sin(around_rad), np.zeros_like(around_rad)], axis=-1) @ figure.to_sphere.T
    way -= (way @ axis)[:, None] * axis
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    on_sphere = axis / distance + math.sqrt(1.0 - 1.0 / distance**2) * way
    points = model.project(position_km + on_sphere @ np.linalg.inv(figure.to_sphere).T)
    arms = points - model.project(position_km)
    return points, arms / np.linalg.norm(arms, axis=-1, keepdims=True)


def _light(setting: Setting, figure: Figure, position_km: Float, sun: Float, level_dn: float, pixels: Float) -> Float:
    """Signal (rows, columns), DN, at positions (rows, columns, 2) of the frame, without blur and noise."""
    to_sphere = figure.to_sphere
    rays = np.concatenate(
        [(pixels - [setting.model.cx_px, setting.model.cy_px]) / setting.model.fx_px, np.ones((*pixels.shape[:2], 1))],
        axis=-1,
    )
    eye, ways = to_sphere @ position_km, rays @ to_sphere.T
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    along = ways @ eye
    closest = along[..., None] * ways - eye  # from the center of the unit sphere to the ray
    offset = np.sqrt(np.einsum("ijk,ijk->ij", closest, closest))
    limb = float(figure.radii_km.mean())
    altitude = (offset - 1.0) * limb
    scale = np.where(offset > 1e-9, np.minimum(offset, 1.0) / np.maximum(offset, 1e-9), 1.0)
    inward = np.sqrt(np.maximum(1.0 - np.minimum(offset, 1.0) ** 2, 0.0))
    normals = closest * scale[..., None] - inward[..., None] * ways
    outward = normals @ figure.camera_from_axes.as_matrix().T
    incidence = np.maximum(outward @ sun, 0.0)
    lit = np.sqrt(incidence)  # clouds and air brighten the terminator less than Lambert's law
    signal: Float = level_dn * lit * setting.air.brightness(altitude, limb)
    return signal
