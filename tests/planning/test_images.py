"""Geometry of planned images by hand, and the reasons for which candidates are of no use."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import time_from_et
from giantlike.core.units import AU_KM, RAD_PER_DEG
from giantlike.ephemeris import ApparentGeometry, FixedEphemeris, TableEphemeris
from giantlike.image import ObserverState
from giantlike.io.ephemeris_table import EphemerisSamples
from giantlike.io.geometry_table import GeometryRow, GeometryTable
from giantlike.planning import (
    Candidate,
    Plan,
    PlanOptions,
    candidates_from_table,
    candidates_in_window,
    plan_images,
)
from giantlike.scene import Scene, Target
from giantlike.shapes import sphere
from tests.simulated import ET, small_camera, sphere_scene

CAMERA = small_camera()
ONE = PlanOptions(exposures_s=(0.5,))
HERE = Candidate(name="a.fits", epoch=time_from_et(ET), camera_from_inertial=Rotation.identity())


def plan_of(*candidates: Candidate, options: PlanOptions = ONE, phase_deg: float = 60.0) -> Plan:
    plan = plan_images(candidates, CAMERA, sphere_scene(1000.0, phase_deg), None, options)
    assert isinstance(plan, Plan)
    return plan


def test_size_phase_and_elongation_are_those_of_the_geometry() -> None:
    (image,) = plan_of(HERE).images
    assert image.failure is None
    assert_allclose(image.diameter_px, 60.0, rtol=1e-12)
    assert_allclose(image.phase_rad, 60.0 * RAD_PER_DEG, rtol=1e-12)
    assert_allclose(image.elongation_rad, 120.0 * RAD_PER_DEG, rtol=1e-12)  # from behind the camera, 60 deg to the side
    assert_allclose(image.center_px, [99.5, 99.5], atol=1e-9)
    assert image.blur_px == 0.0


def test_motion_is_that_of_the_states_and_of_the_camera() -> None:
    place = ApparentGeometry(
        position_inertial_km=np.array([0.0, 0.0, 1000.0]), velocity_inertial_km_s=np.array([2.0, 31.0, 0.0])
    )
    observer = ObserverState(position_km=np.array([AU_KM, 0.0, 0.0]), velocity_km_s=np.array([0.0, 30.0, 0.0]))
    moving = replace(HERE, places={"BALL": place}, observer=observer)
    turning = replace(moving, name="b.fits", angular_rate_camera_rad_s=np.array([0.0, 2e-3, 0.0]))
    first, second = plan_of(moving, turning).images
    assert_allclose(first.rate_px_s, [2.0, 1.0], rtol=1e-9)
    assert_allclose(first.star_rate_px_s, 0.0)
    assert_allclose(second.rate_px_s, [0.0, 1.0], atol=1e-9)  # +y rotation takes the axis to +x: the sky goes to -x
    assert_allclose(second.star_rate_px_s, [-2.0, 0.0], atol=1e-9)
    assert_allclose(first.blur_px, 0.5 * math.sqrt(5.0), rtol=1e-9)


def test_candidates_of_no_use_have_a_reason() -> None:
    aside = replace(HERE, name="aside.fits", camera_from_inertial=Rotation.from_euler("y", 20.0, degrees=True))
    behind = replace(HERE, name="behind.fits", camera_from_inertial=Rotation.from_euler("x", 180.0, degrees=True))
    lost = replace(HERE, name="lost.fits", camera_from_inertial=None, failure=Failure(Reason.NO_GEOMETRY, "lost"))
    within = replace(
        HERE, name="within.fits", places={"BALL": ApparentGeometry(position_inertial_km=np.array([0.0, 0.0, 20.0]))}
    )
    plan = plan_of(HERE, aside, behind, lost, within)
    reasons = [None if image.failure is None else image.failure.reason for image in plan.images]
    assert reasons == [
        None, Reason.OUT_OF_FRAME, Reason.OUT_OF_FRAME, Reason.NO_GEOMETRY, Reason.DEGENERATE_GEOMETRY
    ]  # fmt: skip
    assert [image.candidate.name for image in plan.usable] == ["a.fits"]
    assert "behind the camera" in plan.images[2].failure.detail  # type: ignore[union-attr]
    near_sun = plan_images([HERE], CAMERA, sphere_scene(1000.0, 160.0), None, replace(ONE, keep_out_deg=30.0))
    assert isinstance(near_sun, Failure)
    assert near_sun.reason is Reason.SUN_KEEP_OUT
    assert "20.0 deg from the Sun, keep_out_deg is 30" in near_sun.detail


def test_a_window_points_the_camera_at_the_body_and_refuses_epochs_without_ephemeris() -> None:
    ball, camera_km = np.array([AU_KM, 0.0, 0.0]), np.array([AU_KM, 3000.0, 500.0])
    samples = EphemerisSamples(
        et=ET + np.array([0.0, 600.0]),
        position_km=np.stack([camera_km, camera_km]),
        velocity_km_s=np.zeros((2, 3)),
        inertial_from_body=None,
    )
    scene = Scene(
        targets=(Target(name="BALL", shape=sphere(30.0), ephemeris=FixedEphemeris(position_km=ball)),),
        observer=TableEphemeris(samples),
        light=FixedEphemeris(),
    )
    window = candidates_in_window([ET, ET + 300.0, ET + 900.0], CAMERA, scene, at_px=(40.0, 120.0), exposure_s=0.1)
    plan = plan_images(window, CAMERA, scene, None)
    assert isinstance(plan, Plan)
    for image in plan.images[:2]:
        assert_allclose(image.center_px, [40.0, 120.0], atol=1e-6)
        assert_allclose(image.phase_rad, _angle(-ball, camera_km - ball), atol=2e-4)  # aberration of light
    late = plan.images[2].failure
    assert late is not None
    assert late.reason is Reason.NO_GEOMETRY
    assert "lies outside the ephemeris table" in late.detail


def _angle(first: Float, second: Float) -> float:
    return math.acos(first @ second / np.linalg.norm(first) / np.linalg.norm(second))


def test_a_geometry_table_gives_candidates() -> None:
    position, turn = np.array([0.0, 0.0, 1000.0]), Rotation.from_euler("z", 40.0, degrees=True)
    known = GeometryRow(
        file="a.fits",
        epoch=time_from_et(ET),
        exposure_s=0.2,
        camera_from_inertial=turn,
        target="BALL",
        target_position_inertial_km=position,
        sun_direction_inertial=np.array([1.0, 0.0, 0.0]),
    )
    table = GeometryTable(Path("geometry.csv"), (known, GeometryRow(file="b.fits", exposure_s=0.2)))
    first, second = candidates_from_table(table)
    plan = plan_of(first, second)
    assert_allclose(plan.images[0].geometry.sun_direction_camera, rotate(turn, [1.0, 0.0, 0.0]))  # type: ignore[union-attr]
    assert plan.images[0].exposure_s == 0.2
    assert plan.images[1].failure is not None
    assert "lacks an epoch and an attitude" in plan.images[1].failure.detail


@pytest.mark.parametrize(
    ("candidates", "options", "text"),
    [
        ([], ONE, "at least one candidate"),
        ([HERE, HERE], ONE, "two candidates have the name 'a.fits'"),
        ([HERE], PlanOptions(), "a.fits: no exposure time: give exposures_s"),
        ([HERE], replace(ONE, target="MOON"), "no target 'MOON'"),
    ],
)
def test_what_cannot_be_planned_is_refused(candidates: list[Candidate], options: PlanOptions, text: str) -> None:
    with pytest.raises(InputError, match=text):
        plan_images(candidates, CAMERA, sphere_scene(1000.0, 60.0), None, options)


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, math.nan, math.inf])
def test_an_exposure_that_is_none_is_refused_by_name(exposure_s: float) -> None:
    with pytest.raises(InputError, match=r"a\.fits: exposure_s"):
        replace(HERE, exposure_s=exposure_s)
    with pytest.raises(InputError, match="exposures_s"):
        PlanOptions(exposures_s=(exposure_s,))
