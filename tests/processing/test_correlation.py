"""Normalized correlation: against sums written out and an FFT oracle, with masks, at edges, and its sub-pixel peak."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.ndimage import fourier_shift, gaussian_filter
from scipy.signal import fftconvolve
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.correlate import (
    CorrelationOptions,
    CorrelationPeak,
    find_peak,
    locate_template,
    normalized_correlation,
)
from tests.tolerances import FLOAT64_SUM, RARE

SINGLE_PRECISION = 1e-5  # OpenCV sums in float32
PARABOLOID_PX = 1e-9  # a paraboloid is fitted exactly
SMOOTH_PEAK_PX = 0.05  # a paraboloid through a smooth but not parabolic peak


def texture(shape: tuple[int, int], seed: int, blur_px: float = 1.5) -> Float:
    return np.asarray(gaussian_filter(np.random.default_rng(seed).normal(size=shape), blur_px) * 300.0 + 40.0)


def brute_force(image: Float, template: Float, image_ok: NDArray[np.bool_], template_ok: NDArray[np.bool_]) -> Float:
    h, w = template.shape
    surface = np.empty((image.shape[0] - h + 1, image.shape[1] - w + 1))
    for j in range(surface.shape[0]):
        for i in range(surface.shape[1]):
            both = image_ok[j : j + h, i : i + w] & template_ok
            surface[j, i] = np.corrcoef(image[j : j + h, i : i + w][both], template[both])[0, 1]
    return surface


def fft_oracle(image: Float, template: Float) -> Float:
    pattern = template - template.mean()
    ones = np.ones_like(template)
    cross = fftconvolve(image, pattern[::-1, ::-1], mode="valid")
    mean, square = fftconvolve(image, ones, mode="valid"), fftconvolve(image**2, ones, mode="valid")
    return np.asarray(cross / np.sqrt((pattern**2).sum() * (square - mean**2 / ones.size)))


def test_correlation_without_masks_agrees_with_an_fft_oracle() -> None:
    image, template = texture((90, 110), 1), texture((31, 24), 2)
    assert_allclose(normalized_correlation(image, template), fft_oracle(image, template), rtol=0, atol=SINGLE_PRECISION)


def test_correlation_keeps_its_precision_on_a_high_background() -> None:
    image, template = texture((60, 60), 1), texture((21, 21), 2)
    surface = normalized_correlation(image + 1e5, template + 1e5)
    assert_allclose(surface, fft_oracle(image, template), rtol=0, atol=SINGLE_PRECISION)


@pytest.mark.parametrize("size", [(40, 46), (21, 24)], ids=["many shifts", "few shifts"])
def test_masked_correlation_agrees_with_sums_written_out(size: tuple[int, int]) -> None:
    image, template = texture(size, 3), texture((17, 21), 4)
    random = np.random.default_rng(5)
    image_ok, template_ok = random.uniform(size=image.shape) > 0.3, random.uniform(size=template.shape) > 0.2
    surface = normalized_correlation(image, template, image_usable=image_ok, template_usable=template_ok)
    assert_allclose(surface, brute_force(image, template, image_ok, template_ok), rtol=0, atol=FLOAT64_SUM)


def test_both_ways_agree_where_nothing_is_masked() -> None:
    image, template = texture((50, 60), 6), texture((21, 17), 7)
    nearly_all = np.ones(image.shape, bool)
    nearly_all[-1, -1] = False  # takes the masked way; changes the last coefficient only
    masked = normalized_correlation(image, template, image_usable=nearly_all)
    whole = normalized_correlation(image, template)
    assert_allclose(masked[:-1, :-1], whole[:-1, :-1], rtol=0, atol=SINGLE_PRECISION)


@given(
    gain=st.floats(0.01, 100.0), offset=st.floats(-1000.0, 1000.0), row=st.integers(0, 20), column=st.integers(0, 30)
)
@settings(max_examples=30, deadline=None)
def test_a_part_of_the_image_is_found_whatever_its_gain_and_offset(
    gain: float, offset: float, row: int, column: int
) -> None:
    image = texture((52, 66), 8)
    template = gain * image[row : row + 32, column : column + 36] + offset
    surface = normalized_correlation(image, template)
    assert int(np.argmax(surface)) == row * surface.shape[1] + column
    assert_allclose(surface[row, column], 1.0, rtol=0, atol=1e-4)  # gain and offset cost digits
    assert np.nanmax(np.abs(surface)) <= 1.0 + 1e-4


def test_a_window_without_contrast_is_undefined_and_never_the_peak() -> None:
    image = np.full((40, 60), 12.5)
    image[:, 35:] = texture((40, 25), 9)
    surface = normalized_correlation(image, texture((11, 11), 10))
    assert np.isnan(surface[:, :25]).all()
    assert np.isfinite(surface[:, 26:]).all()


def test_a_template_without_contrast_gives_nothing() -> None:
    assert np.isnan(normalized_correlation(texture((30, 30), 1), np.full((9, 9), 3.0))).all()


def test_small_overlaps_are_undefined() -> None:
    image, template = texture((40, 40), 11), texture((20, 20), 12)
    usable = np.zeros(image.shape, bool)
    usable[:, 20:] = True
    surface = normalized_correlation(image, template, image_usable=usable, min_overlap=0.5)
    assert np.isnan(surface[:, :10]).all()
    assert np.isfinite(surface[:, 10:]).all()


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match="must not be larger"):
        normalized_correlation(np.zeros((5, 5)), np.zeros((6, 3)))
    with pytest.raises(InputError, match="image_usable"):
        normalized_correlation(np.zeros((5, 5)), np.zeros((3, 3)), image_usable=np.ones((4, 5), bool))


@pytest.mark.parametrize("options", [{"search_px": 0}, {"min_score": 1.0}, {"min_overlap": 0.0}])
def test_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        CorrelationOptions(**options)  # type: ignore[arg-type]


@given(x=st.floats(-0.6, 0.6), y=st.floats(-0.6, 0.6), twist=st.floats(-0.5, 0.5))
@settings(max_examples=50, deadline=None)
def test_the_peak_of_a_paraboloid_is_found_exactly(x: float, y: float, twist: float) -> None:
    rows, columns = np.mgrid[:9, :11]
    u, v = columns - (5 + x), rows - (4 + y)
    surface = 0.9 - 0.01 * (u**2 + 1.3 * v**2 + twist * u * v)
    peak = find_peak(surface)
    assert peak is not None
    assert_allclose(peak.offset_px, [5 + x, 4 + y], rtol=0, atol=PARABOLOID_PX)


@pytest.mark.monte_carlo(few=60, full=150)
def test_the_covariance_of_the_peak_holds_under_noise(draws: int) -> None:
    """Scenes that are shifted exactly, by Fourier transform, and noise as strong as the scene or half so."""
    rows, columns = np.indices((96, 96)) - 47.5
    envelope = np.exp(-(rows**2 + columns**2) / (2.0 * 10.0**2))
    for noise_over_scene in (0.5, 1.0):
        random = np.random.default_rng(17)
        nees: list[float] = []
        for _ in range(draws):
            scene = np.asarray(gaussian_filter(random.normal(size=(96, 96)), 2.0, mode="wrap")) * envelope
            shift = random.uniform(-2.0, 2.0, 2)
            moved = np.real(np.fft.ifft2(fourier_shift(np.fft.fft2(scene), shift[::-1])))
            pixels = moved + noise_over_scene * scene[24:72, 24:72].std() * random.normal(size=scene.shape)
            usable = random.uniform(size=scene.shape) > 0.1
            template = scene[24:72, 24:72]
            peak = found(locate_template(pixels, usable, template, (24, 24), options=CorrelationOptions(search_px=8)))
            error = peak.offset_px - shift
            nees.append(float(error @ np.linalg.solve(peak.covariance_px2, error)))
        low, high = (float(chi2.ppf(q, 2 * draws)) / draws for q in (RARE, 1.0 - RARE))
        assert low < np.mean(nees) < high


def test_a_peak_that_is_not_rounded_or_of_unknown_support_has_no_finite_covariance() -> None:
    surface = np.zeros((7, 7))
    surface[0, 3] = 1.0
    for n_pixels in (0, 100):
        peak = find_peak(surface, n_pixels=n_pixels)
        assert peak is not None
        assert np.isinf(np.diag(peak.covariance_px2)).all()


def test_a_peak_on_the_border_or_next_to_nothing_is_said_to_be_at_the_edge() -> None:
    surface = np.zeros((7, 7))
    surface[0, 3] = 1.0
    border = find_peak(surface)
    surface[0, 3], surface[3, 3], surface[3, 4] = 0.0, 1.0, np.nan
    beside = find_peak(surface)
    assert border is not None
    assert border.at_edge
    assert beside is not None
    assert beside.at_edge
    assert find_peak(np.full((3, 3), np.nan)) is None


def test_a_saddle_leaves_the_peak_on_its_pixel() -> None:
    surface = np.zeros((5, 5))
    surface[1:4, 1:4] = [[0.999, 0.9, 0.8], [0.99, 1.0, 0.99], [0.8, 0.9, 0.999]]  # rises along one diagonal in the fit
    peak = find_peak(surface)
    assert peak is not None
    assert_allclose(peak.offset_px, [2.0, 2.0], rtol=0, atol=0)


def found(outcome: CorrelationPeak | Failure) -> CorrelationPeak:
    assert isinstance(outcome, CorrelationPeak), outcome
    return outcome


def reason(outcome: CorrelationPeak | Failure) -> Reason:
    assert isinstance(outcome, Failure)
    return outcome.reason


OPTIONS = CorrelationOptions(search_px=12)


def blob(shape: tuple[int, int], x: float, y: float) -> Float:
    rows, columns = np.indices(shape)
    return np.asarray(900.0 * np.exp(-((columns - x) ** 2 / 18.0 + (rows - y) ** 2 / 11.0)))


def test_a_template_is_located_to_a_fraction_of_a_pixel() -> None:
    pixels = blob((100, 120), 60.3, 47.8) + np.random.default_rng(1).normal(0, 5, (100, 120))
    template = blob((31, 31), 15.0, 15.0)
    peak = found(locate_template(pixels, np.ones(pixels.shape, bool), template, (40, 35), options=OPTIONS))
    assert_allclose(peak.offset_px, [60.3 - 55.0, 47.8 - 50.0], rtol=0, atol=SMOOTH_PEAK_PX)


def test_a_template_larger_than_the_frame_is_located() -> None:
    scene = texture((160, 160), 20, blur_px=3.0)
    pixels = scene[30:110, 40:120]
    shift = (5, -4)
    template = np.roll(scene, shift[::-1], axis=(0, 1))  # predicted 5 px too far right, 4 px too far up
    peak = found(locate_template(pixels, np.ones(pixels.shape, bool), template, (-40, -30), options=OPTIONS))
    assert_allclose(peak.offset_px, [-5.0, 4.0], rtol=0, atol=SMOOTH_PEAK_PX)


def test_bad_pixels_do_not_pull_the_peak() -> None:
    pixels = blob((100, 120), 60.0, 50.0)
    usable = np.ones(pixels.shape, bool)
    usable[:, 63:66] = False
    spoiled = np.where(usable, pixels, 4000.0)
    peak = found(locate_template(spoiled, usable, blob((31, 31), 15.0, 15.0), (40, 35), options=OPTIONS))
    assert_allclose(peak.offset_px, [5.0, 0.0], rtol=0, atol=SMOOTH_PEAK_PX)


def test_what_cannot_be_located_is_refused_with_a_reason() -> None:
    template, everywhere = blob((31, 31), 15.0, 15.0), np.ones((100, 120), bool)
    noise = np.random.default_rng(2).normal(0, 5, (100, 120))
    at = (40, 35)
    assert reason(locate_template(noise, everywhere, template, at, options=OPTIONS)) is Reason.LOW_CORRELATION
    assert reason(locate_template(np.zeros((100, 120)), everywhere, template, at, options=OPTIONS)) is Reason.NO_SIGNAL
    assert reason(locate_template(noise, everywhere, template, (500, 35), options=OPTIONS)) is Reason.OUT_OF_FRAME
    assert reason(locate_template(noise, ~everywhere, template, at, options=OPTIONS)) is Reason.OUT_OF_FRAME
    beyond = blob((100, 120), 55.0 + 14.0, 50.0) + noise
    assert reason(locate_template(beyond, everywhere, template, at, options=OPTIONS)) is Reason.PEAK_AT_EDGE
