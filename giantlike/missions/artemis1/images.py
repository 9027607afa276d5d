"""Images of the Moon with a rough limb and of the Earth in its atmosphere, and exposures that fill pixels.

Light is a function of the position on the disk: of the distance from the limb, and of the incidence of the Sun below. A
limb that is rough is a disk whose radius changes with the position angle; an atmosphere is light above the limb.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import Detector
from giantlike.core.values import Value
from giantlike.missions.artemis1.passes import Setting
from giantlike.relative.horizon.geometry import Figure

_MARGIN_PX = 14
_RAYS = ((100.0, 4), (250.0, 3), (math.inf, 2))
"""Largest radius, px, and rays along the side of a pixel: steps of the limb are averaged along it and blurred."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageWindow(Value):
    """One image: the window around the body, and its truth."""

    pixels_dn: Float  # (rows, columns)
    model: PinholeModel  # of the window
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


def moon_shot(
    setting: Setting, position_km: Float, sun: Float, heights_km: Float, rng: np.random.Generator | None
) -> ImageWindow:
    """Take an image of the Moon whose limb stands at heights (n,) at evenly spaced position angles."""
    figure, moon = setting.figure("moon"), setting.data["moon"]

    def light(offset: Float, angle: Float) -> Float:
        count = heights_km.size
        around = 2.0 * math.pi * np.arange(count + 1) / count
        height = np.interp(angle % (2.0 * math.pi), around, np.append(heights_km, heights_km[0]))
        scaled: Float = offset * moon["radius_km"] / (moon["radius_km"] + height)
        return scaled

    return _shot(setting, figure, position_km, sun, light, (moon["peak_dn"], 0.0), rng)


def earth_shot(
    setting: Setting, position_km: Float, sun: Float, exposure_us: float, rng: np.random.Generator | None
) -> ImageWindow:
    """Take an image of the Earth in its atmosphere: clouds below, molecules above the limb."""
    level_dn = setting.detector.saturation_dn * exposure_us / setting.data["earth"]["saturating_exposure_us"]
    return _shot(setting, setting.figure("earth"), position_km, sun, None, (level_dn, 1.0), rng)


def _shot(
    setting: Setting,
    figure: Figure,
    position_km: Float,
    sun: Float,
    reshaped: Callable[[Float, Float], Float] | None,
    level: tuple[float, float],
    rng: np.random.Generator | None,
) -> ImageWindow:
    """Render, blur and record the window around a body."""
    model, radius = setting.model, float(figure.radii_km.max())
    distance = float(np.linalg.norm(position_km))
    center = model.project(position_km)
    reach = model.fx_px * radius / math.sqrt(distance**2 - radius**2) + _MARGIN_PX
    low, high = np.floor(center - reach).astype(int), np.ceil(center + reach).astype(int)
    size, rays = high - low + 1, next(count for largest, count in _RAYS if reach - _MARGIN_PX <= largest)
    steps = (np.arange(size[0] * rays) + 0.5) / rays - 0.5 + low[0]
    rows = (np.arange(size[1] * rays) + 0.5) / rays - 0.5 + low[1]
    fine = _light(setting, figure, position_km, sun, reshaped, level, np.stack(np.meshgrid(steps, rows), axis=-1))
    blurred = gaussian_filter(fine, setting.psf.sigma_px * rays)
    pixels = blurred.reshape(size[1], rays, size[0], rays).mean(axis=(1, 3))
    window = PinholeModel(
        fx_px=model.fx_px, fy_px=model.fy_px, cx_px=model.cx_px - float(low[0]), cy_px=model.cy_px - float(low[1])
    )
    return ImageWindow(
        pixels_dn=pixels if rng is None else read_out(pixels, setting.detector, rng),
        model=window,
        corner_px=low.astype(np.float64),
        position_camera_km=position_km,
        radius_px=reach - _MARGIN_PX,
    )


def lunar_share(phase_deg: float) -> float:
    """Fraction of the law of Lommel and Seeliger in the reflectance of the Moon; the rest is Lambert's.

    Source: McEwen (1996), A precise lunar photometric function, Lunar and Planetary Science 27, 841: the cubic.
    """
    return max(1.0 - 0.019 * phase_deg + 2.42e-4 * phase_deg**2 - 1.46e-6 * phase_deg**3, 0.0)


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


def _light(
    setting: Setting,
    figure: Figure,
    position_km: Float,
    sun: Float,
    reshaped: Callable[[Float, Float], Float] | None,
    level: tuple[float, float],
    pixels: Float,
) -> Float:
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
    if reshaped is not None:
        center = setting.model.project(position_km)
        arm = pixels - center
        offset = reshaped(offset, np.arctan2(arm[..., 1], arm[..., 0]))
    on_disk = offset < 1.0
    scale = np.where(offset > 1e-9, np.minimum(offset, 1.0) / np.maximum(offset, 1e-9), 1.0)
    inward = np.sqrt(np.maximum(1.0 - np.minimum(offset, 1.0) ** 2, 0.0))
    normals = closest * scale[..., None] - inward[..., None] * ways
    outward = normals @ figure.camera_from_axes.as_matrix().T
    incidence = np.maximum(outward @ sun, 0.0)
    if level[1] == 0.0:  # the Moon
        share = lunar_share(math.degrees(math.acos(-float(position_km @ sun) / float(np.linalg.norm(position_km)))))
        lunar = 2.0 * incidence / np.maximum(incidence + inward, 1e-9)
        return level[0] * np.where(on_disk, share * lunar + (1.0 - share) * incidence, 0.0)
    lit = np.sqrt(incidence)  # clouds and air brighten the terminator less than Lambert's law
    signal: Float = level[0] * lit * setting.air.brightness(altitude, limb)
    return signal


def read_out(signal_dn: Float, detector: Detector, rng: np.random.Generator) -> Float:
    """Pixels with shot and read noise, clipped and rounded."""
    electrons = rng.poisson(np.maximum(signal_dn, 0.0) * detector.gain_e_per_dn)
    noisy = (electrons + rng.normal(0.0, detector.read_noise_e, signal_dn.shape)) / detector.gain_e_per_dn
    return np.rint(np.clip(noisy, -64.0, detector.saturation_dn))


def find_saturated(shot: ImageWindow, detector: Detector) -> Mask:
    """Clipped pixels of an image."""
    return shot.pixels_dn >= detector.saturation_dn
