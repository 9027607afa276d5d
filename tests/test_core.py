"""Directions, attitudes, time and light against astropy, ERFA and SPICE conventions."""

from __future__ import annotations

import erfa
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import as_finite, as_unit
from giantlike.core.blocks import block_sums
from giantlike.core.errors import DataError, EstimationError, FrameMismatchError, InputError
from giantlike.core.frames import (
    FrameRotation,
    camera_from_inertial_of_pointing,
    direction_from_radec,
    pointing_deg,
    position_angle_deg,
    quaternion_xyzw,
    radec_from_direction,
    rotation_between,
    rotation_from_xyzw,
    skew,
)
from giantlike.core.light import aberrate
from giantlike.core.outcomes import Failure, Quality, Reason
from giantlike.core.time import et_from_time, time_from_et, time_from_utc, utc_text
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from tests.tolerances import EPOCH_S, FLOAT64, FLOAT64_ROOT, FLOAT64_SUM

ANGLE_DEG = 1e-9  # float64 at 360 degrees, through arc functions


@given(ra=st.floats(0, 359.999), dec=st.floats(-89.9, 89.9), roll=st.floats(0, 359.999))
def test_pointing_survives_the_way_to_an_attitude_and_back(ra: float, dec: float, roll: float) -> None:
    found = np.array(pointing_deg(camera_from_inertial_of_pointing(ra, dec, roll), [0.0, 0.0, 1.0]))
    difference = (found - [ra, dec, roll] + 180.0) % 360.0 - 180.0
    assert_allclose(difference, 0.0, rtol=0, atol=FLOAT64_ROOT)  # near the poles RA and roll lose digits together


def test_position_angle_agrees_with_astropy() -> None:
    here, there = SkyCoord(10 * u.deg, 60 * u.deg), SkyCoord(10.01 * u.deg, 60.01 * u.deg)
    a, b = (direction_from_radec(c.ra.deg, c.dec.deg) for c in (here, there))
    assert_allclose(position_angle_deg(a, b), here.position_angle(there).deg, rtol=0, atol=ANGLE_DEG)
    with pytest.raises(InputError, match="pole"):
        position_angle_deg([0, 0, 1], [1, 0, 0])


def test_radec_of_a_direction_is_what_made_it() -> None:
    ra, dec = np.array([0.0, 123.4, 359.0]), np.array([-89.0, 0.0, 45.0])
    found_ra, found_dec = radec_from_direction(3.0 * direction_from_radec(ra, dec))
    assert_allclose([found_ra, found_dec], [ra, dec], rtol=0, atol=ANGLE_DEG)


def test_rotation_between_undoes_a_small_turn_on_the_left() -> None:
    estimate = Rotation.random(rng=np.random.default_rng(2))
    turn = np.array([1e-3, -2e-3, 3e-3])
    assert_allclose(rotation_between(estimate, Rotation.from_rotvec(turn) * estimate), turn, rtol=0, atol=FLOAT64)


def test_quaternions_are_scalar_last_with_positive_scalar() -> None:
    assert_allclose(quaternion_xyzw(Rotation.from_quat([0, 0, 0, -1])), [0, 0, 0, 1], rtol=0, atol=0)
    with pytest.raises(InputError, match="norm 1"):
        rotation_from_xyzw([1.0, 1.0, 0.0, 0.0])


def test_skew_is_the_cross_product() -> None:
    a, b = np.random.default_rng(3).normal(size=(2, 5, 3))
    assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), rtol=0, atol=FLOAT64)


def test_aberration_agrees_with_erfa() -> None:
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    velocity = np.array([20.0, -25.0, 11.0])
    beta = velocity / SPEED_OF_LIGHT_KM_S
    # erfa.ab adds the Sun's gravitational potential, a third-order term that vanishes far away
    expected = np.array([erfa.ab(d, beta, 1e9, np.sqrt(1 - beta @ beta)) for d in directions])
    assert_allclose(aberrate(directions, velocity), expected, rtol=0, atol=5 * FLOAT64)
    assert_allclose(np.linalg.norm(aberrate(7.0 * directions, velocity), axis=1), 7.0, rtol=0, atol=FLOAT64_SUM)


def test_et_is_tdb_seconds_past_j2000() -> None:
    # UTC 2000-01-01T11:58:55.816 is TT 12:00:00.000, within 0.1 ms of TDB
    assert abs(et_from_time(time_from_utc("2000-01-01T11:58:55.816Z"))) < 1e-4
    et = 596930900.3060744
    assert abs(et_from_time(time_from_et(et)) - et) < EPOCH_S
    assert et_from_time(Time("2000-01-02T12:00:00", scale="tdb")) == 86400.0
    assert utc_text(Time("2018-12-01T10:07:11.123", scale="utc")) == "2018-12-01T10:07:11.123000"
    with pytest.raises(InputError, match="ISO 8601"):
        time_from_utc("yesterday")


def test_an_epoch_by_the_day_of_the_year_is_that_of_its_calendar_date() -> None:
    assert utc_text(time_from_utc("2020-061T10:07:11.25Z")) == "2020-03-01T10:07:11.250000"  # a leap year
    assert utc_text(time_from_utc("2021-060T10:07")) == "2021-03-01T10:07:00.000000"
    for wrong in ("2021-366T00:00:00", "2021-000T00:00:00", "2021-060T25:00:00", "2021-060"):
        with pytest.raises(InputError, match="ISO 8601"):
            time_from_utc(wrong)


def test_a_failure_is_false_and_raises_when_unwrapped() -> None:
    failure = Failure(Reason.TOO_FEW_MATCHES, "3 matches, needed 6")
    assert not failure
    with pytest.raises(EstimationError, match="3 matches, needed 6"):
        failure.unwrap()


def test_quality_names_list_single_flags() -> None:
    flags = Quality.SATURATED | Quality.LOW_SCORE
    assert flags.names() == ("saturated", "low_score")
    assert flags.suspect
    assert not Quality.CUT_BY_FRAME.suspect


def test_checks_name_what_is_wrong() -> None:
    with pytest.raises(InputError, match=r"position must have shape \(3,\)"):
        as_finite([1.0, 2.0], (3,), "position")
    with pytest.raises(InputError, match="must be finite"):
        as_finite([1.0, np.nan, 0.0], (3,), "position")
    with pytest.raises(InputError, match="normalize"):
        as_unit([[1.0, 0.0, 0.1]], "rays")
    assert "gone.fits: is missing" in str(DataError("gone.fits", "is missing"))


# --- Frames with names ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("utc", "et"),
    [
        ("1979-03-05T10:00:00", -657251949.8145534),
        ("2004-10-26T14:30:00", 152073064.1824572),
        ("2019-03-03T05:00:00.123", 604861269.3084089),
        ("2024-12-30T12:00:00", 788832069.1838841),
    ],
)
def test_et_is_the_number_of_cspice(utc: str, et: float) -> None:
    """``str2et`` of CSPICE N0067 with naif0012.tls; astropy's TDB is up to 18 us off."""
    assert abs(et_from_time(time_from_utc(utc)) - et) < 2e-7
    assert utc_text(time_from_et(et)) == utc_text(Time(utc, scale="utc"))


def named(target: str, source: str, turn_rad: float = 0.1) -> FrameRotation:
    return FrameRotation(rotation=Rotation.from_rotvec([turn_rad, 0.0, 0.0]), target=target, source=source)


def test_named_frames_cancel_in_products() -> None:
    product = named("CAMERA", "BUS") * named("BUS", "J2000", 0.2)
    assert (product.target, product.source) == ("CAMERA", "J2000")
    assert_allclose(product.rotation.as_rotvec(), [0.3, 0.0, 0.0], rtol=0, atol=FLOAT64)
    back = product.inv()
    assert (back.target, back.source) == ("J2000", "CAMERA")
    assert (product * back).between("CAMERA", "CAMERA").magnitude() < FLOAT64


def test_a_product_of_rotations_whose_inner_frames_differ_is_refused() -> None:
    with pytest.raises(FrameMismatchError) as caught:
        named("CAMERA", "BUS") * named("TRACKER", "J2000")
    assert (caught.value.have, caught.value.need) == ("TRACKER", "BUS")


def test_a_rotation_between_other_frames_than_needed_is_refused() -> None:
    with pytest.raises(FrameMismatchError) as caught:
        named("CAMERA", "ECLIPJ2000").between("CAMERA", "J2000")
    assert (caught.value.have, caught.value.need) == ("ECLIPJ2000", "J2000")


def test_a_frame_without_a_name_fits_any_other() -> None:
    assert (named("CAMERA", "") * named("BUS", "J2000")).source == "J2000"


@pytest.mark.parametrize("size", [1, 3, 11])
def test_blocks_of_an_image_are_summed_and_what_fills_none_is_left_out(size: int) -> None:
    image = np.arange(26.0 * 40.0).reshape(26, 40)
    rows, columns = 26 // size, 40 // size
    expected = [
        [image[size * i : size * (i + 1), size * j : size * (j + 1)].sum() for j in range(columns)] for i in range(rows)
    ]
    assert_array_equal(block_sums(image, size), expected)
