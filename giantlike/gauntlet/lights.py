"""Light that should not be there, or is not where it should be: before the detector, all in numpy.

Each function makes a :data:`~giantlike.gauntlet.plan.Light`: (signal DN, world, random numbers) to signal.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.gauntlet.plan import Light, World, log_uniform
from giantlike.independent import Body, EllipsoidBody, Pose, Sampling, background, render_body

_OPENING_RAD = 0.5  # half opening angle of the brighter, sunward fan of a coma, rad


def background_light(
    *, slope_dn: tuple[float, float], glow_dn: float, glow_px: tuple[float, float], width_px: float
) -> Light:
    """Stray light: a plane, its rise over the frame as ``slope_dn``, and a round glow in or outside the frame."""

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        level = 0.5 * (abs(slope_dn[0]) + abs(slope_dn[1]))  # light is never negative
        shape = (signal.shape[0], signal.shape[1])
        return signal + background(
            shape,
            constant_dn=level,
            slope_dn=slope_dn,
            glare_dn=glow_dn,
            glare_center_px=glow_px,
            glare_sigma_px=width_px,
        )

    return add


def second_image(*, shift_px: tuple[int, int], share: float, blur_px: float = 0.0, turned: bool = False) -> Light:
    """A second image of everything, moved by columns and rows: a ghost, or a second exposure on the same frame."""

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        other = signal[::-1, ::-1] if turned else signal
        other = shift_image(other, shift_px)
        return signal + share * (gaussian_filter(other, blur_px) if blur_px else other)

    return add


def shift_image(image: Float, shift_px: tuple[int, int]) -> Float:
    """Shift an image by whole pixels, padded with zeros. ``shift_px``: columns and rows; returns (rows, columns)."""
    x, y = shift_px
    rows, columns = image.shape
    result = np.zeros_like(image)
    if abs(x) < columns and abs(y) < rows:
        result[max(y, 0) : rows + min(y, 0), max(x, 0) : columns + min(x, 0)] = image[
            max(-y, 0) : rows - max(y, 0), max(-x, 0) : columns - max(x, 0)
        ]
    return result


def other_body(body: Body, position_camera_km: Float, brightness: float, *, in_front: bool = False) -> Light:
    """An undeclared body near the target or in front of it; ``brightness``: ratio of the brightest pixels."""

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        pose = Pose(position_camera_km, world.camera_from_body, world.sun)
        light = render_body(
            body,
            world.view,
            pose,
            law=world.law,
            peak_dn=brightness * world.peak_dn,
            psf=world.psf,
            sampling=world.sampling,
        )
        return (signal * (1.0 - coverage(world, body, position_camera_km)) if in_front else signal) + light

    return add


def coverage(world: World, body: Body, position_camera_km: Float) -> Float:
    """Fraction (rows, columns) of each pixel that a body covers, illuminated or not."""
    toward = -position_camera_km / np.linalg.norm(position_camera_km)
    pose = Pose(position_camera_km, world.camera_from_body, toward)
    return render_body(
        body,
        world.view,
        pose,
        law=lambda incidence, emission, phase: np.ones_like(incidence),
        peak_dn=None,
        psf=world.psf,
        sampling=Sampling(cells=2, edge_rays=2),
    )


def rings(*, inner: float, outer: float, brightness: float, opacity: float) -> Light:
    """Rings in the plane of the equator: radii over that of the body, brightness over its brightest pixel."""

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        assert world.body is not None
        rows, columns = signal.shape
        rays = world.view.directions(np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1))
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        normal = world.camera_from_body.as_matrix()[:, 2]
        position, radius = world.position_camera_km, world.body.bounding_radius_km
        slant = rays @ normal
        slant = np.where(np.abs(slant) < 1e-6, 1e-6, slant)
        along = (normal @ position) / slant
        distance = np.linalg.norm(along[..., None] * rays - position, axis=-1) / radius
        on_ring = ((distance > inner) & (distance < outer) & (along > 0.0)).astype(float)
        near = along < np.linalg.norm(position)
        front = gaussian_filter(on_ring * near, world.psf.sigma_px)
        behind = gaussian_filter(on_ring * ~near, world.psf.sigma_px)
        hidden = coverage(world, world.body, position)
        light = brightness * world.peak_dn
        return signal * (1.0 - opacity * front) + light * (front + behind * (1.0 - hidden))

    return add


def coma(*, brightness: float, core_px: float, fan: float) -> Light:
    """Dust around a nucleus, brighter towards the Sun, as 1/r beyond ``core_px``.

    ``brightness``: up to there, relative to the brightest pixel of the nucleus.
    """

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        rows, columns = signal.shape
        x, y = np.arange(columns)[None, :] - world.center_px[0], np.arange(rows)[:, None] - world.center_px[1]
        distance = np.maximum(np.hypot(x, y), core_px)
        angle = np.arctan2(y, x) - math.atan2(world.sun[1], world.sun[0])
        turned = np.abs(np.angle(np.exp(1j * angle)))
        side = 1.0 + fan * np.exp(-0.5 * (turned / _OPENING_RAD) ** 2)
        return np.asarray(signal + brightness * world.peak_dn * core_px / distance * side, dtype=float)

    return add


def field_stars(count: int, faintest_dn: float, brightest_dn: float) -> Light:
    """Stars that no catalog lists, behind the body."""

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        rows, columns = signal.shape
        points = np.zeros_like(signal)
        share = rng.uniform(size=count)
        flux = faintest_dn / (1.0 - share * (1.0 - faintest_dn / brightest_dn))
        x, y = rng.uniform(0, columns - 2, count), rng.uniform(0, rows - 2, count)
        left, top = x.astype(int), y.astype(int)
        right, down = x - left, y - top
        for dx, dy, part in (
            (0, 0, (1 - right) * (1 - down)),
            (1, 0, right * (1 - down)),
            (0, 1, (1 - right) * down),
            (1, 1, right * down),
        ):
            np.add.at(points, (top + dy, left + dx), flux * part)
        light = gaussian_filter(points, world.psf.sigma_px)
        if world.body is not None:
            light = light * (1.0 - coverage(world, world.body, world.position_camera_km))
        return signal + light

    return add


def dark(signal: Float, world: World, rng: np.random.Generator) -> Float:
    """Nothing but a level: the shutter stayed closed, or the camera looked elsewhere."""
    return np.full_like(signal, float(signal.min()))


def moon_of(rng: np.random.Generator, world: World) -> tuple[EllipsoidBody, Float]:
    """A spherical moon between camera and target: its shape, and its position (3,) in camera axes, km."""
    assert world.body is not None
    radius = world.body.bounding_radius_km
    share = log_uniform(rng, 0.15, 0.5)
    side = Rotation.from_rotvec(rng.uniform(0.0, 2.0 * math.pi) * np.array([0.0, 0.0, 1.0])).apply([1.0, 0.0, 0.0])
    place = world.position_camera_km + radius * rng.uniform(0.2, 1.0) * side
    return EllipsoidBody((0.9 * share * radius,) * 3), 0.9 * place
