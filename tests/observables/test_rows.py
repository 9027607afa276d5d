"""Rows of observables: derivatives by finite differences, parts that go back to what they share, and the file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import BrownModel
from giantlike.campaign.store.observables import camera_rates, observables_metadata
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import direction_from_radec, rotate
from giantlike.core.light import boosted
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import AttitudeErrors, CenterFix, PositionFix, Quality
from giantlike.ephemeris import BARYCENTER
from giantlike.io.observables_file import FORMAT_VERSION, ObservableRow, read_observables, write_observables
from giantlike.io.tables import columns_of
from giantlike.observables import (
    ImageContext,
    LandmarkSeen,
    Sighting,
    StarsSeen,
    preferred,
    row_of_body,
    row_of_landmark,
    rows_of_stars,
)
from giantlike.relative.place import place_jacobian
from giantlike.scene import Circumstances, TargetUncertainty

MODEL = BrownModel(fx_px=3000.0, fy_px=3001.0, cx_px=320.0, cy_px=238.0, k1=-0.5, p1=2e-4)
KNOWN = ModelUncertainty(
    estimated=("fx_px", "k1"),
    covariance=np.diag([0.04, 1e-6]),
    residual_sigma_px=0.1,
    n_observations=300,
    n_images=3,
)
CAMERA = Camera(name="cam", columns=640, rows=480, model=MODEL, uncertainty=KNOWN)
ATTITUDE = Rotation.from_euler("zyx", [200.0, 35.0, -70.0], degrees=True)
TURN = ATTITUDE.as_matrix()
ATTITUDE_RAD2 = np.diag([1.0, 2.0, 30.0]) * 1e-12
BODY = Rotation.from_euler("xyz", [30.0, -50.0, 10.0], degrees=True)
STATES = Circumstances(
    origin=BARYCENTER,
    observer_position_km=np.array([1.5e8, 2e7, 0.0]),
    observer_velocity_km_s=np.array([-4.0, 27.0, 11.0]),
    target_velocity_km_s=np.array([-5.0, 28.0, 10.0]),
    target_motion_km=np.array([-5.0, 28.0, 10.0]) * 0.004,
    light_time_s=0.004,
)
UNCERTAIN = TargetUncertainty(scale=0.003, pole_rad=2e-3, spin_rad=3e-3, ephemeris_km=1.0)
SIGHTING = Sighting(
    predicted_camera_km=np.array([30.0, -20.0, 1200.0]),
    camera_from_body=BODY,
    sun_direction_camera=np.array([0.6, 0.0, -0.8]),
    uncertainty=UNCERTAIN,
    circumstances=STATES,
)
CONTEXT = ImageContext(
    file="a.fits",
    camera=CAMERA,
    shared_camera="cam 1",
    camera_from_inertial=ATTITUDE,
    attitude_source="interpolated",
    attitude_covariance_rad2=ATTITUDE_RAD2,
    attitude_errors=AttitudeErrors(parts={Cause.NOISE: ATTITUDE_RAD2}),
    attitude_shares={"s1.fits": 0.25, "s2.fits": 0.75},
    epoch_utc="2024-01-01T00:00:00.000000",
    et=757339269.184,
    exposure_s=0.1,
)
APPARENT_KM = np.array([32.0, -21.0, 1203.0])
LANDMARK = LandmarkSeen(
    name="L7",
    body_km=np.array([3.0, -2.0, 1.5]),
    observed_px=np.array([400.0, 200.0]),
    covariance_px2=np.array([[0.01, 0.002], [0.002, 0.02]]),
)
DERIVATIVE = 2e-6  # of the largest: central differences of a distorting camera in float64


def position_fix(**changes: object) -> PositionFix:
    """A fix whose parts go back to derivatives, as the error budget makes them."""
    by_turn = place_jacobian(MODEL, APPARENT_KM) @ np.cross(np.eye(3), APPARENT_KM).T
    partials = {
        Cause.ATTITUDE: by_turn,
        Cause.SHAPE_SCALE: np.array([[0.0], [0.0], [-1.0]]),
        Cause.CAMERA: np.array([[0.1, 3.0], [0.2, -4.0], [-3e-4, 0.1]]),
        Cause.POLE: np.array([[10.0, 5.0], [-3.0, 2.0], [0.01, 0.02]]),
    }
    parts = {
        Cause.NOISE: np.array([[4e-4, 1e-4, 3e-7], [1e-4, 5e-4, 2e-7], [3e-7, 2e-7, 1e-8]]),
        Cause.SHAPE_SCALE: UNCERTAIN.scale**2 * partials[Cause.SHAPE_SCALE] @ partials[Cause.SHAPE_SCALE].T,
        Cause.POLE: UNCERTAIN.pole_rad**2 * partials[Cause.POLE] @ partials[Cause.POLE].T,
        Cause.CAMERA: partials[Cause.CAMERA] @ KNOWN.covariance @ partials[Cause.CAMERA].T,
        Cause.ATTITUDE: by_turn @ ATTITUDE_RAD2 @ by_turn.T,
        Cause.EPHEMERIS: np.diag([1.0, 1.0, 1e-6]),
    }
    in_image = sum((parts[c] for c in (Cause.NOISE, Cause.SHAPE_SCALE, Cause.POLE)), np.zeros((3, 3)))
    km_per_place = np.linalg.inv(place_jacobian(MODEL, APPARENT_KM))
    in_camera = km_per_place @ (in_image + parts[Cause.CAMERA]) @ km_per_place.T
    fields: dict[str, Any] = {
        "estimator": "limb_matching",
        "target": "ROCK",
        "center_px": MODEL.project(APPARENT_KM),
        "covariance_px2": in_image[:2, :2],
        "predicted_px": MODEL.project(SIGHTING.predicted_camera_km),
        "residuals": np.zeros(0),
        "n_used": 100,
        "n_rejected": 2,
        "score": 0.5,
        "parts": {cause: (part + part.T) / 2.0 for cause, part in parts.items()},
        "partials": partials,
        "position_camera_km": APPARENT_KM,
        "covariance_camera_km2": (in_camera + in_camera.T) / 2.0,
        "limb_px": np.zeros((0, 2)),
    }
    return PositionFix(**(fields | changes))


def vector(cells: object) -> Float:
    return np.asarray(cells, dtype=np.float64)


def matrix(cells: object, columns: int = 3) -> Float:
    return np.reshape(np.asarray(cells, dtype=np.float64), (3, columns))


def observed(target_km: Float, *, turn: Rotation = ATTITUDE, model: BrownModel = MODEL) -> Float:
    """Pixel, line and apparent range (3,) of a target at the end of its light, from the spacecraft at rest there."""
    light_time_s = 0.0
    for _ in range(20):
        seen_km = target_km - light_time_s * vector(STATES.target_velocity_km_s)
        light_time_s = float(np.linalg.norm(seen_km)) / 299792.458
    apparent_km = boosted(seen_km, STATES.observer_velocity_km_s)
    return np.append(model.project(turn.as_matrix() @ apparent_km), np.linalg.norm(apparent_km))


def differences(function: object, step: float, count: int = 3) -> Float:
    """Central differences by each of the arguments, as columns."""
    assert callable(function)
    return np.array([(function(step * axis) - function(-step * axis)) / (2.0 * step) for axis in np.eye(count)]).T


def assert_same(found: Float, numerical: Float) -> None:
    for row, expected in zip(found, numerical, strict=True):
        assert_allclose(row, expected, rtol=0, atol=DERIVATIVE * np.abs(expected).max() + 1e-12)


def test_the_geometric_position_observed_again_is_the_measurement() -> None:
    row = row_of_body(CONTEXT, SIGHTING, position_fix())
    again = observed(np.array(row.geometric_position_icrf_km))
    assert_allclose(
        again, vector([row.observed_pixel_px, row.observed_line_px, row.observed_apparent_range_km]), rtol=0, atol=1e-8
    )
    assert_allclose(rotate(ATTITUDE, vector(row.apparent_position_icrf_km)), APPARENT_KM, rtol=0, atol=1e-9)
    for name in ("apparent", "astrometric", "geometric"):
        position = np.array(getattr(row, f"{name}_position_icrf_km"))
        direction = direction_from_radec(getattr(row, f"{name}_ra_deg"), getattr(row, f"{name}_dec_deg"))
        assert_allclose(direction, position / np.linalg.norm(position), rtol=0, atol=1e-14)
    # 30 km/s shift a direction by 1e-4 rad; the light time of a body that moves along takes nearly all of it back.
    assert np.linalg.norm(vector(row.apparent_direction_icrf) - vector(row.astrometric_direction_icrf)) > 5e-5
    assert np.linalg.norm(vector(row.apparent_direction_icrf) - vector(row.geometric_direction_icrf)) < 1e-5


def test_partials_by_positions_attitude_and_focal_length_are_those_of_differences() -> None:
    row = row_of_body(CONTEXT, SIGHTING, position_fix())
    target_km = np.array(row.geometric_position_icrf_km)
    assert_same(matrix(row.partial_target_position), differences(lambda step: observed(target_km + step), 0.05))
    assert_same(matrix(row.partial_camera_position), differences(lambda step: observed(target_km - step), 0.05))

    def turned(step: Float) -> Float:
        return observed(target_km, turn=Rotation.from_rotvec(step) * ATTITUDE)[:2]

    assert_same(matrix(row.partial_attitude)[:2], differences(turned, 1e-6))
    assert_allclose(matrix(row.partial_attitude)[2], 0.0, atol=1e-9)
    step = 1e-5
    longer, shorter = (replace(MODEL, fx_px=MODEL.fx_px * f, fy_px=MODEL.fy_px * f) for f in (1 + step, 1 - step))
    numerical = (observed(target_km, model=longer) - observed(target_km, model=shorter))[:2] / (2.0 * step)
    partial = np.array(row.partial_focal_length)
    assert_allclose(partial[:2], numerical, rtol=1e-6)
    # A body whose image is larger by 1e-5 than the assumed lens makes it is taken to be nearer by as much.
    assert_allclose(partial[2], -np.linalg.norm(APPARENT_KM), rtol=1e-12)


def test_the_partial_by_the_time_tag_is_that_of_a_later_exposure() -> None:
    """Spacecraft and target move on, and the camera rotates; an attitude from its own stars needs no rate."""
    rate = np.array([2e-4, -1e-4, 3e-3])
    context = replace(CONTEXT, camera_rate_rad_s=rate)
    row = row_of_body(context, SIGHTING, position_fix())
    target_km = np.array(row.geometric_position_icrf_km)
    assert STATES.target_velocity_km_s is not None
    motion = STATES.target_velocity_km_s - STATES.observer_velocity_km_s

    def later(step_s: Float, rotation: Float = rate) -> Float:
        return observed(target_km + step_s[0] * motion, turn=Rotation.from_rotvec(-rotation * step_s[0]) * ATTITUDE)

    expected = differences(later, 0.01, 1)[:, 0]
    assert_allclose(vector(row.partial_time_tag), expected, rtol=1e-6, atol=1e-9)
    assert row.camera_rate_rad_s == rate.tolist()
    starry = row_of_body(replace(context, attitude_source="stars"), SIGHTING, position_fix())
    still = differences(lambda step: later(step, np.zeros(3)), 0.01, 1)[:, 0]
    assert_allclose(vector(starry.partial_time_tag), still, rtol=1e-6, atol=1e-9)
    assert np.linalg.norm(expected - still) > 0.3
    assert row_of_body(CONTEXT, SIGHTING, position_fix()).partial_time_tag is None
    assert row_of_body(replace(CONTEXT, attitude_source="stars"), SIGHTING, position_fix()).partial_time_tag is not None
    mark = row_of_landmark(context, SIGHTING, position_fix(), LANDMARK)
    moved = matrix(mark.partial_target_position) @ motion - matrix(mark.partial_attitude) @ rate
    assert_allclose(vector(mark.partial_time_tag)[:2], moved[:2], rtol=1e-12)


def test_the_partial_by_the_place_of_a_landmark_is_that_of_differences_and_rows_of_it_share_a_key() -> None:
    mark = row_of_landmark(CONTEXT, replace(SIGHTING, uncertainty=TargetUncertainty()), position_fix(), LANDMARK)

    def seen(step: Float) -> Float:
        turned = rotate(SIGHTING.camera_from_body, LANDMARK.body_km + step)
        return np.asarray(MODEL.project(position_fix().position_camera_km + turned))

    assert_same(matrix(mark.partial_landmark)[:2], differences(seen, 1e-4))
    assert mark.shared_landmark == "ROCK L7"
    for partial in (mark.partial_pole, mark.partial_spin, mark.partial_shape_scale):
        assert partial is not None  # though no sigma is declared
    assert row_of_body(CONTEXT, SIGHTING, position_fix()).shared_landmark is None


def test_a_rate_is_given_where_the_attitudes_before_and_after_agree() -> None:
    et = np.array([0.0, 30.0, 50.0, 100.0, 130.0, 160.0, 900.0])
    rate = np.array([1e-4, -3e-4, 2e-3])
    turns = Rotation.from_rotvec(-np.outer(np.minimum(et, 100.0), rate)) * ATTITUDE  # it stops at 100 s
    found = camera_rates(et, turns, np.zeros(et.size))
    assert_allclose(found[1:3], [rate, rate], rtol=0, atol=1e-12)
    assert np.isnan(found[[0, 3, 5, 6]]).all()
    assert_allclose(found[4], 0.0, atol=1e-12)
    assert np.isnan(camera_rates(et[:2], turns[:2], np.zeros(2))).all()
    shaken = Rotation.from_rotvec(1e-3 * np.random.default_rng(1).normal(size=(et.size, 3))) * turns
    assert np.isnan(camera_rates(et, shaken, np.zeros(et.size))[4]).all()
    assert np.isfinite(camera_rates(et, shaken, np.full(et.size, 2e-3))[4]).all()


def test_parts_go_back_to_what_rows_share_and_sum_to_the_covariance() -> None:
    row = row_of_body(CONTEXT, SIGHTING, position_fix())
    total = matrix(row.covariance)
    parts = [matrix(value) for name in Cause if (value := getattr(row, f"part_{name}", None)) is not None]
    assert_allclose(sum(parts, np.zeros((3, 3))), total, rtol=1e-12)
    by_attitude = matrix(row.partial_attitude)
    shared = by_attitude @ matrix(row.attitude_covariance_rad2) @ by_attitude.T
    assert_allclose(matrix(row.part_attitude), shared, rtol=0, atol=1e-9 * np.abs(shared).max())
    scale = np.array(row.partial_shape_scale)
    assert_allclose(matrix(row.part_shape_scale), UNCERTAIN.scale**2 * np.outer(scale, scale), rtol=1e-12)
    pole = matrix(row.partial_pole, 2)
    assert_allclose(matrix(row.part_pole), UNCERTAIN.pole_rad**2 * pole @ pole.T, rtol=1e-9, atol=1e-18)
    camera = matrix(row.partial_camera_parameters, 2)
    assert_allclose(matrix(row.part_camera), camera @ KNOWN.covariance @ camera.T, rtol=1e-9, atol=1e-15)
    assert (row.shared_image, row.shared_attitude, row.shared_body) == ("a.fits", "s1.fits + s2.fits", "ROCK")
    assert (row.attitude_images, row.attitude_weights) == (["s1.fits", "s2.fits"], [0.25, 0.75])


def test_sigmas_and_correlations_are_those_of_the_covariance_and_of_the_position() -> None:
    row = row_of_body(CONTEXT, SIGHTING, position_fix())
    total = matrix(row.covariance)
    assert row.sigma_range_km is not None
    assert row.correlation_pixel_range is not None
    assert row.sigma_pixel_px is not None
    assert_allclose(row.sigma_range_km**2, total[2, 2], rtol=1e-12)
    assert_allclose(row.correlation_pixel_range * row.sigma_pixel_px * row.sigma_range_km, total[0, 2], rtol=1e-12)
    # The covariance of the position, seen again through the camera, is that of pixel, line and range.
    by_place = place_jacobian(MODEL, APPARENT_KM) * np.array([1.0, 1.0, np.linalg.norm(APPARENT_KM)])[:, None]
    again = by_place @ TURN @ matrix(row.covariance_position_icrf_km2) @ TURN.T @ by_place.T
    assert_allclose(again, total, rtol=1e-6, atol=1e-12)
    # East and north: the position's covariance across the line of sight over the range.
    east = np.array(
        [-np.sin(np.radians(vector(row.apparent_ra_deg))), np.cos(np.radians(vector(row.apparent_ra_deg))), 0.0]
    )
    sigma_rad = np.sqrt(east @ matrix(row.covariance_position_icrf_km2) @ east) / np.linalg.norm(APPARENT_KM)
    assert_allclose(np.degrees(sigma_rad) * 3600.0, vector(row.sigma_ra_cos_dec_arcsec), rtol=1e-6)


def test_a_center_without_a_range_says_so_and_still_has_its_light_time_removed() -> None:
    whole = position_fix()
    fix = CenterFix(
        estimator="moment",
        target="ROCK",
        center_px=whole.center_px,
        covariance_px2=whole.parts[Cause.NOISE][:2, :2],
        predicted_px=whole.predicted_px,
        residuals=np.zeros(0),
        n_used=5,
        n_rejected=0,
        score=1.0,
        parts={Cause.NOISE: whole.parts[Cause.NOISE][:2, :2], Cause.ATTITUDE: whole.parts[Cause.ATTITUDE][:2, :2]},
    )
    row = row_of_body(CONTEXT, SIGHTING, fix)
    assert (row.observed_apparent_range_km, row.sigma_range_km, row.geometric_position_icrf_km) == (None, None, None)
    assert np.isnan(matrix(row.covariance)[2]).all()
    assert np.isfinite(matrix(row.covariance)[:2, :2]).all()
    # The light time is that of the predicted range, 3 km shorter: nothing, over that of light.
    found, ranged = (vector(each.geometric_direction_icrf) for each in (row, row_of_body(CONTEXT, SIGHTING, whole)))
    assert_allclose(found, ranged, rtol=0, atol=1e-9)


def test_an_attitude_of_unknown_uncertainty_leaves_the_total_empty_and_the_parts_there() -> None:
    parts = {cause: part for cause, part in position_fix().parts.items() if cause is not Cause.ATTITUDE}
    row = row_of_body(replace(CONTEXT, attitude_covariance_rad2=None), SIGHTING, position_fix(parts=parts))
    assert row.covariance is None
    assert row.sigma_pixel_px is None
    assert row.part_noise is not None


def test_partials_of_a_landmark_are_those_of_differences() -> None:
    row = row_of_landmark(CONTEXT, SIGHTING, position_fix(), LANDMARK)
    turned_km = rotate(BODY, LANDMARK.body_km)

    def seen(body_km: Float) -> Float:
        return MODEL.project(APPARENT_KM + rotate(BODY, body_km))

    step = 1e-6
    by_scale = (seen(LANDMARK.body_km * (1 + step)) - seen(LANDMARK.body_km * (1 - step))) / (2 * step)
    assert_allclose(np.array(row.partial_shape_scale)[:2], by_scale, rtol=1e-6)
    by_turn = differences(lambda turn: seen(Rotation.from_rotvec(turn).as_matrix() @ LANDMARK.body_km), 1e-5)
    assert_same(np.hstack([matrix(row.partial_pole, 2), matrix(row.partial_spin, 1)])[:2], by_turn)
    by_camera = differences(
        lambda p: replace(MODEL, fx_px=MODEL.fx_px + p[0], k1=MODEL.k1 + p[1]).project(APPARENT_KM + turned_km), 1e-4, 2
    )
    assert_same(matrix(row.partial_camera_parameters, 2)[:2], by_camera)
    computed = MODEL.project(SIGHTING.predicted_camera_km + turned_km)
    assert_allclose(
        vector([row.o_minus_c_pixel_px, row.o_minus_c_line_px]), LANDMARK.observed_px - computed, rtol=0, atol=1e-9
    )


def test_a_star_is_where_it_is_without_the_motion_of_the_spacecraft() -> None:
    observer = ObserverState(position_km=np.zeros(3), velocity_km_s=STATES.observer_velocity_km_s)
    catalog = rotate(ATTITUDE.inv(), MODEL.unproject([100.0, 300.0]))
    apparent = boosted(catalog, observer.velocity_km_s)
    observed_px = MODEL.project(rotate(ATTITUDE, apparent))
    stars = StarsSeen(
        numbers=np.array([42]),
        magnitudes=np.array([6.5]),
        observed_px=observed_px[None],
        predicted_px=observed_px[None] - 0.1,
        sigma_px=np.array([0.2]),
    )
    (row,) = rows_of_stars(CONTEXT, stars, observer, status="ok").rows()
    assert (row.kind, row.feature, row.target, row.preferred) == ("star", "42", None, False)
    assert_allclose(vector(row.geometric_direction_icrf), catalog, rtol=0, atol=1e-12)
    assert_allclose(vector([row.o_minus_c_pixel_px, row.o_minus_c_line_px]), vector([0.1, 0.1]), rtol=0, atol=1e-12)
    assert_allclose(matrix(row.covariance)[:2, :2], 0.04 * np.eye(2), rtol=1e-12)
    direction = MODEL.unproject(observed_px)
    numerical = differences(lambda turn: MODEL.project(direction + np.cross(turn, direction)), 1e-6)
    assert_same(matrix(row.partial_attitude)[:2], numerical)


def _named(estimator: str, *, shift_px: float = 0.0, sigma: float = 1.0, flags: Quality = Quality.NONE) -> CenterFix:
    covariance = sigma**2 * np.array([[4e-4, 1e-4], [1e-4, 5e-4]])
    return CenterFix(
        estimator=estimator,
        target="ROCK",
        center_px=np.array([300.0 + shift_px, 200.0]),
        covariance_px2=covariance,
        predicted_px=np.array([300.0, 200.0]),
        residuals=np.zeros(0),
        n_used=1,
        n_rejected=0,
        score=1.0,
        flags=flags,
        parts={Cause.NOISE: covariance},
    )


def test_the_preferred_fix_is_the_most_certain_of_those_that_agree() -> None:
    agreeing = [_named("a", sigma=2.0), _named("b", shift_px=0.01), _named("liar", shift_px=3.0, sigma=0.1)]
    choice = preferred(agreeing)
    assert choice.index == 1
    assert "agree with 1 of 2 others" in choice.reason
    assert preferred([*agreeing, _named("auto", sigma=5.0)]).index == 3
    suspect = _named("a", flags=Quality.LOW_SCORE)
    assert preferred([suspect]).index is None
    assert preferred([suspect]).reason == "all fixes are suspect"
    assert preferred([suspect, agreeing[0]]).reason == "the only fix that is not suspect"
    assert "contradict" in preferred([_named("a"), _named("b", shift_px=3.0)]).reason


def _rows() -> list[ObservableRow]:
    return [
        row_of_body(CONTEXT, SIGHTING, position_fix()),
        row_of_landmark(CONTEXT, SIGHTING, position_fix(), LANDMARK),
    ]


def test_parquet_holds_what_each_column_means_and_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "o.parquet"
    assert write_observables(path, _rows(), {"campaign": "test"}) == 2
    schema = parquet.read_schema(path)
    assert schema.metadata[b"campaign"] == b"test"
    field = schema.field("geometric_position_icrf_km")
    assert field.type.list_size == 3
    assert (field.metadata[b"unit"], field.metadata[b"frame"]) == (b"km", b"ICRF")
    assert all(schema.field(column.name).metadata[b"description"] for column in columns_of(ObservableRow))
    rows, metadata = read_observables(path)
    assert metadata["format_version"] == "1"
    assert rows[0] == _rows()[0]
    assert np.isnan(rows[1].covariance[8])  # type: ignore[index]


def test_stars_are_the_same_row_by_row_and_column_by_column(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    places = rng.uniform(50.0, 400.0, (30, 2))
    stars = StarsSeen(
        numbers=np.arange(30),
        magnitudes=np.linspace(4.0, 8.0, 30),
        observed_px=places,
        predicted_px=places + rng.normal(0.0, 0.1, (30, 2)),
        sigma_px=np.full(30, 0.1),
    )
    block = rows_of_stars(CONTEXT, stars, None, status="ok")
    body = _rows()[0]
    counts = [
        write_observables(tmp_path / "blocks.parquet", [body, block, body], {}),
        write_observables(tmp_path / "rows.parquet", [body, *block.rows(), body], {}),
    ]
    assert counts == [32, 32]
    both = [parquet.read_table(tmp_path / name) for name in ("blocks.parquet", "rows.parquet")]
    assert both[0].schema.equals(both[1].schema, check_metadata=True)
    for name in both[0].column_names:
        np.testing.assert_equal(both[0][name].to_pylist(), both[1][name].to_pylist())


def test_json_lines_hold_the_same_without_what_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "o.jsonl"
    write_observables(path, _rows(), observables_metadata("test", CONTEXT.camera))
    head, body, landmark = (json.loads(line) for line in path.read_text().splitlines())
    assert head["kind"] == "metadata"
    assert head["format_version"] == FORMAT_VERSION
    assert head["camera"] == CONTEXT.camera.to_mapping()
    assert head["units"]["covariance_position_icrf_km2"] == "km²"
    assert head["frames"]["partial_attitude"] == "camera"
    assert body["geometric_ra_deg"] == _rows()[0].geometric_ra_deg
    assert body["covariance"] == _rows()[0].covariance
    assert "feature" not in body
    assert landmark["covariance"][8] is None


def test_another_ending_and_another_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.parquet or \.jsonl"):
        write_observables(tmp_path / "o.csv", _rows(), {})
    (tmp_path / "x.parquet").write_text("no")
    with pytest.raises(DataError, match="Parquet"):
        read_observables(tmp_path / "x.parquet")
