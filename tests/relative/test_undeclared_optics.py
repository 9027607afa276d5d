"""Point spread functions that are wider along one direction, and trails of charge, hardly move a body."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from giantlike import ApparentGeometry, Camera, Detector, GaussianPsf, Image, Scene, Target
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.outcomes import PositionFix
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, render_body
from giantlike.relative import ESTIMATORS
from giantlike.shapes import Ellipsoid
from tests.sizes import slow

RADII_KM = (10.0, 9.2, 8.6)
FOCAL_PX, SIZE, RANGE_KM, PSF_PX = 3600.0, 180, 560.0, 0.7
SUN = np.array([0.9, 0.3, -0.4]) / np.linalg.norm([0.9, 0.3, -0.4])
TURN = Rotation.from_rotvec([0.4, -0.9, 0.3])
MIDDLE = 0.5 * (SIZE - 1)
TRUTH_KM = np.array([0.5, -0.3, RANGE_KM])
CAMERA = Camera(
    name="pinhole",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=MIDDLE, cy_px=MIDDLE),
    psf=GaussianPsf(sigma_px=PSF_PX),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0),
)


def widened(light: Float) -> Float:
    """Light (h, w) by a point spread function 1.4 times as wide along rows."""
    return np.asarray(gaussian_filter1d(light, PSF_PX * math.sqrt(1.4**2 - 1.0), axis=1))


def trailed(light: Float) -> Float:
    """Light (h, w) of which 2 % arrive late, in trails of 5 px toward higher columns."""
    delays = np.exp(-np.arange(60) / 5.0)
    late = np.stack([np.convolve(row, delays / delays.sum())[: row.size] for row in light])
    return np.asarray(0.98 * light + 0.02 * late)


def found(estimator: str, change: Callable[[Float], Float]) -> PositionFix:
    view = PinholeView(FOCAL_PX, (MIDDLE, MIDDLE), SIZE, SIZE)
    pose = Pose(TRUTH_KM, TURN, SUN)
    light = change(3000.0 * render_body(EllipsoidBody(RADII_KM), view, pose, law="mcewen", psf=Psf(PSF_PX)))
    rng = np.random.default_rng(7)
    noisy = rng.poisson(light) + rng.normal(0.0, 5.0, light.shape)
    image = Image(pixels=noisy.astype(np.float32), camera_from_inertial=Rotation.identity(), name="picture")
    geometry = ApparentGeometry(
        position_inertial_km=np.array([0.8, 0.1, RANGE_KM + 2.0]), inertial_from_body=TURN, sun_direction_inertial=SUN
    )
    target = Target(name="b", shape=Ellipsoid(radii_km=np.array(RADII_KM)), ephemeris=geometry)
    fix = ESTIMATORS[estimator]().estimate(image, CAMERA, Scene(targets=(target,)))
    assert isinstance(fix, PositionFix), fix
    return fix


@pytest.mark.parametrize("estimator", [slow("limb_matching"), "ellipsoid_cra", slow("sigmoid_limb")])
def test_an_oval_point_spread_function_moves_no_limb(estimator: str) -> None:
    """Without ovality in the model they are 0.19 px (``limb_matching``) and 1.2 px (horizons) off."""
    fix = found(estimator, widened)
    error = fix.position_camera_km - TRUTH_KM
    assert not fix.flags.suspect
    assert float(np.hypot(*(fix.center_px - CAMERA.model.project(TRUTH_KM)))) < 0.05
    assert float(error @ np.linalg.solve(fix.covariance_camera_km2, error)) < 16.3  # 1 of 1,000 right ones
    assert float(np.sqrt(np.trace(fix.covariance_px2))) < 0.1


@pytest.mark.parametrize("estimator", ["cross_correlation", "limb_matching", "ellipsoid_cra", "sigmoid_limb"])
def test_trails_of_charge_hardly_move_a_body(estimator: str) -> None:
    fix = found(estimator, trailed)
    error = fix.position_camera_km - TRUTH_KM
    assert not fix.flags.suspect
    assert float(error @ np.linalg.solve(fix.covariance_camera_km2, error)) < 16.3  # 1 of 1,000 right ones
    assert float(np.sqrt(np.trace(fix.covariance_px2))) < 0.03


def test_the_template_says_which_way_charge_trails() -> None:
    """Without trails in the model its center is 0.04 px off, and uncertain by 0.3 px."""
    fix = found("cross_correlation", trailed)
    assert fix.corrections.trails is not None
    assert fix.corrections.trails.along_rows == pytest.approx(0.02, abs=0.01)
    assert float(np.hypot(*(fix.center_px - CAMERA.model.project(TRUTH_KM)))) < 0.01
