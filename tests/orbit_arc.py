"""Observables of an arc with known truth: errors of noise, attitude and size are drawn and go the way of real ones."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.campaign.store.observables import observables_metadata
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.frames import rotate, skew
from giantlike.core.light import boosted
from giantlike.core.outcomes import PositionFix
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.values import Value
from giantlike.ephemeris import BARYCENTER, light_path
from giantlike.io.observables_file import write_observables
from giantlike.observables import ImageContext, Sighting, row_of_body
from giantlike.relative.budget import position_covariance
from giantlike.relative.place import place_jacobian
from giantlike.scene import Circumstances, TargetUncertainty
from giantlike.simulation.approach import demo_camera
from giantlike.simulation.orbits import CircularOrbit

CAMERA = demo_camera()
MODEL = CAMERA.model
NOISE = np.diag([0.1, 0.1, 5e-3]) ** 2  # px, px and of the range: a body of 12 px
NOISE[0, 2] = NOISE[2, 0] = 0.3 * 0.1 * 5e-3
ATTITUDE_RAD = np.array([2e-5, 2e-5, 1e-4])  # 0.07 px and, of the roll, 0.05 px in a corner
SCALE = 5e-3
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "orbit_determination.py"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arc(Value):
    """The truth of an arc.

    Parameters
    ----------
    times : (n,) float64, TDB seconds past J2000
    relative_km : callable
        Position (3,) of the spacecraft relative to the central body at a time.
    per_attitude : int
        Images in a row that share an attitude.
    drift_rad : float, rad
        Step of a random walk of the attitude, about each axis, from one of them to the next.
    bodies : mapping of str to callable
        Positions (3,) of the bodies, one an image in turn, relative to the central one.
    center : callable, optional
        Position and velocity of the central body at a time, relative to the barycenter; else on a circular orbit.
    """

    times: Float
    relative_km: Callable[[float], Float]
    per_attitude: int = 10
    drift_rad: float = 0.0
    bodies: Mapping[str, Callable[[float], Float]] = field(default_factory=lambda: {"BENNU": lambda _: np.zeros(3)})
    center: Callable[[float], tuple[Float, Float]] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Body(Value):
    """Ephemeris of a body about the central one."""

    center: Callable[[float], tuple[Float, Float]]
    offset_km: Callable[[float], Float]
    origin: str = BARYCENTER

    def inertial_from_body(self, _: float) -> Rotation:
        """Orientation of the body axes."""
        return Rotation.identity()

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s."""
        position, velocity = self.center(et)
        return position + self.offset_km(et), velocity + (self.offset_km(et + 1.0) - self.offset_km(et - 1.0)) / 2.0


def orbit_example() -> SimpleNamespace:
    """Functions of the example, which is no module of a package."""
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE)))


def write_arc(path: Path, arc: Arc, rng: np.random.Generator) -> None:
    """Write the observables file of an arc with one draw of all errors."""
    center = CircularOrbit(epoch_et=float(arc.times[0])).state if arc.center is None else arc.center
    scale_errors = rng.normal(0.0, SCALE, len(arc.bodies))
    errors = rng.normal(0.0, ATTITUDE_RAD, (1 + len(arc.times) // arc.per_attitude, 3))
    rows, walk = [], np.zeros(3)
    for k, et in enumerate(arc.times.tolist()):
        number, steps = k % len(arc.bodies), k % arc.per_attitude
        if arc.drift_rad:
            walk = walk + rng.normal(0.0, arc.drift_rad, 3) if steps else np.zeros(3)
        name = list(arc.bodies)[number]
        states, apparent_km = _circumstances(center, arc, name, et)
        pointing = _pointing(apparent_km, rng)
        told = Rotation.from_rotvec(-errors[k // arc.per_attitude] - walk) * pointing
        true_km = rotate(pointing, apparent_km)
        noise = rng.multivariate_normal(np.zeros(3), NOISE)
        center_px = MODEL.project(true_km) + noise[:2]
        range_km = float(np.linalg.norm(true_km)) * (1.0 - scale_errors[number] + noise[2])
        context = ImageContext(
            file=f"image_{k:03d}.fits",
            camera=CAMERA,
            shared_camera=CAMERA.name,
            camera_from_inertial=told,
            attitude_source="interpolated",
            attitude_covariance_rad2=np.diag(ATTITUDE_RAD**2 + steps * arc.drift_rad**2),
            attitude_shares={f"stars_{k // arc.per_attitude:03d}.fits": 1.0},
            epoch_utc=utc_text(time_from_et(et)),
            et=et,
        )
        sighting = Sighting(
            predicted_camera_km=rotate(told, apparent_km) * 1.01,
            camera_from_body=Rotation.identity(),
            sun_direction_camera=np.array([1.0, 0.0, 0.0]),
            uncertainty=TargetUncertainty(scale=SCALE),
            circumstances=states,
        )
        fix = _fix(name, center_px, range_km * MODEL.unproject(center_px))
        rows.append(row_of_body(context, sighting, fix, is_preferred=True))
    write_observables(path, rows, observables_metadata("arc", CAMERA))


def _circumstances(
    center: Callable[[float], tuple[Float, Float]], arc: Arc, name: str, et: float
) -> tuple[Circumstances, Float]:
    """States, and the apparent vector (3,) from the spacecraft to the body, km, inertial axes."""
    center_km, center_km_s = center(et)
    body = _Body(center=center, offset_km=arc.bodies[name])
    moved = arc.relative_km(et + 1.0) - arc.relative_km(et - 1.0)
    position, velocity = center_km + arc.relative_km(et), center_km_s + moved / 2.0
    seen_km, emission = light_path(body, et, position)
    states = Circumstances(
        origin=BARYCENTER,
        observer_position_km=position,
        observer_velocity_km_s=velocity,
        target_velocity_km_s=body.state(emission)[1],
        target_motion_km=body.state(et)[0] - body.state(emission)[0],
        light_time_s=et - emission,
    )
    return states, boosted(seen_km, velocity)


def _pointing(apparent_km: Float, rng: np.random.Generator) -> Rotation:
    """Attitude with the body at a random place within 300 px of the middle."""
    x, y = rng.uniform(-300.0, 300.0, 2) / 3473.0
    place = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    to_axis = Rotation.align_vectors([place], [apparent_km / np.linalg.norm(apparent_km)])[0]
    return Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * place) * to_axis


def _fix(name: str, center_px: Float, position_km: Float) -> PositionFix:
    """Fix with the parts and derivatives that the error budget gives."""
    by_turn = place_jacobian(MODEL, position_km) @ -skew(position_km)
    by_scale = np.array([[0.0], [0.0], [-1.0]])
    attitude = by_turn @ np.diag(ATTITUDE_RAD**2) @ by_turn.T
    parts = {
        Cause.NOISE: NOISE,
        Cause.SHAPE_SCALE: SCALE**2 * by_scale @ by_scale.T,
        Cause.ATTITUDE: (attitude + attitude.T) / 2.0,
    }
    in_image = sum_parts(parts)
    return PositionFix(
        estimator="cross_correlation",
        target=name,
        center_px=center_px,
        covariance_px2=in_image[:2, :2],
        predicted_px=center_px,
        residuals=np.zeros(0),
        n_used=100,
        n_rejected=0,
        score=0.0,
        parts=parts,
        partials={Cause.ATTITUDE: by_turn, Cause.SHAPE_SCALE: by_scale},
        position_camera_km=position_km,
        covariance_camera_km2=position_covariance(MODEL, position_km, in_image),
        limb_px=np.zeros((0, 2)),
    )
