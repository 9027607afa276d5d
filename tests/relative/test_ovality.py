"""A point spread function that is wider along one direction moves no limb, and costs exact limbs nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from giantlike import ApparentGeometry, Camera, Detector, GaussianPsf, Image, Scene, Target
from giantlike.camera_models import PinholeModel
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


def found(estimator: str, oval: float) -> PositionFix:
    view = PinholeView(FOCAL_PX, (MIDDLE, MIDDLE), SIZE, SIZE)
    pose = Pose(TRUTH_KM, TURN, SUN)
    light = 3000.0 * render_body(EllipsoidBody(RADII_KM), view, pose, law="mcewen", psf=Psf(PSF_PX))
    if oval > 1.0:
        light = gaussian_filter1d(light, PSF_PX * math.sqrt(oval**2 - 1.0), axis=1)
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
    fix = found(estimator, 1.4)
    error = fix.position_camera_km - TRUTH_KM
    assert not fix.flags.suspect
    assert float(np.hypot(*(fix.center_px - CAMERA.model.project(TRUTH_KM)))) < 0.05
    assert float(error @ np.linalg.solve(fix.covariance_camera_km2, error)) < 16.3  # 1 of 1,000 right ones
    assert float(np.sqrt(np.trace(fix.covariance_px2))) < 0.1
