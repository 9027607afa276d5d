"""Small control networks with known truth, and a dense reference that shares no code with the package."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.network import Photo, Tracks

CAMERA = PinholeModel(fx_px=2000.0, fy_px=2000.0, cx_px=499.5, cy_px=499.5)
SIGMA_PX = 0.5


@dataclass
class World:
    """Truth of a network, and its images and measures."""

    points_km: Float
    rotations: Rotation
    positions_km: Float
    photos: list[Photo] = field(default_factory=list)
    tracks: Tracks = None  # type: ignore[assignment]


def looking_at_center(positions: Float) -> Rotation:
    """Attitudes of cameras that look at the center of the body."""
    matrices = []
    for position in positions:
        z = -position / np.linalg.norm(position)
        x = np.cross([0.1, 0.2, 1.0], z)
        x /= np.linalg.norm(x)
        matrices.append(np.stack([x, np.cross(z, x), z]))
    return Rotation.from_matrix(np.array(matrices))


def world(
    seed: int,
    *,
    images: int = 6,
    points: int = 40,
    sigma_px: float = SIGMA_PX,
    angles: Float | None = None,
    sigma_pose: tuple[float, float] = (1e-3, 0.05),
    **tracks: Any,
) -> World:
    """Points within 1 km, seen by all images from 10 km over 60 degrees, poses drawn from their a priori."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(points, 3))
    truth *= (rng.uniform(0.5, 1.0, points) / np.linalg.norm(truth, axis=1))[:, None]
    angle = np.linspace(-0.5, 0.5, images) if angles is None else angles
    height = 2.0 * np.sin(np.arange(images) * 2.0)
    positions = 10.0 * np.stack([np.cos(angle), np.sin(angle), height / 10.0], axis=1)
    rotations = looking_at_center(positions)
    covariance = np.diag([sigma_pose[0] ** 2] * 3 + [sigma_pose[1] ** 2] * 3)
    photos, pixels = [], []
    for k in range(images):
        moved = rng.normal(size=6) * np.sqrt(np.diag(covariance))
        photos.append(
            Photo(
                name=f"image {k}",
                model=CAMERA,
                camera_from_inertial=Rotation.from_rotvec(moved[:3]) * rotations[k],
                position_km=positions[k] + moved[3:],
                covariance_pose=covariance,
            )
        )
        look = rotations[k].apply(truth - positions[k])
        pixels.append(CAMERA.project(look) + rng.normal(0.0, sigma_px, (points, 2)))
    found = World(truth, rotations, positions, photos)
    found.tracks = Tracks(
        names=tuple(f"p{k}" for k in range(points)),
        point=np.tile(np.arange(points), images),
        photo=np.repeat(np.arange(images), points),
        points_px=np.concatenate(pixels),
        sigma_px=np.array(SIGMA_PX),
        **tracks,
    )
    return found


def dense_covariance(photos: list[Photo], start: list[Photo], tracks: Tracks, points_km: Float) -> tuple[Float, Float]:
    """Covariances of the poses (m, 6, 6) and the points (p, 3, 3) by the whole normal matrix.

    Derivatives are central differences of a pinhole written here; a priori covariances are those of
    ``start`` and tracks.
    """
    m, p = len(photos), len(points_km)
    size = 6 * m + 3 * p
    information = np.zeros((size, size))
    matrices = [photo.camera_from_inertial.as_matrix() for photo in photos]
    bodies = [photo.inertial_from_body.as_matrix() for photo in photos]

    def project(k: int, change: Float, point: Float) -> Float:
        model = photos[k].model
        look = (
            Rotation.from_rotvec(change[:3]).as_matrix() @ matrices[k]
            @ (bodies[k] @ (point + change[6:]) - photos[k].position_km - change[3:6])
        )  # fmt: skip
        fx, fy, cx, cy = model.parameters[:4]
        return np.array([fx * look[0] / look[2] + cx, fy * look[1] / look[2] + cy])

    for i, k, sigma in zip(tracks.point, tracks.photo, tracks.sigma_px, strict=True):
        jacobian = np.empty((2, 9))
        for column in range(9):
            step = np.zeros(9)
            step[column] = 1e-6 if column < 3 else 1e-5
            jacobian[:, column] = (project(k, step, points_km[i]) - project(k, -step, points_km[i])) / (
                2 * step[column]
            )
        rows = np.r_[6 * k : 6 * k + 6, 6 * m + 3 * i : 6 * m + 3 * i + 3]
        information[np.ix_(rows, rows)] += jacobian.T @ jacobian / sigma**2
    for k, photo in enumerate(start):
        if photo.covariance_pose is not None:
            by_turn = np.eye(6)
            for column, step in enumerate(1e-6 * np.eye(3)):
                ahead, behind = (
                    (photo.camera_from_inertial * (Rotation.from_rotvec(each) * photos[k].camera_from_inertial).inv())
                    for each in (step, -step)
                )
                by_turn[:3, column] = (ahead.as_rotvec() - behind.as_rotvec()) / -2e-6
            rows = slice(6 * k, 6 * k + 6)
            information[rows, rows] += by_turn.T @ np.linalg.inv(photo.covariance_pose) @ by_turn
    for i, covariance in enumerate(np.asarray(tracks.covariance_points_km2)):
        if np.isfinite(covariance).all():
            rows = np.arange(6 * m + 3 * i, 6 * m + 3 * i + 3)
            information[np.ix_(rows, rows)] += np.linalg.inv(covariance)
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    poses = np.array([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(m)])
    first = 6 * m
    points = np.array(
        [covariance[first + 3 * i : first + 3 * i + 3, first + 3 * i : first + 3 * i + 3] for i in range(p)]
    )
    return poses, points
