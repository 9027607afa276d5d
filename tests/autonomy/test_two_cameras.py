"""Two cameras at one time: triggers, sources of images, poses, and the modes of an instrument."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import giantlike as gl
from giantlike.autonomy import ModeMachine, pose_of_pair
from giantlike.autonomy.body_search import pointing_slew
from giantlike.autonomy.camera_sources import (
    ExposureRequest,
    FolderCamera,
    SimulatedCamera,
    take_pair,
    trigger_plan,
)
from giantlike.autonomy.mode_machine import InstrumentState, Mode
from giantlike.autonomy.two_camera_pose import Interlock, carried_attitude
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Reason
from giantlike.core.time import time_from_et

CAMERA = gl.Camera.from_fov(20.0, 64, 48)
REQUEST = ExposureRequest(et=0.0, exposure_s=0.1)


def _image(*, et: float = 0.0, name: str = "frame") -> gl.Image:
    return gl.Image(pixels=np.zeros((48, 64)), name=name, epoch=time_from_et(et), exposure_s=0.1)


@pytest.mark.parametrize(("exposures", "primary"), [((0.5, 2e-4), 0), ((2e-4, 0.5), 1), ((0.1, 0.1), 0)])
def test_a_trigger_plan_gives_both_exposures_one_middle(exposures: tuple[float, float], primary: int) -> None:
    plan = trigger_plan(exposures)
    assert plan.primary == primary
    assert plan.delay_s >= 0.0
    first, second = exposures[plan.primary], exposures[1 - plan.primary]
    assert abs(first / 2.0 - (plan.delay_s + second / 2.0)) < 1e-15


def test_a_pair_of_images_must_be_of_one_time() -> None:
    early = SimulatedCamera(CAMERA, lambda request: _image(et=request.et, name="early"))
    late = SimulatedCamera(CAMERA, lambda request: _image(et=request.et + 0.01, name="late"))
    unknown = SimulatedCamera(CAMERA, lambda request: dataclasses.replace(_image(), epoch=None))
    pair = take_pair((early, early), 5.0, (0.1, 0.2))
    assert not isinstance(pair, gl.Failure)
    apart = take_pair((early, late), 5.0, (0.1, 0.1))
    assert isinstance(apart, gl.Failure)
    assert apart.reason is Reason.REJECTED
    assert "0.01 s apart" in apart.detail
    timeless = take_pair((early, unknown), 5.0, (0.1, 0.1))
    assert isinstance(timeless, gl.Failure)
    assert timeless.reason is Reason.NO_EPOCH


def _write(path: Path, value: float) -> None:
    fits.PrimaryHDU(np.full((48, 64), value, dtype=np.float32)).writeto(path)


def test_a_folder_gives_its_images_in_order_and_each_once(tmp_path: Path) -> None:
    _write(tmp_path / "b.fits", 2.0)
    _write(tmp_path / "a.fits", 1.0)
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "c.fits").write_text("no FITS file")
    source = FolderCamera(CAMERA, tmp_path)
    levels = []
    for _ in range(2):
        image = source.take(REQUEST)
        assert isinstance(image, gl.Image)
        levels.append(float(image.pixels[0, 0]))
    assert levels == [1.0, 2.0]
    damaged, none = source.take(REQUEST), source.take(REQUEST)
    assert isinstance(damaged, gl.Failure)
    assert damaged.reason is Reason.UNREADABLE_IMAGE
    assert isinstance(none, gl.Failure)
    assert none.reason is Reason.NO_SIGNAL
    with pytest.raises(InputError, match="there is no folder"):
        FolderCamera(CAMERA, tmp_path / "missing")


def test_a_watched_folder_waits_for_a_file_until_it_is_whole(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.fits", tmp_path / "whole.tmp"
    fits.PrimaryHDU(np.ones((48, 64), dtype=np.float32)).writeto(whole)
    data = whole.read_bytes()
    looks = []

    def sleep(seconds: float) -> None:
        """The file comes with the second look, half of it, and is whole at the third."""
        looks.append(seconds)
        if len(looks) == 2:
            path.write_bytes(data[: len(data) // 2])
        if len(looks) == 3:
            path.write_bytes(data)

    source = FolderCamera(CAMERA, tmp_path, wait_s=5.0, poll_s=0.5, sleep=sleep)
    image = source.take(REQUEST)
    assert isinstance(image, gl.Image)
    assert len(looks) == 4  # found at the third look back, taken when its size stood still at the fourth
    none = source.take(REQUEST)
    assert isinstance(none, gl.Failure)
    assert "within 5 s" in none.detail


# poses --------------------------------------------------------------------------------------------------------


def _attitude(turn: Rotation, covariance: Float) -> gl.AttitudeFix:
    none = np.zeros((0, 2))
    return gl.AttitudeFix(
        camera_from_inertial=turn,
        covariance_rad2=covariance,
        star_ids=np.zeros(0, dtype=np.int64),
        detection_indices=np.zeros(0, dtype=np.int64),
        observed_px=none,
        predicted_px=none,
        sigma_px=np.zeros(0),
        magnitudes=np.zeros(0),
        n_detected=0,
        n_rejected=0,
        false_match_probability=0.0,
        focal_length_px=1000.0,
        fov_deg=20.0,
    )


def _position(position: Float, covariance: Float) -> gl.PositionFix:
    return gl.PositionFix(
        estimator="ellipsoid_cra",
        target="MOON",
        center_px=np.zeros(2),
        covariance_px2=np.eye(2),
        predicted_px=np.zeros(2),
        residuals=np.zeros(1),
        n_used=1,
        n_rejected=0,
        score=1.0,
        position_camera_km=position,
        covariance_camera_km2=covariance,
        limb_px=np.zeros((0, 2)),
    )


@pytest.mark.monte_carlo(few=60, full=600)
def test_the_pose_of_a_pair_has_errors_as_large_as_its_covariance(draws: int) -> None:
    """Noise of stars, interlock and limb drawn from their covariances; truth by rotations alone."""
    rng = np.random.default_rng(2)
    first = Rotation.from_rotvec([0.3, -0.8, 1.9])
    between = Rotation.from_rotvec([0.02, 1.57, -0.01])
    stars = np.diag([2e-6, 1e-6, 2e-5]) ** 2
    bend = np.diag([4e-6, 8e-6, 3e-6]) ** 2
    limb = np.array([[4.0, 1.0, 3.0], [1.0, 3.0, -2.0], [3.0, -2.0, 900.0]])
    truth = np.array([2e4, -1e4, 3.8e5])  # in the axes of the second camera
    inertial = rotate((between * first).inv(), truth)
    squares = []
    for _ in range(draws):
        fix = _attitude(Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), stars)) * first, stars)
        told = Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), bend)) * between
        body = _position(truth + rng.multivariate_normal(np.zeros(3), limb), limb)
        turn, covariance = carried_attitude(fix, Interlock(second_from_first=told, covariance_rad2=bend))
        pose = pose_of_pair(body, turn, covariance)
        error = pose.position_inertial_km - inertial
        squares.append(float(error @ np.linalg.solve(pose.covariance_inertial_km2, error)))
        assert_allclose(np.sum(list(pose.parts.values()), axis=0), pose.covariance_inertial_km2, rtol=1e-9)
    assert float(chi2.ppf(1e-4, 3 * draws)) < sum(squares) < float(chi2.ppf(1 - 1e-4, 3 * draws))


def test_an_interlock_reversed_twice_is_itself() -> None:
    interlock = Interlock(
        second_from_first=Rotation.from_rotvec([0.1, 1.5, 0.2]), covariance_rad2=np.diag([1.0, 4.0, 9.0])
    )
    again = interlock.reversed().reversed()
    assert (again.second_from_first * interlock.second_from_first.inv()).magnitude() < 1e-12
    assert_allclose(again.covariance_rad2, interlock.covariance_rad2, atol=1e-12)


@pytest.mark.parametrize("direction", [[0.3, -0.2, 0.7], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
def test_a_slew_puts_the_target_onto_the_boresight(direction: list[float]) -> None:
    boresight = np.array([0.0, 0.0, 1.0])
    there = np.array(direction) / np.linalg.norm(direction)
    slew = pointing_slew(np.array(direction), boresight)
    assert_allclose(rotate(slew, there), boresight, atol=1e-12)
    assert slew.magnitude() <= np.arccos(np.clip(there @ boresight, -1.0, 1.0)) + 1e-12


# modes --------------------------------------------------------------------------------------------------------


def _calibrated(state: InstrumentState) -> InstrumentState:
    known = Interlock(second_from_first=Rotation.identity(), covariance_rad2=np.eye(3) * 1e-12)
    return dataclasses.replace(state, interlock=known)


def test_modes_come_only_when_what_they_need_is_there() -> None:
    failing = gl.Failure(Reason.NO_SIGNAL, "no light")
    machine = ModeMachine({Mode.CALIBRATION: _calibrated, Mode.PROCESSING: lambda state: failing})
    state = InstrumentState(cameras=(CAMERA, CAMERA))
    same, told = machine.command(state, Mode.PROCESSING)
    assert same is state
    assert not told.done
    assert "command calibration first" in told.detail
    same, told = machine.command(state, Mode.TARGET_DETERMINATION)
    assert same is state
    assert "has no target_determination" in told.detail
    state, _ = machine.command(state, Mode.CALIBRATION)
    state, told = machine.step(state)
    assert told.done
    assert state.interlock is not None
    _, told = machine.command(state, Mode.PROCESSING)
    assert "needs a target" in told.detail
    state, told = machine.command(state, Mode.PROCESSING, target="MOON", target_camera=0)
    assert told.done
    after, told = machine.step(state)
    assert after is state
    assert not told.done
    assert told.detail == "no_signal: no light"
    state, _ = machine.command(state, Mode.IDLE)
    assert machine.step(state)[0] is state
    with pytest.raises(InputError, match="target_camera must be 0 or 1"):
        machine.command(state, Mode.IDLE, target_camera=2)
