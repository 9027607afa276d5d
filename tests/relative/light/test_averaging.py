"""Center of light of wide bodies, which is found on means over blocks of pixels."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike import independent
from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import CenterFix, Failure, Quality, Reason
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, Recorder
from giantlike.relative.inputs import EstimatorInputs, gather
from giantlike.relative.light.averaging import average_blocks
from giantlike.relative.light.moment import Moment
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid
from tests.sizes import slow

SIZE, FOCAL_PX, DIAMETER_PX = 760, 5000.0, 600.0
BLOCK_PX = 3  # of a body of that size
RADII_KM = np.array([1.0, 0.93, 0.88])
SATURATION_DN = 1e4
RIGHT_PX, RIGHT_SIGMAS = 0.5, 4.0  # 1.2 px by templates whose rays are as far apart as blocks


@cache
def clean(phase_deg: float) -> tuple[Float, Pose]:
    """Image without noise of peak 1, and the pose."""
    position_km = 2.0 * float(np.cbrt(RADII_KM.prod())) * FOCAL_PX / DIAMETER_PX * np.array([0.001, -0.002, 1.0])
    phase = np.radians(phase_deg)
    sun = np.array([0.8 * np.sin(phase), 0.6 * np.sin(phase), -np.cos(phase)])
    pose = Pose(position_km, Rotation.random(random_state=3), sun)
    middle = (SIZE - 1) / 2
    view = PinholeView(focal_px=FOCAL_PX, center_px=(middle, middle), columns=SIZE, rows=SIZE)
    return independent.render_body(EllipsoidBody(RADII_KM), view, pose, law="mcewen", psf=Psf(0.7), peak_dn=1.0), pose


def shot(phase_deg: float) -> tuple[Image, Camera, Scene, Float]:
    """An image, what is believed of it, and the true center."""
    signal, pose = clean(phase_deg)
    pixels = independent.record(3000.0 * signal, np.random.default_rng(5), Recorder(read_noise_e=5.0)).pixels
    middle = (SIZE - 1) / 2
    camera = Camera(
        name="independent",
        columns=SIZE,
        rows=SIZE,
        model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=middle, cy_px=middle),
        psf=GaussianPsf(sigma_px=0.7),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=SATURATION_DN),
    )
    true_km = np.asarray(pose.position_camera_km)
    believed = ApparentGeometry(
        position_inertial_km=1.005 * (true_km + np.array([3.0, -2.0, 0.0]) / FOCAL_PX * true_km[2]),
        inertial_from_body=pose.camera_from_body,
        sun_direction_inertial=np.asarray(pose.sun_direction_camera),
    )
    scene = Scene(targets=(Target(name="BODY", shape=Ellipsoid(radii_km=RADII_KM, name="BODY"), ephemeris=believed),))
    image = Image(pixels=np.asarray(pixels, dtype=np.float32), camera_from_inertial=Rotation.identity(), name="wide")
    return image, camera, scene, FOCAL_PX * true_km[:2] / true_km[2] + middle


def inputs_of(image: Image, camera: Camera, scene: Scene) -> EstimatorInputs:
    found = gather(image, camera, scene, None, estimator="moment", options=None)
    assert not isinstance(found, Failure), found
    return found


@pytest.mark.parametrize("phase_deg", [slow(20.0), 60.0, slow(90.0), slow(120.0)])
def test_the_center_of_a_wide_body_is_right_in_pixels_of_the_image(phase_deg: float) -> None:
    image, camera, scene, center_px = shot(phase_deg)
    fix = Moment().estimate(image, camera, scene)
    assert isinstance(fix, CenterFix), fix
    error = fix.center_px - center_px
    assert np.linalg.norm(error) < RIGHT_PX
    assert error @ np.linalg.solve(fix.covariance_px2, error) < RIGHT_SIGMAS**2
    assert np.abs(fix.predicted_px - inputs_of(image, camera, scene).predicted_px).max() < 1e-9
    lit = clean(phase_deg)[0] > 0.3
    rows, columns = np.nonzero(lit)
    middle_px = np.array([0.5 * (columns.min() + columns.max()), 0.5 * (rows.min() + rows.max())])
    low, high = fix.residuals_at_px.min(axis=0), fix.residuals_at_px.max(axis=0)
    assert np.abs(0.5 * (low + high) - middle_px).max() < 0.05 * DIAMETER_PX
    assert fix.n_used < 2.0 * lit.sum() / BLOCK_PX**2


def test_bad_pixels_are_left_out_of_means_and_flagged() -> None:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[::7, ::5] = True
    mask[:, 400] = True
    image, camera, scene, center_px = shot(60.0)
    pixels = image.pixels.copy()
    pixels[mask] = -5000.0
    fix = Moment().estimate(replace(image, pixels=pixels, mask=mask), camera, scene)
    assert isinstance(fix, CenterFix), fix
    assert np.linalg.norm(fix.center_px - center_px) < RIGHT_PX
    assert fix.flags & Quality.MASKED


def test_means_have_the_noise_that_is_stated_for_them() -> None:
    detector = Detector(
        gain_e_per_dn=2.0, read_noise_e=5.0, step_dn=1.0, frame_noise_dn=2.0, relative_noise=0.01, saturation_dn=9e3
    )
    signal = np.array([0.0, 100.0, 5000.0])
    means = detector.averaged(4)
    assert np.allclose(means.variance_dn2(signal), detector.variance_dn2(signal) / 16.0, rtol=1e-12, atol=0.0)
    assert means.saturation_dn == detector.saturation_dn


def test_blocks_are_saturated_where_all_of_their_good_pixels_are() -> None:
    image, camera, scene, _ = shot(60.0)
    pixels = image.pixels.copy()
    pixels[300:306, 300:305] = SATURATION_DN  # two blocks of 3 x 3, and four in part
    mask = np.zeros((SIZE, SIZE), bool)
    mask[301, 301] = True
    mask[90:92, 90:93] = True  # most of a block
    inputs = inputs_of(replace(image, pixels=pixels, mask=mask), camera, scene)
    means = average_blocks(inputs, BLOCK_PX)
    assert np.argwhere(means.saturated).tolist() == [[100, 100], [101, 100]]
    assert np.argwhere(means.masked).tolist() == [[30, 30]]
    assert means.pixels_dn[100, 100] == SATURATION_DN
    assert not (means.usable & (means.saturated | means.masked)).any()
    middle = BLOCK_PX * means.predicted_px + 0.5 * (BLOCK_PX - 1)
    assert np.allclose(middle, inputs.predicted_px, rtol=0.0, atol=1e-9)
    assert BLOCK_PX * means.radius_px == pytest.approx(inputs.radius_px, rel=1e-3)


def test_what_fails_says_so_in_pixels_of_the_image() -> None:
    image, camera, scene, _ = shot(60.0)
    failure = Moment().estimate(replace(image, pixels=np.zeros_like(image.pixels) + image.pixels[:1]), camera, scene)
    assert isinstance(failure, Failure)
    assert failure.reason is Reason.NO_SIGNAL
    assert "within 40 px" in failure.detail
