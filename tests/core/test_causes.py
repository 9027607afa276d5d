"""Covariances by cause: what sums to what, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel
from giantlike.core.causes import IN_IMAGE, IN_POSITION, Cause, sum_parts
from giantlike.core.errors import InputError
from giantlike.core.outcomes import AttitudeFix, CenterFix, PositionFix
from giantlike.relative.place import place_covariance, position_of_center

NOISE, RELIEF = np.diag([0.01, 0.02, 1e-8]), np.diag([0.03, 0.01, 4e-8])
CAMERA = np.array([[0.04, 0.01, 0.0], [0.01, 0.04, 0.0], [0.0, 0.0, 9e-8]])


def center_fix(**values: Any) -> CenterFix:
    common: dict[str, Any] = {
        "estimator": "test",
        "target": "body",
        "center_px": np.zeros(2),
        "predicted_px": np.zeros(2),
        "residuals": np.zeros(0),
        "n_used": 1,
        "n_rejected": 0,
        "score": 1.0,
    }
    kind = PositionFix if "position_camera_km" in values else CenterFix
    return kind(**common | values)


def test_parts_in_the_image_sum_to_the_covariance_and_the_others_stand_beside_it() -> None:
    parts = {Cause.RELIEF: RELIEF[:2, :2], Cause.ATTITUDE: np.eye(2), Cause.NOISE: NOISE[:2, :2]}
    fix = center_fix(covariance_px2=sum_parts(parts), parts=parts)
    assert list(fix.parts) == [Cause.NOISE, Cause.RELIEF, Cause.ATTITUDE]
    assert_allclose(fix.covariance_total, np.diag([1.04, 1.03]), rtol=0, atol=1e-15)
    with pytest.raises(InputError, match="parts must sum to covariance_px2"):
        center_fix(covariance_px2=sum_parts(parts, tuple(Cause)), parts=parts)


def test_a_position_has_the_camera_in_kilometers_and_not_in_pixels() -> None:
    model = BrownModel(fx_px=2000.0, fy_px=2010.0, cx_px=500.0, cy_px=400.0, k1=-0.05)
    center, range_km = np.array([812.0, 97.0]), 4.0e5
    parts = {Cause.NOISE: NOISE, Cause.RELIEF: RELIEF, Cause.CAMERA: CAMERA}
    position, covariance = position_of_center(model, center, range_km, sum_parts(parts, IN_POSITION))
    values = {"position_camera_km": position, "limb_px": np.zeros((0, 2)), "parts": parts}
    fix = center_fix(covariance_px2=sum_parts(parts, IN_IMAGE)[:2, :2], covariance_camera_km2=covariance, **values)
    assert_allclose(
        place_covariance(model, position, covariance), sum_parts(fix.parts, IN_POSITION), rtol=1e-9, atol=1e-15
    )
    without_camera = position_of_center(model, center, range_km, sum_parts(parts, IN_IMAGE))[1]
    with pytest.raises(InputError, match="relative variance of range"):
        center_fix(covariance_px2=fix.covariance_px2, covariance_camera_km2=without_camera, **values)


@pytest.mark.parametrize(
    ("part", "message"),
    [(np.eye(3), "shape"), (-np.eye(2), "negative variance"), (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric")],
)
def test_a_part_that_is_no_covariance_of_the_center_is_refused(part: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        center_fix(covariance_px2=np.eye(2), parts={Cause.NOISE: part})


def test_parts_of_an_attitude_sum_to_its_covariance() -> None:
    values: dict[str, Any] = {
        name: np.zeros(0) for name in ("star_ids", "detection_indices", "sigma_px", "magnitudes", "rejected_px")
    } | {name: np.zeros((0, 2)) for name in ("observed_px", "predicted_px")}
    numbers = {"n_detected": 0, "n_rejected": 0, "false_match_probability": 0.0, "focal_length_px": 1.0, "fov_deg": 1.0}
    values |= numbers | {"camera_from_inertial": Rotation.identity()}
    parts = {Cause.NOISE: 1e-12 * np.eye(3), Cause.CAMERA: 3e-12 * np.eye(3)}
    AttitudeFix(covariance_rad2=4e-12 * np.eye(3), parts=parts, **values)
    with pytest.raises(InputError, match="covariance_rad2"):
        AttitudeFix(covariance_rad2=1e-12 * np.eye(3), parts=parts, **values)


def test_a_part_of_rank_one_may_have_lost_digits_on_its_way_through_jacobians() -> None:
    shift = np.array([1.0, -2.0])
    rounded = np.outer(shift, shift) - 1e-8 * np.eye(2)
    fix = center_fix(covariance_px2=rounded + np.eye(2), parts={Cause.NOISE: np.eye(2), Cause.PSF: rounded})
    assert fix.parts[Cause.PSF] is not None
