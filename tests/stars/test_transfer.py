"""Attitudes of short exposures from those of long ones."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotation_between
from giantlike.core.outcomes import AttitudeErrors, Failure, Quality, Reason
from giantlike.core.time import time_from_et
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_DEG
from giantlike.image import AttitudeSource, Image
from giantlike.stars.transfer import (
    StarAttitude,
    TransferMethod,
    TransferOptions,
    TransferredAttitude,
    carry_attitude,
    transfer_attitude,
)
from tests.bands import mean_square_band
from tests.tolerances import FLOAT64

REPLACE = TransferOptions(method=TransferMethod.REPLACE, drift_arcsec_per_sqrt_s=0.0)
PROPAGATE = TransferOptions(method=TransferMethod.PROPAGATE, drift_arcsec_per_sqrt_s=0.0)
INTERPOLATE = TransferOptions(method=TransferMethod.INTERPOLATE, drift_arcsec_per_sqrt_s=0.0)
START = Rotation.from_euler("zyx", [40.0, -20.0, 10.0], degrees=True)
RATE_RAD_S = np.array([2e-4, -1e-4, 5e-4])


def attitude(et: float) -> Rotation:
    """A camera that turns at a constant rate."""
    return Rotation.from_rotvec(RATE_RAD_S * et) * START


def star(et: float, *, apriori: Rotation | None = None, sigma_rad: Float | None = None) -> StarAttitude:
    sigma = np.array([1e-5, 2e-5, 1e-4]) if sigma_rad is None else sigma_rad
    return StarAttitude(et=et, camera_from_inertial=attitude(et), covariance_rad2=np.diag(sigma**2), apriori=apriori)


def fixed(outcome: TransferredAttitude | Failure) -> TransferredAttitude:
    assert isinstance(outcome, TransferredAttitude), outcome
    return outcome


def angle_rad(a: Rotation, b: Rotation) -> float:
    return float((a * b.inv()).magnitude())


def test_replace_takes_the_star_solution_nearest_in_time_whatever_the_order() -> None:
    stars = [star(100.0), star(0.0), star(50.0)]
    result = fixed(transfer_attitude(60.0, stars, options=REPLACE))
    assert result.used == (2,)
    assert result.gap_s == 10.0
    assert angle_rad(result.camera_from_inertial, attitude(50.0)) <= FLOAT64


def test_replace_prefers_the_earlier_of_two_equally_near_solutions() -> None:
    assert fixed(transfer_attitude(5.0, [star(10.0), star(0.0)], options=REPLACE)).used == (1,)


def test_interpolate_is_exact_for_a_constant_rate_and_agrees_with_slerp() -> None:
    stars = [star(0.0), star(100.0)]
    slerp = Slerp([0.0, 100.0], Rotation.concatenate([s.camera_from_inertial for s in stars]))
    for et in (0.0, 13.0, 50.0, 99.0, 100.0):
        result = fixed(transfer_attitude(et, stars, options=INTERPOLATE)).camera_from_inertial
        assert angle_rad(result, attitude(et)) <= FLOAT64
        assert angle_rad(result, slerp(et)) <= FLOAT64


def test_interpolate_brackets_with_the_closest_solution_on_each_side() -> None:
    stars = [star(et) for et in (0.0, 30.0, 60.0, 90.0)]
    assert fixed(transfer_attitude(45.0, stars, options=INTERPOLATE)).used == (1, 2)


def test_interpolate_outside_the_star_images_takes_the_nearest() -> None:
    stars = [star(0.0), star(10.0)]
    early, late = (fixed(transfer_attitude(et, stars, options=INTERPOLATE)) for et in (-3.0, 14.0))
    assert (early.used, late.used) == ((0,), (1,))
    assert late.gap_s == 4.0


def test_propagate_carries_the_star_solution_by_the_relative_rotation_of_the_a_priori_attitudes() -> None:
    bias_inertial = Rotation.from_rotvec([3e-4, -2e-4, 1e-4])  # of the a priori attitudes, fixed in inertial axes
    stars = [star(et, apriori=attitude(et) * bias_inertial) for et in (0.0, 500.0)]
    result = fixed(transfer_attitude(200.0, stars, apriori=attitude(200.0) * bias_inertial, options=PROPAGATE))
    assert result.used == (0,)
    assert angle_rad(result.camera_from_inertial, attitude(200.0)) <= FLOAT64


def test_propagate_turns_the_covariance_with_the_camera() -> None:
    quarter = Rotation.from_euler("z", 90.0, degrees=True)
    near = dataclasses.replace(star(0.0), apriori=attitude(0.0))
    result = fixed(transfer_attitude(1.0, [near], apriori=quarter * attitude(0.0), options=PROPAGATE))
    assert_allclose(np.diag(result.covariance_rad2), [4e-10, 1e-10, 1e-8], rtol=0, atol=1e-8 * FLOAT64)


def test_the_blended_covariance_follows_the_weights_for_small_turns() -> None:
    sigma = np.array([2e-5, 2e-5, 2e-5])
    still = [dataclasses.replace(star(et, sigma_rad=sigma), camera_from_inertial=START) for et in (0.0, 100.0)]
    for et, weight in ((25.0, 0.25), (50.0, 0.5), (90.0, 0.9)):
        result = fixed(transfer_attitude(et, still, options=INTERPOLATE))
        expected = np.eye(3) * 4e-10 * ((1 - weight) ** 2 + weight**2)
        assert_allclose(result.covariance_rad2, expected, rtol=0, atol=1e-8 * FLOAT64)


@pytest.mark.parametrize("weight", [0.2, 0.7])
@pytest.mark.monte_carlo(few=60, full=1500)
def test_the_blended_covariance_holds_in_monte_carlo_for_a_large_turn(weight: float, draws: int) -> None:
    rng = np.random.default_rng(5)
    turn = Rotation.from_rotvec([0.5, -0.9, 0.7])
    ends = (START, turn * START)
    root = [np.array([[3e-5, 0, 0], [1e-5, 2e-5, 0], [0, 2e-5, 9e-5]]), np.diag([1e-5, 8e-5, 3e-5])]

    def solve(errors: list[Float]) -> TransferredAttitude:
        stars = [
            StarAttitude(
                et=100.0 * k,
                camera_from_inertial=Rotation.from_rotvec(errors[k]).inv() * ends[k],
                covariance_rad2=root[k] @ root[k].T,
            )
            for k in range(2)
        ]
        return fixed(transfer_attitude(100.0 * weight, stars, options=INTERPOLATE))

    truth = solve([np.zeros(3), np.zeros(3)])
    inverse = np.linalg.inv(truth.covariance_rad2)
    nees = np.empty(draws)
    for k in range(draws):
        draw = solve([part @ rng.standard_normal(3) for part in root])
        error = rotation_between(draw.camera_from_inertial, truth.camera_from_inertial)
        nees[k] = error @ inverse @ error
    low, high = mean_square_band(3 * draws, 3e-5)  # four sigma
    assert low < nees.mean() / 3.0 < high


def test_drift_grows_with_the_gap_and_is_pinned_at_both_ends_of_an_interpolation() -> None:
    variance = (2.0 * RAD_PER_ARCSEC) ** 2
    none = np.zeros(3)
    stars = [star(0.0, sigma_rad=none), star(100.0, sigma_rad=none)]
    one = dataclasses.replace(REPLACE, drift_arcsec_per_sqrt_s=2.0)
    both = dataclasses.replace(INTERPOLATE, drift_arcsec_per_sqrt_s=2.0)
    for options, et, seconds in ((one, 20.0, 20.0), (both, 20.0, 16.0), (both, 50.0, 25.0), (both, 100.0, 0.0)):
        result = fixed(transfer_attitude(et, stars, options=options))
        assert_allclose(result.covariance_rad2, np.eye(3) * variance * seconds, rtol=0, atol=1e-10 * FLOAT64)


def test_a_solution_too_far_in_time_is_not_used() -> None:
    options = dataclasses.replace(INTERPOLATE, max_gap_s=30.0)
    one_side = fixed(transfer_attitude(20.0, [star(0.0), star(100.0)], options=options))
    assert one_side.used == (0,)
    refused = transfer_attitude(50.0, [star(0.0), star(100.0)], options=options)
    assert isinstance(refused, Failure)
    assert refused.reason is Reason.NO_ATTITUDE
    assert "50 s" in refused.detail


def test_without_any_star_solution_there_is_no_attitude() -> None:
    outcome = transfer_attitude(0.0, [], options=REPLACE)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.NO_ATTITUDE


def test_propagate_without_a_priori_attitudes_says_so() -> None:
    here = transfer_attitude(0.0, [star(1.0, apriori=START)], options=PROPAGATE)
    there = transfer_attitude(0.0, [star(1.0)], apriori=START, options=PROPAGATE)
    for outcome in (here, there):
        assert isinstance(outcome, Failure)
        assert "a priori" in outcome.detail


@pytest.mark.parametrize("options", [REPLACE, INTERPOLATE])
def test_a_slew_that_the_a_priori_attitudes_know_of_is_refused(options: TransferOptions) -> None:
    slewed = Rotation.from_rotvec([0.0, 3 * RAD_PER_DEG, 0.0]) * attitude(50.0)
    stars = [star(et, apriori=attitude(et)) for et in (0.0, 100.0)]
    outcome = transfer_attitude(50.0, stars, apriori=slewed, options=options)
    assert isinstance(outcome, Failure)
    assert "propagate" in outcome.detail
    trusting = dataclasses.replace(options, max_disagreement_deg=180.0)
    assert isinstance(transfer_attitude(50.0, stars, apriori=slewed, options=trusting), TransferredAttitude)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6),
    st.floats(0.01, 0.99),
)
def test_interpolation_does_not_depend_on_the_direction_of_time(numbers: list[float], weight: float) -> None:
    ends = [Rotation.from_rotvec(numbers[:3]), Rotation.from_rotvec(numbers[3:])]
    if angle_rad(*ends) > 3.0:  # half a turn has no shortest way
        return
    covariance = [np.diag([1e-10, 4e-10, 9e-10]), np.diag([4e-10, 1e-10, 1e-10])]
    forward, backward = (
        fixed(
            transfer_attitude(
                et,
                [
                    StarAttitude(et=t, camera_from_inertial=r, covariance_rad2=c)
                    for t, r, c in zip(times, ends, covariance, strict=True)
                ],
                options=INTERPOLATE,
            )
        )
        for times, et in (((0.0, 1.0), weight), ((1.0, 0.0), 1.0 - weight))
    )
    assert angle_rad(forward.camera_from_inertial, backward.camera_from_inertial) <= 1e-9
    assert_allclose(forward.covariance_rad2, backward.covariance_rad2, rtol=0, atol=1e-4 * FLOAT64)


def test_options_out_of_range_are_refused() -> None:
    bad: list[dict[str, float]] = [
        {"max_gap_s": -1.0},
        {"drift_arcsec_per_sqrt_s": -1.0},
        {"max_disagreement_deg": 0.0},
    ]
    for values, method in itertools.product(bad, TransferMethod):
        with pytest.raises(InputError, match=next(iter(values))):
            TransferOptions(method=method, **values)


def taken(name: str, et: float | None, *, camera_name: str = "") -> Image:
    """An image without an attitude."""
    epoch = None if et is None else time_from_et(et)
    return Image(pixels=np.zeros((2, 2)), name=name, epoch=epoch, camera_name=camera_name)


def solved(name: str, et: float) -> Image:
    known = star(et)
    errors = AttitudeErrors(flags=Quality.SATURATED)
    return taken(name, et).with_attitude(
        known.camera_from_inertial, source=AttitudeSource.STARS, covariance_rad2=known.covariance_rad2, errors=errors
    )


def test_an_image_between_two_of_stars_gets_their_attitude_covariance_and_errors() -> None:
    short, around = taken("short", 30.0), [solved("long2", 50.0), solved("long1", 0.0)]
    carried = carry_attitude(short, around, options=INTERPOLATE)
    assert isinstance(carried, Image)
    wanted = fixed(transfer_attitude(30.0, [star(50.0), star(0.0)], options=INTERPOLATE))
    assert carried.camera_from_inertial is not None
    assert angle_rad(carried.camera_from_inertial, attitude(30.0)) <= 1e-9  # microseconds of the epoch
    assert carried.attitude_covariance_rad2 is not None
    assert_allclose(carried.attitude_covariance_rad2, wanted.covariance_rad2, rtol=1e-6, atol=0)
    assert carried.attitude_source is AttitudeSource.INTERPOLATED
    assert carried.attitude_errors.flags == Quality.SATURATED
    assert short.camera_from_inertial is None, "images are values"


def test_what_an_attitude_cannot_be_carried_from_or_to_is_told() -> None:
    around = [solved("long1", 0.0), solved("long2", 50.0)]
    timeless = carry_attitude(taken("short", None), around)
    assert isinstance(timeless, Failure)
    assert timeless.reason is Reason.NO_EPOCH
    alone = carry_attitude(taken("short", 30.0), [])
    assert isinstance(alone, Failure)
    assert alone.reason is Reason.NO_ATTITUDE
    short = taken("short", 30.0, camera_name="wide")
    for unsolved, lacks in (
        (taken("long1", 0.0), "no attitude"),
        (taken("long1", 0.0).with_attitude(START), "no covariance"),
        (dataclasses.replace(around[0], epoch=None), "no epoch"),
    ):
        with pytest.raises(InputError, match=f"long1 has {lacks}.*solve its stars"):
            carry_attitude(short, [unsolved])
    with pytest.raises(InputError, match="long1 is of camera 'narrow', short of 'wide'"):
        carry_attitude(short, [dataclasses.replace(around[0], camera_name="narrow")])
