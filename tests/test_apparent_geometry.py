"""Where a moving camera sees a moving body, how large, from which side and lit from where, beside rays one by one.

The truth sends a bundle of tangent rays from a moving camera to a moving sphere (``giantlike.independent``); it is
right to first order in the velocity of the body and to all orders in that of the camera.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike import FixedEphemeris, Image, Scene, Target
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.time import time_from_et
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.ephemeris import BARYCENTER
from giantlike.image import ObserverState
from giantlike.independent import Motion, aberrated, apparent_disk, unaberrated
from giantlike.scene import TargetGeometry
from giantlike.shapes import Ellipsoid

RADIUS_KM = 1737.4
TILT = Rotation.from_euler("xyz", [0.3, -0.8, 1.9])
SUN_KM = np.array([1.1e8, -0.6e8, 0.3e8])


class Straight:
    """A body in straight motion."""

    origin = BARYCENTER

    def __init__(self, position_km: Float, velocity_km_s: Float) -> None:
        self.position_km, self.velocity_km_s = position_km, velocity_km_s

    def state(self, et: float) -> tuple[Float, Float]:
        return self.position_km + et * self.velocity_km_s, self.velocity_km_s

    def inertial_from_body(self, et: float) -> Rotation:
        return TILT


def geometry(position_km: Float, body_km_s: Float, observer_km_s: Float) -> TargetGeometry:
    """As the scene predicts it; the camera is at the origin at reception, its axes are those of the sky."""
    shape = Ellipsoid(radii_km=np.full(3, RADIUS_KM))
    scene = Scene(
        targets=(Target(name="BALL", shape=shape, ephemeris=Straight(position_km, body_km_s)),),
        light=FixedEphemeris(position_km=SUN_KM),
    )
    image = Image(
        pixels=np.zeros((4, 4)),
        epoch=time_from_et(0.0),
        camera_from_inertial=Rotation.identity(),
        observer=ObserverState(position_km=np.zeros(3), velocity_km_s=observer_km_s),
    )
    predicted = scene.geometry(image)
    assert isinstance(predicted, TargetGeometry)
    return predicted


@pytest.mark.parametrize(
    "speeds", [((30.0, 12.0, -5.0),) * 2, ((0.0, 0.0, 0.0), (17.0, -28.0, 9.0)), ((-9.0, 24.0, 3.0), (21.0, 4.0, 30.0))]
)
def test_direction_size_side_and_light_are_those_of_rays(speeds: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
    body_km_s, observer_km_s = (np.array(speed) for speed in speeds)
    speeds_km_s = np.linalg.norm(body_km_s) + np.linalg.norm(observer_km_s)
    second_order = 4.0 * float(speeds_km_s) ** 2 / SPEED_OF_LIGHT_KM_S**2
    position = np.array([2.0e5, -1.5e5, 2.9e5])
    motion = Motion(observer_km_s=observer_km_s, body_km_s=body_km_s)
    seen = geometry(position, body_km_s, observer_km_s)
    center, half_angle = apparent_disk(position, RADIUS_KM, motion)
    assert_allclose(seen.position_camera_km / seen.range_km, center, rtol=0, atol=second_order)
    assert_allclose(np.arcsin(RADIUS_KM / seen.range_km), half_angle, rtol=second_order + 1e-9, atol=0)
    path = unaberrated(center[None], motion)[0]
    facing = rotate(TILT.inv(), path / np.linalg.norm(path))
    assert_allclose(rotate(seen.camera_from_body.inv(), center), facing, rtol=0, atol=second_order)
    away = position - body_km_s * np.linalg.norm(position) / SPEED_OF_LIGHT_KM_S  # when the light left, to first order
    sun = rotate(TILT.inv(), aberrated(SUN_KM - away, body_km_s))
    assert_allclose(
        rotate(seen.camera_from_body.inv(), seen.sun_direction_camera), sun, rtol=0, atol=second_order + 1e-7
    )


def test_a_moon_that_moves_along_appears_as_far_as_it_is() -> None:
    position, velocity = np.array([0.0, 3.0e5, 2.5e5]), np.array([3.0, 29.0, 4.0])
    seen = geometry(position, velocity, velocity)
    range_km = float(np.linalg.norm(position))
    contraction = range_km * float(velocity @ velocity) / SPEED_OF_LIGHT_KM_S**2
    assert abs(seen.range_km - range_km) < contraction + 1e-6  # 4 m; the length of the light path alone is 25 km off
    path_km = range_km - float(velocity @ position) / SPEED_OF_LIGHT_KM_S
    assert abs(path_km - range_km) > 25.0


class OneAtATime(Straight):
    """A body whose ephemeris bears one thread at a time, as those of SPICE do."""

    busy = threading.Lock()

    def state(self, et: float) -> tuple[Float, Float]:
        assert self.busy.acquire(blocking=False)
        time.sleep(1e-3)
        self.busy.release()
        return super().state(et)


def test_ephemerides_are_asked_by_one_thread_at_a_time() -> None:
    body = OneAtATime(np.array([2.0e5, -1.5e5, 2.9e5]), np.zeros(3))
    shape = Ellipsoid(radii_km=np.full(3, RADIUS_KM))
    scene = Scene(targets=(Target(name="BALL", shape=shape, ephemeris=body),), light=FixedEphemeris(position_km=SUN_KM))
    image = Image(
        pixels=np.zeros((4, 4)),
        epoch=time_from_et(0.0),
        camera_from_inertial=Rotation.identity(),
        observer=ObserverState(position_km=np.zeros(3), velocity_km_s=np.zeros(3)),
    )
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: scene.geometry(image), range(8)))
    assert all(isinstance(one, TargetGeometry) for one in found)
