"""A pass from the observables of a run: the same numbers as in the file, and the altitude of the limb found from it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.store.observables import observables_metadata
from giantlike.core.causes import Cause
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotate
from giantlike.io.observables_file import ObservableRow, write_observables
from giantlike.observables import ImageContext, Sighting, row_of_body
from giantlike.passes import PassFix, PassOptions, PassTerm, RunPass, estimate_pass, pass_from_run
from giantlike.passes.images import MeasuredPosition
from giantlike.passes.run import pass_from_rows
from giantlike.relative.place import place_jacobian
from giantlike.scene import Circumstances
from tests.observables.test_rows import CONTEXT, SIGHTING, STATES, position_fix
from tests.passes.simulated_pass import MODEL
from tests.tolerances import FLOAT64_CHAIN

CAMERA = Camera(name="nav", columns=2592, rows=1944, model=MODEL)
RADIUS_KM, RANGE_KM, ALTITUDE_KM, ASSUMED_KM = 6371.0, 150_000.0, 25.0, 35.0
PLACE_SIGMA_PX, RANGE_SIGMA_KM = 0.02, 30.0
ATTITUDE_RAD = 5e-6


def rows(count: int = 30) -> list[ObservableRow]:
    """Rows of a run whose limb was taken 10 km too high, with attitudes of their own."""
    rng = np.random.default_rng(3)
    made = []
    for k in range(count):
        attitude = Rotation.from_rotvec([0.2, -0.4, 0.1 + 1e-4 * k])
        true = np.array([200.0, -100.0, RANGE_KM + 40.0 * k])
        turned = Rotation.from_rotvec(ATTITUDE_RAD * rng.normal(size=3)).apply(true)
        seen = turned * (RADIUS_KM + ASSUMED_KM) / (RADIUS_KM + ALTITUDE_KM)
        by_place = place_jacobian(MODEL, seen)
        range_km = float(np.linalg.norm(seen))
        noise = np.diag([PLACE_SIGMA_PX, PLACE_SIGMA_PX, RANGE_SIGMA_KM / range_km]) ** 2
        seen = seen + np.linalg.solve(by_place, np.sqrt(np.diag(noise)) * rng.normal(size=3))
        by_place = place_jacobian(MODEL, seen)
        by_turn = by_place @ np.cross(np.eye(3), seen).T
        parts = {Cause.NOISE: noise, Cause.ATTITUDE: ATTITUDE_RAD**2 * by_turn @ by_turn.T}
        in_camera = np.linalg.inv(by_place) @ noise @ np.linalg.inv(by_place).T
        context = replace(
            CONTEXT,
            file=f"{k:02d}.fits",
            camera=CAMERA,
            camera_from_inertial=attitude,
            attitude_covariance_rad2=ATTITUDE_RAD**2 * np.eye(3),
            attitude_shares={f"{k:02d}.fits": 1.0},
            et=1000.0 + 30.0 * k,
        )
        assert isinstance(context, ImageContext)
        states = replace(STATES, observer_velocity_km_s=STATES.target_velocity_km_s - np.array([0.0, 0.0, 1.3]))
        assert isinstance(states, Circumstances)
        sighting = replace(SIGHTING, predicted_camera_km=true, circumstances=states)
        assert isinstance(sighting, Sighting)
        fix = position_fix(
            center_px=MODEL.project(seen),
            predicted_px=MODEL.project(true),
            position_camera_km=seen,
            covariance_camera_km2=(in_camera + in_camera.T) / 2.0,
            covariance_px2=noise[:2, :2],
            parts={cause: (part + part.T) / 2.0 for cause, part in parts.items()},
            partials={Cause.ATTITUDE: by_turn},
        )
        made.append(row_of_body(context, sighting, fix, is_preferred=True))
    return made


def written(folder: Path) -> Path:
    write_observables(folder / "observables.parquet", rows(), observables_metadata("test", CAMERA))
    return folder


def test_a_run_tells_the_altitude_of_the_limb(tmp_path: Path) -> None:
    choice = RunPass(
        target="ROCK",
        radius_km=RADIUS_KM,
        limb_altitude_km=ASSUMED_KM,
        covariance_trajectory=np.diag([5.0, 5.0, 5.0, 1e-3, 1e-3, 1e-3]) ** 2,
    )
    given = pass_from_run(written(tmp_path), choice)
    assert len(given.images) == 30
    fix = estimate_pass(given, PassOptions(estimate={PassTerm.LIMB_ALTITUDE: math.inf}))
    assert isinstance(fix, PassFix), fix
    assert abs(fix.value("limb_altitude") - ALTITUDE_KM) < 4.0 * fix.sigma("limb_altitude")
    by_noise_km = RANGE_SIGMA_KM * RADIUS_KM / RANGE_KM / math.sqrt(30)
    assert by_noise_km < fix.sigma("limb_altitude") < 1.5 * by_noise_km
    assert fix.test("limb_altitude").significant(1e-6)


def test_places_rates_and_covariances_are_those_of_the_rows() -> None:
    made = rows(3)
    given = pass_from_rows(made, CAMERA, RunPass(target="ROCK", radius_km=RADIUS_KM))
    assert given is not None
    for k, (image, row) in enumerate(zip(given.images, made, strict=True)):
        observed = image.observed
        assert isinstance(observed, MeasuredPosition)
        assert image.time_s == pytest.approx(30.0 * (k - 1))
        predicted = np.array([200.0, -100.0, RANGE_KM + 40.0 * k])
        assert_allclose(image.position_camera_km, predicted, rtol=FLOAT64_CHAIN, atol=1e-6)
        turn = Rotation.from_quat(np.array(row.camera_from_icrf_xyzw))
        assert_allclose(image.rate_camera_km_s, rotate(turn, np.array([0.0, 0.0, 1.3])), rtol=0, atol=FLOAT64_CHAIN)
        measured = np.array(row.apparent_position_icrf_km, dtype=np.float64)
        assert_allclose(rotate(turn.inv(), observed.position_camera_km), measured, rtol=FLOAT64_CHAIN, atol=1e-6)
        sigma_km = math.sqrt(float(observed.covariance_camera_km2[0, 0]))
        x_km, range_km = observed.position_camera_km[0], float(np.linalg.norm(observed.position_camera_km))
        across_km = range_km * math.hypot(PLACE_SIGMA_PX / 7312.5, ATTITUDE_RAD)
        expected_km = math.hypot(across_km, RANGE_SIGMA_KM * x_km / range_km)
        assert sigma_km == pytest.approx(expected_km, rel=1e-4)  # the direction of the body is that far off the axis


def test_attitudes_that_images_share_are_shared_errors() -> None:
    made = [replace(row, shared_attitude="one") for row in rows(2)]
    given = pass_from_rows(made, CAMERA, RunPass(target="ROCK", radius_km=RADIUS_KM))
    assert given is not None
    assert all(set(image.observed.shared_px) == {"attitude one"} for image in given.images)


def test_the_drift_of_an_attitude_is_new_in_each_image() -> None:
    """The error of the star image is one; twice its sigma after a while is no error that doubles."""
    first, later = (replace(row, shared_attitude="one") for row in rows(2))
    assert first.attitude_covariance_rad2 is not None
    assert later.part_attitude is not None
    grown = replace(
        later,
        attitude_covariance_rad2=tuple(4.0 * value for value in first.attitude_covariance_rad2),
        part_attitude=tuple(4.0 * value for value in later.part_attitude),
    )
    choice = RunPass(target="ROCK", radius_km=RADIUS_KM)
    steady, drifting = (pass_from_rows(made, CAMERA, choice) for made in ([first, later], [first, grown]))
    assert steady is not None
    assert drifting is not None
    before, after = (given.images[1].observed for given in (steady, drifting))
    assert isinstance(before, MeasuredPosition)
    assert isinstance(after, MeasuredPosition)
    shift = before.shared_km["attitude one"]
    assert_allclose(after.shared_km["attitude one"], shift, rtol=0, atol=1e-6 * np.abs(shift).max())
    added = after.covariance_camera_km2 - before.covariance_camera_km2
    assert_allclose(added, 3.0 * shift @ shift.T, rtol=0, atol=1e-3 * np.abs(added).max())


def test_errors_by_light_keep_their_direction_to_the_sun_in_a_rolled_camera() -> None:
    """0.3 px toward the Sun in both images: half of the variance is shared, and turns with the image."""
    row = rows(1)[0]
    level = Rotation.from_quat(np.array(row.camera_from_icrf_xyzw))
    seen = []
    for turn in (level, Rotation.from_rotvec([0.0, 0.0, 1.0]) * level):
        position = rotate(turn, np.array(row.apparent_position_icrf_km, dtype=np.float64))
        sight = position / np.linalg.norm(position)
        sun = rotate(turn, np.array(row.sun_direction_icrf, dtype=np.float64))
        toward = MODEL.project_jacobian(position) @ (sun - sun @ sight * sight)
        part = np.zeros((3, 3))
        part[:2, :2] = 0.09 * np.outer(toward, toward) / (toward @ toward)
        pixel, line = MODEL.project(position)
        rolled = replace(
            row, camera_from_icrf_xyzw=turn.as_quat().tolist(), observed_pixel_px=pixel, observed_line_px=line
        )
        given = pass_from_rows(
            [replace(rolled, part_psf=part.ravel().tolist())], CAMERA, RunPass(target="ROCK", radius_km=1.0)
        )
        assert given is not None
        observed = given.images[0].observed
        assert isinstance(observed, MeasuredPosition)
        seen.append(rotate(turn.inv(), observed.shared_km["psf"].T))
    size = float(np.abs(seen[0]).max())
    assert size == pytest.approx(0.3 * math.sqrt(0.5) * RANGE_KM / 7312.5, rel=0.1)
    assert_allclose(seen[0], seen[1], rtol=0, atol=1e-2 * size)


def test_errors_that_images_share_keep_their_signs() -> None:
    """A pole that moves the body to the right in one image and to the left in the next; spin, too, is one error."""
    right = (2.0, 0.0, 1.0, 0.0, 0.0, 3.0)
    rows_of_pass = [
        replace(
            row,
            sigma_pole_rad=1e-3,
            partial_pole=tuple(sign * value for value in right),
            part_pole=tuple(1e-6 * np.ravel(np.reshape(right, (3, 2)) @ np.reshape(right, (3, 2)).T)),
            sigma_spin_rad=1e-3,
            partial_spin=(0.0, sign, 0.0),
            part_spin=tuple(np.diag([0.0, 1e-6, 0.0]).ravel()),
        )
        for row, sign in zip(rows(2), (1.0, -1.0), strict=True)
    ]
    given = pass_from_rows(rows_of_pass, CAMERA, RunPass(target="ROCK", radius_km=RADIUS_KM))
    assert given is not None
    one, other = (image.observed for image in given.images)
    assert isinstance(one, MeasuredPosition)
    assert isinstance(other, MeasuredPosition)
    for cause in ("pole", "spin"):
        size = float(np.linalg.norm(one.shared_km[cause]))
        assert size > 1e-2
        assert_allclose(one.shared_km[cause], -other.shared_km[cause], rtol=0, atol=1e-3 * size)


def test_bodies_turned_with_the_attitude_are_errors_of_it() -> None:
    """0.3 px along x, 6.2 km at the body: new in each image, or shared with its attitude."""
    sigma_px, sigma_km = 0.3, 0.3 * RANGE_KM / 7312.5
    cells = tuple(np.diag([sigma_px**2, 0.0, 0.0]).ravel())
    choice = RunPass(target="ROCK", radius_km=RADIUS_KM)
    exact = rows(2)
    turned = [replace(row, part_orientation=cells) for row in exact]
    before, after = (pass_from_rows(made, CAMERA, choice) for made in (exact, turned))
    shared = pass_from_rows([replace(row, shared_attitude="one") for row in turned], CAMERA, choice)
    assert before is not None
    assert after is not None
    assert shared is not None
    for without, image in zip(before.images, after.images, strict=True):
        assert isinstance(without.observed, MeasuredPosition)
        assert isinstance(image.observed, MeasuredPosition)
        added = image.observed.covariance_camera_km2 - without.observed.covariance_camera_km2
        assert added[0, 0] == pytest.approx(sigma_km**2, rel=1e-2)
        assert added[1, 1] < 1e-3 * sigma_km**2
        assert not image.observed.shared_km
    assert all(set(image.observed.shared_px) == {"attitude one", "orientation one"} for image in shared.images)


def test_a_run_without_the_target_says_what_it_has(tmp_path: Path) -> None:
    folder = written(tmp_path)
    with pytest.raises(DataError, match=r"no preferred position of MARS .* it has ROCK"):
        pass_from_run(folder, RunPass(target="MARS", radius_km=3390.0))
    with pytest.raises(DataError, match="no preferred position of ROCK"):
        pass_from_run(folder, RunPass(target="ROCK", radius_km=RADIUS_KM, from_et_s=1e6))
    with pytest.raises(InputError, match="from_et_s is after"):
        RunPass(target="ROCK", radius_km=1.0, from_et_s=2.0, to_et_s=1.0)
