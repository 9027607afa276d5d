"""Limbs that a wrong orientation or a smear strains, and those of bodies with relief; truth by another renderer."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import PositionFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, ReliefBody, record, render_body
from giantlike.ray_tracing import Lambert
from giantlike.relative import EllipsoidCRA, Estimator, LimbMatching, SigmoidLimb
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid
from tests.sizes import slow
from tests.sphere_fields import bumps

RADII_KM = np.array([1.0, 0.94, 0.9])
FOCAL_PX, SIZE, MIDDLE, PSF_PX = 3000.0, 220, 109.5, 0.7
POSITION_KM = np.array([0.1, -0.1, 40.0])  # a radius of 71 px
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5])
CAMERA = Camera(
    name="square",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=MIDDLE, cy_px=MIDDLE),
    psf=GaussianPsf(sigma_px=PSF_PX),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0),
)
FIVE_SIGMA = 25.0
ESTIMATORS = pytest.mark.parametrize("estimator", [slow(LimbMatching()), EllipsoidCRA(), slow(SigmoidLimb())])


def sun_at(phase_deg: float) -> Float:
    phase = np.radians(phase_deg)
    return np.array([0.8 * np.sin(phase), 0.6 * np.sin(phase), -np.cos(phase)])


@cache
def light(phase_deg: float, relief: int = 0, motion_px: float = 0.0) -> Float:
    """Signal of a body; with relief of 1 % rms, drawn by a number, from 1 on; or in motion along rows."""
    body = ReliefBody(RADII_KM, bumps(relief, rms=0.01, widths_deg=(3.0, 15.0))) if relief else EllipsoidBody(RADII_KM)
    view = PinholeView(FOCAL_PX, (MIDDLE, MIDDLE), SIZE, SIZE)
    pose = Pose(POSITION_KM, TURN, sun_at(phase_deg))
    signal: Float = render_body(body, view, pose, law="lambert", psf=Psf(PSF_PX, motion_px=(motion_px, 0.0)))
    return signal


def fix_of(
    estimator: Estimator, signal: Float, phase_deg: float, *, roll_deg: float = 0.0, declared_rad: float = 0.0
) -> PositionFix:
    """Fix of an image, predicted 3 px and 0.4 % of range off and turned about the line of sight."""
    told = ApparentGeometry(
        position_inertial_km=1.004 * (POSITION_KM + np.array([0.04, -0.03, 0.0])),
        inertial_from_body=Rotation.from_rotvec([0.0, 0.0, np.radians(roll_deg)]) * TURN,
        sun_direction_inertial=sun_at(phase_deg),
    )
    known = TargetUncertainty(pole_rad=declared_rad, spin_rad=declared_rad)
    shape, law = Ellipsoid(radii_km=RADII_KM), Lambert()
    scene = Scene(targets=(Target(name="BODY", shape=shape, ephemeris=told, reflectance=law, uncertainty=known),))
    image = Image(pixels=record(signal, np.random.default_rng(4)).pixels, camera_from_inertial=Rotation.identity())
    fix = estimator.estimate(image, CAMERA, scene)
    assert isinstance(fix, PositionFix), fix
    return fix


def squared_error(fix: PositionFix) -> float:
    error = fix.position_camera_km - POSITION_KM
    return float(error @ np.linalg.solve(fix.covariance_camera_km2, error))


@ESTIMATORS
def test_a_roll_that_only_the_limb_tells_makes_it_less_certain(estimator: Estimator) -> None:
    rolled, right = (fix_of(estimator, light(50.0), 50.0, roll_deg=roll_deg) for roll_deg in (4.0, 0.0))
    assert not rolled.flags.suspect
    assert not right.flags.suspect
    assert squared_error(rolled) < FIVE_SIGMA
    assert np.trace(rolled.covariance_px2) > np.trace(right.covariance_px2)
    declared = fix_of(estimator, light(50.0), 50.0, roll_deg=4.0, declared_rad=0.07)
    assert not declared.flags.suspect
    assert squared_error(declared) < FIVE_SIGMA


@pytest.mark.slow
@pytest.mark.parametrize("relief", [1, 2, 3])
def test_relief_of_one_percent_is_no_other_figure(relief: int) -> None:
    fix = fix_of(LimbMatching(), light(40.0, relief=relief), 40.0)
    assert not fix.flags.suspect
    assert squared_error(fix) < FIVE_SIGMA


def test_a_smear_that_strains_the_limb_a_little_makes_it_less_certain() -> None:
    """By 3 px along rows: the limb was 0.5 % of range off, 3.8 sigma, before its strain counted."""
    fix = fix_of(LimbMatching(), light(10.0, motion_px=3.0), 10.0)
    assert squared_error(fix) < 11.0  # 14 before
