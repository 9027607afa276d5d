"""An attitude stops at the brightest stars where the others would add little, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.image import Image
from giantlike.independent import PinholeView, Psf, Recorder, StarField, background, random_stars, record, star_image
from giantlike.processing import Detections
from giantlike.processing.detection.detect import detect_in_parts
from giantlike.stars import StarNavigation, StarOptions
from tests.stars.test_attitude_errors import EPOCH, STILL, _catalog
from tests.tolerances import FALSE_ALARM

SIDE = 512
VIEW = PinholeView(3000.0, (255.5, 255.5), SIDE, SIDE)
STARS = 1600


def _scene(
    seed: int, *, catalog_error_rad: float = 0.0, bent_rad: float = 0.0
) -> tuple[Image, StarNavigation, Rotation]:
    """Image of a rich field, its navigation, and the true attitude."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(rng=rng)
    field = random_stars(
        rng, STARS, axis=attitude.inv().apply([0.0, 0.0, 1.0]), radius_rad=0.13, magnitudes=(4.0, 10.0)
    )
    light, _ = star_image(field, VIEW, attitude, psf=Psf(0.9))
    recorder = Recorder(gain_e_per_dn=2.0, read_noise_e=5.0)
    pixels = record(light + background(light.shape, constant_dn=100.0), rng, recorder).pixels
    apriori = Rotation.from_rotvec(1e-4 * rng.normal(size=3)) * attitude
    told: Float = field.directions + catalog_error_rad * rng.normal(size=field.directions.shape)
    told += bent_rad * np.sin(20.0 * field.directions[:, [1, 2, 0]])  # over half of the frame
    told /= np.linalg.norm(told, axis=1, keepdims=True)
    model = PinholeModel(fx_px=3000.0, fy_px=3000.0, cx_px=255.5, cy_px=255.5)
    camera = Camera(
        name="test",
        columns=SIDE,
        rows=SIDE,
        model=model,
        psf=GaussianPsf(sigma_px=0.9),
        detector=Detector(gain_e_per_dn=2.0, read_noise_e=5.0),
    )
    image = Image(pixels=pixels, camera_from_inertial=apriori, epoch=EPOCH, observer=STILL)
    catalog = _catalog(StarField(told, field.magnitudes), np.zeros((STARS, 2)))
    return image, StarNavigation(camera, catalog), attitude


def test_the_faint_stars_of_a_rich_field_are_left_out_and_the_covariance_hardly_grows() -> None:
    errors, fewer = [], 0
    for seed in range(4):
        image, navigation, attitude = _scene(seed)
        detections, outcome = navigation.detect_and_solve(image)
        fix, everything = outcome.unwrap(), navigation.detect(image)
        assert isinstance(detections, Detections)
        assert isinstance(everything, Detections)
        if detections.left_out is not None:
            fewer += 1
            assert len(detections) < 0.7 * len(everything)
            assert len(detections) + len(detections.left_out.sigma_px) == len(everything)
        options = replace(navigation.options, all_stars=True)
        whole = StarNavigation(navigation.camera, navigation.catalog, options).solve(image).unwrap()
        # 5 % of the information, and what the error floor of two samples of stars differs by
        assert np.trace(fix.covariance_rad2) < 1.12 * np.trace(whole.covariance_rad2)
        error = (attitude * fix.camera_from_inertial.inv()).as_rotvec()
        errors.append(error @ np.linalg.solve(fix.covariance_rad2, error))
    assert fewer == 4
    assert chi2.ppf(FALSE_ALARM / 2, 12) < sum(errors) < chi2.ppf(1 - FALSE_ALARM / 2, 12)


def test_all_stars_are_measured_where_an_error_common_to_bright_and_faint_ones_makes_them_worth_it() -> None:
    image, navigation, _ = _scene(9, catalog_error_rad=1e-4)  # 0.3 px, and the catalog does not say so
    detections, fix = navigation.detect_and_solve(image)
    assert isinstance(detections, Detections)
    assert detections.left_out is None
    assert fix.unwrap().n_detected > STARS / 4


def test_all_stars_are_measured_where_neighbors_share_errors_that_few_tell_badly() -> None:
    image, navigation, _ = _scene(3, bent_rad=1e-4)  # 0.3 px
    detections, fix = navigation.detect_and_solve(image)
    assert isinstance(detections, Detections)
    assert detections.left_out is None
    assert fix.unwrap().provenance["unmodeled_errors"] == "likely"


def test_bright_sources_that_are_no_stars_hold_no_information() -> None:
    image, navigation, _ = _scene(2)
    pixels = image.pixels.copy()
    y, x = np.random.default_rng(3).integers(0, SIDE, (2, 300))
    pixels[y, x] = 20000  # particles: single pixels brighter than nearly all stars
    hit = replace(image, pixels=pixels)
    some = navigation.detect(hit, replace(navigation.detection, information=0.95))
    every = navigation.detect(hit)
    assert isinstance(some, Detections)
    assert isinstance(every, Detections)
    some_hold, all_hold = (float(np.sum(each.sigma_px[each.clean] ** -2)) for each in (some, every))
    # 95 % by what noise tells before a fit; stars beside particles are measured worse than that
    assert some_hold > 0.85 * all_hold
    assert len(some) < 0.8 * len(every)
    assert not navigation.solve(hit).unwrap().flags.suspect


def test_calibrations_get_all_stars() -> None:
    image, navigation, _ = _scene(1)
    detections = navigation.detect(image)
    assert isinstance(detections, Detections)
    assert detections.left_out is None
    assert not StarOptions().all_stars


def test_sources_measured_in_two_parts_are_those_measured_at_once() -> None:
    image, navigation, _ = _scene(0)
    assert navigation.camera.psf is not None
    parts = detect_in_parts(
        image.pixels,
        (0.9, 1.0),
        detector=navigation.camera.detector,
        psf_sigma_px=navigation.camera.psf.sigma_px,
        options=navigation.detection,
    )
    first, both, at_once = next(parts), next(parts), navigation.detect(image)
    assert isinstance(first, Detections)
    assert isinstance(both, Detections)
    assert isinstance(at_once, Detections)
    assert first.left_out is not None
    assert both.left_out is None
    assert len(first) < len(both) == len(at_once)
    by_place = [found.select(np.lexsort(np.rint(found.points_px).T)) for found in (both, at_once)]
    alike = np.linalg.norm(by_place[0].points_px - by_place[1].points_px, axis=1) / by_place[1].sigma_px
    # stars of two parts that overlap are fitted with each other, but not always in the same rounds
    assert np.quantile(alike, 0.98) < 0.01
    assert np.mean(by_place[0].flags == by_place[1].flags) > 0.98
