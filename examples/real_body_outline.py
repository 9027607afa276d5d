"""Centers of bodies in real images by their outlines, for images whose labels and kernels do not tell them.

The reference of ``real_body_variants.py`` where an image has no attitude. It shares nothing with the estimators but the
lens of the camera: edges are read off the image along lines across the outline of the ellipsoid, by level or by slope,
and the outline of known shape is moved and scaled onto them. Which edge is taken changes the result; the spread over
the ways to take it, over the part of the limb, and over what is uncertain of range and roll, is the uncertainty.
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
    """
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
    return Outline(np.median(centers, axis=0), max(scatter, LEAST_SIGMA_PX), scale, results[0][2])


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
