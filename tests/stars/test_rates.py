"""Attitudes carried between images by angular rates, as a gyro measures them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.stars.rates import AngularRates, read_rates
from giantlike.stars.transfer import (
    StarAttitude,
    TransferMethod,
    TransferOptions,
    TransferredAttitude,
    transfer_attitude,
)
from tests.campaign_files import PAIR_GAP_S, START_UTC, write_campaign
from tests.tolerances import FLOAT64_SUM

START = Rotation.from_euler("zyx", [40.0, -20.0, 10.0], degrees=True)
OPTIONS = TransferOptions(method=TransferMethod.PROPAGATE, drift_arcsec_per_sqrt_s=0.0)
TIMES = np.linspace(0.0, 100.0, 101)
CONING_RAD = 2e-9  # 0.0004 arcsec: the third order of the series over 100 s; a wrong sign of the second leaves 7 arcsec


def _rate(et: Float) -> Float:
    """A tumbling camera, rad/s about its own axes."""
    return 1e-2 * np.stack([np.cos(0.05 * et), np.sin(0.03 * et), 0.5 + 0.0 * et], axis=-1)


def _tumbled(et: float) -> Rotation:
    """The attitude by integrating dC/dt = -[w x] C, to 1e-12."""

    def derivative(t: float, matrix: Float) -> Float:
        w = _rate(np.asarray(t))
        cross = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.asarray(-cross @ matrix.reshape(3, 3)).ravel()

    solution = solve_ivp(derivative, (0.0, et), START.as_matrix().ravel(), rtol=1e-12, atol=1e-12)
    return Rotation.from_matrix(solution.y[:, -1].reshape(3, 3))


def _star(et: float, attitude: Rotation) -> StarAttitude:
    return StarAttitude(et=et, camera_from_inertial=attitude, covariance_rad2=np.diag([1e-10, 4e-10, 1e-8]))


def test_a_tumbling_camera_is_followed_in_both_directions_of_time() -> None:
    rates = AngularRates(et=TIMES, rates_rad_s=_rate(TIMES))
    late = _tumbled(80.5)
    for star, et, truth in ((_star(0.0, START), 80.5, late), (_star(80.5, late), 0.0, START)):
        result = transfer_attitude(et, [star], rates=rates, options=OPTIONS)
        assert isinstance(result, TransferredAttitude)
        # Straight lines between samples of 1 s leave 1e-2 * 0.05^2 / 12 rad/s at worst, over 80 s.
        assert (result.camera_from_inertial * truth.inv()).magnitude() < 2e-4


def _by_tiny_turns(rates_rad_s: Float, step_s: float, parts: int) -> Float:
    """The turn (3, 3) by rates linear between samples: the product of `parts` rotations in each interval."""
    turned = np.eye(3)
    for start, stop in pairwise(rates_rad_s):
        for middle in (np.arange(parts) + 0.5) / parts:
            x, y, z = -(start + (stop - start) * middle) * step_s / parts
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            angle = np.sqrt(x * x + y * y + z * z)
            turn = np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * cross @ cross
            turned = turn @ turned
    return turned


def test_linear_rates_of_a_tumbling_camera_are_integrated_with_the_right_sense_of_coning() -> None:
    rates = _rate(TIMES)
    turn = AngularRates(et=TIMES, rates_rad_s=rates).turn(0.0, TIMES[-1])
    assert isinstance(turn, Rotation)
    coarse, fine = (_by_tiny_turns(rates, TIMES[1] - TIMES[0], parts) for parts in (20, 40))
    truth = fine + (fine - coarse) / 3.0  # the error of the products falls with the square of their steps
    assert (turn * Rotation.from_matrix(truth).inv()).magnitude() < CONING_RAD


def test_finer_samples_bring_the_error_down_with_their_square() -> None:
    truth, errors = _tumbled(80.0), []
    for count in (41, 81, 161):
        times = np.linspace(0.0, 80.0, count)
        turn = AngularRates(et=times, rates_rad_s=_rate(times)).turn(0.0, 80.0)
        assert isinstance(turn, Rotation)
        errors.append(float((turn * START * truth.inv()).magnitude()))
    assert errors[0] > 3.5 * errors[1] > 12.0 * errors[2]


def test_the_covariance_turns_with_the_camera() -> None:
    quarter = AngularRates(et=np.array([0.0, 10.0]), rates_rad_s=np.tile([0.0, 0.0, np.pi / 20], (2, 1)))
    result = transfer_attitude(10.0, [_star(0.0, START)], rates=quarter, options=OPTIONS)
    assert isinstance(result, TransferredAttitude)
    np.testing.assert_allclose(np.diag(result.covariance_rad2), [4e-10, 1e-10, 1e-8], rtol=FLOAT64_SUM)


def test_rates_need_no_a_priori_attitude_but_are_checked_against_one() -> None:
    rates = AngularRates(et=TIMES, rates_rad_s=_rate(TIMES))
    star = StarAttitude(et=0.0, camera_from_inertial=START, covariance_rad2=np.eye(3) * 1e-10, apriori=START)
    outcome = transfer_attitude(50.0, [star], apriori=START, rates=rates, options=OPTIONS)
    assert isinstance(outcome, Failure)
    assert "differ" in outcome.detail


def test_rates_that_do_not_reach_give_no_attitude() -> None:
    rates = AngularRates(et=TIMES, rates_rad_s=_rate(TIMES))
    outcome = transfer_attitude(100.5, [_star(0.0, START)], rates=rates, options=OPTIONS)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.NO_ATTITUDE
    assert "cover et 0.000 to 100.000" in outcome.detail


def test_a_table_of_rates_is_read_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "gyro.csv"
    path.write_text(
        "epoch_utc,rate_x_rad_s,rate_y_rad_s,rate_z_rad_s\n"
        "2000-01-01T11:59:00.816,1e-3,0,0\n2000-01-01T11:58:55.816,2e-3,0,-1e-3\n"
    )
    rates = read_rates(path)
    np.testing.assert_allclose(rates.et, [0.0, 5.0], rtol=0, atol=1e-3)  # 64.184 s between UTC and TDB
    assert rates.rates_rad_s.tolist() == [[2e-3, 0.0, -1e-3], [1e-3, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("et,rate_x_rad_s,rate_y_rad_s,rate_z_rad_s\n0,0,0,0\n", "at least 2 rows"),
        ("et,rate_x_rad_s,rate_y_rad_s,rate_z_rad_s\n0,0,0,0\n0,0,0,0\n", "different times"),
        ("et,rate_x_rad_s,rate_y_rad_s,rate_z_rad_s\n0,,,\n", "line 2, column rate_x_rad_s"),
        ("rate_x_rad_s,rate_y_rad_s,rate_z_rad_s\n0,0,0\n", "epoch_utc or et"),
    ],
)
def test_a_damaged_table_of_rates_is_refused(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "gyro.csv").write_text(text)
    with pytest.raises(DataError, match=problem):
        read_rates(tmp_path / "gyro.csv")


def test_a_campaign_carries_attitudes_by_the_rates_of_a_table(tmp_path: Path) -> None:
    stars = {"max_magnitude": 7.0, "long_exposure_s": 1.0, "transfer": "propagate", "rates": "gyro.csv"}
    path, _ = write_campaign(tmp_path, visits=1, stars=stars, targets=[])
    start, rate = et_from_time(time_from_utc(START_UTC)), np.array([1e-5, -2e-5, 3e-4])
    text = ",".join(map(repr, rate.tolist()))
    rows = [f"{et!r},{text}" for et in (start - 100.0, start + 100.0)]
    (tmp_path / "gyro.csv").write_text("\n".join(["et,rate_x_rad_s,rate_y_rad_s,rate_z_rad_s", *rows]) + "\n")
    before, short, _ = run_campaign(Campaign.load(path), workers=1).attitudes
    assert before.attitude is not None
    assert short.attitude is not None
    assert short.attitude.source == "interpolated"
    assert short.provenance["transfer"] == "propagate"
    turned = (
        Rotation.from_quat(short.attitude.quaternion_xyzw) * Rotation.from_quat(before.attitude.quaternion_xyzw).inv()
    )
    assert (turned * Rotation.from_rotvec(rate * PAIR_GAP_S)).magnitude() < 1e-9  # vectors turn against the camera


@pytest.mark.parametrize(("transfer", "text"), [("interpolate", "propagate"), ("propagate", "no file")])
def test_rates_that_are_of_no_use_or_missing_are_refused_before_any_image(
    tmp_path: Path, transfer: str, text: str
) -> None:
    path, _ = write_campaign(tmp_path, visits=1, stars={"transfer": transfer, "rates": "gyro.csv"})
    with pytest.raises(DataError, match=rf"stars\.rates.*{text}"):
        Campaign.load(path)
