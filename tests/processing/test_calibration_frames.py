"""Images of a made-up detector are what they were before it, within the noise that their frames are said to leave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import InputError
from giantlike.image import Image
from giantlike.independent import PinholeView, Psf, StarField, random_stars, star_image
from giantlike.processing import DetectionOptions, Detections, detect_sources
from giantlike.processing.calibration_frames import CalibrationFrames, combine_frames, flat_from
from giantlike.processing.detection.noise import NoiseSource
from giantlike.stars import StarNavigation
from tests.stars.test_attitude_errors import EPOCH, STILL, _catalog
from tests.tolerances import FALSE_ALARM

SIDE = 384
GAIN, READ_E = 2.0, 6.0
DETECTOR = Detector(gain_e_per_dn=GAIN, read_noise_e=READ_E, saturation_dn=60_000.0, bias_dn=300.0)
EXPOSURE_S, DARK_S = 3.0, 12.0
VIEW = PinholeView(3000.0, ((SIDE - 1) / 2, (SIDE - 1) / 2), SIDE, SIDE)


@dataclass(frozen=True)
class Sensor:
    """Bias with columns of its own, dark current with hot pixels, vignetting, dust and unequal pixels: numpy alone."""

    bias_dn: Float
    dark_dn_s: Float
    response: Float

    @classmethod
    def made_up(cls, rng: np.random.Generator) -> Sensor:
        y, x = np.indices((SIDE, SIDE)).astype(float)
        bias = 300.0 + 8.0 * np.sin(x / 3.0) + rng.normal(0.0, 6.0, SIDE)[None, :]
        dark = 4.0 + 2.0 * y / SIDE
        dark.ravel()[rng.choice(SIDE**2, 300, replace=False)] += rng.uniform(150.0, 3000.0, 300)
        response = 1.0 - 0.25 * np.hypot(x - SIDE / 2, y - SIDE / 2) ** 2 / (2.0 * (SIDE / 2) ** 2)
        response *= 1.0 + 0.02 * rng.standard_normal((SIDE, SIDE))
        for center in rng.uniform(20, SIDE - 20, (25, 2)):
            response *= 1.0 - 0.25 * np.exp(
                -0.5 * ((np.hypot(*(center - np.stack([x, y], 2)).transpose(2, 0, 1)) - 4) / 2) ** 2
            )
        response.ravel()[rng.choice(SIDE**2, 40, replace=False)] = 0.03
        return cls(bias, dark, response / np.median(response))

    def expose(self, light_dn: Float | float, exposure_s: float, rng: np.random.Generator) -> NDArray[np.uint16]:
        electrons = rng.poisson(GAIN * np.maximum(light_dn * self.response + self.dark_dn_s * exposure_s, 0.0))
        numbers = self.bias_dn + (electrons + rng.normal(0.0, READ_E, electrons.shape)) / GAIN
        return np.clip(np.rint(numbers), 0, 60_000).astype(np.uint16)

    def frames(self, rng: np.random.Generator, *, biases: int = 5, darks: int = 4, flats: int = 3) -> CalibrationFrames:
        offsets = CalibrationFrames(
            bias=combine_frames([self.expose(0.0, 0.0, rng) for _ in range(biases)]),
            dark=combine_frames([self.expose(0.0, DARK_S, rng) for _ in range(darks)]),
            dark_exposure_s=DARK_S,
        )
        lit = [self.expose(400.0 + 50.0 * k, 1.0, rng) for k in range(flats)]
        return replace(offsets, flat=flat_from(lit, offsets=offsets, exposures_s=[1.0] * flats))


def _stars(rng: np.random.Generator, count: int = 250) -> tuple[Float, Float, StarField, Rotation]:
    attitude = Rotation.random(rng=rng)
    axis = attitude.inv().apply([0.0, 0.0, 1.0])
    field = random_stars(rng, count, axis=axis, radius_rad=0.09, magnitudes=(3.0, 5.0))
    light, places = star_image(field, VIEW, attitude, psf=Psf(0.9), zero_point_dn=1.5e6)
    return light, places, field, attitude


def _squared_errors(found: Detections, places: Float) -> Float:
    """Squared error over covariance of each star that has no neighbor."""
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(len(places))
    alone = places[(apart.min(axis=1) > 15.0) & (np.abs(places - SIDE / 2) < SIDE / 2 - 12).all(axis=1)]
    squares = []
    for place in alone:
        away = found.points_px - place
        k = int(np.argmin(np.hypot(*away.T)))
        if np.hypot(*away[k]) < 1.0 and found.clean[k]:
            squares.append(away[k] @ np.linalg.solve(found.covariance_px2[k], away[k]))
    return np.array(squares)


def _centroids(image: NDArray[np.generic], detector: Detector, mask: NDArray[np.bool_] | None) -> Detections:
    options = DetectionOptions(noise=NoiseSource.DETECTOR)
    found = detect_sources(image, detector=detector, psf_sigma_px=0.9, mask=mask, options=options)
    assert isinstance(found, Detections)
    return found


@pytest.mark.monte_carlo(few=2, full=4)
def test_squared_errors_of_star_centroids_are_in_band_with_few_frames_and_only_with_their_noise(draws: int) -> None:
    told, untold = [], []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        sensor = Sensor.made_up(rng)
        light, places, _, _ = _stars(rng)
        exposure = sensor.expose(light + 20.0, EXPOSURE_S, rng)
        done = sensor.frames(rng).apply(exposure, DETECTOR, exposure_s=EXPOSURE_S)
        silent = replace(done.detector, frame_noise_dn=0.0, relative_noise=0.0)
        told.append(_squared_errors(_centroids(done.pixels, done.detector, done.mask), places))
        untold.append(_squared_errors(_centroids(done.pixels, silent, done.mask), places))
    squares = np.concatenate(told)
    low, high = (chi2.ppf(part, 2 * len(squares)) / len(squares) for part in (FALSE_ALARM / 2, 1 - FALSE_ALARM / 2))
    assert low < squares.mean() < high
    assert np.concatenate(untold).mean() > high


@pytest.mark.monte_carlo(few=2, full=3)
def test_attitudes_hold_in_calibrated_images_and_are_worse_in_raw_ones(draws: int) -> None:
    errors: dict[str, list[float]] = {"raw": [], "calibrated": []}
    squares = 0.0
    for seed in range(draws):
        rng = np.random.default_rng(100 + seed)
        sensor = Sensor.made_up(rng)
        light, _, field, attitude = _stars(rng)
        raw = Image(
            pixels=sensor.expose(light + 20.0, EXPOSURE_S, rng),
            exposure_s=EXPOSURE_S,
            camera_from_inertial=Rotation.from_rotvec(1e-4 * rng.normal(size=3)) * attitude,
            epoch=EPOCH,
            observer=STILL,
        )
        camera = Camera(
            name="test",
            columns=SIDE,
            rows=SIDE,
            model=PinholeModel(fx_px=3000.0, fy_px=3000.0, cx_px=VIEW.columns / 2 - 0.5, cy_px=VIEW.rows / 2 - 0.5),
            psf=GaussianPsf(sigma_px=0.9),
            detector=DETECTOR,
        )
        navigation = StarNavigation(camera, _catalog(field, np.zeros((len(field.magnitudes), 2))))
        for name, image in (("raw", raw), ("calibrated", raw.calibrated(sensor.frames(rng, flats=20), DETECTOR))):
            fix = navigation.solve(image).unwrap()
            error = (attitude * fix.camera_from_inertial.inv()).as_rotvec()
            errors[name].append(float(np.linalg.norm(error[:2])))
        squares += float(error @ np.linalg.solve(fix.covariance_rad2, error))
    assert np.mean(errors["calibrated"]) < 0.6 * np.mean(errors["raw"])
    assert chi2.ppf(FALSE_ALARM / 2, 3 * draws) < squares < chi2.ppf(1 - FALSE_ALARM / 2, 3 * draws)


def test_the_noise_of_even_light_is_what_the_detector_says_and_bad_pixels_are_masked() -> None:
    rng = np.random.default_rng(5)
    sensor = Sensor.made_up(rng)
    done = sensor.frames(rng).apply(sensor.expose(500.0, EXPOSURE_S, rng), DETECTOR, exposure_s=EXPOSURE_S)
    near_one = ~done.mask & (np.abs(sensor.response - 1.0) < 0.02)
    away = done.pixels[near_one] - np.median(done.pixels[near_one])
    assert np.mean(away**2) / done.detector.variance_dn2(np.array(500.0)) == pytest.approx(
        1.0, abs=0.03
    )  # 3 % of noise^2
    assert done.mask[sensor.response < 0.1].all()
    hot = sensor.dark_dn_s > 100.0
    assert done.mask[hot].mean() > 0.99
    assert done.mask[~hot & (sensor.response > 0.5)].mean() < 1e-3


def test_a_particle_in_one_exposure_leaves_no_mark() -> None:
    rng = np.random.default_rng(6)
    exposures = rng.normal(100.0, 3.0, (5, 64, 64))
    exposures[2, 30:33, 20] = 9000.0
    mean = combine_frames(exposures)
    assert np.abs(mean.pixels - 100.0).max() < 5.0 * 3.0 / np.sqrt(4)
    assert mean.noise == pytest.approx(3.0 / np.sqrt(5), rel=0.03)


def test_saturated_pixels_stay_so_whatever_is_taken_off() -> None:
    rng = np.random.default_rng(7)
    sensor = Sensor.made_up(rng)
    light = np.full((SIDE, SIDE), 500.0)
    light[100:104, 100:104] = 3e5
    done = sensor.frames(rng).apply(sensor.expose(light, EXPOSURE_S, rng), DETECTOR, exposure_s=EXPOSURE_S)
    over = done.pixels >= done.detector.saturation_dn
    assert (over | done.mask)[100:104, 100:104].all()
    assert np.count_nonzero(over) <= 16


def test_a_dark_with_its_bias_fits_its_own_exposure_only() -> None:
    rng = np.random.default_rng(8)
    dark = combine_frames(rng.normal(110.0, 3.0, (3, 32, 32)))
    alone = CalibrationFrames(dark=dark, dark_exposure_s=10.0)
    image = rng.normal(110.0, 3.0, (32, 32))
    assert abs(float(np.mean(alone.apply(image, DETECTOR, exposure_s=10.05).pixels))) < 0.5
    with pytest.raises(InputError, match="add bias frames, or darks of that exposure"):
        alone.apply(image, DETECTOR, exposure_s=5.0)
    with pytest.raises(InputError, match="exposure of the image is not known"):
        alone.apply(image, DETECTOR)
    with pytest.raises(InputError, match="exposure of the dark frames is not known"):
        CalibrationFrames(dark=dark)


def test_frames_of_other_sizes_and_dark_flats_are_refused() -> None:
    small, large = (combine_frames([np.full((n, n), 5.0)]) for n in (8, 9))
    with pytest.raises(InputError, match="calibration frames differ in size"):
        CalibrationFrames(bias=small, flat=large)
    with pytest.raises(InputError, match="same window and binning"):
        CalibrationFrames(bias=small).apply(np.zeros((9, 9)), DETECTOR)
    with pytest.raises(InputError, match="a flat must be > 0 once bias and dark are off"):
        flat_from([np.full((8, 8), 4.0)], offsets=CalibrationFrames(bias=small))
