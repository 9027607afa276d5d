"""Expected stars and attitudes, against fields drawn and recorded by ``giantlike.independent``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import rotate, rotation_between
from giantlike.core.outcomes import AttitudeFix, Reason
from giantlike.core.photometry import Photometry
from giantlike.core.time import time_from_et
from giantlike.image import Image, ObserverState
from giantlike.independent import PinholeView, Psf, Recorder, StarField, random_stars, record, star_image
from giantlike.planning import expect_stars
from giantlike.processing.detection.detections import Detections
from giantlike.stars.navigation import StarNavigation
from giantlike.stars.options import StarOptions
from tests.simulated import catalog_of_directions

SIZE, FOCAL_PX, SIGMA_PX, GAIN, READ_E = 384, 1500.0, 0.9, 2.0, 8.0
ZERO_E_S, FIELDS = 3.0e6, 16
CAMERA = Camera(
    name="stars",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=(SIZE - 1) / 2, cy_px=(SIZE - 1) / 2),
    psf=GaussianPsf(sigma_px=SIGMA_PX),
    detector=Detector(gain_e_per_dn=GAIN, read_noise_e=READ_E, bias_dn=50.0),
    photometry=Photometry(zero_point_e_s=ZERO_E_S),
)


def field_image(seed: int, stars: int = 300) -> tuple[Image, StarField]:
    """A recorded field, with the true attitude a priori, and its stars."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed)
    field = random_stars(rng, stars, axis=attitude.as_matrix()[2], radius_rad=0.19, magnitudes=(4.0, 12.0))
    view = PinholeView(FOCAL_PX, ((SIZE - 1) / 2, (SIZE - 1) / 2), SIZE, SIZE)
    light, _ = star_image(field, view, attitude, psf=Psf(sigma_px=SIGMA_PX), zero_point_dn=ZERO_E_S / GAIN)
    seen = record(light, rng, Recorder(gain_e_per_dn=GAIN, read_noise_e=READ_E, bias_dn=50.0))
    pixels = seen.pixels.astype(np.uint16)
    at_rest = ObserverState(position_km=np.zeros(3), velocity_km_s=np.zeros(3))
    image = Image(
        pixels=pixels, exposure_s=1.0, camera_from_inertial=attitude, epoch=time_from_et(7e8), observer=at_rest
    )
    return image, field


def test_expected_stars_and_attitudes_are_those_found() -> None:
    inside, surprises, ratios, squares = [], [], [], []
    for seed in range(FIELDS):
        image, field = field_image(seed)
        catalog = catalog_of_directions(field.directions, field.magnitudes)
        forecast = expect_stars(image, CAMERA, catalog)
        found, fix = StarNavigation(CAMERA, catalog).detect_and_solve(image)
        assert isinstance(found, Detections)
        assert isinstance(fix, AttitudeFix)
        assert image.camera_from_inertial is not None
        assert forecast.covariance_rad2 is not None
        count = len(found) + (0 if found.left_out is None else len(found.left_out.peaks_px))
        inside.append(forecast.low <= count <= forecast.high)
        surprises.append((count - forecast.expected) / np.sqrt(forecast.expected))
        ratios.append(np.sqrt(np.trace(forecast.covariance_rad2[:2, :2]) / np.trace(fix.covariance_rad2[:2, :2])))
        error = rotation_between(fix.camera_from_inertial, image.camera_from_inertial)
        squares.append(error @ np.linalg.solve(forecast.covariance_rad2, error))
    assert np.mean(inside) >= 0.75  # 95 % but for the noise that detection estimates: 88 % of 60 fields
    assert abs(np.mean(surprises)) < 0.3  # Poisson sigmas; 0.10 in 60 fields
    assert 0.9 <= np.median(ratios) <= 1.1
    assert chi2.ppf(0.005, 3 * FIELDS) < np.sum(squares) < chi2.ppf(0.995, 3 * FIELDS)


def test_trails_and_bodies_hide_stars_and_a_zero_point_widens_the_interval() -> None:
    image, field = field_image(1)
    catalog = catalog_of_directions(field.directions, field.magnitudes)
    doubt = Photometry(zero_point_e_s=ZERO_E_S, covariance_mag2=np.diag([0.25, 0.0, 0.0]))
    sharp = expect_stars(image, CAMERA, catalog)
    trailed = expect_stars(image, CAMERA, catalog, blur_px=(0.0, 12.0))
    hidden = expect_stars(image, CAMERA, catalog, body=(CAMERA.center_px, 100.0))
    doubtful = expect_stars(image, replace(CAMERA, photometry=doubt), catalog)
    assert trailed.expected < 0.8 * sharp.expected
    assert hidden.in_field < sharp.in_field
    assert doubtful.high - doubtful.low > 2.0 * (sharp.high - sharp.low)
    assert doubtful.expected == sharp.expected


def test_without_a_zero_point_the_catalog_is_counted_and_no_attitude_follows() -> None:
    image, field = field_image(2)
    catalog = catalog_of_directions(field.directions, field.magnitudes)
    seen = CAMERA.model.project(rotate(image.camera_from_inertial, field.directions))  # type: ignore[arg-type]
    counted = expect_stars(image, replace(CAMERA, photometry=None), catalog)
    assert counted.in_field == counted.expected == CAMERA.contains(seen).sum()
    assert counted.covariance_rad2 is None
    few = expect_stars(image, CAMERA, catalog, options=StarOptions(max_magnitude=4.5))
    assert few.failure is not None
    assert few.failure.reason is Reason.NO_CATALOG_STARS
    dim = expect_stars(image, replace(CAMERA, photometry=Photometry(zero_point_e_s=1.0)), catalog)
    assert dim.failure is not None
    assert dim.failure.reason is Reason.TOO_FEW_DETECTIONS
    blind = expect_stars(replace(image, camera_from_inertial=None), CAMERA, catalog)
    assert blind.failure is not None
    assert blind.failure.reason is Reason.NO_ATTITUDE
