"""Attitudes from bodies hold within their covariance, and say what one body cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate
from giantlike.core.outcomes import AttitudeErrors, CenterFix, Failure, Reason
from giantlike.io.observables_file import ObservableRow
from giantlike.observables import ImageContext, LandmarkSeen, Sighting, row_of_body, row_of_landmark
from giantlike.observables.pointing import Pointing, pointing_from_bodies
from giantlike.scene import TargetUncertainty
from tests.observables.test_rows import ATTITUDE, BODY, CONTEXT, MODEL, position_fix

CAMERA = Camera(name="cam", columns=640, rows=480, model=MODEL)
PRIOR_RAD = np.array([1e-3, 1e-3, 5e-3])
NOISE_PX = 0.1
EPHEMERIS_KM = 0.4
TRUE_KM = {"MOON": np.array([90.0, -60.0, 1000.0]), "ROCK": np.array([-80.0, 50.0, 1500.0])}
FALSE_ALARM = 1e-3


def context(apriori: Rotation, *, known: bool = True) -> ImageContext:
    covariance = np.diag(PRIOR_RAD**2) if known else None
    return replace(
        CONTEXT,
        camera=CAMERA,
        camera_from_inertial=apriori,
        attitude_source="a_priori",
        attitude_covariance_rad2=covariance,
        attitude_errors=AttitudeErrors(),
        attitude_shares={},
    )


def body(target: str, apriori: Rotation, rng: np.random.Generator, *, known: bool = True) -> ObservableRow:
    """A fix of a body whose ephemeris is off, seen with noise by a camera whose a priori attitude is off."""
    true_km = TRUE_KM[target]
    told_km = true_km + rng.normal(0.0, EPHEMERIS_KM, 3)
    here = context(apriori, known=known)
    center = MODEL.project(true_km) + rng.normal(0.0, NOISE_PX, 2)
    told_camera = rotate(apriori * ATTITUDE.inv(), told_km)
    fix = CenterFix(
        estimator="moment",
        target=target,
        center_px=center,
        covariance_px2=NOISE_PX**2 * np.eye(2),
        predicted_px=MODEL.project(told_camera),
        residuals=np.zeros(0),
        n_used=1,
        n_rejected=0,
        score=1.0,
        parts={Cause.NOISE: NOISE_PX**2 * np.eye(2)},
    )
    sighting = Sighting(
        predicted_camera_km=told_camera,
        camera_from_body=BODY,
        sun_direction_camera=np.array([0.6, 0.0, -0.8]),
        uncertainty=TargetUncertainty(ephemeris_km=EPHEMERIS_KM),
    )
    return row_of_body(here, sighting, fix, is_preferred=True)


def off(found: Pointing) -> Float:
    """True attitude over the one found, as a small rotation about the camera axes."""
    return (ATTITUDE * found.camera_from_inertial.inv()).as_rotvec()


def solved(rows: list[ObservableRow]) -> Pointing:
    found = pointing_from_bodies(CAMERA, rows)
    assert isinstance(found, Pointing)
    return found


@pytest.mark.monte_carlo(few=60, full=300)
def test_errors_of_attitudes_from_two_bodies_are_those_that_the_covariance_states(draws: int) -> None:
    rng = np.random.default_rng(11)
    squared, fits = 0.0, 0.0
    for _ in range(draws):
        apriori = Rotation.from_rotvec(-rng.normal(0.0, PRIOR_RAD)) * ATTITUDE
        found = solved([body(target, apriori, rng) for target in TRUE_KM])
        squared += float(off(found) @ np.linalg.solve(found.covariance_rad2, off(found)))
        fits += found.chi2
    for total, count in ((squared, 3 * draws), (fits, 4 * draws)):
        low, high = (float(chi2.ppf(tail, count)) for tail in (FALSE_ALARM / 2, 1.0 - FALSE_ALARM / 2))
        assert low < total < high


def test_two_bodies_give_all_three_angles_without_an_a_priori_attitude() -> None:
    rng = np.random.default_rng(12)
    apriori = Rotation.from_rotvec([0.02, -0.03, 0.3]) * ATTITUDE
    found = solved([body(target, apriori, rng, known=False) for target in TRUE_KM])
    assert np.abs(off(found) / np.sqrt(np.diag(found.covariance_rad2))).max() < 5.0
    assert np.sqrt(found.covariance_rad2[2, 2]) < 0.01
    assert found.targets == ("MOON", "ROCK")


def test_the_part_of_an_unknown_pole_counts_though_it_has_no_sigma() -> None:
    """Without sigma and derivative, unlike an error of a declared pole, it is an error of each row."""
    rows = [body(target, ATTITUDE, np.random.default_rng(12)) for target in TRUE_KM]
    unknown = [replace(row, part_pole=np.diag([9.0, 9.0, 0.0]).ravel().tolist()) for row in rows]
    known = solved(rows).covariance_rad2
    added = solved(unknown).covariance_rad2 - known
    assert np.linalg.eigvalsh(added).min() > -1e-12
    # 3 px of two bodies, instead of an ephemeris of 0.4 km, which is 1.2 px
    assert np.trace(added[:2, :2]) > np.trace(known[:2, :2])


def test_one_body_leaves_the_roll_as_it_was_known_before() -> None:
    rng = np.random.default_rng(13)
    apriori = Rotation.from_rotvec([4e-4, 7e-4, -3e-3]) * ATTITUDE
    row = body("MOON", apriori, rng)
    found = solved([row])
    # Across the axis the body is known to 4e-4 rad, not exactly: 1.4 % of the sigma about it.
    axis = TRUE_KM["MOON"] / np.linalg.norm(TRUE_KM["MOON"])
    about = float(np.sqrt(axis @ found.covariance_rad2 @ axis))
    assert_allclose(about, 1.0 / np.sqrt(np.sum((axis / PRIOR_RAD) ** 2)), rtol=0.03)
    across = np.cross(axis, [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(axis, [1.0, 0.0, 0.0]))
    # Across it: noise of 0.1 px of 3,000, and 0.4 km of 1,000 of the ephemeris.
    assert float(np.sqrt(across @ found.covariance_rad2 @ across)) < 5e-4
    alone = pointing_from_bodies(CAMERA, [body("MOON", apriori, rng, known=False)])
    assert isinstance(alone, Failure)
    assert alone.reason is Reason.DEGENERATE_GEOMETRY
    assert "attitude_sigma_deg" in alone.detail


def test_landmarks_of_one_body_give_all_three_angles_and_its_center_is_not_used_twice() -> None:
    rng = np.random.default_rng(14)
    apriori = Rotation.from_rotvec([1e-3, -2e-3, 8e-3]) * ATTITUDE
    here = context(apriori, known=False)
    told_camera = rotate(apriori * ATTITUDE.inv(), TRUE_KM["MOON"])
    told_turn = apriori * ATTITUDE.inv() * BODY
    sighting = Sighting(
        predicted_camera_km=told_camera, camera_from_body=told_turn, sun_direction_camera=np.array([0.6, 0.0, -0.8])
    )
    fix = position_fix(target="MOON")
    rows = [row_of_body(here, sighting, fix, is_preferred=True)]
    for k, place_km in enumerate(rng.normal(0.0, 30.0, (20, 3))):
        seen = MODEL.project(TRUE_KM["MOON"] + rotate(BODY, place_km)) + rng.normal(0.0, NOISE_PX, 2)
        landmark = LandmarkSeen(
            name=f"L{k}", body_km=place_km, observed_px=seen, covariance_px2=NOISE_PX**2 * np.eye(2)
        )
        rows.append(row_of_landmark(here, sighting, fix, landmark))
    found = solved(rows)
    assert found.n_used == 20
    error = off(found)
    assert float(error @ np.linalg.solve(found.covariance_rad2, error)) < float(chi2.ppf(1.0 - FALSE_ALARM, 3))
    assert np.sqrt(np.diag(found.covariance_rad2))[2] < 1e-3


def test_an_image_without_bodies_has_no_attitude_from_bodies() -> None:
    found = pointing_from_bodies(CAMERA, [])
    assert isinstance(found, Failure)
    assert found.reason is Reason.NO_SIGNAL
