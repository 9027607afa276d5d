"""The roll of a camera from the limb of one body: from pixels to a C-kernel that SPICE reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.campaign.run.observables import with_fix
from giantlike.campaign.store.observables import _fix
from giantlike.campaign.store.records import ObservationRecord
from giantlike.core.arrays import unit
from giantlike.core.outcomes import BodyTurn, Failure, PositionFix
from giantlike.io.attitude_series import AttitudeSeries
from giantlike.io.spice_ck import CkTarget, write_ck
from giantlike.observables import ImageContext, Sighting, row_of_body
from giantlike.observables.pointing import Pointing, pointing_from_bodies
from giantlike.relative import LimbMatching
from giantlike.shapes import irregular_body, sphere
from tests.limb_images import CAMERA, BodyImage, body_image

ROLL_DEG = 0.5  # five sigma and more of what a limb of 80 px in radius tells
SIGMAS = 4.0  # of three angles: once in ten thousand
PRIOR_RAD = np.radians([0.02, 0.02, 1.0])
ET = 7.5e8


@pytest.fixture(scope="module")
def case() -> BodyImage:
    """A rock; its true attitude is the identity."""
    return body_image(irregular_body(3, facets=5_000), 5, phase_deg=50.0)


@pytest.fixture(scope="module")
def told() -> Rotation:
    """The a priori attitude: rolled about the boresight, and off across it."""
    return Rotation.from_rotvec([2e-4, -3e-4, np.radians(ROLL_DEG)])


@pytest.fixture(scope="module")
def fix(case: BodyImage, told: Rotation) -> PositionFix:
    image = replace(case.image, camera_from_inertial=told, attitude_covariance_rad2=np.diag(PRIOR_RAD**2))
    found = LimbMatching().estimate(image, CAMERA, case.scene)
    assert isinstance(found, PositionFix), found
    return found


def pointing(case: BodyImage, told: Rotation, fix: PositionFix, *, known: bool = True) -> Pointing | Failure:
    """Attitude by the observable of a fix."""
    geometry = case.scene.geometry(replace(case.image, camera_from_inertial=told), "BODY")
    assert not isinstance(geometry, Failure)
    context = ImageContext(
        file="a.fits",
        camera=CAMERA,
        shared_camera="test",
        camera_from_inertial=told,
        attitude_source="a_priori",
        attitude_covariance_rad2=np.diag(PRIOR_RAD**2) if known else None,
    )
    sighting = Sighting(
        predicted_camera_km=geometry.position_camera_km,
        camera_from_body=geometry.camera_from_body,
        sun_direction_camera=geometry.sun_direction_camera,
    )
    return pointing_from_bodies(CAMERA, [row_of_body(context, sighting, fix, is_preferred=True)])


def test_the_turn_of_a_rock_is_found_from_its_limb(case: BodyImage, told: Rotation, fix: PositionFix) -> None:
    turn = fix.turn
    assert turn is not None
    sigma = np.sqrt(turn.covariance[2, 2])
    assert abs(turn.turn_rad - float(turn.by_rotation[2] @ told.inv().as_rotvec())) < SIGMAS * sigma
    assert np.degrees(sigma) < 0.1 * ROLL_DEG
    # A rotation about the line of sight is the turn itself, and leaves the place that is found with it alone.
    assert_allclose(turn.by_rotation @ unit(fix.position_camera_km), [0.0, 0.0, 1.0], rtol=0, atol=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_one_rock_gives_all_three_angles_to_a_c_kernel(
    case: BodyImage, told: Rotation, fix: PositionFix, tmp_path: Path, *, known: bool
) -> None:
    spiceypy = pytest.importorskip("spiceypy")
    found = pointing(case, told, fix, known=known)
    assert isinstance(found, Pointing), found
    assert found.n_turns == 1
    series = AttitudeSeries(
        et=np.array([ET]),
        camera_from_inertial=Rotation.concatenate([found.camera_from_inertial]),
        covariance_rad2=found.covariance_rad2[None],
        names=("a.fits",),
    )
    files = write_ck(tmp_path / "roll.bc", series, CkTarget(instrument_id=-98110, frame_name="ROLL_CAMERA"))
    try:
        for file in files:
            spiceypy.furnsh(str(file))
        read = Rotation.from_matrix(spiceypy.pxform("J2000", "ROLL_CAMERA", ET))
    finally:
        for file in files:
            spiceypy.unload(str(file))
    error, sigma = read.inv().as_rotvec(), np.sqrt(np.diag(found.covariance_rad2))
    assert np.all(np.abs(error) < SIGMAS * sigma)
    assert np.degrees(sigma[2]) < 0.1 * ROLL_DEG, "the a priori roll of 1 deg tells nothing beside the limb"


def test_without_the_turn_the_roll_stays_as_it_was_told(case: BodyImage, told: Rotation, fix: PositionFix) -> None:
    found = pointing(case, told, replace(fix, turn=None))
    assert isinstance(found, Pointing)
    assert np.degrees(abs(found.camera_from_inertial.as_rotvec()[2])) > 0.9 * ROLL_DEG
    assert isinstance(pointing(case, told, replace(fix, turn=None), known=False), Failure)


def test_records_of_a_run_keep_the_turn(case: BodyImage, told: Rotation, fix: PositionFix) -> None:
    geometry = case.scene.geometry(replace(case.image, camera_from_inertial=told), "BODY")
    assert not isinstance(geometry, Failure)
    empty = ObservationRecord(index=0, file="a.fits", target="BODY", estimator="limb_matching", status="ok")
    record = with_fix(empty, CAMERA, geometry, fix)
    again = _fix(ObservationRecord.model_validate_json(record.model_dump_json()))
    assert isinstance(again, PositionFix)
    assert isinstance(again.turn, BodyTurn)
    assert fix.turn is not None
    for name in ("turn_rad", "center_px", "covariance", "by_rotation"):
        assert np.array_equal(getattr(again.turn, name), getattr(fix.turn, name))


def test_a_round_body_has_no_turn() -> None:
    round_case = body_image(sphere(0.25), 5, phase_deg=50.0, radius_px=50.0)
    found = LimbMatching().estimate(round_case.image, CAMERA, round_case.scene)
    assert isinstance(found, PositionFix), found
    assert found.turn is None or np.degrees(np.sqrt(found.turn.covariance[2, 2])) > 2.0
