"""Simulated passes with truth: limb points of an ellipsoid from its own parametric form, in numpy alone.

The horizon of the unit sphere as seen from a point c is a circle about c/|c|; an ellipsoid is that sphere, stretched.
The estimator knows it as a cone of rays instead: none of its formulas is used here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.passes import LimbPoints, NavigationPass, PassImage
from giantlike.passes.images import MeasuredPosition
from giantlike.relative.horizon.geometry import Figure

FOCAL_PX, CENTER_PX = 7312.5, (1295.5, 971.5)
MODEL = PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=CENTER_PX[0], cy_px=CENTER_PX[1])
EARTH_KM = np.array([6378.137, 6378.137, 6356.752])
TRUE_ALTITUDE_KM, ASSUMED_ALTITUDE_KM = 25.0, 35.0
NOISE_PX = 0.15
SWING_S = 700.0


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What is true of a pass, beside what is predicted."""

    altitude_km: float = TRUE_ALTITUDE_KM
    bias_rad: Float = field(default_factory=lambda: np.zeros(3))
    drift_rad_s: Float = field(default_factory=lambda: np.zeros(3))
    interlock_rad: Float = field(default_factory=lambda: np.zeros(3))
    late_s: float = 0.0
    jitter_s: float = 0.0
    step_px: float = 0.0
    offset_px: float = 0.0
    trajectory: Float = field(default_factory=lambda: np.zeros(6))


def ellipsoid_limb_px(radii_km: Float, camera_from_axes: Rotation, position_km: Float, angles: Float) -> Float:
    """Pixels (n, 2) of points of the limb at parameter angles, for a pinhole camera."""
    turn = camera_from_axes.as_matrix()
    eye = -(turn.T @ position_km) / radii_km  # the camera, where the ellipsoid is the unit sphere
    distance = float(np.linalg.norm(eye))
    axis = eye / distance
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    ring = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second)
    on_sphere = axis / distance + math.sqrt(1.0 - 1.0 / distance**2) * ring
    in_camera = (on_sphere * radii_km) @ turn.T + position_km
    pixels: Float = np.array(CENTER_PX) + FOCAL_PX * in_camera[:, :2] / in_camera[:, 2:]
    return pixels


def simulated_pass(
    truth: Truth,
    rng: np.random.Generator,
    *,
    images: int = 40,
    points: int = 24,
    sensors: tuple[str, ...] = ("a",),
    start_km: float = 150_000.0,
    speed_km_s: float = 1.2,
    rate_px_s: float = 0.8,
    arc_deg: float = 170.0,
    trajectory_sigmas: Float | None = None,
    assumed_km: float = ASSUMED_ALTITUDE_KM,
) -> NavigationPass:
    """A pass that leaves the Earth: every image a limb with noise, the prediction without what is in ``truth``."""
    made = []
    times = 30.0 * np.arange(images)
    middle = 0.5 * (times[0] + times[-1])
    axes = Rotation.from_euler("xyz", [0.4, -1.1, 0.3])
    swing = 2.0 * np.pi / SWING_S  # the camera swings to and fro across the body
    sigmas = np.zeros(6) if trajectory_sigmas is None else trajectory_sigmas
    for k, time in enumerate(times):
        depth = start_km + speed_km_s * (time - middle)
        aside = rate_px_s / FOCAL_PX / swing * math.sin(swing * time)
        turning = rate_px_s / FOCAL_PX * math.cos(swing * time)
        predicted = np.array([aside * depth, 0.01 * depth, depth])
        rate = np.array([turning * depth + aside * speed_km_s, 0.01 * speed_km_s, speed_km_s])
        partials = np.hstack([np.eye(3), (time - middle) * np.eye(3)])
        sensor = sensors[k // 2 % len(sensors)]
        late = truth.late_s + truth.jitter_s * rng.normal()
        turn = truth.bias_rad + truth.drift_rad_s * (time - middle)
        if sensor != sensors[0]:
            turn = turn + truth.interlock_rad
        camera = Rotation.from_rotvec(turn)
        where = camera.apply(predicted + partials @ truth.trajectory + late * rate)
        angles = np.radians(rng.uniform(-arc_deg / 2, arc_deg / 2, points))
        figure = Figure(radii_km=EARTH_KM, camera_from_axes=axes)
        px = ellipsoid_limb_px(EARTH_KM + truth.altitude_km, camera * axes, where, angles)
        grown = truth.offset_px + (truth.step_px if k % 2 else 0.0)
        center = np.array(CENTER_PX) + FOCAL_PX * where[:2] / where[2]
        outward = (px - center) / np.linalg.norm(px - center, axis=1)[:, None]
        made.append(
            PassImage(
                name=f"image {k}",
                time_s=float(time),
                position_camera_km=predicted,
                rate_camera_km_s=rate,
                exposure_s=5e-5 if k % 2 else 1e-6,
                sensor=sensor,
                by_trajectory=partials if trajectory_sigmas is not None else np.zeros((3, 0)),
                observed=LimbPoints(
                    points_px=px + (grown + NOISE_PX * rng.normal(size=points))[:, None] * outward,
                    sigma_px=np.full(points, NOISE_PX),
                    model=MODEL,
                    figure=figure,
                ),
            )
        )
    covariance = np.diag(sigmas**2) if trajectory_sigmas is not None else np.zeros((0, 0))
    return NavigationPass(images=tuple(made), limb_altitude_km=assumed_km, covariance_trajectory=covariance)


def as_positions(given: NavigationPass, truth: Truth, rng: np.random.Generator) -> NavigationPass:
    """The same pass with positions in place of limbs: true ones, processed with the assumed altitude, with noise."""
    made = []
    middle = 0.5 * float(given.times_s[0] + given.times_s[-1])
    mean_km = float(EARTH_KM.mean())
    for image in given.images:
        turn = Rotation.from_rotvec(truth.bias_rad + truth.drift_rad_s * (image.time_s - middle))
        where = turn.apply(
            image.position_camera_km
            + image.by_trajectory @ truth.trajectory[: image.by_trajectory.shape[1]]
            + truth.late_s * image.rate_camera_km_s
        )
        range_km = float(np.linalg.norm(where))
        radius_px = FOCAL_PX * mean_km / range_km
        grown = 1.0 + (truth.offset_px + (truth.step_px if image.exposure_s > 1e-5 else 0.0)) / radius_px
        seen = where * (mean_km + given.limb_altitude_km) / ((mean_km + truth.altitude_km) * grown)
        across, along = NOISE_PX / 5.0 * range_km / FOCAL_PX, NOISE_PX / 4.0 * range_km / radius_px
        axis = where / range_km
        covariance = across**2 * (np.eye(3) - np.outer(axis, axis)) + along**2 * np.outer(axis, axis)
        made.append(
            PassImage(
                name=image.name,
                time_s=image.time_s,
                position_camera_km=image.position_camera_km,
                rate_camera_km_s=image.rate_camera_km_s,
                exposure_s=image.exposure_s,
                sensor=image.sensor,
                by_trajectory=image.by_trajectory,
                observed=MeasuredPosition(
                    position_camera_km=seen + rng.multivariate_normal(np.zeros(3), covariance),
                    covariance_camera_km2=covariance,
                    radius_km=mean_km,
                    apparent_radius_px=radius_px,
                ),
            )
        )
    return NavigationPass(
        images=tuple(made),
        limb_altitude_km=given.limb_altitude_km,
        covariance_trajectory=given.covariance_trajectory,
    )
