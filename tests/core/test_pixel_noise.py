"""Step and noise of the pixels of an image, and the detector in their unit."""

from __future__ import annotations

import numpy as np
import pytest

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.pixel_noise import UNKNOWN_READ_NOISE_E, estimate_noise, sky_noise, value_step

NOISE = 0.05  # relative: 256 pixels a block, 64 blocks
SLOPE = 0.15  # relative: a quantile of the variances of about a hundred blocks, each known to 9 %
UNKNOWN = Detector(estimated=True, bias_dn=0.0)


def sky(seed: int = 1, *, read_dn: float = 4.0) -> Float:
    """A frame of 200 x 160 whole numbers: noise on a slope, a bright disk and stars."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((160, 200))
    level = 300.0 + 0.5 * columns - 0.2 * rows + 2000.0 * (np.hypot(columns - 120, rows - 60) < 40.0)
    level[rng.integers(160, size=30), rng.integers(200, size=30)] += 500.0
    return np.asarray(np.rint(level + rng.normal(0.0, read_dn, level.shape)))


@pytest.mark.parametrize("scale", [1.0, 16.0, 1.0 / 3.0, 1e-4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_step_of_scaled_numbers_is_their_scale(scale: float, dtype: type) -> None:
    assert value_step((scale * sky()).astype(dtype)) == pytest.approx(scale, rel=1e-4, abs=0.0)


def test_numbers_without_a_common_step_or_too_few_have_none() -> None:
    flat_field = 1.0 + 0.01 * np.random.default_rng(2).normal(size=(160, 200))
    assert value_step(sky() * flat_field) < 1e-6
    assert value_step(np.where(sky() > 1000, 3.7, 0.0)) == 0.0
    assert value_step(np.where(sky() > 1000, 3000, 0)) == 1.0


def test_noise_is_that_of_the_dark_whatever_its_slope_and_the_bright_body() -> None:
    assert sky_noise(sky()) == pytest.approx(np.hypot(4.0, 1.0 / np.sqrt(12.0)), rel=NOISE, abs=0.0)
    hole = np.zeros((160, 200), dtype=bool)
    hole[:, :100] = True
    broken = np.where(hole, 1e6 * np.random.default_rng(3).normal(size=hole.shape), sky())
    assert sky_noise(broken, hole) == pytest.approx(4.0, rel=2 * NOISE, abs=0.0)
    assert sky_noise(np.where(sky() > 1500, 3000.0, 0.0)) == 0.0


def test_an_unknown_detector_takes_the_noise_of_the_image_in_its_own_unit() -> None:
    counts = UNKNOWN.of_image(sky())
    reflectances = UNKNOWN.of_image(1e-4 * sky())
    signal = np.array([0.0, 100.0, 2000.0])
    expected = counts.read_noise_e**2 / counts.gain_e_per_dn**2 + signal / counts.gain_e_per_dn + 1.0 / 12.0
    assert counts.read_noise_e / counts.gain_e_per_dn == pytest.approx(4.0, rel=NOISE, abs=0.0)
    np.testing.assert_allclose(counts.variance_dn2(signal), expected, rtol=1e-12)
    np.testing.assert_allclose(reflectances.variance_dn2(1e-4 * signal), 1e-8 * expected, rtol=1e-3)
    assert counts.of_image(sky(2)) is counts  # known by then


def lit_disk(seed: int, *, gain_e_per_dn: float, read_dn: float, texture: float = 0.0) -> Float:
    """A frame of 320 x 320 DN: a disk that covers more than half of it, with shot noise, texture on one half."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((320, 320))
    level = 150.0 * (np.hypot(columns - 160, rows - 160) < 135.0) * (0.5 + columns / 640)
    level *= np.where(columns < 160, 1.0 + texture * rng.normal(size=level.shape), 1.0)
    return np.asarray(level + rng.normal(size=level.shape) * np.sqrt(read_dn**2 + level.clip(0.0) / gain_e_per_dn))


def test_the_gain_follows_from_the_noise_of_bright_parts_even_where_half_of_them_have_a_texture() -> None:
    for texture in (0.0, 0.2):
        noise = estimate_noise(lit_disk(5, gain_e_per_dn=2.0, read_dn=3.0, texture=texture), step_dn=0.0)
        assert noise.in_sky
        assert noise.in_light
        assert noise.read_noise_dn == pytest.approx(3.0, rel=NOISE, abs=0.0)
        assert noise.gain_e_per_dn == pytest.approx(2.0, rel=SLOPE, abs=0.0)


def test_the_sky_of_a_clipped_image_is_not_sought_on_the_body_that_covers_most_of_the_frame() -> None:
    clipped = np.rint(lit_disk(6, gain_e_per_dn=2.0, read_dn=3.0, texture=0.2) - 20.0).clip(0, 255).astype(np.uint8)
    assert sky_noise(clipped) == 0.0
    noise = estimate_noise(clipped, step_dn=1.0)
    assert not noise.in_sky
    assert noise.read_noise_dn == pytest.approx(1.0 / np.sqrt(12.0))
    # What the clipping took off is part of the light here: noise over what is left of it is larger.
    assert 0.6 < noise.gain_e_per_dn < 2.0


def test_without_bright_parts_or_noise_the_read_noise_is_taken_to_be_the_usual_one() -> None:
    stars = estimate_noise(sky()[:, :60], step_dn=1.0)
    assert not stars.in_light
    assert stars.gain_e_per_dn * stars.read_noise_dn == pytest.approx(UNKNOWN_READ_NOISE_E)
    rendered = np.where(sky() > 1500, 3000.0, 0.0)
    assert estimate_noise(rendered, step_dn=1.0).read_noise_dn == UNKNOWN_READ_NOISE_E


def test_declared_noise_is_kept_and_estimated_noise_is_named() -> None:
    pixels = lit_disk(7, gain_e_per_dn=2.0, read_dn=3.0)
    declared = Detector(gain_e_per_dn=7.0, read_noise_e=11.0).of_image(pixels)
    assert (declared.gain_e_per_dn, declared.read_noise_e, declared.noise_of_image) == (7.0, 11.0, None)
    assert UNKNOWN.of_image(pixels).noise_of_image == estimate_noise(pixels, step_dn=value_step(pixels))


def test_a_known_detector_keeps_its_noise_and_adds_the_quantization_of_the_image() -> None:
    known = Detector(gain_e_per_dn=2.0, read_noise_e=8.0)
    assert known.of_image(sky()).variance_dn2(np.zeros(1)) == pytest.approx(16.0 + 1.0 / 12.0)
    assert known.of_image(16 * sky()).variance_dn2(np.zeros(1)) == pytest.approx(16.0 + 256.0 / 12.0)
    assert known.of_image(sky() + np.random.default_rng(4).uniform(size=(160, 200))).step_dn == pytest.approx(
        0.0, abs=1e-6
    )


def test_a_detector_whose_read_noise_exceeds_all_of_an_image_is_not_in_its_unit() -> None:
    found = Detector(gain_e_per_dn=20.0, read_noise_e=40.0, bias_dn=100.0).of_image(1e-4 * sky())
    assert found.bias_dn == 0.0
    assert np.sqrt(found.variance_dn2(np.zeros(1))[0]) == pytest.approx(4e-4, rel=2 * NOISE, abs=0.0)


def test_a_camera_file_without_a_gain_and_a_read_noise_leaves_them_to_the_images() -> None:
    table = {"name": "c", "columns": 20, "rows": 20, "fov_deg": 5.0}
    assert Camera.from_mapping(table).detector.estimated
    partly = Camera.from_mapping(table | {"detector": {"saturation_dn": 255.0}})
    assert partly.detector == Detector(saturation_dn=255.0, estimated=True)
    assert Camera.from_mapping(partly.to_mapping()) == partly
    assert not Camera.from_mapping(table | {"detector": {"gain_e_per_dn": 2.0}}).detector.estimated


def test_one_pixel_beyond_the_read_noise_tells_the_unit_of_floating_point_numbers() -> None:
    stated = Detector(read_noise_e=10.0, gain_e_per_dn=1.0, bias_dn=100.0)
    reflectance = np.random.default_rng(3).uniform(0.0, 0.5, (60, 70))
    assert stated.of_image(reflectance).bias_dn == 0.0
    reflectance[31, 17] = 40.0  # between those that are looked at first
    assert stated.of_image(reflectance).bias_dn == 100.0
