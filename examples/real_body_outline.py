"""Centers of bodies in real images by their outlines, for images whose labels and kernels do not tell them.

The reference of ``real_body_variants.py`` where an image has no attitude. It shares nothing with the estimators but the
lens of the camera: edges are read off the image along lines across the outline of the ellipsoid, by level or by slope,
and the outline of known shape is moved and scaled onto them. Which edge is taken changes the result; the spread over
the ways to take it, over the part of the limb, and over what is uncertain of range and roll, is the uncertainty.

A disk that darkens toward its limb has its edge, at any level, inside of where it ends, and only a part of the limb is
lit: of a Lambert sphere of 160 px at 20 deg of phase the center found so is 1.0 px too far toward the Sun. So the
darkening is read off the disk (the exponent of Minnaert's law), an ellipsoid is drawn with it by the few lines here,
the same is done to that image, and what is found there is taken off.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float

HALF_WIDTH_PX, HALF_WIDTH = 30.0, 0.45  # of the lines across the outline, and that over the radius
REACH_PX, REACH = 8.0, 0.15  # from an edge to where levels of body and sky are taken, and that over the radius
STEP_PX = 0.25
ROUNDS, SETTLED_PX = 12, 0.02
BLUR_PX = 1.0  # of the image before edges are read
LEVELS = (0.35, 0.5, 0.65, None)  # of the edge between sky and body; None is the steepest slope
OUTLIER_MAD = 3.0
LEAST_SIGMA_PX = 0.3  # of the center: haze, lens and point spread function are not known better
MINNAERT = (0.3, 1.2)  # exponents that surfaces and clouds have
SIGMA_MINNAERT = 0.1  # of the exponent read off a disk: markings and bands
FACE_COSINE = 0.3  # least cosine of incidence and emission where the darkening is read off
SKY = (1.15, 1.4)  # radii between which the level of the sky is read off
RAYS = 3  # along the side of a pixel of a drawn ellipsoid


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What is known of a body in an image.

    Parameters
    ----------
    radii_km : (3,) float64, km
    camera_from_body : Rotation
    position_km : (3,) float64, km, camera axes
        The center is good to some pixels.
    sun_camera : (3,) float64
        Direction to the Sun.
    sectors_deg : sequence of (float, float), deg
        Parts of the outline to use, by the angle of its normal from +x to +y: those that no ring crosses.
    lit_cosines : sequence of float
        Least cosine between normal and Sun in the image: nearer to the terminator an edge fades.
    sigma_range : float, optional
        Standard deviation of the range over the range. Without it the size is free, which takes half an outline.
    sigma_roll_rad : float, rad
        Standard deviation of the roll.
    """

    radii_km: Float
    camera_from_body: Rotation
    position_km: Float
    sun_camera: Float
    sectors_deg: Sequence[tuple[float, float]] = ((-180.0, 180.0),)
    lit_cosines: Sequence[float] = (0.05, 0.3)
    sigma_range: float | None = None
    sigma_roll_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Outline:
    """Center of a body by its outline (2,), its standard deviation, px, and the apparent size over the one expected."""

    center_px: Float
    sigma_px: float
    scale: float
    edges_px: Float


def ellipsoid_outline(radii_km: Float, camera_from_body: Rotation, position_km: Float, angles: Float) -> Float:
    """Points (n, 3), km, camera axes, where lines of sight touch an ellipsoid."""
    to_sphere = np.diag(1.0 / radii_km) @ camera_from_body.as_matrix().T
    eye = -to_sphere @ position_km
    distance = float(np.linalg.norm(eye))
    axis = eye / distance
    back = np.linalg.inv(to_sphere)
    first = np.cross(axis, to_sphere @ np.array([0.0, 1.0, 0.0]))
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    ring = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    points = axis / distance + np.sqrt(1.0 - 1.0 / distance**2) * ring
    return np.asarray(points @ back.T + position_km)


def outline_px(camera: Camera, radii_km: Float, turn: Rotation, position_km: Float) -> tuple[Float, Float]:
    """Outline in the image (720, 2) and its outward normals."""
    angles = np.arange(720) * (2.0 * np.pi / 720)
    points = camera.model.project(ellipsoid_outline(radii_km, turn, position_km, angles))
    along = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    normals = np.stack([along[:, 1], -along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1)[:, None]
    outward = np.sign(np.sum(normals * (points - points.mean(axis=0)), axis=1))
    return points, normals * outward[:, None]


def measured_outline(pixels: Float, camera: Camera, seen: Seen) -> Outline:
    """Center of an ellipsoid whose outline lies within some pixels of that of a predicted position.

    Parameters
    ----------
    pixels : (rows, columns) float64, DN
    camera : Camera
    seen : Seen

    Returns
    -------
    Outline
        Without what the same finds on an ellipsoid that is drawn as dark toward its limb.
    """
    found = _by_edges(pixels, camera, seen)
    range_km = float(np.linalg.norm(seen.position_km)) / found.scale
    placed = replace(seen, position_km=range_km * camera.model.unproject(found.center_px))
    exponent, gain, sky = darkening(pixels, camera, placed)
    errors, scales = [], []
    for tilt in (-1.0, 0.0, 1.0):
        drawn = sky + gain * drawn_ellipsoid(camera, placed, exponent + tilt * SIGMA_MINNAERT)
        again = _by_edges(drawn, camera, placed)
        errors.append(again.center_px - found.center_px)
        scales.append(again.scale)
    by_exponent = 0.5 * float(np.linalg.norm(errors[2] - errors[0]))
    sigma_px = max(float(np.hypot(found.sigma_px, by_exponent)), LEAST_SIGMA_PX)
    return Outline(found.center_px - errors[1], sigma_px, found.scale / scales[1], found.edges_px)


def surface(camera: Camera, seen: Seen, points_px: Float) -> tuple[Float, Float]:
    """Cosines of incidence and of emission (n,) at what points (n, 2) of an image show of a body; 0 beside it."""
    to_sphere = np.diag(1.0 / seen.radii_km) @ seen.camera_from_body.as_matrix().T
    rays = camera.model.unproject(points_px)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    eye, along = -to_sphere @ seen.position_km, rays @ to_sphere.T
    half, square = along @ eye, np.sum(along**2, axis=1)
    root2 = half**2 - square * float(eye @ eye - 1.0)
    hit = root2 > 0.0
    depth = (-half - np.sqrt(np.where(hit, root2, 0.0))) / square
    normals = (eye + depth[:, None] * along) @ to_sphere
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    incidence, emission = normals @ seen.sun_camera, -np.sum(normals * rays, axis=1)
    return np.where(hit, np.maximum(incidence, 0.0), 0.0), np.where(hit, np.maximum(emission, 0.0), 0.0)


def darkening(pixels: Float, camera: Camera, seen: Seen) -> tuple[float, float, float]:
    """Exponent of Minnaert's law, brightness of a face seen and lit along its normal, and sky, DN, read off a disk.

    ``ln(I mu) = ln I0 + k ln(mu mu0)`` over the part of the disk in the sectors of the limb that are used.
    """
    rows, columns = (one.ravel() for one in np.indices(pixels.shape))
    points = np.stack([columns, rows], axis=-1).astype(np.float64)
    center = camera.model.project(seen.position_km)
    outline, _ = outline_px(camera, seen.radii_km, seen.camera_from_body, seen.position_km)
    radius_px = 0.5 * float(np.mean(np.ptp(outline, axis=0)))
    away = points - center
    angle, radii = np.degrees(np.arctan2(away[:, 1], away[:, 0])), np.linalg.norm(away, axis=1) / radius_px
    near = (radii < SKY[1]) & np.any([(angle >= low) & (angle <= high) for low, high in seen.sectors_deg], axis=0)
    values, points, radii = pixels.ravel()[near].astype(np.float64), points[near], radii[near]
    sky = float(np.median(values[radii > SKY[0]]))
    incidence, emission = surface(camera, seen, points)
    face = (np.minimum(incidence, emission) > FACE_COSINE) & (values > sky + 1.0)
    light, mu0, mu = values[face] - sky, incidence[face], emission[face]
    slope, height = np.polyfit(np.log(mu * mu0), np.log(light * mu), 1)
    return float(np.clip(slope, *MINNAERT)), float(np.exp(height)), sky


def drawn_ellipsoid(camera: Camera, seen: Seen, exponent: float) -> Float:
    """Image (rows, columns) of an ellipsoid by Minnaert's law, blurred like those of the camera."""
    outline, _ = outline_px(camera, seen.radii_km, seen.camera_from_body, seen.position_km)
    size = np.array([camera.columns, camera.rows])
    low = np.clip(np.floor(outline.min(axis=0)).astype(int) - 2, 0, size - 1)
    high = np.clip(np.ceil(outline.max(axis=0)).astype(int) + 3, 1, size)
    width, height = (high - low).tolist()
    steps = (np.arange(RAYS) + 0.5) / RAYS - 0.5
    image = np.zeros((camera.rows, camera.columns))
    rows, columns = (one.ravel() for one in np.indices((height, width)))
    for across, down in itertools.product(steps, steps):
        points = np.stack([columns + low[0] + across, rows + low[1] + down], axis=-1)
        mu0, mu = surface(camera, seen, points)
        lit = (mu0 > 0.0) & (mu > 0.0)
        light = np.zeros(len(points))
        light[lit] = mu0[lit] ** exponent * mu[lit] ** (exponent - 1.0)
        image[low[1] : high[1], low[0] : high[0]] += light.reshape(height, width) / RAYS**2
    return np.asarray(gaussian_filter(image, 0.0 if camera.psf is None else camera.psf.sigma_px))


def _by_edges(pixels: Float, camera: Camera, seen: Seen) -> Outline:
    """Center by the edges as they are, and the spread over the ways to take them."""
    spread = (-1.0, 0.0, 1.0)
    results = []
    for level, lit, tilt in itertools.product(LEVELS, seen.lit_cosines, spread):
        sight = seen.position_km / np.linalg.norm(seen.position_km)
        turn = Rotation.from_rotvec(tilt * seen.sigma_roll_rad * sight) * seen.camera_from_body
        larger = None if seen.sigma_range is None else 1.0 + tilt * seen.sigma_range
        results.append(
            _fitted(
                gaussian_filter(pixels, BLUR_PX), camera, replace(seen, camera_from_body=turn), (level, lit), larger
            )
        )
    centers = np.array([center for center, _, _ in results])
    scatter = float(np.max(np.std(centers, axis=0)))
    scale = float(np.median([one for _, one, _ in results]))
    return Outline(np.median(centers, axis=0), scatter, scale, results[0][2])


def _fitted(
    smooth: Float, camera: Camera, seen: Seen, edges: tuple[float | None, float], larger: float | None
) -> tuple[Float, float, Float]:
    """Center, size over the expected one and edges; ``larger`` is the size where that is given."""
    (level, lit_cosine), start = edges, float(np.linalg.norm(seen.position_km))
    points, _ = outline_px(camera, seen.radii_km, seen.camera_from_body, seen.position_km)
    radius_px = 0.5 * float(np.mean(np.ptp(points, axis=0)))
    range_km = start / (larger or 1.0)
    position = range_km / start * seen.position_km
    sun = seen.sun_camera[:2] / np.linalg.norm(seen.sun_camera[:2])
    for _ in range(ROUNDS):
        points, normals = outline_px(camera, seen.radii_km, seen.camera_from_body, position)
        angle = np.degrees(np.arctan2(normals[:, 1], normals[:, 0]))
        used = normals @ sun > lit_cosine
        used &= np.any([(angle >= low) & (angle <= high) for low, high in seen.sectors_deg], axis=0)
        used &= camera.contains(points, margin_px=-2.0)
        away = _edges(smooth, points[used], normals[used], level, radius_px)
        step, keep = _moved(points[used], normals[used], away, points.mean(axis=0), size_given=larger is not None)
        range_km /= 1.0 + step[2]
        center = camera.model.project(position) + step[:2]
        position = range_km * camera.model.unproject(center)
        if np.abs(step[:2]).max() < SETTLED_PX:
            break
    return center, start / range_km, (points[used] + away[:, None] * normals[used])[keep]


def _edges(smooth: Float, points: Float, normals: Float, level: float | None, radius_px: float) -> Float:
    """Distance (n,) of the edge outside of the points along the normals; NaN where there is none."""
    half_px, reach_px = min(HALF_WIDTH_PX, HALF_WIDTH * radius_px), min(REACH_PX, REACH * radius_px)
    along = np.arange(-half_px, half_px + STEP_PX, STEP_PX)
    x, y = (points[:, None] + along[:, None] * normals[:, None]).transpose(2, 0, 1)
    profiles = map_coordinates(smooth, [y, x], order=1, mode="nearest")
    slope = -np.gradient(profiles, STEP_PX, axis=1)
    steepest = np.argmax(slope, axis=1)
    found = np.full(len(points), np.nan)
    reach = round(reach_px / STEP_PX)
    for index, (profile, middle) in enumerate(zip(profiles, steepest, strict=True)):
        if not reach < middle < len(along) - reach:
            continue
        if level is None:
            before, here, after = slope[index, middle - 1 : middle + 2]
            found[index] = along[middle] + 0.5 * STEP_PX * (before - after) / (before - 2.0 * here + after)
            continue
        sky, body = float(profile[middle : middle + reach].min()), float(profile[middle - reach : middle].max())
        below = np.flatnonzero(profile[middle - reach : middle + reach] < sky + level * (body - sky))
        below = below[below > 0]
        crossing = next((one for one in below if profile[middle - reach + one - 1] >= sky + level * (body - sky)), None)
        if crossing is not None:
            high, low = profile[middle - reach + crossing - 1], profile[middle - reach + crossing]
            share = (high - sky - level * (body - sky)) / (high - low)
            found[index] = along[middle - reach + crossing - 1] + share * STEP_PX
    return found


def _moved(points: Float, normals: Float, away: Float, middle: Float, *, size_given: bool) -> tuple[Float, Float]:
    """Move and change of size of an outline (3,) that puts it on its edges, and the edges that agree."""
    by_size = np.sum((points - middle) * normals, axis=1)
    design = normals if size_given else np.column_stack([normals, by_size])
    keep = np.isfinite(away)
    for _ in range(8):
        step, *_ = np.linalg.lstsq(design[keep], away[keep], rcond=None)
        left = away - design @ step
        scatter = 1.4826 * float(np.median(np.abs(left[keep])))
        keep = np.isfinite(left) & (np.abs(left) < max(OUTLIER_MAD * scatter, 0.3))
    return np.append(step, 0.0) if size_given else step, keep
