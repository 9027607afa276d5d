"""Viewing geometry, there and back: angles measured on an exact scene lead to the scene again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.independent import PinholeView
from giantlike.io.viewing_geometry import ViewingGeometry

FOCAL_PX, CENTER_PX = 2500.0, (511.5, 400.0)
VIEW = PinholeView(FOCAL_PX, CENTER_PX, 1024, 801, k1=-0.3)
MODEL = BrownModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=CENTER_PX[0], cy_px=CENTER_PX[1], k1=-0.3)
SMALL = 1e-6
"""Length, relative to the range, of an arrow whose picture is measured: perspective turns it by as much, rad."""


def azimuth_rad(position: np.ndarray, arrow: np.ndarray) -> float:
    """Angle of the picture of a short arrow at a body from the +x axis of the image towards +y."""
    start, end = (VIEW.project(position + length * SMALL * np.linalg.norm(position) * arrow) for length in (-1, 1))
    return float(np.arctan2(*(end - start)[::-1]))


def scene(seed: int) -> tuple[ViewingGeometry, np.ndarray, Rotation, np.ndarray]:
    """A random scene, and the angles by which it is described."""
    random = np.random.default_rng(seed)
    sight = VIEW.directions([random.uniform(0, 1023), random.uniform(0, 800)])
    position = random.uniform(10.0, 1e6) * sight / np.linalg.norm(sight)
    turn, sun = Rotation.random(random_state=seed), random.normal(size=3)
    sun /= np.linalg.norm(sun)
    viewer = -position / np.linalg.norm(position)
    stated = ViewingGeometry(
        target="BODY",
        center_px=VIEW.project(position),
        range_km=float(np.linalg.norm(position)),
        north_azimuth_rad=azimuth_rad(position, rotate(turn, np.array([0.0, 0.0, 1.0]))),
        observer_direction_body=rotate(turn.inv(), viewer),
        sun_direction_body=rotate(turn.inv(), sun),
        # of the part across the line of sight: an arrow of any length along it would do as well
        sun_azimuth_rad=azimuth_rad(position, sun - (sun @ viewer) * viewer),
        phase_angle_rad=float(np.arccos(sun @ viewer)),
    )
    return stated, position, turn, sun


@pytest.mark.parametrize("seed", range(12))
def test_the_angles_of_a_scene_lead_to_the_scene_again(seed: int) -> None:
    stated, position, turn, sun = scene(seed)
    by_points = dataclasses.replace(stated, sun_azimuth_rad=None, phase_angle_rad=None)
    by_angles = dataclasses.replace(stated, sun_direction_body=None)
    for given in (stated, by_points, by_angles):
        found = given.in_camera(MODEL)
        assert_allclose(found.position_camera_km, position, rtol=1e-10)
        assert found.camera_from_body is not None
        assert (found.camera_from_body * turn.inv()).magnitude() < 20 * SMALL
        assert_allclose(found.sun_direction_camera, sun, rtol=0, atol=20 * SMALL)
    sphere = dataclasses.replace(by_angles, north_azimuth_rad=None, observer_direction_body=None)
    assert sphere.in_camera(MODEL).camera_from_body is None


def test_over_a_pole_the_azimuth_is_the_meridian_s() -> None:
    stated, *_ = scene(1)
    pole, prime = np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])
    above = dataclasses.replace(
        stated, observer_direction_body=pole, sun_direction_body=None, north_azimuth_rad=0.4
    ).in_camera(MODEL)
    turn, position = above.camera_from_body, above.position_camera_km
    assert turn is not None
    assert_allclose(rotate(turn, pole), -position / np.linalg.norm(position), rtol=0, atol=1e-12)
    assert azimuth_rad(position, rotate(turn, prime)) == pytest.approx(0.4, abs=20 * SMALL)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"phase_angle_rad": 0.5}, "phase angle is 28.65 deg, but the sub-solar point is"),
        ({"sun_azimuth_rad": 0.3}, "Sun by its azimuth is"),
        ({"north_azimuth_rad": None}, "both the north azimuth and the sub-observer point"),
        ({"sun_direction_body": None, "phase_angle_rad": None}, "or the phase angle and the Sun azimuth"),
        ({"north_azimuth_rad": None, "observer_direction_body": None}, "needs the orientation"),
        ({"range_km": 0.0}, "range must be > 0"),
    ],
)
def test_circumstances_that_disagree_or_do_not_suffice_are_refused(change: dict[str, object], message: str) -> None:
    stated, *_ = scene(5)
    with pytest.raises(InputError, match=message):
        dataclasses.replace(stated, **change).in_camera(MODEL)  # type: ignore[arg-type]


def test_rounded_angles_agree() -> None:
    stated, _, _, sun = scene(3)
    assert stated.phase_angle_rad is not None
    assert stated.sun_azimuth_rad is not None
    rounded = dataclasses.replace(
        stated, phase_angle_rad=stated.phase_angle_rad + 0.01, sun_azimuth_rad=stated.sun_azimuth_rad + 0.05
    )
    assert_allclose(rounded.in_camera(MODEL).sun_direction_camera, sun, rtol=0, atol=20 * SMALL)
